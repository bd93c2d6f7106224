"""Statuses of a real project's steel: some elements taken out, some moved, scanned by the virtual scanner, inspected.

python -m benchmarks.inspection --seeds 4-5
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cyclopts
import numpy as np

import scanfind
from benchmarks.common import ROOT, Floats, median, seeds_of, tell, write_csv
from scanfind.cloud import PointCloud
from scanfind.design.elements import INSTALLED, NOT_FOUND
from scanfind.mesh import Mesh, Placement
from scanfind.models import read_models
from scanfind.simulate.parts import blocks
from scanfind.simulate.scanner import scan
from scanfind.simulate.scene import Scene, SceneObject

STEEL = Path("ifc") / "schependomlaan" / "ROOT-staal" / "IFC-staal.ifc"
MISSING, MOVED = 5, 10
SHIFTS_M, TURN_RAD = (0.02, 0.08), np.radians(0.3)
FLOOR = blocks("floor", [((-5, -5, -0.8), (29, 29, -0.7))])
# Around the frame and in it, on the ground and on floors that are not drawn.
STATIONS = np.array([
    [-4, -4, 1.6], [28, -4, 1.6], [28, 28, 1.6], [-4, 28, 1.6], [12, -6, 6], [12, 30, 8], [-6, 12, 9], [30, 12, 9],
    [9, 9, 1.6], [17, 12, 4.2], [12, 18, 7], [5, 18, 4],
], np.float64)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One element; see README.md for the columns."""

    seed: int
    global_id: str
    model: str
    built: str
    status: str
    off_mm: float
    built_off_mm: float
    middle_error_mm: float
    on: float
    beside: float
    through: float
    hidden: float
    total_s: float


class Built(NamedTuple):
    """An element of the design as it was built: "as designed", "moved" or "missing"; where it stands then."""

    mesh: Mesh
    placement: Placement
    how: str
    pose: scanfind.Pose


def main(
    seeds: str = "4-5", points: float = 5e6, time_limit: float = 20.0, data: Path = ROOT.parent / "shared" / "data",
    date: str = "",
) -> None:  # fmt: skip
    """Inspect scans of the steel of a housing project, a row an element.

    :param seeds: of what is changed and of the scans.
    :param points: about how many a scan has.
    :param time_limit: for elements that are not in their place, seconds.
    :param data: folder that holds ifc/schependomlaan.
    :param date: written to the CSV.
    """
    meshes = [mesh for mesh in read_models(data / STEEL) if isinstance(mesh, Mesh) and "Kubus" not in mesh.name]
    rows = [row for seed in seeds_of(seeds) for row in rows_of(seed, meshes, int(points), time_limit)]
    lines = []
    for how in ("as designed", "moved", "missing"):
        these = [row for row in rows if row.built == how]
        counts = {status: sum(row.status == status for row in these) for status in sorted({r.status for r in these})}
        lines.append(f"{how}: {len(these)} elements, " + ", ".join(f"{n} {status}" for status, n in counts.items()))
    still = [row.off_mm for row in rows if row.built == "as designed" and row.status == INSTALLED]
    moved = [row.middle_error_mm for row in rows if row.built == "moved" and row.status == INSTALLED]
    lines.append(
        f"as designed, told to be off: median {median(still):.1f} mm, largest {max(still, default=0.0):.1f} mm"
    )
    lines.append(f"moved: middle wrong by {median(moved):.1f} mm (median), largest {max(moved, default=0.0):.1f} mm")
    wrong = sum(row.built != "missing" and row.status == NOT_FOUND for row in rows)
    lines.append(f"called missing and there: {wrong}; seconds a scene: {median([row.total_s for row in rows]):.0f}")
    tell(lines, write_csv("inspection", rows, seeds, date, lines))


def rows_of(seed: int, meshes: list[Mesh], points: int, time_limit: float) -> list[Row]:
    """One scan of the design with some of it changed."""
    built = changed(seed, meshes)
    parameters = scanfind.PRESETS["default"]
    parameters = replace(parameters, search=replace(parameters.search, time_limit_s=time_limit))
    stations = scanned(built, seed, points)
    began = time.perf_counter()
    found = scanfind.find(stations, meshes, parameters=parameters, at_design=True)
    total_s = time.perf_counter() - began
    poses, told = {one.id: one.scene_from_model for one in found}, []
    by_id = {one.placement.global_id: one for one in built}
    for element in found.elements:
        truth = by_id[element.placement.global_id]
        middle = truth.mesh.vertices.mean(axis=0)[None]
        stands = poses.get(element.detection or 0)
        error = float("nan") if stands is None else apart(stands, truth.pose, middle)
        spoken = (element.on, element.beside, element.through, element.hidden)
        on, beside, through, hidden = (float("nan") if share is None else share for share in spoken)
        told.append(
            Row(
                seed=seed,
                global_id=element.placement.global_id,
                model=element.model,
                built=truth.how,
                status=element.status,
                off_mm=1e3 * (float("nan") if element.off_m is None else element.off_m),
                built_off_mm=1e3 * apart(truth.pose, element.placement.design_from_model, truth.mesh.vertices),
                middle_error_mm=1e3 * error,
                on=on,
                beside=beside,
                through=through,
                hidden=hidden,
                total_s=total_s,
            )
        )
    return told


def changed(seed: int, meshes: list[Mesh]) -> list[Built]:
    """The elements as built: MISSING of them not there, MOVED shifted and turned a little."""
    rng = np.random.default_rng(seed)
    design = [(mesh, placement) for mesh in meshes for placement in mesh.placements]
    order, built = rng.permutation(len(design)).tolist(), []
    for number, (mesh, placement) in enumerate(design):
        how, pose = "as designed", placement.design_from_model
        if order.index(number) < MISSING:
            how = "missing"
        elif order.index(number) < MISSING + MOVED:
            how = "moved"
            shift = rng.normal(size=3)
            shift *= rng.uniform(*SHIFTS_M) / np.linalg.norm(shift)
            turn = scanfind.Pose.from_rotation_vector(rng.normal(size=3) * TURN_RAD).rotation @ pose.rotation
            middle = mesh.vertices.mean(axis=0)
            pose = scanfind.Pose(turn, pose.move(middle[None])[0] + shift - turn @ middle)
        built.append(Built(mesh, placement, how, pose))
    return built


def scanned(built: list[Built], seed: int, points: int) -> list[PointCloud]:
    """What the stations see of it."""
    there = [SceneObject(one.placement.name, one.mesh, one.pose, target=True) for one in built if one.how != "missing"]
    scene = Scene((SceneObject("floor", FLOOR, scanfind.Pose.identity()), *there), STATIONS)
    return scan(scene, seed=seed, points=points).stations


def apart(one: scanfind.Pose, other: scanfind.Pose, points: Floats) -> float:
    """How far two poses part the point (of N, (N, 3)) that they part the most, metres."""
    return float(np.linalg.norm(one.move(points) - other.move(points), axis=1).max())


if __name__ == "__main__":
    cyclopts.run(main)
