"""PLY: faces of any number of corners, ASCII and both binary orders; without faces it is a piece of scan.

Our own, because trimesh takes every face of a binary file to have as many corners as the first, and believes the
header's counts in an ASCII one.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import CloudModel
from scanfind.errors import UnreadableFileError
from scanfind.mesh import Mesh
from scanfind.models import clouds
from scanfind.models.parts import Part, join
from scanfind.models.polygons import fans
from scanfind.models.wanted import Wanted

KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")
HEADER_BYTES = 1 << 16


class Property(NamedTuple):
    """A property of an element: its dtype, and that of its length where it is a list ("" where it is not)."""

    name: str
    kind: str
    length: str = ""


class Element(NamedTuple):
    """Vertices, faces or something else: how many, each with which properties."""

    name: str
    rows: int
    properties: list[Property]


class Header(NamedTuple):
    """What the header declares, and where the data begin."""

    order: str
    elements: list[Element]
    start: int


def read(path: Path, wanted: Wanted) -> list[Mesh | CloudModel]:
    """One mesh of the whole file, or one piece of scan where it has no faces. Raises UnreadableFileError."""
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    try:
        header = parse_header(head, path.stat().st_size)
        if not any(element.name == "face" and element.rows for element in header.elements):
            return list(clouds.read(path, wanted))
        data = path.read_bytes()
        vertices, corners, counts = (_read_ascii if header.order == "" else _read_binary)(data, header)
        if counts.min() < 0 or (corners.size and (corners.min() < 0 or corners.max() >= len(vertices))):
            msg = "it has faces that name vertices it does not have"
            raise ValueError(msg)
        faces = fans(corners, counts)
    except KeyError as error:
        msg = f"{path} is not a readable PLY file: its header has the word {error}, which PLY does not know"
        raise UnreadableFileError(msg) from None
    except (ValueError, IndexError, OverflowError) as error:
        msg = f"{path} is not a readable PLY file: {error}"
        raise UnreadableFileError(msg) from None
    return [join(path.stem, [Part(path.stem, vertices, faces)], str(path), wanted.scale)]


def parse_header(head: bytes, size: int) -> Header:
    """The header among the file's first bytes.

    Raises ValueError or KeyError where it is none, or declares more elements than a file of `size` bytes has room for.
    """
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        msg = "no header from `ply` to `end_header`"
        raise ValueError(msg)
    order, elements = "none", []  # type: tuple[str, list[Element]]
    for line in head[:end].decode("ascii", errors="replace").splitlines()[1:]:
        match line.split():
            case ["format", name, *_]:
                order = ORDERS[name]
            case ["element", name, count]:
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append(Property(name, KINDS[kind], KINDS[length]))
            case ["property", kind, name]:
                elements[-1].properties.append(Property(name, KINDS[kind]))
    if order == "none":
        msg = "its header names no format"
        raise ValueError(msg)
    start = head.find(b"\n", end) + 1 or len(head)
    for element in elements:
        # Every element takes a byte at least: this is what keeps a count of 2^63 from being believed.
        if not 0 <= element.rows <= size - start or not element.properties:
            msg = f"it declares {element.rows} of {element.name!r} and has {size - start} bytes: cut short?"
            raise ValueError(msg)
    return Header(order, elements, start)


def _read_ascii(data: bytes, header: Header) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices (V, 3), corners (C,) and corners of each face (P,); one element a line."""
    lines = [line for line in data[header.start :].splitlines() if line.strip()]
    vertices, corners, counts = np.zeros((0, 3)), [], []  # type: tuple[NDArray[np.float64], list[int], list[int]]
    row = 0
    for element in header.elements:
        rows = lines[row : row + element.rows]
        row += element.rows
        if len(rows) < element.rows:
            msg = f"it declares {element.rows} of {element.name!r} and has {len(rows)} lines of them: cut short"
            raise ValueError(msg)
        names = [prop.name for prop in element.properties]
        if element.name == "vertex":
            columns = [names.index(axis) for axis in "xyz"]
            if any(prop.length for prop in element.properties[: max(columns)]):
                msg = "it has lists before the coordinates"
                raise ValueError(msg)
            vertices = np.array([[float(words[c]) for c in columns] for words in map(bytes.split, rows)])
        elif element.name == "face":
            for words in map(bytes.split, rows):
                face = _face_of(words, element.properties)
                corners += face
                counts.append(len(face))
    return vertices.reshape(-1, 3), np.array(corners, dtype=np.int64), np.array(counts, dtype=np.int64)


