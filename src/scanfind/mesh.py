"""Triangles in metres, with a name: what every model reader yields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.errors import InvalidGeometryError
from scanfind.pose import Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """A product of the design that uses a model: its IFC GlobalId, class, name, and where the design puts it."""

    global_id: str
    ifc_class: str
    name: str
    design_from_model: Pose


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    vertices : (V, 3) float64, metres
    faces : (F, 3) int32, counter-clockwise seen from outside
    source : where it came from, for people (file, element)
    placements : the design's products of this geometry; empty where the format knows none
    """

    name: str
    vertices: Floats
    faces: NDArray[np.int32]
    source: str = ""
    placements: tuple[Placement, ...] = ()
    notes: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(name: str, vertices: ArrayLike, faces: ArrayLike, source: str = "") -> Mesh:
        """The door: checks shapes, finiteness and indices; raises InvalidGeometryError. Degenerate faces go."""
        v = np.ascontiguousarray(vertices, dtype=np.float64)
        f = np.ascontiguousarray(faces, dtype=np.int64)
        if v.ndim != 2 or v.shape[1] != 3 or f.ndim != 2 or f.shape[1] != 3:
            msg = f"a mesh has vertices (V, 3) and faces (F, 3), got {v.shape} and {f.shape}"
            raise InvalidGeometryError(msg)
        if not np.isfinite(v).all():
            msg = f"mesh {name!r} has vertices that are not finite numbers"
            raise InvalidGeometryError(msg)
        if f.size and (f.min() < 0 or f.max() >= len(v)):
            msg = f"mesh {name!r} has faces that name vertices it does not have"
            raise InvalidGeometryError(msg)
        f = f[doubled_areas(v, f) > 0.0]
        if not len(f):
            msg = f"mesh {name!r} has no triangle with an area"
            raise InvalidGeometryError(msg)
        return Mesh(name, v, f.astype(np.int32), source)

    def triangles(self) -> Floats:
        """(F, 3, 3): the corners of each face."""
        return self.vertices[self.faces]

    def area(self) -> float:
        """Surface area, m²."""
        return float(doubled_areas(self.vertices, self.faces).sum() / 2.0)

    def scaled(self, factor: float) -> Mesh:
        """The same in other units."""
        return Mesh(self.name, self.vertices * factor, self.faces, self.source, self.placements, self.notes)


def doubled_areas(vertices: Floats, faces: NDArray[Any]) -> Floats:
    """Twice the area of each of F faces, (F,), m²."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas: Floats = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas
