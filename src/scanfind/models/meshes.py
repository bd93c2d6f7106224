"""STL and OFF: a list of triangles, read here and now."""

from __future__ import annotations

from pathlib import Path

from scanfind.errors import UnreadableFileError
from scanfind.mesh import Mesh
from scanfind.models.loading import load_parts
from scanfind.models.parts import join
from scanfind.models.wanted import Wanted

STL_HEADER, STL_TRIANGLE = 84, 50


def read(path: Path, wanted: Wanted) -> list[Mesh]:
    """One mesh of the whole file. Raises UnreadableFileError, InvalidGeometryError where it has no triangle."""
    kind = path.suffix.lower().removeprefix(".")
    data, triangles = (_checked_stl if kind == "stl" else _checked_off)(path, path.read_bytes())
    parts, _ = load_parts(data, kind, path)
    found = sum(len(part.faces) for part in parts)
    if found < triangles:
        msg = f"{path} is cut short: {found} of {triangles} faces could be read"
        raise UnreadableFileError(msg)
    if len(parts) == 1:
        parts = [parts[0]._replace(name=path.stem)]  # the name trimesh makes up for it says nothing
    return [join(path.stem, parts, str(path), wanted.scale)]


def _checked_stl(path: Path, data: bytes) -> tuple[bytes, int]:
    """The bytes that count, and the triangles they should give; the size must justify what the header declares."""
    declared = int.from_bytes(data[80:STL_HEADER], "little")
    size = STL_HEADER + declared * STL_TRIANGLE
    # A binary file may begin with "solid" too: its size tells.
    if len(data) >= STL_HEADER and len(data) == size:
        return data, declared
    text = data.lower()
    if text.lstrip().startswith(b"solid") and (b"facet" in text or b"endsolid" in text):
        if b"endsolid" not in text:
            msg = f"{path} is cut short: no `endsolid`"
            raise UnreadableFileError(msg)
        return data, text.count(b"endfacet")
    if len(data) >= STL_HEADER and len(data) > size:
        return data[:size], declared  # some exporters append colours
    msg = (
        f"{path} is not an STL file, or cut short: {declared:,} triangles would be {size:,} bytes, it has {len(data):,}"
    )
    raise UnreadableFileError(msg)


def _checked_off(path: Path, data: bytes) -> tuple[bytes, int]:
    """The bytes, and the faces they should give at least; there must be a line for everything declared."""
    lines = [line for line in (raw.partition(b"#")[0].strip() for raw in data.splitlines()) if line]
    head = lines[0] if lines else b""
    counts = head.upper().removeprefix(b"C").removeprefix(b"OFF").split() or (lines[1].split() if lines[1:] else [])
    used = 1 if head.upper() not in (b"OFF", b"COFF") else 2
    try:
        vertices, faces = int(counts[0]), int(counts[1])
    except (ValueError, IndexError):
        msg = f"{path} is not a readable OFF file: no line that says how many vertices and faces it has"
        raise UnreadableFileError(msg) from None
    if min(vertices, faces) < 0 or vertices + faces > len(lines) - used:
        msg = f"{path} is cut short: {vertices} vertices and {faces} faces declared, {len(lines) - used} lines"
        raise UnreadableFileError(msg)
    return data, faces
