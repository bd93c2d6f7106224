"""Statuses of a real project's steel: some of it missing, moved or swapped, scanned by the virtual scanner, inspected.

python -m benchmarks.inspection --seeds 6200-6219
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, replace
from itertools import combinations
from math import sqrt
from pathlib import Path
from typing import NamedTuple

import cyclopts
import numpy as np

import scanfind
from benchmarks.common import ROOT, Floats, median, seeds_of, tell, write_csv
from scanfind.cloud import PointCloud
from scanfind.design.elements import INSTALLED, NOT_FOUND
from scanfind.evidence.rays import RayCaster
from scanfind.library import ModelLibrary
from scanfind.mesh import Mesh, Placement
from scanfind.models import read_models
from scanfind.simulate.parts import blocks
from scanfind.simulate.placement import sample_oriented
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.sought import models_of

STEEL = Path("ifc") / "schependomlaan" / "ROOT-staal" / "IFC-staal.ifc"
DESIGNED, MOVED, MISSING, SWAPPED = "as designed", "moved", "missing", "swapped"
MANY = {MISSING: 5, MOVED: 10}
PAIRS = 2  # swapped, of one section and by so much of different lengths, metres and share of the longer
SECTION_M, LONGER_M, LONGER = 0.015, 0.02, 0.2
SHIFTS_M, TURN_RAD = (0.02, 0.08), np.radians(0.3)
VISIBLE = 0.3  # of its surface: what is asked of elements that show more is what a result is held to
EXACT_M, THERE_M = 1e-3, 0.1
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
    visible: float
    status: str
    right: int
    off_mm: float
    built_off_mm: float
    error_mm: float
    across_mm: float
    points: int
    on: float
    beside: float
    through: float
    hidden: float
    total_s: float


class Built(NamedTuple):
    """An element of the design as it was built: how (DESIGNED, …), and where it stands then."""

    mesh: Mesh
    placement: Placement
    how: str
    pose: scanfind.Pose


def main(
    seeds: str = "6100-6101", points: float = 5e6, time_limit: float = 20.0,
    data: Path = ROOT.parent / "shared" / "data", date: str = "", name: str = "inspection",
) -> None:  # fmt: skip
    """Inspect scans of the steel of a housing project, a row an element.

    :param seeds: of what is changed and of the scans.
    :param points: about how many a scan has.
    :param time_limit: for elements that are not in their place, seconds.
    :param data: folder that holds ifc/schependomlaan.
    :param date: written to the CSV.
    :param name: of the CSV.
    """
    meshes = [mesh for mesh in read_models(data / STEEL) if isinstance(mesh, Mesh) and "Kubus" not in mesh.name]
    with ModelLibrary.in_memory() as library:
        for model in models_of(meshes, scanfind.PRESETS["default"], None, ()):
            library.put(model)
        rows: list[Row] = []
        for seed in seeds_of(seeds):
            rows += rows_of(seed, meshes, library, int(points), time_limit)
            lines, done = summary(rows), ",".join(dict.fromkeys(str(row.seed) for row in rows))
            path = write_csv(name, rows, f"{done} of {seeds}", date, lines)  # a scene takes minutes: none is lost
    tell(lines, path)


def summary(rows: list[Row]) -> list[str]:
    """What was said of what, then the three lines a result is held to."""
    lines = []
    for how in (DESIGNED, MOVED, MISSING, SWAPPED):
        these = [row for row in rows if row.built == how]
        counts = Counter(row.status for row in these)
        told = ", ".join(f"{n} {status.replace('_', ' ')}" for status, n in counts.most_common())
        lines.append(f"{how}: {len(these)} elements, {told or 'none'}")
    still = [row.off_mm for row in rows if row.built == DESIGNED and row.status == INSTALLED]
    lines.append(f"as designed, told off: median {median(still):.1f} mm, largest {max(still, default=0.0):.1f} mm")
    seen = [row for row in rows if row.visible >= VISIBLE]
    right, gone = sum(row.right for row in seen), [row for row in rows if row.built != MISSING]
    moved = [row for row in seen if row.built == MOVED and row.status == INSTALLED]
    exact, across = (
        sum(getattr(row, column) <= 1e3 * limit_m(row.points) for row in moved) for column in ("error_mm", "across_mm")
    )
    return [
        *lines,
        f"seconds a scene: {median([row.total_s for row in rows]):.0f}",
        f"status right: {right} of {len(seen)} elements that show {VISIBLE:.0%} of their surface or more "
        f"({right / max(len(seen), 1):.1%}); of all {sum(row.right for row in rows)} of {len(rows)}",
        f"there and called missing: {sum(row.status == NOT_FOUND for row in gone)} of {len(gone)}, "
        f"{sum(row.status == NOT_FOUND and row.visible >= VISIBLE for row in gone)} of them showing {VISIBLE:.0%}",
        f"moved, found and showing {VISIBLE:.0%}: {exact} of {len(moved)} measured within 1 mm + noise/√n, {across} "
        f"across their length; middle wrong by {median([row.error_mm for row in moved]):.2f} mm (median), "
        f"{median([row.across_mm for row in moved]):.2f} across",
    ]


def limit_m(points: int) -> float:
    """Within how many metres a moved element is to be measured that has so many points."""
    return EXACT_M + Scanner().noise / sqrt(max(points, 1))


def rows_of(seed: int, meshes: list[Mesh], library: ModelLibrary, points: int, time_limit: float) -> list[Row]:
    """One scan of the design with some of it changed."""
    built = changed(seed, meshes)
    parameters = scanfind.PRESETS["default"]
    parameters = replace(parameters, search=replace(parameters.search, time_limit_s=time_limit))
    stations, visible = scanned(built, seed, points), visible_of(built, seed)
    began = time.perf_counter()
    found = scanfind.find(stations, library, parameters=parameters, at_design=True)
    total_s = time.perf_counter() - began
    by_id, told = {one.id: one for one in found}, []
    truths = {one.placement.global_id: (one, share) for one, share in zip(built, visible, strict=True)}
    for element in found.elements:
        truth, share = truths[element.placement.global_id]
        instance = by_id.get(element.detection or 0)
        low, high = truth.mesh.vertices.min(axis=0), truth.mesh.vertices.max(axis=0)
        middle, long = 0.5 * (low + high)[None], np.eye(3)[np.argmax(high - low)]
        error = np.full(3, np.nan)
        if instance is not None:
            motion = element.built_from_design
            placed = element.placement.design_from_model
            stands = instance.scene_from_model if motion is None else motion @ placed
            error = (stands.move(middle) - truth.pose.move(middle))[0]
        along = truth.pose.turn(long[None])[0]
        spoken = (element.on, element.beside, element.through, element.hidden)
        on, beside, through, hidden = (float("nan") if each is None else each for each in spoken)
        told.append(
            Row(
                seed=seed,
                global_id=element.placement.global_id,
                model=element.model,
                built=truth.how,
                visible=share,
                status=element.status,
                right=int(is_right(truth, element.status, float(np.linalg.norm(error)))),
                off_mm=1e3 * (float("nan") if element.off_m is None else element.off_m),
                built_off_mm=1e3 * apart(truth.pose, element.placement.design_from_model, truth.mesh.vertices),
                error_mm=1e3 * float(np.linalg.norm(error)),
                across_mm=1e3 * float(np.linalg.norm(error - (error @ along) * along)),
                points=0 if instance is None or instance.isolated is None else len(instance.isolated),
                on=on,
                beside=beside,
                through=through,
                hidden=hidden,
                total_s=total_s,
            )
        )
    return told


def is_right(truth: Built, status: str, error_m: float) -> bool:
    """Is that its status? What is there is to be found where it stands, and nowhere else."""
    if truth.how == MISSING:
        return status == NOT_FOUND
    return status == INSTALLED and error_m < THERE_M


def changed(seed: int, meshes: list[Mesh]) -> list[Built]:
    """The elements as built: PAIRS swapped; of the others some not there, some shifted and turned a little."""
    rng = np.random.default_rng(seed)
    design = [(mesh, placement) for mesh in meshes for placement in mesh.placements]
    swaps = swapped(rng, [mesh for mesh, _ in design])
    others = [number for number in rng.permutation(len(design)).tolist() if number not in swaps]
    hows = dict(zip(others, [MISSING] * MANY[MISSING] + [MOVED] * MANY[MOVED], strict=False))
    built = []
    for number, (mesh, placement) in enumerate(design):
        how, pose = hows.get(number, DESIGNED), placement.design_from_model
        if number in swaps:
            other, place = design[swaps[number]]
            how, pose = SWAPPED, place.design_from_model @ onto(mesh, other)
        elif how == MOVED:
            shift = rng.normal(size=3)
            shift *= rng.uniform(*SHIFTS_M) / np.linalg.norm(shift)
            turn = scanfind.Pose.from_rotation_vector(rng.normal(size=3) * TURN_RAD).rotation @ pose.rotation
            middle = mesh.vertices.mean(axis=0)
            pose = scanfind.Pose(turn, pose.move(middle[None])[0] + shift - turn @ middle)
        built.append(Built(mesh, placement, how, pose))
    return built


def swapped(rng: np.random.Generator, meshes: list[Mesh]) -> dict[int, int]:
    """Number of an element → the one in whose place it stands, of some that are of one section."""
    boxes = np.array([np.sort(np.ptp(mesh.vertices, axis=0)) for mesh in meshes])
    alike = []
    for one, other in combinations(range(len(meshes)), 2):
        section = np.abs(boxes[one, :2] - boxes[other, :2]).max()
        longer = abs(boxes[one, 2] - boxes[other, 2])
        if section < SECTION_M and LONGER_M < longer < LONGER * max(boxes[one, 2], boxes[other, 2]):
            alike.append((one, other))
    taken: dict[int, int] = {}
    for number in rng.permutation(len(alike)).tolist():
        one, other = alike[number]
        if len(taken) < 2 * PAIRS and not {one, other} & set(taken):
            taken |= {one: other, other: one}
    return taken


def onto(mesh: Mesh, other: Mesh) -> scanfind.Pose:
    """What puts a mesh where another is: the middle of its box to the other's, long side along long side."""
    turns, middles = [], []
    for each in (mesh, other):
        axes = np.eye(3)[np.argsort(-np.ptp(each.vertices, axis=0), kind="stable")]
        axes[2] *= np.linalg.det(axes)
        turns.append(axes)
        middles.append(0.5 * (each.vertices.min(axis=0) + each.vertices.max(axis=0)))
    turn = turns[1].T @ turns[0]
    return scanfind.Pose(turn, middles[1] - turn @ middles[0])


