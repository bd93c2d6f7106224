"""What of a model a drawing would dimension: pipes, flange faces, and the outermost planes of what has none.

Found once a model, from its triangles alone. Each feature is a few faces of the mesh that are parts of planes and
cylinders, and is later fitted as one rigid thing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import cos, radians, sin
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.dimensions.skin import Flat, Ints, Round, Skin, flats_of, rounds_of, skin_of

if TYPE_CHECKING:
    from scanfind.mesh import Mesh

Floats = NDArray[np.float64]

PIPE, FLANGE, SIDE, BAR = "pipe", "flange", "side", "bar"

LONG = 1.0  # half a pipe's length over its radius: what is shorter is a rim or a coupling, and tells no axis
COAXIAL = cos(radians(1.0))
SAME = 0.02  # of the radius: an axis that passes a face's middle so near is its axis
CIRCLE = 0.01  # of the radius, by which a disc's border may leave its circle
CORNERS = 10  # of a disc; a nut has six
LEAST_DISC_M = 0.02  # radius: below are bolts
FREE = 0.5  # of a disc's radius: nothing of the model stands so far in front of a face that something can be bolted to
DIRECTIONS = 64
MOST_FLANGES, MOST_PIPES = 8, 8
LEAST_SIDE = 3e-4  # of a model's area: the end of a hollow column of 3.6 m is 7e-4
PARALLEL = cos(radians(0.2))
UPRIGHT = sin(radians(5.0))
EXTENTS = ("length", "width", "height")


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces of the mesh that are of one plane (`radius` None) or one cylinder; model frame, metres.

    point, direction : of the plane and its outward normal, or of the axis
    border : (B, 2, 3) where the plane's faces end; width : of what is between, on average
    low, high : where the cylinder ends, along its axis from `point`
    """

    faces: Ints
    point: Floats
    direction: Floats
    radius: float | None = None
    border: Floats | None = None
    width: float = 0.0
    low: float = 0.0
    high: float = 0.0


@dataclass(frozen=True, eq=False)
class Feature:
    """A pipe, a flange, a side or a bar: a centre and a unit axis, model frame, metres, and its surfaces.

    axis : of a pipe or bar; the outward normal of a flange's face or of a side
    radius : of a pipe, or of a flange's face; half : half the length of a pipe or bar
    surfaces : the cylinder of a pipe; the face of a flange, and its rim where it has one; the plane of a side; the four
        sides of a bar
    """

    name: str
    kind: str
    centre: Floats
    axis: Floats
    surfaces: tuple[Surface, ...]
    radius: float = 0.0
    half: float = 0.0

    @property
    def has_rim(self) -> bool:
        """Has it a surface about its axis, which tells where its centre is?"""
        return any(surface.radius is not None for surface in self.surfaces)


def features_of(mesh: Mesh) -> tuple[Feature, ...]:
    """The features of a mesh, flanges first, then pipes, each the largest first; sides where it has neither."""
    skin = skin_of(mesh)
    flats, rounds = flats_of(skin), rounds_of(skin)
    flanges = flanges_of(skin, flats, rounds)
    pipes = [piece for piece in rounds if piece.half >= LONG * piece.radius]
    pipes = sorted(pipes, key=lambda piece: (-round(piece.radius * piece.half, 4), *np.round(piece.centre, 3)))
    found = [*flanges, *(pipe_of(skin, piece, k) for k, piece in enumerate(pipes[:MOST_PIPES], 1))]
    return tuple(found or sides_of(skin, flats))


def pipe_of(skin: Skin, piece: Round, number: int) -> Feature:
    """A straight round piece as a feature."""
    return Feature(f"pipe {number}", PIPE, piece.centre, piece.axis, (about(skin, piece),), piece.radius, piece.half)


