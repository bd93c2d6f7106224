"""Sets of scans made elsewhere, searched and judged like the paper's scenes: real ones, and any folder of a user.

A folder holds scan.<suffix> (any format scanfind reads), models, and truth.json, as `scanfind simulate` writes it,

    {"objects": [{"id": 3, "name": "spool", "model": "spool.stl", "target": true, "scene_from_model": [4 x 4]}, ...]}

or only what is where, by model file:

    {"spool.stl": [[4 x 4], ...], ...}

Metres, row-major. Where the scan has an attribute object_id with the ids of truth.json, recall and precision are known.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import scanfind
from benchmarks.common import ROOT
from benchmarks.paper.definitions import RIGHT_MM, Ints, clutter_ratio
from benchmarks.paper.experiments import Case
from benchmarks.paper.scenes import Cloud
from benchmarks.real import MILK_LIMITS, PUMP, points_of
from scanfind.cloud import CloudModel
from scanfind.errors import UnreadableFileError, UsageError
from scanfind.mesh import Mesh
from scanfind.pose import Pose

NAN = float("nan")


@dataclass(frozen=True, eq=False)
class Instance:
    """Something in a scan: the model, where it is, and its object id there; -1 where nobody knows."""

    model: Mesh | CloudModel
    truth: Pose
    object_id: int = -1


def folder_cases(folder: Path, seed: int) -> Iterator[Case]:
    """A case for each target in a user's folder. Raises UsageError, UnreadableFileError."""
    scans = sorted(folder.glob("scan.*"))
    if len(scans) != 1:
        msg = f"{folder}: a set has one scan.<suffix>, got {[path.name for path in scans]}"
        raise UsageError(msg)
    cloud, ids = read(scans[0])
    yield from cases_of(folder.resolve().name, cloud, ids, instances(folder), seed)


def milk(data: Path, seed: int) -> Iterator[Case]:
    """The milk carton of a Kinect frame (PCL); its points are those of the segment that comes with it."""
    folder = data / "milk_kinect"
    known = json.loads((folder / "gt.json").read_text(encoding="utf-8"))["refined"][0]["T_model_to_scene"]
    cloud, _ = read(folder / "scene.pcd")
    own = {point.tobytes() for point in points_of(folder / "milk_segment_in_scene.pcd").astype(np.float32)}
    ids = np.array([point.tobytes() in own for point in cloud.xyz.astype(np.float32)], dtype=np.int64)
    carton = Instance(scanfind.read_models(folder / "milk_model.pcd")[0], Pose.from_matrix(known), 1)
    yield from cases_of("milk_kinect", cloud, ids, [carton], seed, MILK_LIMITS[0])


def pump(data: Path, seed: int) -> Iterator[Case]:
    """Both skids of the plant room, the model being a piece of the first. benchmarks.real has the pipes, which roll."""
    derived = json.loads((data / "pump_e57" / "derived.json").read_text(encoding="utf-8"))
    first_from_second = Pose.from_matrix(derived["unit_B_to_unit_A"])
    cloud, ids = read(PUMP / "scan.e57")
    model = scanfind.read_models(PUMP / "skid.ply", origin=(0.0, 0.0, 0.0))[0]
    skids = [Instance(model, Pose.identity()), Instance(model, first_from_second.inverse())]
    yield from cases_of("pump_e57", cloud, ids, skids, seed)


def cases_of(
    name: str, cloud: Cloud, ids: Ints, known: list[Instance], seed: int, right_mm: float = RIGHT_MM
) -> Iterator[Case]:
    """A case for each instance; the scene is the same, what counts as the object's own points is not."""
    for k, one in enumerate(known, 1):
        same = [other.truth for other in known if other.model is one.model and other is not one]
        own = cloud.marked((ids == one.object_id) & (one.object_id >= 0), one.truth)
        ratio = clutter_ratio(len(own), own.object_points()) if own.object_points() else NAN
        yield Case(
            "set", name, f"{one.model.name}_{k}", NAN, ratio, seed, 0, own, one.model, tuple(same), right_mm
        )  # fmt: skip


def instances(folder: Path) -> list[Instance]:
    """What truth.json says is to be found. Raises UnreadableFileError."""
    path = folder / "truth.json"
    try:
        told: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if "objects" in told:
            placed = [one for one in told["objects"] if one.get("target", True) and one.get("model")]
            listed = [(one["model"], one["scene_from_model"], int(one["id"])) for one in placed]
        else:
            listed = [(model, pose, -1) for model, poses in told.items() for pose in poses]
    except (OSError, ValueError, KeyError, TypeError) as error:
        msg = f"{path}: cannot tell what is where ({error}); see the head of benchmarks/paper/sets.py for what it holds"
        raise UnreadableFileError(msg) from error
    models = {name: scanfind.read_models(folder / name)[0] for name in dict.fromkeys(name for name, _, _ in listed)}
    return [Instance(models[name], Pose.from_matrix(pose), number) for name, pose, number in listed]


def read(path: Path) -> tuple[Cloud, Ints]:
    """A scan file in memory, and the object id of each point, -1 where it has none.

    A scan that does not say where its scanner stood has no origin.
    """
    chunks = list(scanfind.read_scan(path))
    xyz = np.concatenate([chunk.xyz for chunk in chunks])
    origins = {chunk.scan: chunk.origin for chunk in chunks}
    known = all(origin is not None for origin in origins.values())
    number = {scan: k for k, scan in enumerate(sorted(origins))}
    blank = np.full(len(xyz), -1)
    cloud = Cloud(
        xyz=xyz,
        station=np.repeat([number[chunk.scan] for chunk in chunks], [len(chunk) for chunk in chunks]),
        on_object=np.zeros(len(xyz), dtype=bool),
        order=np.arange(len(xyz)),
        distance=np.full(len(xyz), np.nan),
        branch=blank,
        origins=np.array([origins[scan] for scan in sorted(origins)], dtype=float) if known else None,
        truth=Pose.identity(),
    )
    ids = [chunk.attributes.get("object_id", np.full(len(chunk), -1)) for chunk in chunks]
    return cloud, np.concatenate(ids).astype(np.int64)


SETS = {"milk_kinect": milk, "pump_e57": pump}


def set_cases(name: str, data: Path, seed: int) -> Iterator[Case]:
    """The cases of a real set by name, or of a folder. Raises UsageError."""
    if name in SETS:
        return SETS[name](data, seed)
    if not Path(name).is_dir():
        msg = f"no set {name!r}: give a folder, or one of {', '.join(SETS)}"
        raise UsageError(msg)
    return folder_cases(Path(name), seed)


DATA = ROOT.parent / "shared" / "data"
