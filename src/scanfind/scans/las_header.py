"""The header of a LAS, LAZ or COPC file, checked against the file's size before anything believes it.

LAS 1.4 R15 specification, tables 3 (header), 5 (variable length records) and 24 (extra bytes). Written here rather
than left to laspy, which does not return from a header of a thousand million variable length records.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple, NoReturn

import numpy as np

from scanfind.cloud import Floats
from scanfind.errors import UnreadableFileError

# Bytes of the header up to minor version 2, 3, 4, 5.
HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
# Bytes of a point in formats 0 to 10.
FORMAT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
EXTRA_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
EXTRA_BYTES, LASZIP, WKT, GEO_KEYS = 4, 22204, 2112, 34735
# Our writer's ending for the extra dimension that holds exactly what a dimension of the point format could not.
EXACT = "_exact"
PROJECTED_CRS, GEOGRAPHIC_CRS, USER_DEFINED = 3072, 2048, 32767


class ExtraDimension(NamedTuple):
    """A dimension beyond the point format: `values` numbers of `dtype` a point, times scale plus offset where set."""

    name: str
    dtype: str
    values: int = 1
    scale: tuple[float, ...] | None = None
    offset: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class LasHeader:
    """What the header says, proven possible.

    points : point records; they are there, if the file is not compressed
    start : byte of the first point record
    scale, offset : (3,) metres = record * scale + offset
    laszip : the LASzip record of a compressed file, else None
    crs : WKT, or "EPSG:nnnn" where the file has GeoTIFF keys only
    """

    version: str
    point_format: int
    record_bytes: int
    points: int
    start: int
    scale: Floats
    offset: Floats
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    extra: tuple[ExtraDimension, ...]
    laszip: bytes | None
    crs: str | None


def read_header(path: Path) -> LasHeader:
    """Read and check the header; raises UnreadableFileError for one that cannot be true."""
    with path.open("rb") as file:
        return parse_header(file, path.stat().st_size, path.name)


def parse_header(file: BinaryIO, size: int, name: str) -> LasHeader:
    """As `read_header`, from an open file of `size` bytes called `name`."""

    def refuse(why: str) -> NoReturn:
        msg = f"{name} is damaged or not a LAS file: {why}"
        raise UnreadableFileError(msg)

    head = file.read(HEADER_BYTES[5])
    if head[:4] != b"LASF":
        refuse("it does not begin with LASF")
    if len(head) < HEADER_BYTES[0]:
        refuse(f"it has {len(head)} bytes, a header alone has {HEADER_BYTES[0]}")
    major, minor = head[24], head[25]
    if major != 1 or minor not in HEADER_BYTES:
        refuse(f"version {major}.{minor} does not exist")
    header_bytes, start, vlrs, format_byte, record_bytes, points = struct.unpack_from("<HIIBHI", head, 94)
    if not HEADER_BYTES[minor] <= header_bytes <= start <= size or len(head) < HEADER_BYTES[minor]:
        refuse(f"header of {header_bytes} bytes, points from byte {start}, but the file has {size} bytes")
    # Two bits of the format byte mark LASzip compression.
    point_format, compressed = format_byte & 0x3F, bool(format_byte & 0xC0)
    if point_format >= len(FORMAT_BYTES) or record_bytes < FORMAT_BYTES[point_format]:
        refuse(f"point format {point_format} with records of {record_bytes} bytes")
    if vlrs * 54 > start - header_bytes:
        refuse(f"{vlrs:,} variable length records do not fit before the points at byte {start}")
    evlrs_start, evlrs = 0, 0
    if minor >= 4:
        evlrs_start, evlrs, long_points = struct.unpack_from("<QIQ", head, 235)
        points = long_points or points
    numbers = np.frombuffer(head, "<f8", 12, 131)
    scale, offset = numbers[:3].copy(), numbers[3:6].copy()
    if not np.isfinite(numbers[:6]).all() or (scale == 0).any():
        refuse(f"scale {scale.tolist()}, offset {offset.tolist()}")

    if not compressed and points * record_bytes > size - start:
        there = (size - start) // record_bytes
        msg = f"{name} is cut short: its header promises {points:,} points, {there:,} are there"
        raise UnreadableFileError(msg)

    records = list(_records(file, header_bytes, start, vlrs))
    extended = list(_extended_records(file, evlrs_start, size, evlrs))
    laszip = next((data for _, number, data in records if number == LASZIP), None)
    if compressed and laszip is None:
        refuse("its points are compressed, but the LASzip record that says how is missing")
    return LasHeader(
        f"{major}.{minor}",
        point_format,
        record_bytes,
        points,
        start,
        scale,
        offset,
        _bounds(numbers[6:], scale, offset),
        tuple(_extra_dimensions(records, record_bytes - FORMAT_BYTES[point_format])),
        laszip if compressed else None,
        _crs(records + extended),
    )


Record = tuple[str, int, bytes]


def _records(file: BinaryIO, at: int, end: int, count: int) -> Iterator[Record]:
    """(user, number, data) of the variable length records between two bytes; one that overruns ends the list."""
    file.seek(at)
    block = file.read(end - at)
    at = 0
    for _ in range(count):
        if at + 54 > len(block):
            return
        user, number, length = struct.unpack_from("<16sHH", block, at + 2)
        at += 54 + length
        if at > len(block):
            return
        yield user.split(b"\0")[0].decode("latin-1"), number, block[at - length : at]


def _extended_records(file: BinaryIO, at: int, size: int, count: int) -> Iterator[Record]:
    """The same for the extended records after the points; only a CRS is read, others may be gigabytes."""
    for _ in range(count):
        if at + 60 > size:
            return
        file.seek(at)
        user, number, length = struct.unpack_from("<16sHQ", file.read(60), 2)
        if at + 60 + length > size:
            return
        if number in (WKT, GEO_KEYS):
            yield user.split(b"\0")[0].decode("latin-1"), number, file.read(length)
        at += 60 + length


def _extra_dimensions(records: list[Record], room: int) -> Iterator[ExtraDimension]:
    """The dimensions of the extra bytes record that fit into `room` bytes, and the rest undocumented."""
    described = b"".join(data for user, number, data in records if number == EXTRA_BYTES and user == "LASF_Spec")
    for at in range(0, len(described) - 191, 192):
        kind, options, raw_name = struct.unpack_from("<BB32s", described, at + 2)
        name = raw_name.split(b"\0")[0].decode("utf-8", "replace").strip() or "extra_bytes"
        numbers = struct.unpack_from("<6d", described, at + 112)
        if kind == 0:
            dimension = ExtraDimension(name, "u1", options)
        elif kind <= 30:
            # Types 11 to 30 are the pairs and triples of the first ten; deprecated, still met.
            count = (kind - 1) // 10 + 1
            scale = numbers[:count] if options & 8 else None
            offset = numbers[3 : 3 + count] if options & 16 else None
            dimension = ExtraDimension(name, "<" + EXTRA_TYPES[(kind - 1) % 10], count, scale, offset)
        else:
            break
        size = dimension.values * np.dtype(dimension.dtype).itemsize
        if not 0 < size <= room:
            break
        room -= size
        yield dimension
    if room:
        yield ExtraDimension("extra_bytes", "u1", room)


def _crs(records: list[Record]) -> str | None:
    wkt = next((data for user, number, data in records if number == WKT and user in ("LASF_Projection", "liblas")), b"")
    if text := wkt.split(b"\0")[0].decode("utf-8", "replace").strip():
        return text
    keys = next((data for _, number, data in records if number == GEO_KEYS), b"")
    entries = np.frombuffer(keys[: len(keys) // 8 * 8], "<u2").reshape(-1, 4)[1:].tolist()
    # A key's third number is how many values lie elsewhere; its value is here only where its second is 0.
    codes = {key: value for key, elsewhere, _, value in entries if elsewhere == 0 and 0 < value < USER_DEFINED}
    code = codes.get(PROJECTED_CRS) or codes.get(GEOGRAPHIC_CRS)
    return f"EPSG:{code}" if code else None


def _bounds(
    numbers: Floats, scale: Floats, offset: Floats
) -> tuple[tuple[float, float, float], tuple[float, float, float]] | None:
    """The header's box, None where no 32-bit record could lie at its ends: some writers forget to scale it."""
    high, low = numbers.reshape(3, 2).T
    with np.errstate(over="ignore"):
        reach = 2.0**31 * np.abs(scale) * (1 + 1e-9)
        reached = (offset - reach <= low) & (low <= high) & (high <= offset + reach)
    if not np.isfinite(numbers).all() or not reached.all():
        return None
    a, b = low.tolist(), high.tolist()
    return (a[0], a[1], a[2]), (b[0], b[1], b[2])
