"""Results made by hand: what results.json would hold, with only what a test is about said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scanfind.design.elements import INSTALLED, NOT_FOUND, Element
from scanfind.detection import Detection, Findings, IsolatedPoints, SceneScan
from scanfind.isolation.deviation import deviation_of
from scanfind.library import ModelLibrary
from scanfind.library.model import ModelParameters, build_model
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Placement
from scanfind.pose import Pose
from scanfind.results import write_results
from scanfind.results.schema import (
    DetectionEntry,
    DeviationEntry,
    ElementEntry,
    Matrix,
    ModelEntry,
    MotionEntry,
    PartEntry,
    Quaternion,
    Results,
    ScanEntry,
    Vector,
)
from scanfind.simulate.parts import blocks
from scanfind.tolerances import allowed_off, judge_findings

STATIONS: list[Vector | None] = [(0.0, 0.0, 1.5), (4.0, 0.0, 1.5), (0.0, 4.0, 1.5)]


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Matrix:
    return (1.0, 0.0, 0.0, x), (0.0, 1.0, 0.0, y), (0.0, 0.0, 1.0, z), (0.0, 0.0, 0.0, 1.0)


def element(**said: Any) -> ElementEntry:
    """An element in its place, found as instance 1."""
    values: dict[str, Any] = {
        "global_id": "0aB", "ifc_class": "IfcBeam", "name": "B1", "model": "beam", "status": INSTALLED, "verdict": None,
        "detection": 1, "design_from_model": at(), "shift_m": (0.0, 0.0, 0.0), "turn_rad": 0.0, "off_m": 0.0, "on": 0.9,
        "beside": 0.0, "through": 0.0, "hidden": 0.1, "why": "found",
    }  # fmt: skip
    return ElementEntry(**values | said)


def absent(status: str, on: float, beside: float, through: float, hidden: float, **said: Any) -> ElementEntry:
    """An element that was not found, and what beams say of its place."""
    nothing = {"detection": None, "shift_m": None, "turn_rad": None, "off_m": None}
    return element(status=status, on=on, beside=beside, through=through, hidden=hidden, **nothing | said)


def detection(**said: Any) -> DetectionEntry:
    """A well measured instance."""
    values: dict[str, Any] = {
        "id": 1, "model": "beam", "scene_from_model": at(), "translation_m": (0.0, 0.0, 0.0),
        "quaternion": Quaternion(x=0.0, y=0.0, z=0.0, w=1.0), "score": 0.97, "support": 0.6, "visible_support": 0.97,
        "penalty": 0.0, "coverage": 0.6, "rms_m": 0.001, "unobservable": [], "points": 5000, "isolated": None,
        "pose": None, "deviation": DeviationEntry(mean_m=0.0002, rms_m=0.001, p95_m=0.002, worst_m=0.006),
        "sigma_m": 0.0001, "sigma_rad": 0.0001,
    }  # fmt: skip
    return DetectionEntry(**values | said)


def part(**said: Any) -> PartEntry:
    """A part in its place."""
    values: dict[str, Any] = {
        "name": "flange_2", "status": "measured", "joined_to": "pipe", "built_from_design": at(),
        "shift_m": (0.0, 0.0, 0.0), "turn_rad": (0.0, 0.0, 0.0), "off_m": 0.0, "off_sigma_m": 0.0001,
        "shift_sigma_m": 0.0001, "turn_sigma_rad": 0.0001, "free": [], "support": 0.6, "visible_support": 0.9,
        "penalty": 0.02,
    }  # fmt: skip
    return PartEntry(**values | said)


def motion(kind: str, axis: tuple[float, float, float], sigma: float | None = None) -> MotionEntry:
    return MotionEntry(kind=kind, axis=axis, through_m=(0.0, 0.0, 0.0), sigma=sigma)


def results(*entries: ElementEntry | DetectionEntry, **said: Any) -> Results:
    """A result of these elements and detections."""
    elements = [each for each in entries if isinstance(each, ElementEntry)]
    detections = [each for each in entries if isinstance(each, DetectionEntry)]
    names = sorted({each.model for each in entries})
    values: dict[str, Any] = {
        "schema": 1, "scanfind": "0.1.0", "seed": 0, "parameters": {}, "shift_m": (0.0, 0.0, 0.0), "crs": None,
        "tolerance_m": 0.008, "scans": [ScanEntry(path="hall.e57", points=1000, dropped=0, stations_m=STATIONS)],
        "models": [ModelEntry(name=name, sha256="", diameter_m=2.0, pairs=1) for name in names],
        "detections": detections, "refused": [], "elements": elements, "timings_s": {"total": 12.0},
        "peak_memory_bytes": 0,
    }  # fmt: skip
    return Results(**values | said)


def folder_by_hand(out: Path, *, names: Sequence[str] = ("B1", "B2", "B3"), points: int = 4000) -> Path:
    """A result folder as an inspection leaves it, made without a search: the first element in its place, the second
    20 mm too low, the others not found; points 1 mm about the surface, a tenth of them 6 mm outside.
    """  # fmt: skip
    rng = np.random.default_rng(0)
    mesh = blocks("beam", [((0, 0, 0), (2.0, 0.3, 0.1)), ((0, 0, 0), (0.1, 0.3, 0.8))])
    model = build_model(mesh, ModelParameters(SurfaceParameters(samples=200)))
    triangles = mesh.triangles()
    findings = Findings()
    for number, low in ((1, 0.0), (2, -0.02)):
        pose = Pose(np.eye(3), np.array([0.0, 1.5 * number, low]))
        of = rng.integers(0, len(triangles), points)
        weights = rng.dirichlet((1.0, 1.0, 1.0), points)
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[of]
        deviation = np.where(rng.random(points) < 0.1, 0.006, rng.normal(0.0, 0.001, points))
        normals *= deviation[:, None] / np.linalg.norm(normals, axis=1, keepdims=True)
        xyz = pose.move(np.einsum("nk,nkj->nj", weights, triangles[of]) + normals)
        ids = np.arange(points)
        cut = IsolatedPoints(xyz, {}, np.zeros(points, np.int32), ids, deviation.astype(np.float32))
        found = Detection(number, "beam", pose, 0.97, 0.6, 0.97, 0.0, 0.6, 0.001)
        covariance = np.diag([1e-8] * 6)
        pivot = (1.0, 1.5 * number, 0.2)
        with_points = replace(found, isolated=cut, deviation=deviation_of(deviation))
        findings.append(replace(with_points, covariance=covariance, pivot=pivot))
    for k, name in enumerate(names, 1):
        placement = Placement(f"gid{k}", "IfcBeam", name, Pose(np.eye(3), np.array([0.0, 1.5 * k, 0.0])))
        missing = Element(placement, "beam", NOT_FOUND, None, None, None, None, 0.0, 0.1, 0.6, 0.3, "missing")
        off = 0.02 if k == 2 else 0.0
        moved = replace(missing, status=INSTALLED, detection=k, shift_m=(0.0, 0.0, -off), turn_rad=0.0, off_m=off)
        findings.elements.append(replace(moved, on=0.9, beside=0.0, through=0.0, hidden=0.1) if k <= 2 else missing)
    findings.scans = [SceneScan("hall.e57", 100_000, 0, tuple(STATIONS))]
    findings.tolerance_m = 0.008
    with ModelLibrary.in_memory() as models:
        models.put(model)
        judge_findings(findings, allowed_off(0.03), models)
        write_results(findings, out, models=models, parameters={})
    return out
