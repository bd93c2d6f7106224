"""The axis and radius of parts that are round about one: flanges, rings, pipes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

LIKE = 0.02  # two moments of inertia that differ by less are those of a round thing; bolt holes do not disturb that


@dataclass(frozen=True)
class Disc:
    """The axis of a round part, a unit direction of the model's frame, and the radius of its rim, metres."""

    axis: tuple[float, float, float]
    radius: float


def discs_of(model: Model) -> dict[tuple[str, str], Disc]:
    """Of a model's parts those that are round: (model, part) → axis and radius. Empty for a piece of scan."""
    if model.mesh is None:
        return {}
    found = {}
    for name, first, end in model.mesh.notes.get("parts", ()):
        disc = disc_of(model.mesh.vertices[model.mesh.faces[first:end]])
        if disc is not None:
            found[model.name, str(name)] = disc
    return found


def disc_of(triangles: Floats) -> Disc | None:
    """The axis about which a surface (F, 3, 3) has equal moments in all directions; None where it has none, or many."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    if not areas.sum() > 0.0:
        return None
    # Exact second moments of each triangle: its corners and its middle, weighted 1 : 1 : 1 : 9 over 12.
    middles = triangles.mean(axis=1)
    centre = areas @ middles / areas.sum()
    moments = sum(np.einsum("f,fi,fj->ij", areas * w, p - centre, p - centre) for p, w in
                  ((a, 1 / 12), (b, 1 / 12), (c, 1 / 12), (middles, 9 / 12)))  # fmt: skip
    values, axes = np.linalg.eigh(moments)
    low, mid, high = values / values[2]
    if mid - low <= LIKE < high - mid:
        axis = axes[:, 2]
    elif high - mid <= LIKE < mid - low:
        axis = axes[:, 0]
    else:
        return None
    x, y, z = axis.tolist()
    away = triangles.reshape(-1, 3) - centre
    radius = np.linalg.norm(away - np.outer(away @ axis, axis), axis=1).max()
    return Disc((x, y, z), float(radius))
