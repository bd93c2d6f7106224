"""Findings as results.json has them, and back."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydantic_core import to_jsonable_python

from scanfind.clock import STAGES
from scanfind.design.alignment import Alignment
from scanfind.design.elements import Element
from scanfind.detection import (
    Detection,
    Deviation,
    Dimension,
    Findings,
    Motion,
    PartFit,
    Refused,
    ScanScale,
    SceneScan,
    StationSays,
)
from scanfind.mesh import Placement
from scanfind.pose import Pose
from scanfind.results import schema

if TYPE_CHECKING:
    from scanfind.library import ModelLibrary
    from scanfind.symmetry import Symmetry

# Both ends of a file and its length: a GB is told apart from another in milliseconds, not in seconds.
FINGERPRINT_BLOCK = 1 << 20


def document(
    findings: Findings,
    *,
    models: Sequence[schema.ModelEntry],
    parameters: object,
    seed: int,
    files: dict[int, tuple[str, str | None]] | None = None,
    remainder: str | None = None,
) -> schema.Results:
    """The findings as results.json has them.

    models : what was sought, see `model_entries`
    files : detection's id → its pose file and point file in the result folder, where there is one
    """
    from scanfind import __version__

    files = files or {}
    timings = dict.fromkeys(STAGES, 0.0) | findings.timings_s
    timings["total"] = findings.timings_s.get("total", sum(findings.timings_s.values()))
    return schema.Results(
        schema=schema.SCHEMA,
        scanfind=__version__,
        made=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        seed=seed,
        parameters=to_jsonable_python(parameters),
        shift_m=findings.shift,
        crs=findings.crs,
        tolerance_m=findings.tolerance_m,
        scans=[
            schema.ScanEntry(
                path=_text(scan.path),
                points=scan.points,
                dropped=scan.dropped,
                stations_m=list(scan.stations),
                fingerprint=fingerprint(Path(scan.path)),
            )
            for scan in findings.scans
        ],
        models=[model.model_copy(update={"expected": findings.expected.get(model.name)}) for model in models],
        detections=[_detection_entry(found, *files.get(found.id, (None, None))) for found in findings],
        refused=[_refused_entry(refused) for refused in findings.refused],
        elements=[_element_entry(element) for element in findings.elements],
        profile=None if findings.profile is None else findings.profile.tables(),
        alignment=None if findings.alignment is None else _alignment_entry(findings.alignment),
        scan_scale=None if findings.scan_scale is None else _scale_entry(findings.scan_scale),
        remainder=remainder,
        notes=list(findings.notes),
        timings_s=timings,
        peak_memory_bytes=peak_memory_bytes(),
    )


def findings_of(results: schema.Results) -> Findings:
    """What `document` was given, made back from what it gave; all but the points and the tolerance profile."""
    findings = Findings([_detection(entry) for entry in results.detections])
    findings.refused = [_refused(entry) for entry in results.refused]
    findings.elements = [_element(entry) for entry in results.elements]
    findings.alignment = None if results.alignment is None else _alignment(results.alignment)
    findings.scan_scale = None if results.scan_scale is None else _scale(results.scan_scale)
    findings.scans = [SceneScan(scan.path, scan.points, scan.dropped, tuple(scan.stations_m)) for scan in results.scans]
    findings.shift, findings.crs, findings.notes = results.shift_m, results.crs, list(results.notes)
    findings.expected = {model.name: model.expected for model in results.models if model.expected is not None}
    findings.timings_s, findings.tolerance_m = dict(results.timings_s), results.tolerance_m
    return findings


def model_entries(models: ModelLibrary) -> list[schema.ModelEntry]:
    """What a library holds, as results.json has it."""
    return [
        schema.ModelEntry(
            name=model.name,
            sha256=model.sha256,
            diameter_m=model.diameter,
            pairs=model.pairs,
            symmetry=symmetry_entry(model.symmetry),
        )
        for model in models.show()
    ]


def symmetry_entry(symmetry: Symmetry) -> schema.SymmetryEntry:
    """A model's symmetry, as results.json has it."""
    return schema.SymmetryEntry(
        words=symmetry.words(),
        centre_m=_vector(symmetry.centre),
        axes=[schema.AxisEntry(direction=axis.direction, order=axis.order or None) for axis in symmetry.axes],
    )