def scanned(built: list[Built], seed: int, points: int) -> list[PointCloud]:
    """What the stations see of it."""
    return scan(Scene(tuple(objects_of(built)), STATIONS), seed=seed, points=points).stations


def objects_of(built: list[Built]) -> list[SceneObject]:
    """A floor and what stands on it."""
    there = [SceneObject(one.placement.name, one.mesh, one.pose, target=True) for one in built if one.how != MISSING]
    return [SceneObject("floor", FLOOR, scanfind.Pose.identity()), *there]


def visible_of(built: list[Built], seed: int, samples: int = 1000) -> list[float]:
    """Of each element the share of its surface that some station sees; of what is missing, would see."""
    there = [(thing.mesh, thing.pose) for thing in objects_of(built)]
    scene, shares = RayCaster(there), []
    for one in built:
        caster = RayCaster([*there, (one.mesh, one.pose)]) if one.how == MISSING else scene
        points, _ = sample_oriented(one.mesh, np.random.default_rng(seed), samples)
        seen = [caster.sees(station, one.pose.move(points)) for station in STATIONS]
        shares.append(float(np.any(seen, axis=0).mean()))
    return shares


def apart(one: scanfind.Pose, other: scanfind.Pose, points: Floats) -> float:
    """How far two poses part the point (of N, (N, 3)) that they part the most, metres."""
    return float(np.linalg.norm(one.move(points) - other.move(points), axis=1).max())


if __name__ == "__main__":
    cyclopts.run(main)
