"""PCD in and out: ascii, binary and binary_compressed.

The reading is ours, because pypcd4 loads whole files, believes every size in them, and takes no tabs. It is the twin
in our tests, and we use the LZF codec that it brings along.
"""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import CHUNK_POINTS, Floats, PointChunk, ScanInfo, Station
from scanfind.errors import UnreadableFileError
from scanfind.scans.fields import COLOURS, beyond_8_bits, has_colours, header_words, preview
from scanfind.scans.output import Columns, HeaderFirst
from scanfind.scans.pcd_header import PcdHeader, read_header
from scanfind.scans.records import (
    Block,
    as_doubles,
    declared_block,
    declared_rows,
    native,
    stored_records,
    valid_chunks,
)
from scanfind.scans.rows import Lines

# LZF's longest match is 264 bytes, written in three.
LZF_EXPANDS = 88


def info(path: Path) -> ScanInfo:
    """What the header says; raises UnreadableFileError."""
    with path.open("rb") as file:
        header = read_header(file, path.name)
    none = _block(header, np.empty(0, header.record()))
    return ScanInfo(
        path=str(path),
        format=f"PCD {header.encoding}",
        points=header.points,
        stations=(Station(path.stem, header.points, header.origin),),
        attributes={name: str(values.dtype) for name, values in none.attributes.items()},
    )


def read(path: Path, chunk_points: int) -> Iterator[PointChunk]:
    """Stream the points; points of NaN, a camera's pixels without depth, are dropped and counted.

    A compressed file is decompressed as a whole: its columns lie one after the other. Raises UnreadableFileError.
    """
    with path.open("rb") as file:
        header = read_header(file, path.name)
        if header.encoding == "ascii":
            blocks: Iterator[Block] = _text_blocks(file, header, path.name)
        elif header.encoding == "binary":
            stored = stored_records(file, header.record(), header.points, chunk_points, path.name)
            blocks = (_block(header, records) for records in stored)
        else:
            blocks = _compressed_blocks(file, header, chunk_points, path.name)
        origin = None if header.origin is None else np.array(header.origin)
        yield from valid_chunks(blocks, chunk_points, origin=origin)


def _text_blocks(file: BinaryIO, header: PcdHeader, name: str) -> Iterator[Block]:
    lines = Lines(file, name, header.lines + 1)
    dtypes = [column.dtype for column in header.columns]
    columns = {attribute: (k, dtypes[k]) for k, attribute in header.attributes.items()}
    if header.packed is not None:
        columns["rgb"] = header.packed, dtypes[header.packed]
    for table in declared_rows(lines, dtypes, header.points, name):
        block = declared_block(table, header.xyz, columns, name)
        attributes = dict(block.attributes)
        if header.packed is not None:
            attributes |= unpacked(attributes.pop("rgb"), with_alpha=header.has_alpha)
        yield Block(block.xyz, attributes)


def _compressed_blocks(file: BinaryIO, header: PcdHeader, chunk_points: int, name: str) -> Iterator[Block]:
    if not header.points:
        return
    columns = _decompressed(file, header, name)
    for first in range(0, header.points, chunk_points):
        yield _block(header, {k: values[first : first + chunk_points] for k, values in columns.items()})


def _decompressed(file: BinaryIO, header: PcdHeader, name: str) -> dict[str, NDArray[Any]]:
    """The columns of a compressed file, by number; no size is believed before it is compared with the file's."""
    import lzf

    packed, size = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    left = os.fstat(file.fileno()).st_size - file.tell()
    columns = {str(k): column.dtype for k, column in enumerate(header.columns)}
    if size != header.points * header.record().itemsize:
        # PCL leaves the padding out when it compresses, other writers do not.
        columns = {k: dtype for k, dtype in columns.items() if not header.columns[int(k)].is_padding}
    if (
        packed > left
        or size > LZF_EXPANDS * packed
        or size != header.points * sum(t.itemsize for t in columns.values())
    ):
        msg = (
            f"{name} is damaged or cut short: it promises {header.points:,} points in {size:,} bytes, compressed to "
            f"{packed:,}, of which {left:,} are there"
        )
        raise UnreadableFileError(msg)
    try:
        data = lzf.decompress(file.read(packed), size) or b""
    except ValueError:
        data = b""
    if len(data) != size:
        msg = f"{name} is damaged: its compressed points do not decode"
        raise UnreadableFileError(msg)
    offsets = np.cumsum([0, *(header.points * dtype.itemsize for dtype in columns.values())]).tolist()
    return {
        k: np.frombuffer(data, dtype, header.points, offset)
        for (k, dtype), offset in zip(columns.items(), offsets, strict=False)
    }


def _block(header: PcdHeader, records: NDArray[Any] | Mapping[str, NDArray[Any]]) -> Block:
    """A block of stored columns, which are found by their numbers."""
    attributes = {name: native(records[str(k)]) for k, name in header.attributes.items()}
    if header.packed is not None:
        attributes |= unpacked(records[str(header.packed)], with_alpha=header.has_alpha)
    return Block(as_doubles(records[str(k)] for k in header.xyz), attributes)