def fingerprint(path: Path) -> str | None:
    """sha256 of a file's length and of its first and last MiB; None where there is no such file.

    It tells an exchanged or edited scan from the one searched, not an adversary's: hashing all of 100 GB takes minutes.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            digest = hashlib.sha256(str(size).encode())
            digest.update(file.read(FINGERPRINT_BLOCK))
            file.seek(max(size - FINGERPRINT_BLOCK, 0))
            digest.update(file.read(FINGERPRINT_BLOCK))
    except (OSError, ValueError):
        return None
    return f"sha256-ends:{digest.hexdigest()}"


def peak_memory_bytes() -> int:
    """The most memory this process has held, bytes; 0 where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _detection_entry(found: Detection, pose: str | None, isolated: str | None) -> schema.DetectionEntry:
    deviation = found.deviation
    return schema.DetectionEntry(
        id=found.id,
        model=found.model,
        scene_from_model=rows(found.scene_from_model),
        translation_m=_vector(found.scene_from_model.translation),
        quaternion=schema.Quaternion(**found.scene_from_model.quaternion()),
        score=_or_none(found.score),
        support=_or_none(found.support),
        visible_support=_or_none(found.visible_support),
        penalty=_or_none(found.penalty),
        coverage=_or_none(found.coverage),
        rms_m=_or_none(found.rms_m),
        unobservable=[_motion_entry(motion) for motion in found.unobservable],
        points=0 if found.isolated is None else len(found.isolated),
        isolated=isolated,
        pose=pose,
        deviation=None if deviation is None else _deviation_entry(deviation),
        covariance=None if found.covariance is None else _covariance(found.covariance),
        pivot_m=found.pivot,
        sigma_m=_or_none(found.sigma_m),
        sigma_rad=_or_none(found.sigma_rad),
        parts=[_part_entry(part) for part in found.parts],
        dimensions=[_dimension_entry(each) for each in found.dimensions],
        stations=_station_entries(found.stations),
        instead_of=found.instead_of,
        rival=_or_none(found.rival),
        probability=_or_none(found.probability),
        tolerance_m=found.tolerance_m,
    )


def _dimension_entry(each: Dimension) -> schema.DimensionEntry:
    return schema.DimensionEntry(
        name=each.name,
        kind=each.kind,
        design=each.design,
        built=_or_none(each.built),
        sigma=_or_none(each.sigma),
        why=each.why,
    )


def _part_entry(part: PartFit) -> schema.PartEntry:
    measured = isfinite(part.off_m)
    return schema.PartEntry(
        name=part.name,
        status=part.status,
        joined_to=part.joined_to,
        built_from_design=rows(part.built_from_design) if measured else None,
        shift_m=part.shift_m if measured else None,
        turn_rad=part.turn_rad if measured else None,
        off_m=_or_none(part.off_m),
        off_sigma_m=_or_none(part.off_sigma_m),
        shift_sigma_m=_or_none(part.shift_sigma_m),
        turn_sigma_rad=_or_none(part.turn_sigma_rad),
        free=[_motion_entry(motion) for motion in part.free],
        support=_or_none(part.support),
        visible_support=_or_none(part.visible_support),
        penalty=_or_none(part.penalty),
    )


def _motion_entry(motion: Motion) -> schema.MotionEntry:
    return schema.MotionEntry(kind=motion.kind, axis=motion.axis, through_m=motion.through, sigma=motion.sigma)


def _covariance(matrix: NDArray[np.float64]) -> schema.Covariance:
    a, b, c, d, e, f = (tuple(row) for row in matrix.tolist())
    return a, b, c, d, e, f


def _deviation_entry(deviation: Deviation) -> schema.DeviationEntry:
    return schema.DeviationEntry(
        mean_m=_or_none(deviation.mean_m),
        rms_m=_or_none(deviation.rms_m),
        p95_m=_or_none(deviation.p95_m),
        worst_m=_or_none(deviation.worst_m),
    )


def _refused_entry(refused: Refused) -> schema.RefusedEntry:
    return schema.RefusedEntry(
        model=refused.model,
        scene_from_model=rows(refused.scene_from_model),
        score=_or_none(refused.score),
        support=_or_none(refused.support),
        visible_support=_or_none(refused.visible_support),
        penalty=_or_none(refused.penalty),
        reason=refused.reason,
        rival=_or_none(refused.rival),
        probability=_or_none(refused.probability),
    )


def _element_entry(element: Element) -> schema.ElementEntry:
    placement = element.placement
    return schema.ElementEntry(
        global_id=placement.global_id,
        ifc_class=placement.ifc_class,
        name=placement.name,
        model=element.model,
        status=element.status,
        verdict=element.verdict,
        verdict_why=element.verdict_why,
        stations=_station_entries(element.stations),
        detection=element.detection,
        design_from_model=rows(placement.design_from_model),
        shift_m=element.shift_m,
        turn_rad=element.turn_rad,
        off_m=element.off_m,
        on=element.on,
        beside=element.beside,
        through=element.through,
        hidden=element.hidden,
        why=element.why,
        built_from_design=None if element.built_from_design is None else rows(element.built_from_design),
    )


def _station_entries(stations: Iterable[StationSays]) -> list[schema.StationEntry]:
    return [schema.StationEntry(**each._asdict()) for each in stations]


def _alignment_entry(alignment: Alignment) -> schema.AlignmentEntry:
    return schema.AlignmentEntry(
        scene_from_design=rows(alignment.scene_from_design),
        covariance=_covariance(alignment.covariance),
        pivot_m=alignment.pivot,
        sigma_m=alignment.sigma_m,
        sigma_rad=alignment.sigma_rad,
        agreeing=alignment.agreeing,
        found=alignment.found,
        rms_m=alignment.rms_m,
    )


