"""The scene's points, wherever they come from: files, arrays, clouds; several of them are one scene, streamed twice."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.cloud import CHUNK_POINTS, PointChunk, PointCloud, as_points
from scanfind.detection import SceneScan
from scanfind.errors import UnreadableFileError, UsageError

Scan: TypeAlias = "str | PathLike[str] | PointCloud | NDArray[np.float64]"
Floats = NDArray[np.float64]

# What of a folder is a scan: .txt, .csv and .asc may be anything, and are read where they are named.
FOLDER_SUFFIXES = (".e57", ".las", ".laz", ".ply", ".pcd", ".ptx", ".pts", ".xyz")


@dataclass(eq=False)
class Source:
    """One file or cloud of the scene, and what reading it told.

    expected : records it says it has, -1 where only reading tells
    scale : metres a unit of its coordinates: chunks and stations are in metres
    """

    path: str
    expected: int
    crs: str | None
    read: Callable[[], Iterator[PointChunk]]
    scale: float = 1.0
    points: int = 0
    dropped: int = 0
    stations: dict[int, tuple[float, float, float] | None] | None = None

    def chunks(self, first_scan: int = 0) -> Iterator[PointChunk]:
        """Every valid point, in order, its scans numbered from `first_scan` on. Counts what it passes."""
        self.points = self.dropped = 0
        self.stations = {}
        for raw in self.read():
            chunk = raw if self.scale == 1.0 else raw.scaled(self.scale)
            self.points += len(chunk)
            self.dropped += chunk.dropped
            at = None if chunk.origin is None else (*(float(x) for x in chunk.origin),)
            self.stations.setdefault(chunk.scan, at)  # type: ignore[arg-type]
            yield replace(chunk, scan=chunk.scan + first_scan)

    def scans(self) -> int:
        """How many scan numbers it takes up, once it was read."""
        return max(self.stations or {}, default=0) + 1

    def told(self) -> SceneScan:
        """What reading it told."""
        return SceneScan(self.path, self.points, self.dropped, tuple((self.stations or {}).values()))


class Sources:
    """All points of a scene, as often as they are asked for; `scan` numbers of chunks run on from file to file."""

    def __init__(self, scans: Scan | Sequence[Scan], origin: ArrayLike | None = None) -> None:
        where = origin_of(origin)
        self.all = [source_of(scan, where, number) for number, scan in enumerate(scans_of(scans))]

    def expected(self) -> int:
        """Records in all, -1 where only reading tells."""
        counts = [source.expected for source in self.all]
        return -1 if min(counts) < 0 else sum(counts)

    def chunks(self) -> Iterator[PointChunk]:
        """Every valid point of every source, in order. Counts what it passes."""
        first_scan = 0
        for source in self.all:
            yield from source.chunks(first_scan)
            first_scan += source.scans()

    def crs(self) -> str | None:
        """The first coordinate reference system a source states; coordinates that were scaled are in none."""
        return next((source.crs for source in self.all if source.crs and source.scale == 1.0), None)

    def in_metres(self, scale: float) -> None:
        """From now on all coordinates come times `scale`, metres a unit of the scans."""
        for source in self.all:
            source.scale = scale


def scans_of(scans: Scan | Sequence[Scan]) -> list[Scan]:
    """One by one: the scan files of a folder and those a pattern such as `setups/*.e57` names, sorted by name.

    Raises UsageError where there is none.
    """
    listed = [scans] if isinstance(scans, (str, PathLike, PointCloud, np.ndarray)) else list(scans)
    if not listed:
        msg = "find: no scan to search: give at least one scan file or point array"
        raise UsageError(msg)
    return [one for scan in listed for one in (files_of(scan) if isinstance(scan, (str, PathLike)) else [scan])]


def files_of(scan: str | PathLike[str]) -> list[str | PathLike[str]]:
    """A file as it is; a folder's scan files, or those a pattern names, sorted."""
    path = Path(scan)
    if path.is_dir():
        found = [file for file in path.iterdir() if file.suffix.lower() in FOLDER_SUFFIXES]
        what = f"{path}: no scan file in this folder: scans end in {', '.join(FOLDER_SUFFIXES)}"
    elif not path.exists() and set(path.name) & set("*?["):
        found, what = list(path.parent.glob(path.name)), f"{path}: no file of such a name"
    else:
        return [scan]
    if not found:
        raise UsageError(what)
    return [*sorted(found)]


def origin_of(origin: ArrayLike | None) -> Floats | None:
    """The door for a scanner position, (3,) or None; raises UsageError."""
    where = None if origin is None else np.asarray(origin, np.float64)
    if where is not None and (where.shape != (3,) or not np.isfinite(where).all()):
        msg = f"origin: the scanner position is three finite numbers, got {where.tolist()}"
        raise UsageError(msg)
    return where


def source_of(scan: Scan, origin: Floats | None, number: int) -> Source:
    """A file, a cloud or an array as a source."""
    if isinstance(scan, (str, PathLike)):
        from scanfind.scans import read_scan, scan_info

        path = Path(scan)
        info = scan_info(path)
        return Source(str(scan), info.points, info.crs, lambda: read_scan(path, origin=origin))
    cloud = replace(scan, xyz=as_points(scan.xyz)) if isinstance(scan, PointCloud) else PointCloud(as_points(scan))
    if cloud.origin is None and origin is not None:
        cloud = replace(cloud, origin=origin)
    return Source(f"array {number}", len(cloud), None, lambda: chunks_of(cloud))


def chunks_of(cloud: PointCloud, chunk_points: int = CHUNK_POINTS) -> Iterator[PointChunk]:
    """A cloud in memory as chunks; points that are not finite are dropped and counted."""
    origin = None if cloud.origin is None else np.asarray(cloud.origin, np.float64)
    for start in range(0, len(cloud), chunk_points):
        xyz = np.ascontiguousarray(cloud.xyz[start : start + chunk_points], np.float64)
        index = np.arange(start, start + len(xyz), dtype=np.int64)
        columns = {name: column[start : start + len(xyz)] for name, column in cloud.attributes.items()}
        # One pass over the sum: it is finite only where every coordinate is.
        with np.errstate(invalid="ignore", over="ignore"):
            finite = np.isfinite(xyz @ np.ones(3))
        if finite.all():
            yield PointChunk(xyz, columns, index, 0, origin)
        else:
            columns = {name: column[finite] for name, column in columns.items()}
            yield PointChunk(xyz[finite], columns, index[finite], 0, origin, int(np.count_nonzero(~finite)))


def require_points(sources: Sources) -> None:
    """Raise UnreadableFileError where the scene turned out to have no valid point at all."""
    if not any(source.points for source in sources.all):
        names, dropped = ", ".join(source.path for source in sources.all), sum(source.dropped for source in sources.all)
        msg = f"{names}: no valid point in it ({dropped} invalid records): check the export, or name another scan"
        raise UnreadableFileError(msg)
