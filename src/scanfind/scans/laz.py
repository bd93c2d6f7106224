"""LASzip: the chunks of a compressed file, each checked before lazrs decompresses it.

lazrs is written in Rust and does not corrupt memory, but it reserves what a file claims to need, and panics where it
expected an honest one. Both are prevented here: every length is compared with the bytes that are there.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UnreadableFileError, UnsupportedFormatError
from scanfind.scans.las_header import FORMAT_BYTES, LasHeader

POINTWISE, POINTWISE_CHUNKED, LAYERED = 1, 2, 3
VARIABLE_CHUNKS = 0xFFFF_FFFF
# The LASzip items of point formats 0 to 10; extra bytes are one more, 0 up to format 5, 14 from 6 on.
ITEMS = ((6,), (6, 7), (6, 8), (6, 7, 8), (6, 7, 9), (6, 7, 8, 9), (10,), (10, 11), (10, 12), (10, 13), (10, 12, 13))
ITEM_BYTES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
# In a layered chunk each item is stored as so many layers; extra bytes as one layer a byte.
ITEM_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
# A chunk is decompressed as a whole. Writers make them of 50 thousand points; octree nodes reach a few hundred.
MOST_CHUNK_POINTS = 20_000_000


class Chunk(NamedTuple):
    """One compressed chunk: how many points in how many bytes."""

    points: int
    bytes: int


class Compression(NamedTuple):
    """The LASzip record: compressor, points a chunk (VARIABLE_CHUNKS: the table says), layers a chunk (0: none)."""

    record: bytes
    compressor: int
    chunk_points: int
    layers: int


def decompressed(path: Path, header: LasHeader, block_points: int) -> Iterator[NDArray[np.uint8]]:
    """The point records as bytes, in blocks of whole chunks: up to `block_points`, but at least one chunk.

    Raises UnreadableFileError for chunks that do not add up, UnsupportedFormatError for unknown compression.
    """
    if not header.points:
        return
    how = _compression(path.name, header)
    with path.open("rb") as file:
        chunks = _chunks(file, path.name, header, how)
        for group in _groups(chunks, block_points):
            packed = file.read(sum(chunk.bytes for chunk in group))
            _check_chunks(packed, group, header, how, path.name)
            yield _decompress(packed, group, header, how, path.name)


def _decompress(packed: bytes, group: list[Chunk], header: LasHeader, how: Compression, name: str) -> NDArray[np.uint8]:
    import lazrs

    table = [tuple(chunk) for chunk in group]
    try:
        block = np.empty(sum(chunk.points for chunk in group) * header.record_bytes, np.uint8)
        lazrs.decompress_points_with_chunk_table(packed, how.record, block, table)
    except BaseException as error:
        _raise_damaged(error, name)
    return block


def _compression(name: str, header: LasHeader) -> Compression:
    """Compare the LASzip record with the point format."""
    record = header.laszip or b""
    kinds = ITEMS[header.point_format]
    sizes = [ITEM_BYTES[kind] for kind in kinds]
    if extra := header.record_bytes - FORMAT_BYTES[header.point_format]:
        kinds, sizes = (*kinds, 0 if header.point_format < 6 else 14), [*sizes, extra]
    if len(record) < 34 + 6 * len(kinds):
        msg = f"{name} is damaged: its LASzip record has {len(record)} bytes"
        raise UnreadableFileError(msg)
    compressor, coder, chunk_points, count = struct.unpack_from("<HH8xI16xH", record)
    items = [struct.unpack_from("<HHH", record, 34 + 6 * k) for k in range(len(kinds))]
    if count != len(kinds) or [item[:2] for item in items] != list(zip(kinds, sizes, strict=True)):
        msg = f"{name} is damaged: its LASzip record does not fit point format {header.point_format}"
        raise UnreadableFileError(msg)
    layered = header.point_format >= 6
    versions = {3} if layered else {1, 2}
    compressors = (LAYERED,) if layered else (POINTWISE, POINTWISE_CHUNKED)
    if compressor not in compressors or coder != 0 or not {item[2] for item in items} <= versions:
        msg = f"{name}: LASzip compressor {compressor} is not read for these items; re-save it with a current LASzip"
        raise UnsupportedFormatError(msg)
    if chunk_points == 0 and compressor != POINTWISE:
        msg = f"{name} is damaged: chunks of no points"
        raise UnreadableFileError(msg)
    layers = sum(ITEM_LAYERS.get(kind, size) for kind, size in zip(kinds, sizes, strict=True)) if layered else 0
    return Compression(record, compressor, chunk_points, layers)


def _chunks(file: BinaryIO, name: str, header: LasHeader, how: Compression) -> list[Chunk]:
    """The chunk table, proven to add up; leaves the file at the first chunk."""
    size = os.fstat(file.fileno()).st_size
    file.seek(header.start)
    if how.compressor == POINTWISE:
        # Before LASzip 2 there were no chunks: the whole file is one.
        chunks = [Chunk(header.points, size - header.start)]
    else:
        chunks = _chunk_table(file, size, name, header, how)
    most = max(chunk.points for chunk in chunks)
    if most > MOST_CHUNK_POINTS:
        msg = f"{name}: a LASzip chunk of {most:,} points does not fit in memory; re-save it with smaller chunks"
        raise UnsupportedFormatError(msg)
    return chunks


def _chunk_table(file: BinaryIO, size: int, name: str, header: LasHeader, how: Compression) -> list[Chunk]:
    import lazrs

    first = header.start + 8
    at = _number(file, header.start)
    if at <= header.start:
        # A writer that could not seek back left the position at the end of the file.
        at = _number(file, size - 8)
    if not first <= at <= size - 8:
        msg = f"{name} is cut short: its chunk table should be at byte {at:,}, the file has {size:,}"
        raise UnreadableFileError(msg)
    file.seek(at + 4)
    count = int.from_bytes(file.read(4), "little")
    # Each chunk begins with one record as it is.
    if count * header.record_bytes > at - first:
        msg = f"{name} is damaged: {count:,} chunks in {at - first:,} bytes"
        raise UnreadableFileError(msg)
    file.seek(header.start)
    try:
        table = [Chunk(*entry) for entry in lazrs.read_chunk_table(file, lazrs.LazVlr(how.record))]
    except BaseException as error:
        _raise_damaged(error, name)
    if how.chunk_points != VARIABLE_CHUNKS:
        # Every chunk is full but the last one, and the table does not say how full that is.
        left = range(header.points, 0, -how.chunk_points)
        table = [Chunk(min(n, how.chunk_points), c.bytes) for n, c in zip(left, table, strict=False)]
    points, packed = sum(chunk.points for chunk in table), sum(chunk.bytes for chunk in table)
    if points != header.points or packed > at - first:
        msg = f"{name} is damaged: its header promises {header.points:,} points, its chunks hold {points:,}"
        raise UnreadableFileError(msg)
    file.seek(first)
    return table


def _check_chunks(packed: bytes, group: list[Chunk], header: LasHeader, how: Compression, name: str) -> None:
    """Compare the layer sizes at the head of each chunk with the chunk: lazrs reserves up to 4 GB for each."""
    head = header.record_bytes + 4 * (1 + how.layers if how.layers else 0)
    at = 0
    for chunk in group:
        sizes = np.frombuffer(packed[at + header.record_bytes + 4 : at + head], "<u4")
        at += chunk.bytes
        if at > len(packed) or (chunk.points and head + int(sizes.sum(dtype=np.int64)) > chunk.bytes):
            msg = (
                f"{name} is damaged: a chunk of {chunk.points:,} points is larger than the {chunk.bytes:,} bytes it has"
            )
            raise UnreadableFileError(msg)


def _groups(chunks: list[Chunk], block_points: int) -> Iterator[list[Chunk]]:
    """Consecutive chunks, as many as `block_points` allows, at least one."""
    group: list[Chunk] = []
    points = 0
    for chunk in chunks:
        if group and points + chunk.points > block_points:
            yield group
            group, points = [], 0
        group.append(chunk)
        points += chunk.points
    yield group


def _number(file: BinaryIO, at: int) -> int:
    """The signed 64-bit number at a byte; 0 beyond the end of the file."""
    file.seek(max(at, 0))
    return int.from_bytes(file.read(8), "little", signed=True)


def _raise_damaged(error: BaseException, name: str) -> NoReturn:
    # A Rust panic arrives as pyo3_runtime.PanicException, which is not an Exception.
    if isinstance(error, Exception) or type(error).__module__ == "pyo3_runtime":
        msg = f"{name} is damaged: its compressed points do not decode ({str(error).splitlines()[0]})"
        raise UnreadableFileError(msg) from error
    raise error
