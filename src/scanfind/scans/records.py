"""From a file's records to PointChunks: what the plain formats (PLY, PCD, text) share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import Attributes, Floats, PointChunk
from scanfind.errors import UnreadableFileError
from scanfind.scans.rows import Lines, layout_of, parse

# A chunk of records takes no more than this, even where each is 64 KiB long.
BLOCK_BYTES = 1 << 28
# PLY and PCD headers have a few hundred bytes; one that does not end is no header.
LONGEST_HEADER = 1 << 20


class Block(NamedTuple):
    """Consecutive records, valid or not: xyz (N, 3) metres, attributes name → (N,)."""

    xyz: Floats
    attributes: Attributes


def valid_chunks(
    blocks: Iterable[Block], chunk_points: int, *, scan: int = 0, origin: Floats | None = None, first: int = 0
) -> Iterator[PointChunk]:
    """The finite points of one scan, at most `chunk_points` a chunk; the others are counted as dropped.

    first : record number of the first record of the first block
    """
    dropped, begin = 0, first
    last: PointChunk | None = None
    for block in blocks:
        for start in range(0, len(block.xyz), chunk_points):
            part = slice(start, start + chunk_points)
            xyz = block.xyz[part]
            attributes = {name: values[part] for name, values in block.attributes.items()}
            index = np.arange(begin, begin + len(xyz), dtype=np.int64)
            begin += len(xyz)
            finite = np.isfinite(xyz).all(axis=1)
            if not finite.all():
                xyz, index = xyz[finite], index[finite]
                attributes = {name: values[finite] for name, values in attributes.items()}
                dropped += int((~finite).sum())
            last = PointChunk(xyz, attributes, index, scan, origin, dropped)
            if len(last):
                yield last
                dropped = 0
    if last is not None and dropped:
        none = {name: values[:0] for name, values in last.attributes.items()}
        yield PointChunk(last.xyz[:0], none, last.source_index[:0], scan, origin, dropped)


def stored_records(
    file: BinaryIO, dtype: np.dtype[Any], count: int, chunk_points: int, name: str
) -> Iterator[NDArray[Any]]:
    """`count` records of fixed size from where `file` stands, at most `chunk_points` at a time."""
    most = min(chunk_points, max(1, BLOCK_BYTES // dtype.itemsize))
    for first in range(0, count, most):
        wanted = min(most, count - first)
        records = np.fromfile(file, dtype, wanted)
        if len(records) < wanted:
            raise cut_short(name, count, first + len(records))
        yield records


def as_doubles(columns: Iterable[NDArray[Any]]) -> Floats:
    """Three columns (N,) of any type → (N, 3)."""
    # A signalling NaN of single precision warns when it is widened.
    with np.errstate(invalid="ignore"):
        return np.column_stack([column.astype(np.float64) for column in columns])


def native(column: NDArray[Any]) -> NDArray[Any]:
    """A copy in this machine's byte order, so that the records can go."""
    return column.astype(column.dtype.newbyteorder("="))


def declared_rows(lines: Lines, dtypes: Sequence[np.dtype[Any]], count: int, name: str) -> Iterator[list[NDArray[Any]]]:
    """The next `count` rows of a text whose header declares its columns, as far as a block goes at a time."""
    # Doubles hold any other type exactly.
    wide = tuple((k, dtype.str[1:]) for k, dtype in enumerate(dtypes) if dtype.kind in "iu" and dtype.itemsize == 8)
    done = 0
    while done < count:
        rows = lines.take(count - done)
        if not rows.count:
            raise cut_short(name, count, done)
        yield parse(rows, layout_of(rows.text)._replace(columns=len(dtypes), wide=wide), name)
        done += rows.count


def declared_block(
    table: list[NDArray[Any]], xyz: Sequence[int], attributes: Mapping[str, tuple[int, np.dtype[Any]]], name: str
) -> Block:
    """A block of text columns; each attribute is a column and the type its header declares."""
    points = as_doubles(table[k] for k in xyz)
    valid = np.asarray(np.isfinite(points).all(axis=1))
    declared = {a: as_declared(table[k], dtype, valid, f"{name}: {a}") for a, (k, dtype) in attributes.items()}
    return Block(points, declared)


def as_declared(values: NDArray[Any], dtype: np.dtype[Any], valid: NDArray[np.bool_], what: str) -> NDArray[Any]:
    """Numbers read from text as the type their header declares; only the `valid` ones have to fit it.

    Raises UnreadableFileError where a number does not: a lie would become another number.
    """
    dtype = dtype.newbyteorder("=")
    if dtype.kind == "f" or values.dtype == dtype:
        with np.errstate(over="ignore", invalid="ignore"):
            return values.astype(dtype)
    kept = np.where(valid, values, 0)
    if not fits(kept, dtype):
        misfit = next(value for value in kept.tolist() if not fits(np.array([value]), dtype))
        msg = f"{what} is {dtype} by the file's header or first rows, but holds {misfit}"
        raise UnreadableFileError(msg)
    return kept.astype(dtype)


def fits(values: NDArray[Any], dtype: np.dtype[Any]) -> bool:
    """Whether all values are whole numbers within the range of an integer type."""
    limits = np.iinfo(dtype)
    # Compared as doubles, 2^63 would pass for the largest int64: hence < on the next power of two.
    inside = (values >= float(limits.min)) & (values < float(limits.max) + 1.0)
    return bool(inside.all()) and bool((values == np.floor(values)).all())


def header_lines(file: BinaryIO, name: str, last: str) -> Iterator[list[str]]:
    """The words of each line up to and including the one that begins with the word `last`.

    Raises UnreadableFileError for a header that does not end.
    """
    left = LONGEST_HEADER
    while line := file.readline(left):
        left -= len(line)
        if left <= 0:
            break
        words = line.decode("utf-8", "replace").split()
        yield words
        if words[:1] == [last]:
            return
    msg = f"{name} is damaged: its header does not end (no line begins with {last})"
    raise UnreadableFileError(msg)


def whole_number(word: str, what: str) -> int:
    """A count from a header; raises UnreadableFileError for anything but digits."""
    # int() takes "1_000" and takes long for a million digits.
    if not (word.isascii() and word.isdigit() and len(word) <= 20):
        msg = f"{what} is {word[:40]!r}, not a number of records"
        raise UnreadableFileError(msg)
    return int(word)


def cut_short(name: str, promised: int, there: int) -> UnreadableFileError:
    """The error for a file that ends before its points do."""
    return UnreadableFileError(f"{name} is cut short: its header promises {promised:,} points, {there:,} are there")