def _face_of(words: list[bytes], properties: list[Property]) -> list[int]:
    """The corners among the words of a face's line."""
    at = 0
    for prop in properties:
        length = int(words[at]) if prop.length else 1
        at += bool(prop.length)
        if prop.name in CORNERS:
            face = [int(word) for word in words[at : at + length]]
            if len(face) == length:
                return face
            break
        at += length
    msg = "a face lacks its corners"
    raise ValueError(msg)


def _read_binary(data: bytes, header: Header) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """As `_read_ascii`."""
    vertices = np.zeros((0, 3))
    corners = counts = np.zeros(0, np.int64)
    at = header.start
    for element in header.elements:
        if not any(prop.length for prop in element.properties):
            dtype = np.dtype([(prop.name, header.order + prop.kind) for prop in element.properties])
            rows = np.frombuffer(data, dtype, element.rows, at)
            at += rows.nbytes
            if element.name == "vertex":
                vertices = np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"])
        else:
            found, lengths, at = _read_lists(data, at, element, header.order)
            if element.name == "face":
                corners, counts = found, lengths
    return vertices, corners, counts


def _read_lists(data: bytes, at: int, element: Element, order: str) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """The corner lists of an element's rows, end to end; the length of each; where the next element begins."""
    if not element.rows:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), at
    _, _, lengths = _row(data, at, element, order)
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for prop, length in zip(element.properties, lengths, strict=True):
        if prop.length:
            fields += [("length of " + prop.name, order + prop.length), (prop.name, order + prop.kind, (length,))]
        else:
            fields.append((prop.name, order + prop.kind))
    dtype = np.dtype(fields)
    # Nearly every file has nothing but triangles: then all rows are as long as the first, and are read at once.
    if element.rows * dtype.itemsize <= len(data) - at:
        rows = np.frombuffer(data, dtype, element.rows, at)
        lists = [(p.name, n) for p, n in zip(element.properties, lengths, strict=True) if p.length]
        if all((rows["length of " + name] == length).all() for name, length in lists):
            name, length = next(((name, n) for name, n in lists if name in CORNERS), ("", 0))
            found = rows[name].astype(np.int64).ravel() if name else np.zeros(0, np.int64)
            return found, np.full(element.rows, length), at + rows.nbytes
    faces = []
    for _ in range(element.rows):
        face, at, _ = _row(data, at, element, order)
        faces.append(face)
    return np.concatenate(faces), np.array([len(face) for face in faces]), at


def _row(data: bytes, at: int, element: Element, order: str) -> tuple[NDArray[np.int64], int, list[int]]:
    """One row that has lists: its corners, where the next row begins, how many values each property has."""
    corners, lengths = np.zeros(0, np.int64), []  # type: tuple[NDArray[np.int64], list[int]]
    for prop in element.properties:
        length = 1
        if prop.length:
            length = int(np.frombuffer(data, order + prop.length, 1, at)[0])
            at += np.dtype(prop.length).itemsize
        if not 0 <= length <= len(data) - at:
            msg = f"a list of {length} values in a file of {len(data)} bytes"
            raise ValueError(msg)
        values = np.frombuffer(data, order + prop.kind, length, at)
        at += values.nbytes
        lengths.append(length)
        if prop.name in CORNERS:
            corners = values.astype(np.int64)
    return corners, at, lengths
