"""A mesh as a skin of faces that know their neighbours, and the flat and round pieces of it."""

from __future__ import annotations

from math import cos, radians
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly.members import connected
from scanfind.library.near_surface import unit_normals, weld

if TYPE_CHECKING:
    from scanfind.mesh import Mesh

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FLAT = cos(radians(0.3))  # neighbours that differ by less are of one plane; the finest pipes have 1° a facet
SMOOTH, ALIKE = cos(radians(16.0)), 0.3
MOST_FLATS = 500
BENT = cos(radians(35.0))  # neighbours on a pipe of ten sides; coarser ones are not told from bars
LEAST_SHARE = 1e-4  # of all area, for what is looked at
ROUND = 2e-3  # of the radius: corners of a tessellated cylinder lie on it, but for the rounding of a file
SECTORS = 24
HALF_SEEN = SECTORS // 2  # less is a fillet
ACROSS = 0.05  # sine by which a face of a cylinder may lean; those of elbows lean more
MOST_TRIES = 200  # a millisecond each of 10,000 faces
LEAST_FACES = 8


class Skin(NamedTuple):
    """F faces with an area.

    corners : (F, 3, 3) model frame, metres; normals : (F, 3) unit; areas : (F,) m²; number : (F,) of the mesh's faces
    edges : (F, 3) numbers of edges, shared by neighbours; pairs : (E, 2) neighbours
    """

    corners: Floats
    normals: Floats
    areas: Floats
    number: Ints
    edges: Ints
    pairs: Ints


class Flat(NamedTuple):
    """A connected flat piece of skin: its faces, area, middle, outward normal, and border (B, 2, 3)."""

    faces: Ints
    area: float
    centre: Floats
    normal: Floats
    border: Floats


class Round(NamedTuple):
    """A straight round piece of skin, bulging outwards: its faces, the middle of its axis, unit axis, radius, and half
    its length, metres.
    """

    faces: Ints
    centre: Floats
    axis: Floats
    radius: float
    half: float


def skin_of(mesh: Mesh) -> Skin:
    """The skin of a mesh; corners that are equal are one, as in a file that knows no shared ones."""
    corners = mesh.triangles()
    normals = unit_normals(corners)
    number = np.flatnonzero((normals != 0.0).any(axis=1))
    corners, normals = corners[number], normals[number]
    corner = weld(corners) if len(corners) else np.empty((0, 3), np.int64)
    a, b = corner, np.roll(corner, -1, axis=1)
    packed = np.minimum(a, b) * (corner.max(initial=0) + 1) + np.maximum(a, b)
    edges = np.unique(packed, return_inverse=True)[1].reshape(corner.shape)
    order = np.argsort(edges.ravel(), kind="stable")
    along, face = edges.ravel()[order], order // 3
    same = np.flatnonzero(along[1:] == along[:-1])
    pairs = np.stack([face[same], face[same + 1]], axis=1)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return Skin(corners, normals, 0.5 * np.linalg.norm(doubled, axis=1), number, edges, pairs)


def flats_of(skin: Skin) -> list[Flat]:
    """The flat pieces, the largest first."""
    if not len(skin.areas):
        return []
    first, second = skin.pairs.T
    cosine = (skin.normals[first] * skin.normals[second]).sum(axis=1)
    piece = np.unique(connected(len(skin.areas), skin.pairs[cosine > FLAT]), return_inverse=True)[1]
    areas = np.bincount(piece, skin.areas)
    # A facet of something curved: two or more neighbours of about its size go on from it smoothly.
    smooth = skin.pairs[(cosine <= FLAT) & (cosine > SMOOTH)]
    beside = np.unique(piece[np.concatenate([smooth, smooth[:, ::-1]])], axis=0)
    beside = beside[areas[beside[:, 1]] > ALIKE * areas[beside[:, 0]]]
    curved = np.bincount(beside[:, 0], minlength=len(areas)) > 1
    order = np.argsort(piece, kind="stable")
    counts = np.bincount(piece)
    ends = np.cumsum(counts)
    found: list[Flat] = []
    for k in np.argsort(-areas, kind="stable"):
        if areas[k] < LEAST_SHARE * areas.sum() or len(found) >= MOST_FLATS:
            break
        if curved[k]:
            continue
        flat = flat_of(skin, order[ends[k] - counts[k] : ends[k]])
        off = (skin.corners[flat.faces] - flat.centre) @ flat.normal
        if np.abs(off).max() < ROUND * np.sqrt(flat.area):
            found.append(flat)
    return found


def flat_of(skin: Skin, faces: Ints) -> Flat:
    """Faces of a plane as one flat piece."""
    weights = skin.areas[faces]
    normal = weights @ skin.normals[faces]
    centre = weights @ skin.corners[faces].mean(axis=1) / weights.sum()
    edges = skin.edges[faces]
    once = np.bincount(edges.ravel())[edges] == 1
    ends = np.stack([skin.corners[faces], np.roll(skin.corners[faces], -1, axis=1)], axis=2)
    return Flat(faces, float(weights.sum()), centre, normal / np.linalg.norm(normal), ends[once])