def flanges_of(skin: Skin, flats: Sequence[Flat], rounds: Sequence[Round]) -> list[Feature]:
    """The faces that something is bolted or welded to: discs and rings across a round piece's axis, free in front."""
    found: list[tuple[Flat, float, Round]] = []
    for flat in flats:
        circle = circle_about(flat)
        if circle is None or circle[1] < LEAST_DISC_M:
            continue
        disc, radius = flat._replace(centre=circle[0]), circle[1]
        behind = [piece for piece in rounds if is_behind(piece, disc, radius)]
        if behind and is_free(skin, disc, radius):
            # The rim: of the face's own size. Else its pipe.
            rim = min(behind, key=lambda piece: (abs(piece.radius - radius), -piece.half))
            found.append((disc, radius, rim))
    # Of a raised face and the ring behind it the one in front.
    front = [one for one in found if not any(is_before(other[0], one[0], one[1]) for other in found)]
    front.sort(key=lambda one: (-round(one[1], 4), *np.round(one[0].centre, 3)))
    return [flange_of(skin, flat, radius, rim, k) for k, (flat, radius, rim) in enumerate(front[:MOST_FLANGES], 1)]


def flange_of(skin: Skin, flat: Flat, radius: float, rim: Round, number: int) -> Feature:
    """A disc with what is round behind it as a feature."""
    if abs(rim.radius - radius) < SAME * radius and rim.half < LONG * rim.radius:
        surfaces = plane(skin, flat), about(skin, rim)
        return Feature(f"flange {number}", FLANGE, flat.centre, flat.normal, surfaces, radius)
    return Feature(f"end {number}", FLANGE, flat.centre, flat.normal, (plane(skin, flat),), radius)


def circle_about(flat: Flat) -> tuple[Floats, float] | None:
    """The centre and radius of a flat piece whose outer border is a circle; None where it is none."""
    corners = flat.border.reshape(-1, 3) - flat.centre
    u = corners[0] / np.linalg.norm(corners[0]) if len(corners) else np.zeros(3)
    v = np.cross(flat.normal, u)
    plane = np.stack([corners @ u, corners @ v], axis=1)
    turns = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    if not len(plane):
        return None
    outer = np.unique(np.argmax(plane @ [np.cos(turns), np.sin(turns)], axis=0))
    outer = plane[outer]
    if len(np.unique(np.round(outer, 6), axis=0)) < CORNERS:
        return None
    # x² + y² = 2 a x + 2 b y + c
    rows = np.column_stack([2.0 * outer, np.ones(len(outer))])
    a, b, c = np.linalg.lstsq(rows, (outer**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(c + a * a + b * b, 0.0)))
    if np.abs(np.linalg.norm(outer - [a, b], axis=1) - radius).max() > CIRCLE * radius:
        return None
    return flat.centre + a * u + b * v, radius


def is_behind(piece: Round, flat: Flat, radius: float) -> bool:
    """Does a round piece begin at a disc, or near it, and go back from it, about the same axis?"""
    away = piece.centre - flat.centre
    along = float(away @ flat.normal)
    aside = float(np.linalg.norm(away - along * flat.normal))
    begins = along + piece.half
    slack = SAME * radius + (1.0 - abs(float(piece.axis @ flat.normal))) * abs(along)
    parallel = abs(float(piece.axis @ flat.normal)) > COAXIAL
    return bool(parallel and aside < slack and -2.0 * radius < begins < SAME * radius and piece.radius < 1.05 * radius)


def is_free(skin: Skin, flat: Flat, radius: float) -> bool:
    """Is there nothing of the model right in front of a disc?"""
    off = skin.corners - flat.centre
    along = off @ flat.normal
    aside = np.linalg.norm(off - along[..., None] * flat.normal, axis=2)
    # A raised face stands out by a few millimetres. By the faces: a long pipe has corners at its ends alone.
    stands = (along.max(axis=1) > 0.1 * radius) & (along.min(axis=1) < FREE * radius)
    return not (stands & (aside.min(axis=1) < radius)).any()


