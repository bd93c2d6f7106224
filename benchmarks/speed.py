"""The whole of find against what small_gicp takes to downsample and estimate normals, turn by turn in one run.

python -m benchmarks.speed --target ps --points 10e6
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import cyclopts
import numpy as np

import scanfind
from benchmarks.common import STAGES, Floats, median, seeds_of, tell, write_csv
from benchmarks.shop import TARGETS, WARM_UP_POINTS
from scanfind.grid.scene import first_cell
from scanfind.simulate.scanner import scan
from scanfind.simulate.scenes import shop
from scanfind.sought import models_of

Result = TypeVar("Result")

# Issue 2: find takes not more than small_gicp, isolation under a tenth of it.
FIND_LIMIT, ISOLATE_LIMIT = 1.0, 0.1


@dataclass(frozen=True)
class Row:
    """One turn; see README.md for the columns."""

    seed: int
    turn: int
    points: int
    cell_mm: float
    detections: int
    grid_s: float
    search_s: float
    refine_s: float
    verify_s: float
    isolate_s: float
    find_s: float
    read_s: float
    downsample_s: float
    normals_s: float
    rival_s: float
    find_ratio: float
    isolate_ratio: float


def main(
    target: str = "ps", seeds: str = "1000", points: float = 10e6, turns: int = 5, threads: int = 2, date: str = ""
) -> None:
    """Measure find and small_gicp in turn on shop scenes in memory, compiled beforehand.

    :param target: ps (pipe spool) or bf (box frame).
    :param seeds: of the scenes, `1000-1019` or `1,5,9`.
    :param points: about how many a scene has.
    :param turns: of each on each scene.
    :param threads: of both.
    :param date: written to the CSV.
    """
    mesh = TARGETS[target]()
    model = models_of(mesh, scanfind.Parameters(), None, ())[0]
    cell = first_cell([model.diameter], scanfind.Parameters().grid)
    # Both at this cell, whatever a sparser scan would make find choose.
    parameters = replace(scanfind.Parameters(), grid=replace(scanfind.Parameters().grid, cell_m=cell))
    scanfind.find(scan(shop(0, mesh), points=WARM_UP_POINTS).stations, mesh, jobs=threads)
    rows = []
    for seed in seeds_of(seeds):
        stations = scan(shop(seed, mesh), seed=seed, points=int(points)).stations
        every = np.concatenate([station.xyz for station in stations])
        for turn in range(turns):
            found = scanfind.find(stations, mesh, parameters=parameters, seed=seed, jobs=threads)
            rows.append(row := row_of(seed, turn, len(every), cell, found, rival(every, cell, threads)))
            print(row, flush=True)
    lines = summary(rows)
    tell(lines, write_csv(f"speed_{target}", rows, seeds, date, lines))


def rival(points: Floats, cell: float, threads: int) -> tuple[float, float]:
    """Seconds small_gicp takes to downsample points (N, 3) by voxels, and for the normals of what is left."""
    import small_gicp

    downsample_s, sampled = timed(lambda: small_gicp.voxelgrid_sampling(points, cell, num_threads=threads))
    normals_s, _ = timed(lambda: small_gicp.estimate_normals(sampled, num_threads=threads))
    return downsample_s, normals_s


def timed(work: Callable[[], Result]) -> tuple[float, Result]:
    """Seconds and outcome."""
    began = time.perf_counter()
    outcome = work()
    return time.perf_counter() - began, outcome


def row_of(
    seed: int, turn: int, points: int, cell: float, found: scanfind.Findings, rival_s: tuple[float, float]
) -> Row:
    """One turn's times and ratios."""
    stage = found.timings_s
    find_s = sum(stage[name] for name in STAGES)
    return Row(
        seed=seed,
        turn=turn,
        points=points,
        cell_mm=1e3 * cell,
        detections=len(found),
        grid_s=stage["grid"],
        search_s=stage["search"],
        refine_s=stage["refine"],
        verify_s=stage["verify"],
        isolate_s=stage["isolate"],
        find_s=find_s,
        read_s=stage["read"],
        downsample_s=rival_s[0],
        normals_s=rival_s[1],
        rival_s=sum(rival_s),
        find_ratio=find_s / sum(rival_s),
        isolate_ratio=stage["isolate"] / sum(rival_s),
    )


def summary(rows: list[Row]) -> list[str]:
    """Medians, and the ratios as against their limits."""
    find, isolate = median([row.find_ratio for row in rows]), median([row.isolate_ratio for row in rows])
    stages = "  ".join(f"{stage} {median([getattr(row, stage + '_s') for row in rows]):.2f}" for stage in STAGES)
    return [
        f"median seconds: find {median([r.find_s for r in rows]):.2f} ({stages}), "
        f"small_gicp {median([r.rival_s for r in rows]):.2f}",
        f"find / small_gicp: {find:.3f} (limit {FIND_LIMIT}, {'held' if find <= FIND_LIMIT else 'NOT held'})",
        f"isolate / small_gicp: {isolate:.3f} "
        f"(limit {ISOLATE_LIMIT}, {'held' if isolate <= ISOLATE_LIMIT else 'NOT held'})",
    ]


if __name__ == "__main__":
    cyclopts.run(main)
