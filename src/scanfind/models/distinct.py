"""Which shapes are one shape, wherever they lie, and which placements are rigid motions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.mesh import Floats
from scanfind.models.parts import Part

# Exporters write the same bolt with a few micrometres of rounding; no two designs differ by so little.
SAME_M = 1e-5


class Copy(NamedTuple):
    """A part that is the geometry of another: its number, and copy_from_first (4, 4), the motion between the two."""

    part: int
    copy_from_first: Floats


def same_shapes(parts: Sequence[Part]) -> list[list[Copy]]:
    """Parts that are the same geometry but for a rigid motion, group by group; the first of each moves by nothing.

    The same: equal triangles of equal vertex numbers, vertices within 0.01 mm. Some exporters write every beam in the
    coordinates of the site, so that equal ones differ by where they lie. Groups, and the parts in them, are in the
    order given. Distances are compared, not rounded numbers: 3.175 mm lies on the edge between two hundredths, and
    would be two shapes.
    """
    alike: dict[tuple[int, bytes], list[int]] = defaultdict(list)
    for index, part in enumerate(parts):
        alike[len(part.vertices), np.ascontiguousarray(part.faces).tobytes()].append(index)
    groups = []
    for indices in alike.values():
        frames = [own_frame(parts[k].vertices) for k in indices]
        for group in _near([_inside(frame, parts[k].vertices) for frame, k in zip(frames, indices, strict=True)]):
            first = group[0]
            first_vertices, to_first = parts[indices[first]].vertices, np.linalg.inv(frames[first])
            groups.append([
                Copy(
                    indices[k],
                    # Where they lie in one place already, no motion of a micrometre is made up.
                    np.eye(4) if _close(parts[indices[k]].vertices, first_vertices) else frames[k] @ to_first,
                )
                for k in group
            ])  # fmt: skip
    return sorted(groups, key=lambda copies: copies[0].part)


def own_frame(vertices: Floats) -> Floats:
    """A frame (4, 4) that moves with the vertices (V, 3): world_from_own.

    At the first vertex, x to the farthest from it, y to the farthest from that line; of equally far ones, to the first
    in the order given, which copies share.
    """
    spread = vertices - vertices[0]
    x = _towards_farthest(spread)
    y = _towards_farthest(spread - np.outer(spread @ x, x))
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    frame[:3, 3] = vertices[0]
    return frame


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
    mirror = np.diag([1.0 if handed > 0 else -1.0, 1.0, 1.0])
    rigid, rest = np.eye(4), np.eye(4)
    rigid[:3, :3] = u @ vt @ mirror
    rigid[:3, 3] = matrix[:3, 3]
    rest[:3, :3] = mirror @ vt.T @ np.diag(scales) @ vt
    return rigid, rest


def _towards_farthest(offsets: Floats) -> Floats:
    """Unit vector along the first of the longest offsets."""
    lengths = np.linalg.norm(offsets, axis=1)
    longest = int(np.argmax(lengths >= lengths.max() - SAME_M))
    direction: Floats = offsets[longest] / max(float(lengths[longest]), SAME_M)
    return direction


def _inside(frame: Floats, vertices: Floats) -> Floats:
    """The vertices, seen from the frame."""
    seen: Floats = (vertices - frame[:3, 3]) @ frame[:3, :3]
    return seen


def _near(vertices: list[Floats]) -> list[list[int]]:
    """Groups of equal arrays, by their numbers: all within SAME_M of the first of the group."""
    stack = np.stack(vertices).reshape(len(vertices), -1)
    left: NDArray[np.int64] = np.arange(len(vertices))
    groups = []
    while len(left):
        same = (np.abs(stack[left] - stack[left[0]]) <= SAME_M).all(axis=1)
        groups.append(left[same].tolist())
        left = left[~same]
    return groups


def _close(a: Floats, b: Floats) -> bool:
    return bool((np.abs(a - b) <= SAME_M).all())
