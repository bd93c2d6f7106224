"""Parts as a file has them, and the one mesh they make: welded, facing outwards, in metres."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import InvalidGeometryError
from scanfind.mesh import Floats, Mesh

if TYPE_CHECKING:
    from trimesh import Trimesh


class Part(NamedTuple):
    """One body of a model file: vertices (V, 3) float64, in the file's units until joined; faces (F, 3) integers."""

    name: str
    vertices: Floats
    faces: NDArray[Any]


# An assembly of more is a list of triangles by another name, and facing each outwards by itself would take minutes.
MOST_PARTS = 10_000

# Beyond any site on Earth by a hundred times; what is welded at 1e-8 m still fits into 64 bits.
FARTHEST_M = 1e9


def join(name: str, parts: Iterable[Part], source: str, scale: float = 1.0) -> Mesh:
    """One mesh of all the parts: a CAD assembly is one object.

    scale : metres in one of the parts' units

    Its notes: `parts`, ((name, first face, face after the last), …); `watertight`, whether every part is; `turned`, how
    many parts came inside out. Raises InvalidGeometryError for vertices or faces that cannot be, and where no triangle
    has an area.
    """
    parts = list(parts)
    if len(parts) > MOST_PARTS:
        parts = [as_one(parts)._replace(name=name)]
    vertices, faces, bounds, closed, turned = [], [], [], [], 0
    first_vertex = first_face = 0
    for part in parts:
        _check(part, source or name, FARTHEST_M / scale)
        try:
            mesh = Mesh.of(part.name, part.vertices * scale, part.faces)
        except InvalidGeometryError:
            # A part without area (a weld line, a construction plane of no width) is no reason to refuse the others.
            continue
        welded, watertight, inverted = _faced_outwards(mesh)
        vertices.append(welded.vertices)
        faces.append(welded.faces.astype(np.int64) + first_vertex)
        bounds.append((part.name, first_face, first_face + len(welded.faces)))
        closed.append(watertight)
        turned += inverted
        first_vertex += len(welded.vertices)
        first_face += len(welded.faces)
    if not faces:
        msg = f"{source or name} has no triangle with an area"
        raise InvalidGeometryError(msg)
    whole = Mesh.of(name, np.concatenate(vertices), np.concatenate(faces), source)
    return replace(whole, notes={"parts": tuple(bounds), "watertight": all(closed), "turned": turned})


def moved(part: Part, matrix: Floats) -> Part:
    """The part under a 4×4 affine matrix; one that mirrors turns the faces round, so that outside stays outside."""
    linear = matrix[:3, :3]
    faces = part.faces[:, ::-1] if np.linalg.det(linear) < 0 else part.faces
    return Part(part.name, part.vertices @ linear.T + matrix[:3, 3], faces)


def as_one(parts: Sequence[Part]) -> Part:
    """All of at least one part in one, under the first one's name."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=True)]
    return Part(parts[0].name, np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def _check(part: Part, source: str, farthest: float) -> None:
    """That coordinates are numbers, of a size that can be squared and welded, and that faces name them."""
    if not (np.abs(part.vertices) <= farthest).all():
        msg = f"{source} has coordinates that are not numbers, or beyond {FARTHEST_M:g} m: damaged, or of other units"
        raise InvalidGeometryError(msg)
    if part.faces.size and (part.faces.min() < 0 or part.faces.max() >= len(part.vertices)):
        msg = f"{source} has faces that name vertices it does not have: damaged"
        raise InvalidGeometryError(msg)


def _faced_outwards(mesh: Mesh) -> tuple[Mesh, bool, bool]:
    """Equal vertices made one, and a closed surface turned to face outwards: mesh, was it closed, was it turned.

    An open surface has no inside to tell its side by, and stays as the file has it.
    """
    import trimesh

    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, validate=False)
    welded.merge_vertices()
    # Vertices within 1e-8 m have become one: of a needle between two of them nothing is left.
    welded.update_faces(welded.nondegenerate_faces(height=0.0))
    watertight, turned = bool(welded.is_watertight), False
    if watertight and not welded.is_winding_consistent:
        trimesh.repair.fix_normals(welded, multibody=True)
        turned = True
    elif watertight and welded.volume < 0:
        welded.invert()
        turned = True
    return _as_mesh(mesh.name, welded), watertight, turned


def _as_mesh(name: str, mesh: Trimesh) -> Mesh:
    return Mesh.of(name, np.asarray(mesh.vertices), np.asarray(mesh.faces))
