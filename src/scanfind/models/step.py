"""STEP: exact surfaces, meshed by Open CASCADE (cascadio), in metres. Read in a child process."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scanfind.errors import UnreadableFileError
from scanfind.mesh import Mesh
from scanfind.models.child import need_extra, read_in_child
from scanfind.models.loading import load_parts
from scanfind.models.parts import Part, join
from scanfind.models.wanted import Wanted

# How far a triangle may lie from the surface it stands for: a twentieth of a scanner's noise of 2 mm.
TOLERANCE_MM = 0.1
TOLERANCE_RAD = 0.3


def read(path: Path, wanted: Wanted) -> list[Mesh]:
    """One mesh of the whole assembly. Raises UnreadableFileError, MissingExtraError without cascadio."""
    need_extra("cascadio", "step", "STEP")
    parts, _ = read_in_child("step", path)
    return [join(path.stem, parts, str(path))]


def read_here(path: Path, options: dict[str, Any]) -> tuple[list[Part], dict[str, Any]]:
    """In the child: the parts in their places, metres."""
    import cascadio

    with TemporaryDirectory(prefix="scanfind-") as folder:
        meshed = Path(folder) / "meshed.glb"
        cascadio.step_to_glb(str(path), str(meshed), tol_linear=TOLERANCE_MM, tol_angular=TOLERANCE_RAD)
        if not meshed.exists():
            msg = f"{path} is not a readable STEP file, or has no solids or surfaces"
            raise UnreadableFileError(msg)
        parts, _ = load_parts(meshed.read_bytes(), "glb", path)
    return parts, {}
