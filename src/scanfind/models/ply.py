"""PLY: faces of any number of corners, ASCII and both binary orders; without faces it is a piece of scan.

Our own, because trimesh takes every face of a binary file to have as many corners as the first, and believes the
header's counts in an ASCII one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import CloudModel
from scanfind.errors import UnreadableFileError
from scanfind.mesh import Mesh
from scanfind.models import clouds
from scanfind.models.parts import Part, join
from scanfind.models.polygons import fans
from scanfind.models.wanted import Wanted
from scanfind.scans.ply_header import Element, Property, read_declared

Ints = NDArray[np.int64]

CORNERS = ("vertex_indices", "vertex_index")


def read(path: Path, wanted: Wanted) -> list[Mesh | CloudModel]:
    """One mesh of the whole file, or one piece of scan where it has no faces. Raises UnreadableFileError."""
    with path.open("rb") as file:
        encoding, elements, _ = read_declared(file, str(path))
        if not _any_faces(elements):
            return list(clouds.read(path, wanted))
        data = file.read()
    try:
        _check_room(elements, len(data))
        vertices, corners, counts = (_read_ascii if encoding == "ascii" else _read_binary)(data, elements)
        if counts.min() < 0 or (corners.size and (corners.min() < 0 or corners.max() >= len(vertices))):
            msg = "it has faces that name vertices it does not have"
            raise ValueError(msg)
        faces = fans(corners, counts)
    except (ValueError, IndexError, OverflowError) as error:
        msg = f"{path} is not a readable PLY file: {error}"
        raise UnreadableFileError(msg) from None
    return [join(path.stem, [Part(path.stem, vertices, faces)], str(path), wanted.scale)]


def has_faces(path: Path) -> bool:
    """Whether the header announces faces: then it is a mesh, else a piece of scan. Raises UnreadableFileError."""
    with path.open("rb") as file:
        return _any_faces(read_declared(file, path.name).elements)


def _any_faces(elements: list[Element]) -> bool:
    return any(element.name == "face" and element.count for element in elements)


def _check_room(elements: list[Element], size: int) -> None:
    """Raise ValueError where more is declared than `size` bytes of data have room for."""
    for element in elements:
        # Every element takes a byte at least: this is what keeps a count of 2^63 from being believed.
        if element.count > size or not element.properties:
            msg = f"it declares {element.count} of {element.name!r} and has {size} bytes: cut short?"
            raise ValueError(msg)


def _read_ascii(data: bytes, elements: list[Element]) -> tuple[NDArray[np.float64], Ints, Ints]:
    """Vertices (V, 3), corners (C,) and corners of each face (P,); one element a line."""
    lines = [line for line in data.splitlines() if line.strip()]
    vertices = np.zeros((0, 3))
    corners: list[int] = []
    counts: list[int] = []
    row = 0
    for element in elements:
        rows = lines[row : row + element.count]
        row += element.count
        if len(rows) < element.count:
            msg = f"it declares {element.count} of {element.name!r} and has {len(rows)} lines of them: cut short"
            raise ValueError(msg)
        names = [prop.name for prop in element.properties]
        if element.name == "vertex":
            columns = [names.index(axis) for axis in "xyz"]
            if any(prop.is_list for prop in element.properties[: max(columns)]):
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
        length = int(words[at]) if prop.is_list else 1
        at += prop.is_list
        if prop.name in CORNERS:
            face = [int(word) for word in words[at : at + length]]
            if len(face) == length:
                return face
            break
        at += length
    msg = "a face lacks its corners"
    raise ValueError(msg)


def _read_binary(data: bytes, elements: list[Element]) -> tuple[NDArray[np.float64], Ints, Ints]:
    """As `_read_ascii`."""
    vertices = np.zeros((0, 3))
    corners = counts = np.zeros(0, np.int64)
    at = 0
    for element in elements:
        if element.is_fixed:
            dtype = np.dtype([(prop.name, prop.dtype) for prop in element.properties])
            rows = np.frombuffer(data, dtype, element.count, at)
            at += rows.nbytes
            if element.name == "vertex":
                vertices = np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"])
        else:
            found, lengths, at = _read_lists(data, at, element)
            if element.name == "face":
                corners, counts = found, lengths
    return vertices, corners, counts


def _read_lists(data: bytes, at: int, element: Element) -> tuple[Ints, Ints, int]:
    """The corner lists of an element's rows, end to end; the length of each; where the next element begins."""
    if not element.count:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), at
    _, _, lengths = _row(data, at, element)
    fields: list[tuple[str, np.dtype[Any]] | tuple[str, np.dtype[Any], tuple[int]]] = []
    for prop, length in zip(element.properties, lengths, strict=True):
        if prop.length is None:
            fields.append((prop.name, prop.dtype))
        else:
            fields += [("length of " + prop.name, prop.length), (prop.name, prop.dtype, (length,))]
    dtype = np.dtype(fields)
    # Nearly every file has nothing but triangles: then all rows are as long as the first, and are read at once.
    if element.count * dtype.itemsize <= len(data) - at:
        rows = np.frombuffer(data, dtype, element.count, at)
        lists = [(p.name, n) for p, n in zip(element.properties, lengths, strict=True) if p.is_list]
        if all((rows["length of " + name] == length).all() for name, length in lists):
            name, length = next(((name, n) for name, n in lists if name in CORNERS), ("", 0))
            found = rows[name].astype(np.int64).ravel() if name else np.zeros(0, np.int64)
            return found, np.full(element.count, length), at + rows.nbytes
    faces = []
    for _ in range(element.count):
        face, at, _ = _row(data, at, element)
        faces.append(face)
    return np.concatenate(faces), np.array([len(face) for face in faces]), at


def _row(data: bytes, at: int, element: Element) -> tuple[Ints, int, list[int]]:
    """One row that has lists: its corners, where the next row begins, how many values each property has."""
    corners = np.zeros(0, np.int64)
    lengths: list[int] = []
    for prop in element.properties:
        length = 1
        if prop.length is not None:
            length = int(np.frombuffer(data, prop.length, 1, at)[0])
            at += prop.length.itemsize
        if not 0 <= length <= len(data) - at:
            msg = f"a list of {length} values in a file of {len(data)} bytes"
            raise ValueError(msg)
        values = np.frombuffer(data, prop.dtype, length, at)
        at += values.nbytes
        lengths.append(length)
        if prop.name in CORNERS:
            corners = values.astype(np.int64)
    return corners, at, lengths
