"""glTF, GLB and 3MF: geometries placed by a graph.

Read in a child process, because a few kilobytes may place a part a billion times over.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

from scanfind.errors import UnreadableFileError
from scanfind.mesh import Mesh
from scanfind.models.child import read_in_child
from scanfind.models.loading import load_parts
from scanfind.models.parts import Part, join
from scanfind.models.wanted import Wanted

# What a 3MF archive may unpack to; the largest in our collection is 2.3 MB.
MOST_UNPACKED = 1 << 30


def read(path: Path, wanted: Wanted) -> list[Mesh]:
    """One mesh of the whole scene. Raises UnreadableFileError."""
    parts, facts = read_in_child("scenes", path)
    return [join(path.stem, parts, str(path), facts["scale"])]


def read_here(path: Path, options: dict[str, Any]) -> tuple[list[Part], dict[str, Any]]:
    """In the child: the parts, and the metres in one of their units."""
    from trimesh.units import unit_conversion

    kind = path.suffix.lower().removeprefix(".")
    if kind == "3mf":
        _check_archive(path)
    parts, unit = load_parts(path.read_bytes(), kind, path)
    return parts, {"scale": unit_conversion(unit, "meters") if kind == "3mf" and unit else 1.0}


def _check_archive(path: Path) -> None:
    """That it unpacks to a size we can hold, and declares no entities that could multiply in reading."""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
            if unpacked > MOST_UNPACKED:
                msg = f"{path} unpacks to {unpacked:,} bytes, more than {MOST_UNPACKED:,}: export a part of it"
                raise UnreadableFileError(msg)
            for member in archive.infolist():
                if member.filename.lower().endswith(".model"):
                    with archive.open(member) as text:
                        head = text.read(1 << 16)
                    if b"<!DOCTYPE" in head or b"<!ENTITY" in head:
                        msg = f"{path} declares XML entities, which 3MF forbids"
                        raise UnreadableFileError(msg)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        msg = f"{path} is not a readable 3MF archive: {error}"
        raise UnreadableFileError(msg) from None