def unpacked(colours: NDArray[Any], *, with_alpha: bool) -> Columns:
    """The colours in numbers 0xAARRGGBB (N,), which PCL keeps in integers or in the bits of floats."""
    if colours.dtype.kind == "f":
        with np.errstate(over="ignore", invalid="ignore"):
            colours = colours.astype(np.float32).view(np.uint32)
    shifts = {"red": 16, "green": 8, "blue": 0} | ({"alpha": 24} if with_alpha else {})
    return {name: (colours >> shift & 0xFF).astype(np.uint8) for name, shift in shifts.items()}


def packed(red: NDArray[Any], green: NDArray[Any], blue: NDArray[Any]) -> NDArray[np.float32]:
    """Colours of 8 bits as PCL's PointXYZRGB wants them: 0x00RRGGBB in the bits of a float."""
    number = red.astype(np.uint32) << 16 | green.astype(np.uint32) << 8 | blue.astype(np.uint32)
    return number.view(np.float32)


class Writer(HeaderFirst):
    """Binary PCD, as PCL, Open3D and CloudCompare open it and `read` gives it back.

    - x y z are F 4 as long as that is exact, as it is for points that came from a camera or another PCD, and F 8 from
      the first point on that it is not: a shift is not needed, and nothing moves. PCL before 1.15 finds no x in F 8.
    - Colours of 8 bits are packed into `rgb`. Those of 16 bits (LAS) are packed as a preview, and exact in red, green
      and blue beside it; `read` gives the exact ones.
    - Everything else keeps its name and its type.
    - VIEWPOINT stays unset: the points may come from several stations. A CRS has no place here.
    """

    def _begin(self) -> None:
        self._has_rgb = has_colours(self.fields)
        is_packed = self._has_rgb and all(self.fields[colour] == np.uint8 for colour in COLOURS)
        apart = [name for name in self.fields if not (is_packed and name in COLOURS)]
        self._names = dict(zip(header_words(apart), apart, strict=True))
        self._record = self._record_of("<f4")
        self._scaled: bool | None = None
        self._file = self.part.open("w+b")
        self._file.write(self._header())

    def _append(self, xyz: Floats, columns: Columns) -> None:
        if self._record["x"] == np.float32 and not _is_single(xyz):
            self._widen()
        if self._scaled is None:
            self._scaled = beyond_8_bits(columns)
        records = np.empty(len(xyz), self._record)
        records["x"], records["y"], records["z"] = xyz.T
        if self._has_rgb:
            colours = (columns[colour] for colour in COLOURS)
            eight = [c if c.dtype == np.uint8 else preview(c, scaled=self._scaled) for c in colours]
            records["rgb"] = packed(*eight)
        for word, name in self._names.items():
            records[word] = columns[name]
        self._file.write(records.view(np.uint8).data)

    def _widen(self) -> None:
        """Write again in double what has been written in single precision."""
        single, self._record = self._record, self._record_of("<f8")
        with tempfile.TemporaryFile(dir=self.part.parent) as copy:
            self._file.seek(len(self._header()))
            shutil.copyfileobj(self._file, copy)
            copy.seek(0)
            self._file.seek(0)
            self._file.truncate()
            self._file.write(self._header())
            for records in stored_records(copy, single, self.points, CHUNK_POINTS, self.part.name):
                self._file.write(records.astype(self._record).view(np.uint8).data)

    def _record_of(self, coordinate: str) -> np.dtype[Any]:
        colours = [("rgb", "<f4")] if self._has_rgb else []
        others = [(word, _stored(self.fields[name])) for word, name in self._names.items()]
        return np.dtype([(axis, coordinate) for axis in "xyz"] + colours + others)

    def _header(self) -> bytes:
        """The header for so many points as there are now, of one length however many they are."""
        names = self._record.names or ()
        types = [self._record[name] for name in names]
        lines = [
            "# .PCD v0.7 - Point Cloud Data file format" + " " * 2 * (20 - len(str(self.points))),
            "VERSION 0.7",
            f"FIELDS {' '.join(names)}",
            f"SIZE {' '.join(str(dtype.itemsize) for dtype in types)}",
            f"TYPE {' '.join(dtype.kind.upper() for dtype in types)}",
            f"COUNT {' '.join('1' for _ in names)}",
            f"WIDTH {self.points}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {self.points}",
            "DATA binary",
        ]
        return "".join(f"{line}\n" for line in lines).encode("ascii")


def _is_single(xyz: Floats) -> bool:
    with np.errstate(over="ignore"):
        return bool((xyz.astype(np.float32) == xyz).all())


def _stored(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The PCD type that holds a dtype."""
    if dtype.kind == "b":
        return np.dtype("u1")
    if dtype.kind == "f" and dtype.itemsize not in (4, 8):
        return np.dtype("<f4" if dtype.itemsize < 4 else "<f8")
    return dtype.newbyteorder("<")
