"""The verb: scan a scene and write what comes of it, or only say what would be seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.errors import UsageError
from scanfind.results import result_folder
from scanfind.scans import STATION_WRITERS, open_stations, open_writer
from scanfind.simulate.instruments import Instrument
from scanfind.simulate.scanner import Block, Survey
from scanfind.simulate.scene import Scene
from scanfind.simulate.sight import Sight, remarks, sight_of
from scanfind.simulate.truth import (
    SIMULATION,
    TRUTH_JSON,
    model_file,
    station_name,
    target_meshes,
    truth_of,
    write_model,
    write_truth,
)
from scanfind.threads import available_cores

if TYPE_CHECKING:
    from scanfind.progress import Progress

Taker: TypeAlias = Callable[[Block], None]

FORMATS = ("e57", "laz", "ply", "ptx")
IDS = "scan.object_id.npy"


@dataclass(frozen=True, eq=False)
class Simulated:
    """What came of it.

    survey : the instrument at the resolution used, the stations, the scene
    sights : what is seen of each object, by object id
    remarks : for people, one line each
    truth : what truth.json holds
    """

    survey: Survey
    sights: tuple[Sight, ...]
    remarks: tuple[str, ...]
    truth: Mapping[str, Any]

    def targets(self) -> tuple[Sight, ...]:
        """Of what is looked for."""
        return tuple(sight for sight in self.sights if sight.target)

    def points(self) -> int:
        """In all."""
        return sum(sum(sight.points) for sight in self.sights)


def simulate(
    scene: Scene,
    out: str | Path | None = None,
    *,
    scanner: Instrument | None = None,
    stations: ArrayLike | None = None,
    points: int | None = None,
    seed: int = 0,
    format: str = "e57",
    overwrite: bool = False,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> Simulated:
    """Scan a scene; write it, its truth and its target models into a new folder, or the cloud alone into a file.

        out : a folder, which gets scan.<format>, truth.json and models/*.stl; a file, by its suffix the cloud alone;
            None: nothing is written, only what would be seen is found out
        stations, points, seed, scanner : as for `scan`
        overwrite : replace an older simulation of that name
        jobs : threads; None: one a core

    Memory is bounded whatever the number of points. Raises UsageError, InvalidGeometryError, OutputError,
    UnsupportedFormatError.
    """
    survey = Survey.of(scene, stations, scanner, seed, points)
    jobs, meshes = jobs or available_cores(), target_meshes(scene)
    alone = out is not None and Path(out).suffix.removeprefix(".").lower() in FORMATS
    if format not in FORMATS:
        msg = f"format must be one of {', '.join(FORMATS)}, got {format!r}"
        raise UsageError(msg)
    if out is None:
        counts = _scanned(survey, None, jobs, progress)
        return _told(survey, counts, {}, [])
    if alone:
        counts = _to_file(survey, Path(out), jobs, progress)
        return _told(survey, counts, {}, [])
    with result_folder(out, overwrite=overwrite, kind=SIMULATION) as folder:
        counts = _to_file(survey, folder / f"scan.{format}", jobs, progress, ids=folder / IDS)
        models = {name: model_file(name) for name in meshes}
        for name, mesh in meshes.items():
            write_model(folder / models[name], mesh)
        files = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
        told = _told(survey, counts, models, files)
        write_truth(folder / TRUTH_JSON, told.truth)
    return told


def _told(survey: Survey, counts: NDArray[np.int64], models: Mapping[str, str], files: list[str]) -> Simulated:
    objects = range(len(survey.scene.objects))
    sights = [sight_of(survey, k, tuple(counts[:, k].tolist())) for k in objects]
    return Simulated(survey, tuple(sights), tuple(remarks(survey, sights)), truth_of(survey, sights, models, files))


def _scanned(survey: Survey, take: Taker | None, jobs: int, progress: Progress | None) -> NDArray[np.int64]:
    """Make the survey; how many points each object has from each station, (stations, objects)."""
    counts = np.zeros((len(survey.poses), len(survey.scene.objects)), dtype=np.int64)
    done, beams = 0, survey.beams()
    for block in survey.blocks(jobs):
        counts[block.station] += np.bincount(block.cloud.attributes["object_id"], minlength=counts.shape[1])
        if take is not None:
            take(block)
        done += block.beams
        if progress is not None:
            progress("scan", done, beams)
    return counts


def _to_file(
    survey: Survey, path: Path, jobs: int, progress: Progress | None, ids: Path | None = None
) -> NDArray[np.int64]:
    """Make the survey and write its points.

    ids : where object ids go of a format that has no place for them
    """
    kind = path.suffix.removeprefix(".").lower()
    if survey.scanner.has_stations and kind in STATION_WRITERS:
        sink = _ptx(survey, path, ids) if kind == "ptx" else _by_station(survey, path, survey.fields())
    elif kind == "ptx":
        msg = f"{path.name}: PTX is a raster from each station, and this cloud has none: choose e57, laz or ply"
        raise UsageError(msg)
    else:
        sink = _merged(survey, path)
    with sink as take:
        return _scanned(survey, take, jobs, progress)


@contextmanager
def _by_station(survey: Survey, path: Path, fields: Mapping[str, np.dtype[Any]]) -> Iterator[Taker]:
    """A scan a station, with its pose."""
    raster, begun = (survey.scanner.rows(), survey.scanner.columns()), 0
    with open_stations(path, fields) as file:

        def take(block: Block) -> None:
            nonlocal begun
            if block.station == begun:
                file.station(station_name(begun), survey.poses[begun], raster)
                begun += 1
            file.write(block.cloud.xyz, {name: block.cloud.attributes[name] for name in fields})

        yield take


@contextmanager
def _ptx(survey: Survey, path: Path, ids: Path | None) -> Iterator[Taker]:
    """A block a station; the object ids apart, one a record of the file, -1 for beams without a point."""
    rows, columns = survey.scanner.rows(), survey.scanner.columns()
    kept = np.full((len(survey.poses), columns, rows) if ids else (0, 0, 0), -1, dtype=np.int32)
    fields = {name: dtype for name, dtype in survey.fields().items() if name in ("intensity", "row", "column")}
    with _by_station(survey, path, fields) as write:

        def take(block: Block) -> None:
            write(block)
            if ids:
                has = block.cloud.attributes
                kept[block.station, has["column"], has["row"]] = has["object_id"]

        yield take
    if ids:
        np.save(ids, kept.ravel())


@contextmanager
def _merged(survey: Survey, path: Path) -> Iterator[Taker]:
    """One cloud; where there are stations, each point says of which it is."""
    fields = survey.fields() | ({"station": np.dtype(np.int32)} if survey.scanner.has_stations else {})
    with open_writer(path, fields) as file:

        def take(block: Block) -> None:
            columns = {**block.cloud.attributes, "station": np.full(len(block.cloud), block.station, dtype=np.int32)}
            file.write(block.cloud.xyz, {name: columns[name] for name in fields})

        yield take