def _scale_entry(scale: ScanScale) -> schema.ScaleEntry:
    return schema.ScaleEntry(metres=scale.metres, sigma=_or_none(scale.sigma))


def rows(pose: Pose) -> schema.Matrix:
    """A pose as results.json has it."""
    a, b, c, d = (tuple(row) for row in pose.matrix().tolist())
    return a, b, c, d


def _vector(values: Iterable[float]) -> schema.Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _text(path: str) -> str:
    """A path as JSON can hold it: Linux allows names that are no text at all."""
    return os.fsencode(path).decode(errors="replace")


def _detection(entry: schema.DetectionEntry) -> Detection:
    deviation = entry.deviation
    return Detection(
        id=entry.id,
        model=entry.model,
        scene_from_model=_pose(entry.scene_from_model),
        score=_or_nan(entry.score),
        support=_or_nan(entry.support),
        visible_support=_or_nan(entry.visible_support),
        penalty=_or_nan(entry.penalty),
        coverage=_or_nan(entry.coverage),
        rms_m=_or_nan(entry.rms_m),
        unobservable=_motions(entry.unobservable),
        deviation=None if deviation is None else Deviation(*map(_or_nan, deviation.model_dump().values())),
        covariance=None if entry.covariance is None else np.array(entry.covariance),
        pivot=entry.pivot_m,
        parts=tuple(_part(part) for part in entry.parts),
        dimensions=tuple(
            Dimension(each.name, each.kind, each.design, _or_nan(each.built), _or_nan(each.sigma), each.why)
            for each in entry.dimensions
        ),
        stations=_stations(entry.stations),
        instead_of=entry.instead_of,
        rival=_or_nan(entry.rival),
        probability=_or_nan(entry.probability),
        tolerance_m=entry.tolerance_m,
    )


def _stations(entries: Iterable[schema.StationEntry]) -> tuple[StationSays, ...]:
    return tuple(StationSays(**entry.model_dump()) for entry in entries)


def _motions(entries: Iterable[schema.MotionEntry]) -> tuple[Motion, ...]:
    return tuple(Motion(entry.kind, entry.axis, entry.through_m, entry.sigma) for entry in entries)


def _part(entry: schema.PartEntry) -> PartFit:
    still = (0.0, 0.0, 0.0)
    return PartFit(
        name=entry.name,
        status=entry.status,
        joined_to=entry.joined_to,
        built_from_design=Pose.identity() if entry.built_from_design is None else _pose(entry.built_from_design),
        shift_m=entry.shift_m or still,
        turn_rad=entry.turn_rad or still,
        off_m=_or_nan(entry.off_m),
        off_sigma_m=_or_nan(entry.off_sigma_m),
        shift_sigma_m=_or_nan(entry.shift_sigma_m),
        turn_sigma_rad=_or_nan(entry.turn_sigma_rad),
        free=_motions(entry.free),
        support=_or_nan(entry.support),
        visible_support=_or_nan(entry.visible_support),
        penalty=_or_nan(entry.penalty),
    )


def _element(entry: schema.ElementEntry) -> Element:
    placement = Placement(entry.global_id, entry.ifc_class, entry.name, _pose(entry.design_from_model))
    moved = None if entry.built_from_design is None else _pose(entry.built_from_design)
    return Element(
        placement, entry.model, entry.status, entry.detection, entry.shift_m, entry.turn_rad, entry.off_m, entry.on,
        entry.beside, entry.through, entry.hidden, entry.why, moved, entry.verdict, entry.verdict_why,
        _stations(entry.stations),
    )  # fmt: skip


def _alignment(entry: schema.AlignmentEntry) -> Alignment:
    pose, covariance = _pose(entry.scene_from_design), np.array(entry.covariance)
    return Alignment(pose, covariance, entry.pivot_m, entry.agreeing, entry.found, entry.rms_m)


def _scale(entry: schema.ScaleEntry) -> ScanScale:
    return ScanScale(entry.metres, _or_nan(entry.sigma))


def _refused(entry: schema.RefusedEntry) -> Refused:
    return Refused(
        model=entry.model,
        scene_from_model=_pose(entry.scene_from_model),
        score=_or_nan(entry.score),
        support=_or_nan(entry.support),
        visible_support=_or_nan(entry.visible_support),
        penalty=_or_nan(entry.penalty),
        reason=entry.reason,
        rival=_or_nan(entry.rival),
        probability=_or_nan(entry.probability),
    )


def _pose(rows: schema.Matrix) -> Pose:
    matrix = np.array(rows)
    Pose.from_matrix(matrix)  # refuses what is no rigid motion; but what it makes orthonormal loses the last digit
    # Views would have every kernel that takes a pose compiled once more, which takes 8 s.
    return Pose(matrix[:3, :3].copy(), matrix[:3, 3].copy())


def _or_none(value: float) -> float | None:
    return float(value) if isfinite(value) else None


def _or_nan(value: float | None) -> float:
    return nan if value is None else value
