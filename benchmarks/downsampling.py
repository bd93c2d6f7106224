"""The pass over points in memory into the grid, against the voxel down-sampling of small_gicp and Open3D, turn by turn.

python -m benchmarks.rivals.install open3d_ransac
python -m benchmarks.downsampling --points 10e6
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cyclopts
import numpy as np

from benchmarks.common import Floats, median, tell, write_csv
from benchmarks.rivals.table import ENVIRONMENTS
from scanfind.cloud import CHUNK_POINTS, PointChunk, PointCloud
from scanfind.errors import UsageError
from scanfind.grid.moments import MomentGrid
from scanfind.simulate.objects import pipe_spool
from scanfind.simulate.scanner import scan
from scanfind.simulate.scenes import shop

# Issue 5: points a second a core, and times the throughput of the faster rival.
RATE_LIMIT, TIMES_LIMIT = 15e6, 2.0
VOXELS = Path(__file__).parent / "rivals" / "inside" / "voxels.py"


@dataclass(frozen=True)
class Row:
    """One turn; see README.md for the columns."""

    turn: int
    threads: int
    points: int
    cell_mm: float
    grid_s: float
    small_gicp_s: float
    open3d_s: float
    open3d_tensor_s: float
    points_s_core: float
    times: float


def main(
    points: float = 10e6, cell: float = 0.02, threads: str = "1,2", turns: int = 5, seed: int = 1000, date: str = ""
) -> None:
    """Sum a shop scan in memory into cells, with scanfind and with each rival in turn.

    :param points: about how many the scan has.
    :param cell: edge, metres, of ours and theirs.
    :param threads: of all, one run of turns each.
    :param turns: of each.
    :param seed: of the shop and the scan.
    :param date: written to the CSV.
    """
    stations = scan(shop(seed, pipe_spool()), seed=seed, points=int(points)).stations
    every = np.concatenate([station.xyz for station in stations])
    gridded(stations, cell, 1)  # compiled beforehand
    rows = []
    with TemporaryDirectory() as folder:
        np.save(Path(folder) / "points.npy", every)
        for count in map(int, threads.split(",")):
            with open3d(Path(folder) / "points.npy", cell, count) as ask:
                for turn in range(turns):
                    rows.append(row_of(turn, count, cell, stations, every, ask))
                    print(rows[-1], flush=True)
    lines = summary(rows)
    tell(lines, write_csv("downsampling", rows, str(seed), date, lines))


def gridded(stations: list[PointCloud], cell: float, threads: int) -> float:
    """Seconds to sum all points into a grid, with the directions they were seen from and the beams of each scanner."""
    chunks = [
        PointChunk(cloud.xyz[first : first + CHUNK_POINTS], {}, np.empty(0, np.int64), scan=k, origin=cloud.origin)
        for k, cloud in enumerate(stations)
        for first in range(0, len(cloud), CHUNK_POINTS)
    ]
    began = time.perf_counter()
    grid = MomentGrid(cell, jobs=threads)
    for chunk in chunks:
        grid.add(chunk)
    return time.perf_counter() - began


def small_gicp_s(points: Floats, cell: float, threads: int) -> float:
    """Seconds small_gicp takes for points (N, 3)."""
    import small_gicp

    began = time.perf_counter()
    small_gicp.voxelgrid_sampling(points, cell, num_threads=threads)
    return time.perf_counter() - began


class Asked:
    """A child in the rivals' environment, asked once a turn."""

    def __init__(self, child: subprocess.Popen[str]) -> None:
        self._child = child
        self._line()

    def _line(self) -> str:
        assert self._child.stdout is not None
        line = self._child.stdout.readline()
        if not line:
            msg = "Open3D's child ended early: see what it printed above"
            raise RuntimeError(msg)
        return line

    def seconds(self) -> tuple[float, float]:
        """Of Open3D's PointCloud and of its tensor's."""
        assert self._child.stdin is not None
        self._child.stdin.write("\n")
        self._child.stdin.flush()
        legacy, tensor = map(float, self._line().split())
        return legacy, tensor


@contextmanager
def open3d(points: Path, cell: float, threads: int) -> Iterator[Asked]:
    """Open3D on the points of a file; raises UsageError where its environment is not there."""
    environment = ENVIRONMENTS["open3d"]
    if not environment.is_current():
        msg = "Open3D is not installed: run `python -m benchmarks.rivals.install open3d_ransac`"
        raise UsageError(msg)
    with subprocess.Popen(
        [environment.python, VOXELS, points, str(cell)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "OMP_NUM_THREADS": str(threads)},
    ) as child:  # fmt: skip
        yield Asked(child)
        assert child.stdin is not None
        child.stdin.close()


def row_of(turn: int, threads: int, cell: float, stations: list[PointCloud], every: Floats, ask: Asked) -> Row:
    """One turn of each."""
    ours, theirs, (legacy, tensor) = (
        gridded(stations, cell, threads), small_gicp_s(every, cell, threads), ask.seconds(),
    )  # fmt: skip
    return Row(
        turn=turn, threads=threads, points=len(every), cell_mm=1e3 * cell, grid_s=ours, small_gicp_s=theirs,
        open3d_s=legacy, open3d_tensor_s=tensor, points_s_core=len(every) / ours / threads,
        times=min(theirs, legacy, tensor) / ours,
    )  # fmt: skip


def summary(rows: list[Row]) -> list[str]:
    """Medians for each number of threads, as against their limits."""
    lines = []
    for threads in sorted({row.threads for row in rows}):
        some = [row for row in rows if row.threads == threads]
        rate, times = median([row.points_s_core for row in some]), median([row.times for row in some])
        seconds = ", ".join(
            f"{name} {median([getattr(row, column) for row in some]):.2f}"
            for name, column in (
                ("grid", "grid_s"), ("small_gicp", "small_gicp_s"), ("Open3D", "open3d_s"),
                ("Open3D tensor", "open3d_tensor_s"),
            )
        )  # fmt: skip
        lines += [
            f"{threads} threads, median seconds: {seconds}",
            f"{rate / 1e6:.1f} M points/s a core (limit {RATE_LIMIT / 1e6:.0f}, "
            f"{'held' if rate >= RATE_LIMIT else 'NOT held'}), {times:.2f} x the fastest of the others "
            f"(limit {TIMES_LIMIT:g}, {'held' if times >= TIMES_LIMIT else 'NOT held'})",
        ]
    return lines


if __name__ == "__main__":
    cyclopts.run(main)
