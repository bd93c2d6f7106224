"""Points with their attributes, as they stream through: chunks, what a file says of itself, and clouds in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.errors import InvalidGeometryError

Floats = NDArray[np.float64]
Attributes = Mapping[str, NDArray[Any]]

# The names every reader gives to what the formats call by twenty names. Anything else keeps the file's own name.
# All attribute arrays are one-dimensional, (N,), and keep the file's dtype.
KNOWN_ATTRIBUTES = (
    "intensity", "red", "green", "blue", "classification", "return_number", "number_of_returns", "gps_time",
    "normal_x", "normal_y", "normal_z", "row", "column",
)  # fmt: skip

# CloudCompare's rule: beyond this, a shift is taken off before anything is done in single precision.
SHIFT_BEYOND_M = 1e4
CHUNK_POINTS = 1_000_000


@dataclass(frozen=True, eq=False)
class PointChunk:
    """Some consecutive valid points of one scan.

    xyz : (N, 3) float64, metres, in the file's own frame (a scan's pose is applied), all finite
    attributes : name → (N,)
    source_index : (N,) int64, each point's record number in its file, counted over all scans of the file, dropped
        records included
    scan : which scan of its file, from 0
    origin : (3,) where the scanner stood, same frame; None where nobody knows
    dropped : how many invalid records were left out since the previous chunk
    """

    xyz: Floats
    attributes: Attributes
    source_index: NDArray[np.int64]
    scan: int = 0
    origin: Floats | None = None
    dropped: int = 0

    def __len__(self) -> int:
        return len(self.xyz)

    def scaled(self, factor: float) -> PointChunk:
        """The same in other units."""
        origin = None if self.origin is None else factor * self.origin
        return replace(self, xyz=factor * self.xyz, origin=origin)


@dataclass(frozen=True)
class Station:
    """One scan of a file: name, number of records its header states, where its scanner stood (or None)."""

    name: str
    points: int
    origin: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class ScanInfo:
    """What a scan file says of itself, from its headers, without reading the points.

    points : records in the file, valid or not; -1 where only reading tells (text files)
    attributes : name → dtype as numpy spells it
    bounds : ((min x, y, z), (max x, y, z)) in metres, None where the header has none
    crs : coordinate reference system as WKT, None where the file has none
    """

    path: str
    format: str
    points: int
    stations: tuple[Station, ...]
    attributes: Mapping[str, str] = field(default_factory=dict)
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    crs: str | None = None


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in memory: xyz (N, 3) float64 metres, attributes name → (N,), scanner origin (3,) or None."""

    xyz: Floats
    attributes: Attributes = field(default_factory=dict)
    origin: Floats | None = None

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class OrientedCloud:
    """Points with unit normals: points (N, 3), normals (N, 3), float64, metres; outwards where `signed`."""

    points: Floats
    normals: Floats
    signed: bool = True

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class CloudModel:
    """A piece of scan used as a model ("find more of this").

    points : (N, 3) float64, metres
    origin : (3,) where its scanner stood, same frame; None where nobody knows (then its normals have no known side)
    """

    name: str
    points: Floats
    source: str = ""
    origin: Floats | None = None


def as_points(array: ArrayLike, what: str = "points") -> Floats:
    """The door for arrays from outside: (N, 3) float64, C-contiguous; raises InvalidGeometryError."""
    try:
        points = np.ascontiguousarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        msg = f"{what} must be numbers of shape (N, 3): {error}"
        raise InvalidGeometryError(msg) from error
    if points.ndim != 2 or points.shape[1] != 3:
        msg = f"{what} must have shape (N, 3), got {points.shape}"
        raise InvalidGeometryError(msg)
    return points


def shift_for(point: ArrayLike) -> Floats:
    """The rounded shift (3,) that brings a far-away `point` near zero; zero where it is near already.

    CloudCompare's rule: a coordinate beyond 1e4 m is shifted, by a multiple of 100 m so that people can type it.
    """
    p = np.asarray(point, dtype=np.float64)
    return np.where(np.abs(p) > SHIFT_BEYOND_M, np.round(p / 100.0) * 100.0, 0.0)
