"""The header of a PLY file (Turk 1994), with the types as people spell them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from scanfind.errors import UnreadableFileError, UnsupportedFormatError
from scanfind.scans.fields import attribute_columns, axes
from scanfind.scans.records import cut_short, header_lines, whole_number

TYPES: Mapping[str, str] = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
SPELLED: Mapping[str, str] = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
    "f4": "float", "f8": "double",
}  # fmt: skip
ORDERS: Mapping[str, str] = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class Property(NamedTuple):
    """A number of `dtype`, or a list of them behind a count of type `length`."""

    name: str
    dtype: np.dtype[Any]
    length: np.dtype[Any] | None = None

    @property
    def is_list(self) -> bool:
        """Whether it is a list."""
        return self.length is not None


@dataclass(frozen=True)
class Element:
    """`count` records of these properties."""

    name: str
    count: int
    properties: list[Property]

    @property
    def is_fixed(self) -> bool:
        """Whether all its records have one size: it has no lists."""
        return not any(p.is_list for p in self.properties)

    def record(self) -> np.dtype[Any]:
        """One record without lists; the fields are numbered, because names may repeat."""
        return np.dtype([(str(k), p.dtype) for k, p in enumerate(self.properties)])


class Declared(NamedTuple):
    """What the header says, believed or not.

    encoding : a key of ORDERS
    elements : in the order of the data
    lines : how many lines the header has
    """

    encoding: str
    elements: list[Element]
    lines: int


class PlyHeader(NamedTuple):
    """What the header says of the points, proven possible.

    encoding : a key of ORDERS
    before : the elements in front of the vertices
    xyz : the properties of a vertex that are its coordinates
    attributes : property → attribute name, for the others
    lines : how many lines the header has
    """

    encoding: str
    vertex: Element
    before: tuple[Element, ...]
    xyz: tuple[int, int, int]
    attributes: dict[int, str]
    lines: int


def read_declared(file: BinaryIO, name: str) -> Declared:
    """Read the header, and leave `file` at the data; raises UnreadableFileError."""
    if file.readline(8).strip() != b"ply":
        msg = f"{name} is not a PLY file: its first line is not 'ply'"
        raise UnreadableFileError(msg)
    encoding, order, lines = "", "", 1
    elements: list[Element] = []
    for words in header_lines(file, name, "end_header"):
        lines += 1
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", str(spelled), "1.0"] if spelled in ORDERS and not elements:
                encoding, order = spelled, ORDERS[spelled]
            case _ if not encoding:
                msg = f"{name} is damaged: its header does not begin with 'format ascii 1.0' or the like"
                raise UnreadableFileError(msg)
            case ["element", str(element), str(count)]:
                elements.append(Element(element, whole_number(count, f"{name}: element {element}"), []))
            case ["property", str(kind), str(own)] if elements and kind in TYPES:
                elements[-1].properties.append(Property(own, np.dtype(order + TYPES[kind])))
            case ["property", "list", str(length), str(kind), str(own)] if (
                elements and kind in TYPES and _is_whole(length)
            ):
                types = np.dtype(order + TYPES[kind]), np.dtype(order + TYPES[length])
                elements[-1].properties.append(Property(own, *types))
            case ["end_header"]:
                break
            case _:
                msg = f"{name} is damaged: header line {lines} is {' '.join(words)[:80]!r}"
                raise UnreadableFileError(msg)
    return Declared(encoding, elements, lines)


def read_header(file: BinaryIO, name: str) -> PlyHeader:
    """Read and check the header, and leave `file` at the data; raises UnreadableFileError, UnsupportedFormatError."""
    encoding, elements, lines = read_declared(file, name)
    vertex, before = _vertices(elements, name)
    names = [p.name for p in vertex.properties]
    xyz = axes(names)
    if xyz is None:
        msg = f"{name}: its points have no x, y and z, only {', '.join(names)[:80] or 'nothing'}"
        raise UnreadableFileError(msg)
    # In text, a number takes a digit and a blank, the file's last one only the digit.
    least = 2 * len(names) if encoding == "ascii" else vertex.record().itemsize
    data_bytes = os.fstat(file.fileno()).st_size - file.tell()
    if vertex.count * least > data_bytes + 1:
        raise cut_short(name, vertex.count, data_bytes // least)
    return PlyHeader(encoding, vertex, before, xyz, attribute_columns(names), lines)


def _is_whole(kind: str) -> bool:
    # The length of a list has to be an integer.
    return TYPES.get(kind, "f4")[0] in "iu"


def _vertices(elements: list[Element], name: str) -> tuple[Element, tuple[Element, ...]]:
    names = [element.name for element in elements]
    if "vertex" not in names:
        msg = f"{name} has no points: no 'element vertex' in its header"
        raise UnreadableFileError(msg)
    k = names.index("vertex")
    if lists := [p.name for p in elements[k].properties if p.is_list]:
        msg = f"{name}: each point has a list ({lists[0]}), which is not read; save it without"
        raise UnsupportedFormatError(msg)
    return elements[k], tuple(elements[:k])