def rounds_of(skin: Skin) -> list[Round]:
    """The round pieces, those of the largest faces first; one straight pipe is one piece, also where a tee is in it.

    Two neighbouring faces tell an axis and a circle; all faces whose corners lie on that cylinder are of it.
    """
    first, second = skin.pairs.T
    cosine = (skin.normals[first] * skin.normals[second]).sum(axis=1)
    size = np.minimum(skin.areas[first], skin.areas[second])
    likely = (cosine < FLAT) & (cosine > BENT) & (size > 0.2 * LEAST_SHARE * skin.areas.sum())
    likely_first = np.flatnonzero(likely)[np.argsort(-size[likely], kind="stable")]
    extent = float(np.ptp(skin.corners.reshape(-1, 3), axis=0).max()) if len(skin.areas) else 0.0
    used = np.zeros(len(skin.areas), np.bool_)
    found: list[Round] = []
    tries = 0
    for seed in likely_first:
        if used[first[seed]] or used[second[seed]] or tries >= MOST_TRIES:
            continue
        tries += 1
        axis, centre, radius = circle_of(skin, int(first[seed]), int(second[seed]))
        if not 0.0 < radius < extent:
            continue
        faces = on_cylinder(skin, ~used, centre, axis, radius)
        # Also what is no whole cylinder is not looked at again.
        used[faces] = True
        if len(faces) >= LEAST_FACES:
            found += [run for run in runs_of(skin, faces, centre, axis, radius) if is_round(skin, run)]
    return found


def circle_of(skin: Skin, one: int, other: int) -> tuple[Floats, Floats, float]:
    """The axis about which two neighbouring faces turn, a point of it, and the radius through their corners."""
    axis = np.cross(skin.normals[one], skin.normals[other])
    axis /= np.linalg.norm(axis)
    corners = skin.corners[[one, other]]
    across = corners - (corners @ axis)[..., None] * axis
    # The shared edge is nearest to the other face's middle; of each face the corner farthest from it.
    shared = across[0][np.argmin(np.linalg.norm(across[0] - across[1].mean(axis=0), axis=1))]
    ends = [three[np.argmax(np.linalg.norm(three - shared, axis=1))] for three in across]
    a, b = ends[0] - shared, ends[1] - shared
    cross = np.cross(a, b)
    doubled = 2.0 * float(cross @ cross)
    if doubled <= 0.0:
        return axis, shared, 0.0
    to_centre = np.cross((a @ a) * b - (b @ b) * a, cross) / doubled
    return axis, shared + to_centre, float(np.linalg.norm(to_centre))


def on_cylinder(skin: Skin, free: NDArray[np.bool_], centre: Floats, axis: Floats, radius: float) -> Ints:
    """Which of the `free` faces, (F,), have all corners on a cylinder and look away from its axis: their numbers."""
    faces = np.flatnonzero(free & (np.abs(skin.normals @ axis) < ACROSS))
    off = skin.corners[faces] - centre
    off -= (off @ axis)[..., None] * axis
    near = (np.abs(np.linalg.norm(off, axis=2) - radius) < ROUND * radius).all(axis=1)
    outwards = (off.mean(axis=1) * skin.normals[faces]).sum(axis=1) > 0.7 * radius
    kept: Ints = faces[near & outwards]
    return kept


def runs_of(skin: Skin, faces: Ints, centre: Floats, axis: Floats, radius: float) -> list[Round]:
    """The faces of one cylinder, cut where there is a gap in it longer than what is on either side of the gap."""
    along = (skin.corners[faces] - centre) @ axis
    low, high = along.min(axis=1), along.max(axis=1)
    order = np.argsort(low, kind="stable")
    reached = np.maximum.accumulate(high[order])
    cuts = np.flatnonzero(low[order][1:] > reached[:-1] + 0.05 * radius) + 1
    pieces = [order[i:j] for i, j in zip([0, *cuts], [*cuts, len(order)], strict=True)]
    joined = [pieces[0]]
    for piece in pieces[1:]:
        before = joined[-1]
        gap = low[piece].min() - high[before].max()
        if gap < min(np.ptp(along[before]), np.ptp(along[piece])):
            joined[-1] = np.concatenate([before, piece])
        else:
            joined.append(piece)
    return [round_of(skin, faces[piece], centre, axis, radius) for piece in joined]


def round_of(skin: Skin, faces: Ints, centre: Floats, axis: Floats, radius: float) -> Round:
    """Faces of a cylinder as a piece, its centre in the middle of them."""
    off = skin.corners[faces] - centre
    u, v = across(axis)
    sector = np.floor((np.arctan2(off @ v, off @ u) / (2 * np.pi) + 0.5) * SECTORS).astype(int).ravel() % SECTORS
    ends = np.full((2, SECTORS), -np.inf)
    for side, along in zip(ends, (off @ axis, -(off @ axis)), strict=True):
        np.maximum.at(side, sector, along.ravel())
    # The median: at the sides of a bend some of its faces still lie on the pipe.
    high, low = (float(np.median(side[np.isfinite(side)])) for side in ends)
    low = -low
    # Of the two ways of an axis the one that goes up in x, or y, or z.
    way = axis if axis[np.argmax(np.abs(axis) > 1e-6)] > 0 else -axis
    return Round(np.sort(faces), centre + 0.5 * (low + high) * axis, way, radius, 0.5 * (high - low))


def is_round(skin: Skin, piece: Round) -> bool:
    """Do the faces go at least half around, and are they most of what such a piece has?"""
    off = skin.corners[piece.faces].mean(axis=1) - piece.centre
    u, v = across(piece.axis)
    sectors = np.unique(np.floor((np.arctan2(off @ v, off @ u) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS)
    # A coarse tube has fewer faces than sectors.
    around = len(sectors) >= min(HALF_SEEN, len(np.unique(np.round(skin.normals[piece.faces], 2), axis=0)))
    whole = 4.0 * np.pi * piece.radius * piece.half
    return bool(around and skin.areas[piece.faces].sum() > 0.25 * whole and len(piece.faces) >= LEAST_FACES)


def across(axis: Floats) -> tuple[Floats, Floats]:
    """Two unit directions across an axis and each other."""
    u = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    u /= np.linalg.norm(u)
    return u, np.cross(axis, u)
