"""PLY in and out: ascii and both binary orders; of a mesh, its vertices.

Our own, because plyfile is GPL and Open3D drops the fields it does not know. PLY has no place for a scanner position,
so the origin is None.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from scanfind.cloud import Floats, PointChunk, ScanInfo, Station
from scanfind.errors import UnreadableFileError
from scanfind.scans.fields import COLOURS, EXACT_COLOURS, NORMALS, beyond_8_bits, has_colours, header_words, preview
from scanfind.scans.output import Columns, HeaderFirst
from scanfind.scans.ply_header import SPELLED, Element, PlyHeader, read_header
from scanfind.scans.records import (
    Block,
    as_doubles,
    cut_short,
    declared_block,
    declared_rows,
    native,
    stored_records,
    valid_chunks,
)
from scanfind.scans.rows import Lines


def info(path: Path) -> ScanInfo:
    """What the header says; raises UnreadableFileError, UnsupportedFormatError."""
    with path.open("rb") as file:
        header = read_header(file, path.name)
    properties = header.vertex.properties
    return ScanInfo(
        path=str(path),
        format=f"PLY {header.encoding.replace('_', ' ')}",
        points=header.vertex.count,
        stations=(Station(path.stem, header.vertex.count),),
        attributes={name: str(properties[k].dtype.newbyteorder("=")) for k, name in header.attributes.items()},
    )


def read(path: Path, chunk_points: int) -> Iterator[PointChunk]:
    """Stream the vertices; raises UnreadableFileError, UnsupportedFormatError."""
    with path.open("rb") as file:
        header = read_header(file, path.name)
        if header.encoding == "ascii":
            blocks = _text_blocks(file, header, path.name)
        else:
            blocks = _binary_blocks(file, header, chunk_points, path.name)
        yield from valid_chunks(blocks, chunk_points)


def _text_blocks(file: BinaryIO, header: PlyHeader, name: str) -> Iterator[Block]:
    lines = Lines(file, name, header.lines + 1)
    # One record a line: the format does not demand it, but every writer does so.
    lines.skip(sum(element.count for element in header.before))
    dtypes = [p.dtype for p in header.vertex.properties]
    columns = {attribute: (k, dtypes[k]) for k, attribute in header.attributes.items()}
    for table in declared_rows(lines, dtypes, header.vertex.count, name):
        yield declared_block(table, header.xyz, columns, name)


def _binary_blocks(file: BinaryIO, header: PlyHeader, chunk_points: int, name: str) -> Iterator[Block]:
    size = os.fstat(file.fileno()).st_size
    for element in header.before:
        _skip(file, element, size, name)
    count, record = header.vertex.count, header.vertex.record()
    if count * record.itemsize > size - file.tell():
        raise cut_short(name, count, max(0, size - file.tell()) // record.itemsize)
    for records in stored_records(file, record, count, chunk_points, name):
        yield Block(
            as_doubles(records[str(k)] for k in header.xyz),
            {attribute: native(records[str(k)]) for k, attribute in header.attributes.items()},
        )


def _skip(file: BinaryIO, element: Element, size: int, name: str) -> None:
    """Pass over the binary records of an element in front of the vertices."""
    if element.is_fixed:
        _skip_bytes(file, element.count * element.record().itemsize, size, name)
        return
    for _ in range(element.count):
        for p in element.properties:
            items = 1
            if p.length is not None:
                counted = file.read(p.length.itemsize).ljust(p.length.itemsize, b"\xff")
                items = int(np.frombuffer(counted, p.length)[0])
            _skip_bytes(file, items * p.dtype.itemsize, size, name)


def _skip_bytes(file: BinaryIO, count: int, size: int, name: str) -> None:
    if not 0 <= count <= size - file.tell():
        msg = f"{name} is damaged: what its header puts in front of the points is longer than the file"
        raise UnreadableFileError(msg)
    file.seek(count, os.SEEK_CUR)


class Writer(HeaderFirst):
    """Binary little endian PLY, as CloudCompare and MeshLab show it and `read` gives it back.

    - x y z are double always: a shift is not needed, and readers would not know of it.
    - Normals are nx ny nz; every other attribute is `scalar_<name>`, which CloudCompare keeps.
    - Colours of 8 bits are red green blue. Those of 16 bits (LAS) are a preview of 8 bits, because viewers clip
      ushort to white, and exact in `scalar_red_16bit` and so on; `read` gives the exact ones.
    - PLY has no integers of 64 bits: they become double, exact to 2^53.
    - A CRS is not kept; PLY has no place for it.
    """

    def _begin(self) -> None:
        self._properties = _properties(self.fields)
        self._record = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), *((p, t) for p, t, _ in self._properties)])
        self._scaled: bool | None = None
        self._file = self.part.open("wb")
        self._file.write(self._header())

    def _append(self, xyz: Floats, columns: Columns) -> None:
        if self._scaled is None:
            self._scaled = beyond_8_bits(columns)
        records = np.empty(len(xyz), self._record)
        records["x"], records["y"], records["z"] = xyz.T
        for name, dtype, attribute in self._properties:
            values = columns[attribute]
            is_preview = dtype == np.uint8 and values.dtype == np.uint16
            records[name] = preview(values, scaled=self._scaled) if is_preview else values
        self._file.write(records.view(np.uint8).data)

    def _header(self) -> bytes:
        """The header for so many points as there are now, of one length however many they are."""
        fields = [(self._record[name].str[1:], name) for name in self._record.names or ()]
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            "comment written by scanfind" + " " * (20 - len(str(self.points))),
            f"element vertex {self.points}",
            *(f"property {SPELLED[kind]} {name}" for kind, name in fields),
            "end_header",
        ]
        return "".join(f"{line}\n" for line in lines).encode("ascii")


def _properties(fields: Mapping[str, np.dtype[Any]]) -> list[tuple[str, np.dtype[Any], str]]:
    """The properties after x y z: name in the file, type in the file, attribute."""
    viewable = [name for name in NORMALS if name in fields]
    properties = [(f"n{name[-1]}", _stored(fields[name]), name) for name in viewable]
    exact: dict[str, str] = {}
    if has_colours(fields):
        properties += [(colour, np.dtype("u1"), colour) for colour in COLOURS]
        if all(fields[colour] == np.uint8 for colour in COLOURS):
            viewable += COLOURS
        else:
            exact = dict(zip(COLOURS, EXACT_COLOURS, strict=True))
    others = [name for name in fields if name not in viewable]
    words = header_words(f"scalar_{exact.get(name, name)}" for name in others)
    return properties + [(word, _stored(fields[name]), name) for word, name in zip(words, others, strict=True)]


def _stored(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The PLY type that holds a dtype, or most of it."""
    if dtype.kind == "b":
        return np.dtype("u1")
    if dtype.kind in "iu" and dtype.itemsize <= 4:
        return dtype.newbyteorder("<")
    return np.dtype("<f4" if dtype.kind == "f" and dtype.itemsize <= 4 else "<f8")
