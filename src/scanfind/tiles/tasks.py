"""What a worker does with a scan: sum it up, cut its points. Each task depends on its arguments alone."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.detection import IsolatedPoints, SceneScan
from scanfind.dimensions import plan_of
from scanfind.errors import InvalidGeometryError, UnreadableFileError, UnsupportedFormatError
from scanfind.grid.moments import MomentGrid
from scanfind.isolation.isolate import IsolateParameters, Isolator, Placed, joined, pieces_of
from scanfind.library.near_surface import near_model
from scanfind.parameters import Parameters
from scanfind.pose import Pose
from scanfind.recognition.around import FARTHEST_M
from scanfind.recognition.stands import as_designed
from scanfind.scans.sources import Scan, source_of
from scanfind.tiles.plan import BASE_BYTES, bin_metres, margin_of
from scanfind.tiles.stored import Store, summed_rows

if TYPE_CHECKING:
    from scanfind.dimensions import Plan
    from scanfind.evidence.neighbours import Design
    from scanfind.kernels.distance import NearSurface
    from scanfind.library.model import Model

# A grid is written out when it takes a third of the memory: its arrays double, and a chunk of points lies beside it.
GRID_SHARE = 1.0 / 3.0
LEAST_GRID_BYTES = 50_000_000
STATIONS_AT_ONCE = 16  # whose beams are held while a scan is summed up, 6 MB each


@dataclass(frozen=True)
class Job:
    """What all tasks of a run share.

    folder : the working folder, the same for all workers; the models lie in it
    cell, offset : of every grid; blocks : log2 of the blocks along a bin's edge
    memory : bytes a worker may take; jobs : its threads
    box : (2, 3) in which points are kept, scans' frame, metres; None: everywhere
    at_design : models are tried where the design has them, see `find`
    """

    folder: Path
    cell: float
    offset: tuple[float, float, float]
    blocks: int
    memory: int
    jobs: int
    parameters: Parameters
    seed: int
    origin: tuple[float, float, float] | None = None
    box: NDArray[np.float64] | None = None
    at_design: bool = False

    def grid(self) -> MomentGrid:
        """An empty one."""
        return MomentGrid(self.cell, np.array(self.offset), self.jobs, box=self.box)

    def models(self) -> list[Model]:
        """The models sought, in the order given."""
        return models_in(self.folder)

    def bin_m(self) -> float:
        """The edge of a bin, metres."""
        return bin_metres(self.cell, self.blocks)

    def margin(self, models: Sequence[Model]) -> int:
        """How many bins around a tile the search for some models needs."""
        # What is beside its place in the design is its owner's all the same.
        beside = FARTHEST_M if self.at_design else 0.0
        return ceil((margin_of(models) + beside) / self.bin_m())


class Summed(NamedTuple):
    """What became of one scan. missing : why it could not be read; then nothing of it is used."""

    told: SceneScan
    scans: int
    signed: bool
    unaddressable: int
    missing: str = ""


class Cut(NamedTuple):
    """Where the points of detections lie in a file of records: (detection, first byte, records, which of `dtypes`)."""

    pieces: list[tuple[int, int, int, int]]
    dtypes: list[np.dtype[Any]]
    fields: dict[str, np.dtype[Any]]


class Found(NamedTuple):
    """An instance for others to respect, or to cut the points of."""

    id: int
    model: str
    scene_from_model: Pose


@lru_cache(maxsize=2)
def models_in(folder: Path) -> list[Model]:
    """The models of a run."""
    with (folder / "models").open("rb") as file:
        models: list[Model] = pickle.load(file)
    return models


@lru_cache(maxsize=2)
def design_in(folder: Path) -> Design | None:
    """All elements of a design in their places, made ready for beams once a worker."""
    return as_designed(models_in(folder))


@lru_cache(maxsize=256)
def surface_of(folder: Path, name: str, reach: float) -> NearSurface:
    """A model's surface, made once a worker."""
    return near_model(next(model for model in models_in(folder) if model.name == name), reach)


@lru_cache(maxsize=256)
def plan_in(folder: Path, name: str) -> Plan | None:
    """What is to be measured of a model; None where there is nothing."""
    mesh = next(model for model in models_in(folder) if model.name == name).mesh
    plan = None if mesh is None else plan_of(mesh)
    return plan if plan and plan.wanted else None


