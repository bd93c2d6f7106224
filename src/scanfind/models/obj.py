"""Wavefront OBJ: vertices, polygons, objects. Materials and textures are not looked at, nor are the files they name.

Our own, because trimesh takes a negative index as one from the file's end (it counts from the current line), and index
0 or one that is out of range as some vertex or other.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanfind.errors import UnreadableFileError
from scanfind.mesh import Mesh
from scanfind.models.parts import Part, join
from scanfind.models.polygons import fans, used_only
from scanfind.models.wanted import Wanted


def read(path: Path, wanted: Wanted) -> list[Mesh]:
    """One mesh of the whole file; its parts are the file's objects (`o`). Raises UnreadableFileError."""
    vertices: list[tuple[float, float, float]] = []
    names = [path.stem]
    corners: list[list[int]] = [[]]
    counts: list[list[int]] = [[]]
    text = path.read_bytes().decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    line = ""
    try:
        for line in text.split("\n"):
            keyword, *words = line.split() or [""]
            if keyword == "v":
                x, y, z = words[:3]
                vertices.append((float(x), float(y), float(z)))
            elif keyword == "f":
                corners[-1] += [_vertex(word, len(vertices)) for word in words]
                counts[-1].append(len(words))
            elif keyword == "o":
                names.append(" ".join(words))
                corners.append([])
                counts.append([])
    except ValueError as error:
        msg = f"{path} is damaged: {error} in {line.strip()[:60]!r}"
        raise UnreadableFileError(msg) from None
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    if any(max(part, default=-1) >= len(points) for part in corners):
        msg = f"{path} is damaged: it has faces that name vertices it does not have"
        raise UnreadableFileError(msg)
    parts = []
    for name, part_corners, part_counts in zip(names, corners, counts, strict=True):
        faces = fans(np.array(part_corners, dtype=np.int64), np.array(part_counts, dtype=np.int64))
        if len(faces):
            parts.append(Part(name, *used_only(points, faces)))
    return [join(path.stem, parts, str(path), wanted.scale)]


def _vertex(word: str, so_far: int) -> int:
    """The vertex, from 0, that a face's `v`, `v/vt` or `v/vt/vn` means; a negative one counts back from here."""
    index = int(word.partition("/")[0])
    vertex = index - 1 if index > 0 else so_far + index
    if index == 0 or vertex < 0:
        msg = f"a face names vertex {index}"
        raise ValueError(msg)
    return vertex
