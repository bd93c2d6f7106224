"""Results made by hand: what results.json would hold, with only what a test is about said."""

from __future__ import annotations

from typing import Any

from scanfind.elements import INSTALLED
from scanfind.schema import (
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
