"""What the page's viewer draws, as bytes: positions in 16 bits a coordinate, a value in 8, models as they are.

A point takes 7 bytes, so a million of them 9.3 MB in the page's base64. Each cloud is quantised in its own box: that
of a beam of 12 m to 0.2 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scanfind.report.items import Item
    from scanfind.report.material import Material, Points
    from scanfind.results.schema import Matrix

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scene:
    """Buffers of little-endian numbers, and what is where in them, for JSON."""

    positions: bytes
    values: bytes
    vertices: bytes
    faces: bytes
    facts: dict[str, Any]


def scene_of(items: Sequence[Item], material: Material) -> Scene:
    """The scene of a report; coordinates are taken from an origin near to it, which the facts name."""
    clouds = [*material.points.values(), material.around]
    corners = [cloud.xyz.mean(axis=0) for cloud in clouds if len(cloud.xyz)]
    corners += [np.array(item.design_from_model)[:3, 3] for item in items if item.design_from_model]
    origin = np.round(np.array(corners).mean(axis=0)) if corners else np.zeros(3)
    # Of all deviations the largest stands for 127: noise alone must not take all of the scale.
    full = max((np.nanmax(np.abs(c.values), initial=0.0) for c in material.points.values()), default=0.0) or 0.01
    packed = _Packed(origin)
    places = {number: packed.add(cloud, np.rint(127.0 * _numbers(cloud.values) / full))
              for number, cloud in material.points.items()}  # fmt: skip
    around = packed.add(material.around, np.rint(127.0 * material.around.values))
    names = {name: k for k, name in enumerate(material.shapes)}
    # About their own middle: a model drawn in the coordinates of a country has no digits left in single precision.
    middles = [np.mean([shape.vertices.min(axis=0), shape.vertices.max(axis=0)], axis=0)
               for shape in material.shapes.values()]  # fmt: skip
    vertices = [
        (shape.vertices - middle).astype("<f4") for shape, middle in zip(material.shapes.values(), middles, strict=True)
    ]
    faces = [shape.faces.astype("<u4") for shape in material.shapes.values()]
    facts = {
        "origin": origin.tolist(),
        "full": float(full),
        "around": around,
        "shapes": [
            {"vertices": len(v), "faces": len(f), "low": v.min(axis=0).tolist(), "high": v.max(axis=0).tolist()}
            for v, f in zip(vertices, faces, strict=True)
        ],
        "items": [
            {
                "key": item.key,
                "name": item.name,
                "status": item.status,
                "verdict": item.verdict,
                "shape": names.get(item.model, -1),
                "stands": _columns(item.scene_from_model, origin, _of(middles, names.get(item.model))),
                "design": _columns(item.design_from_model, origin, _of(middles, names.get(item.model))),
                "cloud": None if item.found is None else places.get(item.found.id),
            }
            for item in items
        ],
    }
    join = b"".join
    return Scene(
        join(packed.positions), join(packed.values), join(v.tobytes() for v in vertices),
        join(f.tobytes() for f in faces), facts,
    )  # fmt: skip


class _Packed:
    """Clouds one after the other, quantised."""

    def __init__(self, origin: Floats) -> None:
        self.origin, self.count = origin, 0
        self.positions: list[bytes] = []
        self.values: list[bytes] = []

    def add(self, cloud: Points, values: Floats) -> dict[str, Any] | None:
        """Append a cloud; where it is and how to unpack it. None for one without points."""
        if not len(cloud.xyz):
            return None
        local = cloud.xyz - self.origin
        low = local.min(axis=0)
        size = np.maximum(local.max(axis=0) - low, 1e-6)
        self.positions.append(np.rint((local - low) / size * 65535.0).astype("<u2").tobytes())
        self.values.append(np.clip(values, -127, 127).astype(np.int8).tobytes())
        first, self.count = self.count, self.count + len(local)
        return {"first": first, "count": len(local), "low": low.tolist(), "size": size.tolist()}


def _numbers(values: Floats) -> Floats:
    return np.nan_to_num(values)


def _of(middles: Sequence[Floats], number: int | None) -> Floats:
    return np.zeros(3) if number is None else middles[number]


def _columns(matrix: Matrix | None, origin: Floats, middle: Floats) -> list[float] | None:
    """The pose of a shape about its middle, from the origin, sixteen numbers column by column as graphics want it."""
    if matrix is None:
        return None
    pose = np.array(matrix)
    pose[:3, 3] += pose[:3, :3] @ middle - origin
    return [float(value) for value in pose.T.ravel()]
