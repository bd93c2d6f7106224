"""Which shapes are one shape, and which placements are rigid motions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanfind.mesh import Floats
from scanfind.models.parts import Part

# Exporters write the same bolt with a few micrometres of rounding; no two designs differ by so little.
SAME_M = 1e-5


def same_shapes(parts: Sequence[Part]) -> list[list[int]]:
    """Indices of parts that are the same geometry, group by group: same triangles, vertices within 0.01 mm.

    Groups, and the parts in them, are in the order given. Distances are compared, not rounded numbers: 3.175 mm lies
    on the edge between two hundredths, and would be two shapes.
    """
    alike: dict[tuple[int, bytes], list[int]] = defaultdict(list)
    for index, part in enumerate(parts):
        alike[len(part.vertices), np.ascontiguousarray(part.faces).tobytes()].append(index)
    groups = [group for indices in alike.values() for group in _near([parts[k].vertices for k in indices], indices)]
    return sorted(groups)


def _near(vertices: list[Floats], indices: list[int]) -> list[list[int]]:
    """Groups of indices whose vertices, all of one shape, lie within SAME_M of those of the first of the group."""
    stack = np.stack(vertices).reshape(len(vertices), -1)
    left: NDArray[np.int64] = np.arange(len(indices))
    groups = []
    while len(left):
        same = (np.abs(stack[left] - stack[left[0]]) <= SAME_M).all(axis=1)
        groups.append([indices[k] for k in left[same]])
        left = left[~same]
    return groups


def rigid_and_rest(matrix: Floats) -> tuple[Floats, Floats | None]:
    """A placement (4, 4) as rigid @ rest: a motion, and the mirror, scale or shear that has to go into the geometry.

    The rest is None where the placement is a rigid motion already. A mirrored one is mirrored in x, so that all
    mirror images of a geometry come out as one; scales and shears are what a polar decomposition leaves.
    """
    linear = matrix[:3, :3]
    u, scales, vt = np.linalg.svd(linear)
    handed = np.linalg.det(u @ vt)
    if np.abs(scales - 1.0).max() < 1e-6 and handed > 0:
        return matrix, None
    mirror = np.diag([np.sign(handed) or 1.0, 1.0, 1.0])
    rigid, rest = np.eye(4), np.eye(4)
    rigid[:3, :3] = u @ vt @ mirror
    rigid[:3, 3] = matrix[:3, 3]
    rest[:3, :3] = mirror @ vt.T @ np.diag(scales) @ vt
    return rigid, rest