def sum_up(folder: Path, job: Job, scan: Scan, number: int) -> Summed:
    """Pass over a scan once; its moments and beams lie in the folder then.

    One that cannot be read is told, not raised: of fifty, the others are searched.
    """
    path = f"array {number}" if not isinstance(scan, (str, Path)) else str(scan)
    store, grid, signed, left_out = Store(folder, job.blocks), job.grid(), True, 0
    room, stations = max(LEAST_GRID_BYTES, GRID_SHARE * (job.memory - BASE_BYTES)), set[int]()
    try:
        source = source_of(scan, None if job.origin is None else np.array(job.origin), number)
        for chunk in source.chunks():
            if grid.memory_bytes() > room or len(stations | {chunk.scan}) > STATIONS_AT_ONCE:
                store.write(grid)
                left_out += grid.unaddressable
                grid, stations = job.grid(), set()
            stations.add(chunk.scan)
            grid.add(chunk)
            signed &= grid.signed
    except (UnreadableFileError, UnsupportedFormatError, InvalidGeometryError) as error:
        for part in folder.iterdir():
            shutil.rmtree(part)
        return Summed(SceneScan(path, 0, 0, ()), 1, True, 0, str(error))
    store.write(grid)
    return Summed(source.told(), source.scans(), signed, left_out + grid.unaddressable)


def count(folder: Path, parts: Sequence[Path], bins: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many rows some bins (K, 3) have when all parts are summed, (K,)."""
    return summed_rows(parts, bins)


def isolator_of(job: Job, found: Sequence[Found], tolerance: float) -> Isolator:
    """What says of each raw point to which instance it belongs."""
    placed = [Placed(one.id, surface_of(job.folder, one.model, tolerance), one.scene_from_model) for one in found]
    return Isolator(placed, IsolateParameters(tolerance), jobs=job.jobs)


def cut(folder: Path, job: Job, scan: Scan, number: int, found: Sequence[Found], tolerance: float, first: int) -> Cut:
    """Pass over a scan once more; the points of detections lie in the folder then, in the order of the file.

    first : the number of its first scan among all
    """
    isolator = isolator_of(job, found, tolerance)
    source = source_of(scan, None if job.origin is None else np.array(job.origin), number)
    pieces: list[tuple[int, int, int, int]] = []
    dtypes: list[np.dtype[Any]] = []
    fields: dict[str, np.dtype[Any]] = {}
    with (folder / "points").open("wb") as file:
        for chunk in source.chunks(first):
            for name, values in chunk.attributes.items():
                fields[name] = np.promote_types(fields.get(name, values.dtype), values.dtype)
            for key, points in pieces_of(chunk, *isolator.cut(chunk)):
                records = packed(points)
                if records.dtype not in dtypes:
                    dtypes.append(records.dtype)
                pieces.append((key, file.tell(), len(records), dtypes.index(records.dtype)))
                file.write(records.view(np.uint8).data)
    return Cut(pieces, dtypes, fields)


OURS = (("xyz", "f8", (3,)), ("source_index", "i8"), ("scan_id", "i4"), ("deviation", "f4"))


def packed(points: IsolatedPoints) -> NDArray[Any]:
    """Points as records (N,); attributes are numbered after ours, since their names may be anything."""
    attributes = [(f"a:{name}", values.dtype) for name, values in points.attributes.items()]
    records = np.empty(len(points), np.dtype([*OURS, *attributes]))
    for name in ("xyz", "source_index", "scan_id", "deviation"):
        records[name] = getattr(points, name)
    for name, values in points.attributes.items():
        records[f"a:{name}"] = values
    return records


def unpacked(records: NDArray[Any]) -> IsolatedPoints:
    """Records (N,) as points."""
    columns = {name: np.ascontiguousarray(records[name]) for name in records.dtype.names or ()}
    attributes = {name.removeprefix("a:"): values for name, values in columns.items() if name.startswith("a:")}
    return IsolatedPoints(columns["xyz"], attributes, columns["scan_id"], columns["source_index"], columns["deviation"])


def gathered(cuts: Sequence[tuple[Path, Cut]], key: int) -> IsolatedPoints:
    """The points of one detection from all scans, in their order."""
    pieces: list[IsolatedPoints] = []
    fields: dict[str, np.dtype[Any]] = {}
    for folder, told in cuts:
        for name, dtype in told.fields.items():
            fields[name] = np.promote_types(fields.get(name, dtype), dtype)
        with (folder / "points").open("rb") as file:
            for of, start, count, kind in told.pieces:
                if of == key:
                    file.seek(start)
                    pieces.append(unpacked(np.fromfile(file, told.dtypes[kind], count)))
    return joined(pieces, fields)


def on_disk(points: IsolatedPoints, folder: Path) -> IsolatedPoints:
    """The same points, mapped from files: those of all detections of a site may be more than memory holds."""
    if not len(points):
        return points
    folder.mkdir(parents=True, exist_ok=True)

    def mapped(name: str, values: NDArray[Any]) -> NDArray[Any]:
        np.save(folder / f"{name}.npy", values)
        array: NDArray[Any] = np.load(folder / f"{name}.npy", mmap_mode="r")
        return array

    attributes = {name: mapped(f"attribute{k}", values) for k, (name, values) in enumerate(points.attributes.items())}
    return IsolatedPoints(
        mapped("xyz", points.xyz), attributes, mapped("scan_id", points.scan_id),
        mapped("source_index", points.source_index), mapped("deviation", points.deviation),
    )  # fmt: skip
