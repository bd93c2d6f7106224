"""Isolate again: the points of instances found before, cut out of the scans anew. No search, and no library needed."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scanfind import schema
from scanfind.cloud import PointChunk
from scanfind.detection import Detection, Findings, IsolatedPoints, SceneScan
from scanfind.deviation import deviation_of
from scanfind.document import findings_of
from scanfind.errors import UsageError
from scanfind.isolate import IsolateParameters, Placed, isolate
from scanfind.library import ModelLibrary
from scanfind.near_surface import near_samples, near_triangles
from scanfind.pose import Pose
from scanfind.results import MODELS, fill_folder, open_remainder, read_results, result_folder
from scanfind.scans import read_scan, scan_info

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface
    from scanfind.model import Model
    from scanfind.progress import Progress
    from scanfind.scans import CloudWriter


def isolate_again(
    result_dir: str | Path,
    scans: Sequence[str | Path],
    *,
    tolerance: float | None = None,
    out: str | Path | None = None,
    format: str = "ply",
    progress: Progress | None = None,
) -> schema.Results:
    """Cut the points of a result's detections out of `scans` and write the result anew; returns its results.json.

    result_dir : a folder that `write_results` (or `scanfind find --out`) wrote
    scans : the files that were searched, or others in the same frame
    tolerance : points this near to a placed model are its own, metres; None as the result's parameters have it
    out : a new folder; None replaces the points in `result_dir`, which stays as it is until the new ones stand

    Raises UnreadableFileError for no result or a scan that cannot be read, UsageError for no tolerance, OutputError.
    """
    before = read_results(result_dir)
    parameters = _with_tolerance(before.parameters, tolerance)
    reach = parameters["isolate"]["tolerance_m"]
    findings = findings_of(before)
    target = Path(result_dir) if out is None else Path(out)
    began = time.perf_counter()
    with (
        result_folder(target, overwrite=out is None) as folder,
        ModelLibrary.open(Path(result_dir) / MODELS) if findings else ModelLibrary.in_memory() as models,
        open_remainder(folder / before.remainder, scans) if before.remainder else nullcontext() as rest,
    ):
        placed = place(findings, {name: models.get(name) for name in models}, reach, findings.shift)
        read: list[SceneScan] = []
        chunks = scene_chunks(scans, read, progress)
        sink = None if rest is None else partial(keep, rest)
        points = isolate(chunks, placed, IsolateParameters(reach), findings.shift, sink)
        cut = Findings(with_points(findings, points))
        cut.refused, cut.shift, cut.crs, cut.notes = findings.refused, findings.shift, findings.crs, findings.notes
        cut.scans, cut.timings_s = read, {"isolate": time.perf_counter() - began}
        return fill_folder(
            folder, cut, models=models, sought=before.models, parameters=parameters, seed=before.seed, format=format,
            remainder=before.remainder, progress=progress,
        )  # fmt: skip


def place(
    detections: Iterable[Detection], models: Mapping[str, Model], reach: float, shift: Sequence[float]
) -> list[Placed]:
    """The models where the detections have them, to be asked for points within `reach`, metres.

    shift : (3,) what is taken off the file's coordinates, metres
    """
    near: dict[str, NearSurface] = {}
    placed = []
    for found in detections:
        if found.model not in near:
            near[found.model] = _surface(models[found.model], reach)
        pose = found.scene_from_model
        shifted = Pose(pose.rotation, pose.translation - np.asarray(shift))
        placed.append(Placed(found.id, near[found.model], shifted))
    return placed


def with_points(detections: Iterable[Detection], points: Mapping[int, IsolatedPoints]) -> list[Detection]:
    """The detections with their points, by id, and the deviation these show."""
    return [
        found.with_points(mine, deviation_of(mine.deviation) if len(mine) else None)
        for found in detections
        for mine in (points[found.id],)
    ]


def scene_chunks(
    scans: Sequence[str | Path], read: list[SceneScan], progress: Progress | None = None
) -> Iterator[PointChunk]:
    """The points of several files as one scene: scans are numbered on from file to file.

    read : gets what each file turned out to hold, when its last point is through
    """
    infos = [scan_info(scan) for scan in scans]
    total = sum(info.points for info in infos) if all(info.points >= 0 for info in infos) else -1
    first = done = 0
    for scan, info in zip(scans, infos, strict=True):
        points = dropped = 0
        for chunk in read_scan(scan):
            points, dropped, done = points + len(chunk), dropped + chunk.dropped, done + len(chunk)
            yield replace(chunk, scan=first + chunk.scan)
            if progress is not None:
                progress("isolate", done, total)
        first += len(info.stations)
        read.append(SceneScan(str(scan), points, dropped, tuple(station.origin for station in info.stations)))


def keep(writer: CloudWriter, chunk: PointChunk) -> None:
    """Write what is left of a chunk, with where each point comes from."""
    scan_id = np.full(len(chunk), chunk.scan, np.int32)
    writer.write(chunk.xyz, {**chunk.attributes, "scan_id": scan_id, "source_index": chunk.source_index})


def _surface(model: Model, reach: float) -> NearSurface:
    if model.mesh is None:
        return near_samples(model.samples, model.spacing, reach)
    return near_triangles(model.mesh.triangles(), reach)


def _with_tolerance(parameters: Mapping[str, object], tolerance: float | None) -> dict[str, dict[str, float]]:
    """The result's parameters with the tolerance that is to hold; raises UsageError where there is none."""
    stages = {stage: dict(values) for stage, values in parameters.items() if isinstance(values, Mapping)}
    known = stages.setdefault("isolate", {})
    if tolerance is not None:
        known["tolerance_m"] = tolerance
    if known.get("tolerance_m") is None:
        msg = "isolate: the search chose its tolerance by itself: give one, such as --tolerance 0.01 (metres)"
        raise UsageError(msg)
    return stages
