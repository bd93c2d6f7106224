"""The scans of a site by their headers alone; one that cannot be read is among them, and is told of later."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from scanfind.cloud import PointCloud, ScanInfo, Station
from scanfind.errors import UnreadableFileError, UnsupportedFormatError
from scanfind.scans.sources import Scan, Source, origin_of, scans_of, source_of


class One(NamedTuple):
    """A scan: where it is, what its header says. info : None where that cannot be read."""

    scan: Scan
    path: str
    number: int
    info: ScanInfo | None

    def opened(self, origin: tuple[float, float, float] | None) -> Source:
        """Ready to be read; raises as `scan_info` does."""
        return source_of(self.scan, None if origin is None else np.array(origin), self.number)


class Listed(NamedTuple):
    """All scans of a site. origin : where the scanner stood, for those that do not say."""

    all: list[One]
    origin: tuple[float, float, float] | None

    def infos(self) -> list[ScanInfo]:
        """What the headers say that can be read."""
        return [one.info for one in self.all if one.info is not None]

    def expected(self) -> int:
        """Records in all, -1 where only reading tells."""
        counts = [info.points for info in self.infos()]
        return -1 if min(counts, default=-1) < 0 else sum(counts)

    def crs(self) -> str | None:
        """The first coordinate reference system a scan states."""
        return next((info.crs for info in self.infos() if info.crs), None)


def listed_of(scans: Scan | Sequence[Scan], origin: ArrayLike | None) -> Listed:
    """The scans, by their headers; raises UsageError where there is none."""
    where = origin_of(origin)
    every = [One(scan, path_of(scan, k), k, info_of(scan, k)) for k, scan in enumerate(scans_of(scans))]
    return Listed(every, None if where is None else (float(where[0]), float(where[1]), float(where[2])))


def path_of(scan: Scan, number: int) -> str:
    """What a scan is called."""
    return str(scan) if isinstance(scan, (str, PathLike)) else f"array {number}"


def info_of(scan: Scan, number: int) -> ScanInfo | None:
    """What a scan's header says, None where it cannot be read."""
    from scanfind.scans import scan_info

    if isinstance(scan, (str, PathLike)):
        try:
            return scan_info(Path(scan))
        except (UnreadableFileError, UnsupportedFormatError):
            return None
    origin = scan.origin if isinstance(scan, PointCloud) else None
    at = None if origin is None else (float(origin[0]), float(origin[1]), float(origin[2]))
    return ScanInfo(path_of(scan, number), "array", len(scan), (Station(path_of(scan, number), len(scan), at),))