def is_before(other: Flat, flat: Flat, radius: float) -> bool:
    """Does another disc stand a little in front of this one, about the same axis and looking the same way?"""
    away = other.centre - flat.centre
    along = float(away @ flat.normal)
    aside = float(np.linalg.norm(away - along * flat.normal))
    alike = float(other.normal @ flat.normal) > COAXIAL and aside < SAME * radius
    return bool(alike and 1e-6 < along < 0.1 * radius and other.area > 0.2 * flat.area)


def sides_of(skin: Skin, flats: Sequence[Flat]) -> list[Feature]:
    """Pairs of opposite outermost planes, square to one another, farthest apart first: extents of a bar or frame."""
    least = LEAST_SIDE * float(skin.areas.sum())
    outer = [side for side in planes_of(skin, flats) if side.area > least and is_outermost(skin, side)]
    pairs = [
        (float((one.centre - other.centre) @ one.normal), one, other)
        for one, other in combinations(outer, 2)
        if float(one.normal @ other.normal) < -PARALLEL
    ]
    pairs.sort(key=lambda pair: (-round(pair[0], 4), *np.round(pair[1].normal, 3)))
    kept: list[tuple[float, Flat, Flat]] = []
    for pair in pairs:
        if all(abs(float(pair[1].normal @ other[1].normal)) < UPRIGHT for other in kept):
            kept.append(pair)
    # Of a bar with mitred ends its depth comes first, and is not its length.
    names = EXTENTS if kept and kept[0][0] > 0.9 * longest(skin, [pair[1].normal for pair in kept]) else EXTENTS[1:]
    return [
        Feature(f"{what} side {number}", SIDE, side.centre, side.normal, (plane(skin, side),))
        for what, (_, *two) in zip(names, kept, strict=False)
        for number, side in enumerate(two, 1)
    ]


def longest(skin: Skin, normals: Sequence[Floats]) -> float:
    """The largest extent along up to three directions that are square to one another, and what is square to them."""
    square = np.linalg.svd(np.array(normals))[2][len(normals) :]
    return float(np.ptp(skin.corners.reshape(-1, 3) @ np.concatenate([normals, square]).T, axis=0).max())


def planes_of(skin: Skin, flats: Sequence[Flat]) -> list[Flat]:
    """Flat pieces, those of one plane as one."""
    left, planes = list(flats), []
    while left:
        first = left[0]
        reach = 1e-3 * np.sqrt(first.area)
        alike = [
            flat.normal @ first.normal > PARALLEL and abs((flat.centre - first.centre) @ first.normal) < reach
            for flat in left
        ]
        planes.append(flat_of_all(skin, [flat for flat, same in zip(left, alike, strict=True) if same]))
        left = [flat for flat, same in zip(left, alike, strict=True) if not same]
    return planes


def flat_of_all(skin: Skin, flats: Sequence[Flat]) -> Flat:
    """Flat pieces of one plane as one."""
    from scanfind.dimensions.skin import flat_of

    return flats[0] if len(flats) == 1 else flat_of(skin, np.concatenate([flat.faces for flat in flats]))


def is_outermost(skin: Skin, side: Flat) -> bool:
    """Does nothing stand out beyond a plane?"""
    beyond = ((skin.corners.reshape(-1, 3) - side.centre) @ side.normal).max()
    return bool(beyond < 1e-3 * np.sqrt(side.area))


def plane(skin: Skin, flat: Flat) -> Surface:
    """A flat piece as a surface."""
    around = float(np.linalg.norm(flat.border[:, 1] - flat.border[:, 0], axis=1).sum())
    width = 2.0 * flat.area / max(around, 1e-12)
    return Surface(skin.number[flat.faces], flat.centre, flat.normal, border=flat.border, width=width)


def about(skin: Skin, piece: Round) -> Surface:
    """A round piece as a surface."""
    return Surface(skin.number[piece.faces], piece.centre, piece.axis, piece.radius, low=-piece.half, high=piece.half)
