"""Scan files in and out, streamed: one module a format, two tables, no format known anywhere else.

A format module has the functions and, where the format can be written, the class below; a new format is one such
module and one line in a table, and `tests/test_scans_contract.py` picks it up.

    def info(path: Path) -> ScanInfo                                    from the headers only, fast
    def read(path: Path, chunk_points: int) -> Iterator[PointChunk]     in file order, bounded memory
    class Writer(CloudFile)                                             see `scanfind.scans.output`

What a reader promises:

- the same points, attributes and source indices whatever `chunk_points` is; no chunk is larger, and one is empty only
  where it has a `dropped` count to report;
- points whose file calls them invalid, or that are not finite, are dropped and counted, never passed on;
- every field of the file is an attribute: the names of `KNOWN_ATTRIBUTES` where they fit, else the file's own name;
- a file that is damaged, cut short or hostile raises UnreadableFileError, one line; it does not crash, hang, or make us
  reserve memory the file's size does not justify.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from scanfind.cloud import CHUNK_POINTS, Attributes, Floats, PointChunk, ScanInfo
from scanfind.errors import UnreadableFileError, UnsupportedFormatError, UsageError
from scanfind.pose import Pose

# Suffix → module of this package. A COPC file (.copc.laz) is a LAZ file.
SCAN_READERS: Mapping[str, str] = {
    ".e57": "e57",
    ".las": "las",
    ".laz": "las",
    ".ply": "ply",
    ".pcd": "pcd",
    ".ptx": "text",
    ".pts": "text",
    ".xyz": "text",
    ".txt": "text",
    ".csv": "text",
    ".asc": "text",
}

# Suffix without its dot, as `--format` takes it → module of this package.
CLOUD_WRITERS: Mapping[str, str] = {
    "ply": "ply",
    "laz": "las_writer",
    "las": "las_writer",
    "e57": "e57_writer",
    "pcd": "pcd",
}

# Suffix without its dot → module whose StationsWriter keeps where each station stood.
STATION_WRITERS: Mapping[str, str] = {"e57": "e57_writer", "ptx": "ptx_writer"}


class CloudWriter(Protocol):
    """An open cloud file that points stream into; it appears under its name only when closed without an error."""

    def write(self, xyz: ArrayLike, attributes: Attributes) -> None:
        """Append points (N, 3), metres, in the scene's own frame, and their attributes name → (N,).

        A field announced at opening that is missing here is filled with 0, or NaN where it is a float.
        """

    def close(self) -> None:
        """Complete the file and give it its name."""

    def abort(self) -> None:
        """Leave nothing behind."""

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None: ...


class StationsFile(CloudWriter, Protocol):
    """An open file of several scans, each with its pose. Points are given in the scene's frame, station by station."""

    def station(self, name: str, pose: Pose, raster: tuple[int, int]) -> None:
        """Begin a scan: what is written from now on is its own.

        pose : scene_from_station
        raster : how many rows and columns of beams it has; row and column of its points say which are theirs
        """


def read_scan(
    path: str | Path, *, chunk_points: int = CHUNK_POINTS, origin: ArrayLike | None = None
) -> Iterator[PointChunk]:
    """Stream the valid points of a scan file, at most `chunk_points` a chunk.

    origin : (3,) where the scanner stood, metres, in the file's frame; used for the scans that do not say
    Raises UnreadableFileError, UnsupportedFormatError, and UsageError for a wrong argument.
    """
    path = Path(path)
    if chunk_points < 1:
        msg = f"chunk_points must be at least 1, got {chunk_points}"
        raise UsageError(msg)
    return _chunks(_reader(path), path, chunk_points, None if origin is None else _as_origin(origin))


def scan_info(path: str | Path) -> ScanInfo:
    """What a scan file says of itself, without reading its points; raises as `read_scan` does."""
    path = Path(path)
    reader = _reader(path)
    try:
        info: ScanInfo = reader.info(path)
    except OSError as error:
        raise _unreadable(path, error) from error
    return info


def open_writer(
    path: str | Path,
    fields: Mapping[str, np.dtype[Any]],
    *,
    shift: ArrayLike = (0.0, 0.0, 0.0),
    crs: str | None = None,
) -> CloudWriter:
    """Open a cloud file for streaming; its suffix says the format. Use it as a context manager.

    fields : every attribute that will be written → its dtype
    shift : (3,) metres, near the points; formats of single precision keep their digits by it. Points are given and
        read back unshifted.
    crs : WKT, kept by the formats that have a place for it
    An older file of that name is replaced, and only on success. Raises UnsupportedFormatError, OutputError.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in CLOUD_WRITERS:
        msg = f"{path.name}: cannot write {path.suffix or 'a file without a suffix'}; choose {', '.join(CLOUD_WRITERS)}"
        raise UnsupportedFormatError(msg)
    dtypes = {name: np.dtype(dtype) for name, dtype in fields.items()}
    writer: CloudWriter = _module(CLOUD_WRITERS[kind]).Writer(path, dtypes, shift=_as_origin(shift), crs=crs)
    return writer


def open_stations(path: str | Path, fields: Mapping[str, np.dtype[Any]]) -> StationsFile:
    """Open a file of several scans for streaming, as `open_writer` does; `station` has to be called first.

    Raises UnsupportedFormatError for a format that knows no stations, or a field it has no place for.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in STATION_WRITERS:
        msg = f"{path.name}: {path.suffix} keeps no stations; choose {', '.join(STATION_WRITERS)}"
        raise UnsupportedFormatError(msg)
    dtypes = {name: np.dtype(dtype) for name, dtype in fields.items()}
    writer: StationsFile = _module(STATION_WRITERS[kind]).StationsWriter(path, dtypes, shift=np.zeros(3))
    return writer


def _reader(path: Path) -> ModuleType:
    suffix = path.suffix.lower()
    if path.is_dir():
        msg = f"{path} is a folder: give the scan files in it, for example {path}/*.e57"
        raise UnreadableFileError(msg)
    if not suffix and not path.exists():  # a folder most likely
        msg = f"{path}: no such file or folder"
        raise UnreadableFileError(msg)
    if suffix not in SCAN_READERS:
        near = difflib.get_close_matches(suffix, SCAN_READERS, n=1, cutoff=0.5)
        hint = f" (did you mean {near[0]}?)" if near else ""
        what = f"{suffix} is not a scan format" if suffix else "no suffix to tell the format by"
        msg = f"{path.name}: {what}{hint}; scans are read from {', '.join(SCAN_READERS)}"
        raise UnsupportedFormatError(msg)
    if not path.exists():
        msg = f"{path}: no such file"
        raise UnreadableFileError(msg)
    return _module(SCAN_READERS[suffix])


def _chunks(reader: ModuleType, path: Path, chunk_points: int, origin: Floats | None) -> Iterator[PointChunk]:
    try:
        for chunk in reader.read(path, chunk_points):
            yield chunk if chunk.origin is not None or origin is None else replace(chunk, origin=origin)
    except OSError as error:
        raise _unreadable(path, error) from error


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"scanfind.scans.{name}")


def _as_origin(point: ArrayLike) -> Floats:
    array = np.asarray(point, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        msg = f"a position is three finite numbers x y z in metres, got {point!r}"
        raise UsageError(msg)
    return array


def _unreadable(path: Path, error: OSError) -> UnreadableFileError:
    return UnreadableFileError(f"{path}: {error.strerror or error}")
