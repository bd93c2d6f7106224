"""LAS, LAZ and COPC in. A COPC file is a LAZ file whose chunks are an octree's nodes; read in file order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import PointChunk, ScanInfo, Station
from scanfind.errors import UnreadableFileError
from scanfind.scans.las_header import EXACT, LasHeader, read_header
from scanfind.scans.laz import decompressed

# A chunk of records takes no more than this, even where each is 64 KiB long.
BLOCK_BYTES = 1 << 28


def info(path: Path) -> ScanInfo:
    """What the header says; raises UnreadableFileError where it cannot be true."""
    header = read_header(path)
    empty = _attributes(np.empty(0, record_dtype(header)), header)
    return ScanInfo(
        path=str(path),
        format=("LAZ " if header.laszip else "LAS ") + header.version,
        points=header.points,
        stations=(Station(path.stem, header.points),),
        attributes={name: str(values.dtype) for name, values in empty.items()},
        bounds=header.bounds,
        crs=header.crs,
    )


def read(path: Path, chunk_points: int) -> Iterator[PointChunk]:
    """Stream the points; LAS says nothing of scanner positions, so their origin is None."""
    header = read_header(path)
    chunk_points = min(chunk_points, max(1, BLOCK_BYTES // header.record_bytes))
    blocks = decompressed(path, header, chunk_points) if header.laszip else _stored(path, header, chunk_points)
    dtype = record_dtype(header)
    done = 0
    for block in blocks:
        records = block.view(dtype)
        for first in range(0, len(records), chunk_points):
            chunk = _chunk(records[first : first + chunk_points], header, done + first)
            if len(chunk) or chunk.dropped:
                yield chunk
        done += len(records)


def record_dtype(header: LasHeader) -> np.dtype[Any]:
    """One point record as the file stores it, extra dimensions numbered."""
    from laspy.point.dims import ALL_POINT_FORMATS_DTYPE

    standard: list[Any] = ALL_POINT_FORMATS_DTYPE[header.point_format].descr
    return np.dtype(standard + [(f"extra {k}", d.dtype, (d.values,)) for k, d in enumerate(header.extra)])


def _stored(path: Path, header: LasHeader, chunk_points: int) -> Iterator[NDArray[np.uint8]]:
    """Blocks of whole records, as bytes, of a file that is not compressed."""
    with path.open("rb") as file:
        file.seek(header.start)
        for first in range(0, header.points, chunk_points):
            wanted = min(chunk_points, header.points - first) * header.record_bytes
            block = np.fromfile(file, np.uint8, wanted)
            if len(block) < wanted:
                there = first + len(block) // header.record_bytes
                msg = f"{path.name} is cut short: its header promises {header.points:,} points, {there:,} are there"
                raise UnreadableFileError(msg)
            yield block


def _chunk(records: NDArray[Any], header: LasHeader, first: int) -> PointChunk:
    raw = np.column_stack([records["X"], records["Y"], records["Z"]])
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = raw * header.scale + header.offset
    attributes = _attributes(records, header)
    index = np.arange(first, first + len(records), dtype=np.int64)
    valid = np.isfinite(xyz).all(axis=1)
    if valid.all():
        return PointChunk(xyz, attributes, index)
    kept = {name: values[valid] for name, values in attributes.items()}
    return PointChunk(xyz[valid], kept, index[valid], dropped=int((~valid).sum()))


def _attributes(records: NDArray[Any], header: LasHeader) -> Mapping[str, NDArray[Any]]:
    """Every dimension but x, y, z: bit fields unpacked, extra dimensions scaled; copies, so that records can go."""
    from laspy.point.dims import COMPOSED_FIELDS

    packed = COMPOSED_FIELDS[header.point_format]
    columns: dict[str, NDArray[Any]] = {}
    for name in records.dtype.names or ():
        if name in packed:
            for field in packed[name]:
                lowest = field.mask & -field.mask
                columns[field.name] = (records[name] & field.mask) // np.uint8(lowest)
        elif name not in ("X", "Y", "Z") and not name.startswith("extra "):
            columns[name] = records[name].copy()
    for k, dimension in enumerate(header.extra):
        for part in range(dimension.values):
            name = dimension.name if dimension.values == 1 else f"{dimension.name}_{part}"
            values = records[f"extra {k}"][:, part].copy()
            if dimension.scale or dimension.offset:
                with np.errstate(over="ignore", invalid="ignore"):
                    values = values * (dimension.scale[part] if dimension.scale else 1.0)
                    values += dimension.offset[part] if dimension.offset else 0.0
            if name.endswith(EXACT) and name.removesuffix(EXACT) in columns:
                name = name.removesuffix(EXACT)
                del columns[name]
            columns[_unused(name, columns)] = values
    return columns


def _unused(name: str, taken: Mapping[str, object]) -> str:
    """`name`, or the first of name_2, name_3, ... that nothing else is called."""
    tried, number = name, 1
    while tried in taken:
        number += 1
        tried = f"{name}_{number}"
    return tried
