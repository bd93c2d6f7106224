"""One watertight surface cut into its straight round members and what lies between them: pipes, bends, branches.

A spool welded into one surface names no parts. Its pipes are cylinders, found greedily, the largest first: two facets
that meet in an edge along the pipe share a circle with it (the projection of their corners along the edge), and edges
that agree on an axis and a radius vote for one cylinder. What no cylinder has is a bend, when it joins two of them, and
otherwise belongs to the member it touches most (flanges, caps, fillets).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.library.near_surface import unit_normals, weld
from scanfind.mesh import Mesh, doubled_areas

Floats = NDArray[np.float64]
Labels = NDArray[np.int64]

# Facets of one cylinder turn by this much from one to the next: 360 to 7 of them around.
FACET_TURN_DEG = (0.5, 52.0)
OFF_RADIUS = 0.005  # corners of a cylinder's faces lie on it within this share of its radius
OFF_AXIS = 0.15  # sine of the angle by which their normals may miss a right angle to the axis
LEAST_LENGTH = 1.0  # a member is at least so many radii long; the rim of a flange is not
LEAST_AROUND = 0.5  # share of the cylinder of its length that is there: a bend lies on one along its back only
LEAST_AREA = 0.01  # share of the surface a member or a bend has
MOST_TRIED = 100  # cylinders voted for that are looked at
COAXIAL = 0.05  # axes this near, in radii and radians, are one: bore and outside, pipe and flange


class Edges(NamedTuple):
    """Edges that two faces share, E of them: the faces, the corner of each that is not on it, the ends."""

    faces: Labels
    apexes: Labels
    ends: Labels


class Cylinder(NamedTuple):
    """A point on the axis, its unit direction, the radius, metres, and a face that lies on it."""

    point: Floats
    axis: Floats
    radius: float
    face: int


def members(mesh: Mesh) -> tuple[Labels, tuple[str, ...]]:
    """Which part each of F faces belongs to, (F,), and the parts' names; one part where there are no members."""
    corners = mesh.triangles()
    edges = shared_edges(weld(corners))
    areas = 0.5 * doubled_areas(mesh.vertices, mesh.faces)
    part, cylinders = cut_cylinders(corners, unit_normals(corners), areas, edges)
    if len(cylinders) < 2:
        return np.zeros(len(corners), np.int64), (mesh.name,)
    part, count = with_rest(part, len(cylinders), areas, corners, edges)
    order = np.argsort(-np.bincount(part[: len(areas)], areas, minlength=count), kind="stable")
    names, numbers = [""] * count, {"pipe": 0, "bend": 0}
    for rank, old in enumerate(order):
        kind = "pipe" if old < len(cylinders) else "bend"
        numbers[kind] += 1
        names[rank] = f"{kind} {numbers[kind]}"
    rank_of = np.empty(count, np.int64)
    rank_of[order] = np.arange(count)
    return rank_of[part], tuple(names)


def shared_edges(corner: Labels) -> Edges:
    """The edges of exactly two faces; corner : (F, 3) a number for each corner, equal where corners are one."""
    start, stop = corner, np.roll(corner, -1, axis=1)
    key = np.minimum(start, stop) * (corner.max() + 1) + np.maximum(start, stop)
    order = np.argsort(key, axis=None, kind="stable")
    keys = key.ravel()[order]
    first = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    two = first[np.diff(np.append(first, len(keys))) == 2]
    at = np.stack([order[two], order[two + 1]], axis=1)
    face = at // 3
    # Corners are named by where they are in (F, 3): their coordinates are corners.reshape(-1, 3)[number].
    where = np.arange(corner.size).reshape(corner.shape)
    apexes = np.roll(where, 1, axis=1).ravel()[at]
    ends = np.stack([where.ravel()[at[:, 0]], np.roll(where, -1, axis=1).ravel()[at[:, 0]]], axis=1)
    return Edges(face, apexes, ends)


def cut_cylinders(
    corners: Floats, normals: Floats, areas: Floats, edges: Edges
) -> tuple[Labels, list[Cylinder]]:  # fmt: skip
    """The member of each face, (F,), -1 for none, and the members."""
    part = np.full(len(corners), -1)
    cylinders: list[Cylinder] = []
    votes = voted(corners, normals, edges)
    for cylinder in votes:
        if part[cylinder.face] >= 0:
            continue
        on = lying_on(cylinder, np.flatnonzero(part < 0), corners, normals)
        if areas[on].sum() < LEAST_AREA * areas.sum():
            continue
        for piece in pieces_of(on, edges.faces, len(corners)):
            along = corners[piece].reshape(-1, 3) @ cylinder.axis
            length, area = float(np.ptp(along)), float(areas[piece].sum())
            whole = LEAST_AROUND * 2.0 * np.pi * cylinder.radius * length
            if length >= LEAST_LENGTH * cylinder.radius and area >= max(whole, LEAST_AREA * areas.sum()):
                part[piece] = joined_to(cylinder, along, cylinders, part, corners)
                if part[piece[0]] == len(cylinders):
                    cylinders.append(cylinder)
    return part, cylinders


def voted(corners: Floats, normals: Floats, edges: Edges) -> list[Cylinder]:
    """Cylinders that edges propose, most edge length first, at most MOST_TRIED."""
    f, g = edges.faces.T
    turn = np.degrees(np.arccos(np.clip((normals[f] * normals[g]).sum(axis=1), -1.0, 1.0)))
    bent = np.flatnonzero((turn > FACET_TURN_DEG[0]) & (turn < FACET_TURN_DEG[1]))
    points = corners.reshape(-1, 3)
    start, stop = points[edges.ends[bent, 0]], points[edges.ends[bent, 1]]
    lengths = np.linalg.norm(stop - start, axis=1)
    axes = (stop - start) / np.maximum(lengths, 1e-12)[:, None]
    axes *= np.where(axes @ [1.0, 1e-3, 1e-6] < 0.0, -1.0, 1.0)[:, None]
    a, b = ((off := points[edges.apexes[bent, k]] - start) - (off * axes).sum(axis=1)[:, None] * axes for k in (0, 1))
    # The circle through three points, one of them the origin: its centre, from the two chords.
    aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
    spread = 2.0 * (aa * bb - ab * ab)
    sound = (spread > 1e-6 * aa * bb) & (lengths > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = ((bb * (aa - ab))[:, None] * a + (aa * (bb - ab))[:, None] * b) / spread[:, None]
    radii = np.linalg.norm(centre, axis=1)
    foot = start + centre
    foot -= (foot * axes).sum(axis=1)[:, None] * axes
    sound &= np.isfinite(radii) & (radii < np.ptp(points, axis=0).max())
    chosen = np.flatnonzero(sound)
    # Rounding may split the votes for one cylinder in two; either half still proposes it.
    rounded = np.round(
        np.hstack(
            [axes[chosen] / 0.01, foot[chosen] / (0.05 * radii[chosen, None]), np.log(radii[chosen, None]) / 0.05]
        )
    ).astype(np.int64)
    _, group = np.unique(rounded, axis=0, return_inverse=True)
    group = group.reshape(-1)
    weight = np.bincount(group, lengths[chosen])
    by_length = chosen[np.argsort(lengths[chosen], kind="stable")]
    longest = np.zeros(len(weight), np.int64)
    longest[group[np.argsort(lengths[chosen], kind="stable")]] = by_length
    best = longest[np.argsort(-weight, kind="stable")[:MOST_TRIED]]
    return [Cylinder(foot[k], axes[k], float(radii[k]), int(f[bent[k]])) for k in best]


def lying_on(cylinder: Cylinder, faces: Labels, corners: Floats, normals: Floats) -> Labels:
    """Those of some faces whose corners lie on a cylinder and that face along its radius."""
    faces = faces[np.abs(normals[faces] @ cylinder.axis) < OFF_AXIS]
    off = corners[faces] - cylinder.point
    off -= (off @ cylinder.axis)[..., None] * cylinder.axis
    far = np.linalg.norm(off, axis=2)
    on: Labels = faces[(np.abs(far - cylinder.radius) < OFF_RADIUS * cylinder.radius).all(axis=1)]
    return on


def joined_to(
    cylinder: Cylinder, along: Floats, known: list[Cylinder], part: Labels, corners: Floats
) -> int:  # fmt: skip
    """The number of a member on the same axis that this one lies in or around (its bore, its flange), or a new one."""
    for number, other in enumerate(known):
        apart = other.point - cylinder.point
        apart -= (apart @ cylinder.axis) * cylinder.axis
        if abs(cylinder.axis @ other.axis) < np.cos(COAXIAL) or np.linalg.norm(apart) > COAXIAL * cylinder.radius:
            continue
        theirs = corners[part == number].reshape(-1, 3) @ cylinder.axis
        overlap = min(along.max(), theirs.max()) - max(along.min(), theirs.min())
        if overlap > 0.5 * min(np.ptp(along), np.ptp(theirs)):
            return number
    return len(known)


def with_rest(
    part: Labels, count: int, areas: Floats, corners: Floats, edges: Edges
) -> tuple[Labels, int]:  # fmt: skip
    """Faces of no member as bends, or with the member they share the most edge with; and how many parts that makes."""
    points = corners.reshape(-1, 3)
    lengths = np.linalg.norm(points[edges.ends[:, 1]] - points[edges.ends[:, 0]], axis=1)
    settled = part.copy()
    for piece in pieces_of(np.flatnonzero(part < 0), edges.faces, len(part)):
        inside = np.zeros(len(part), np.bool_)
        inside[piece] = True
        border = inside[edges.faces[:, 0]] != inside[edges.faces[:, 1]]
        beyond = np.where(inside[edges.faces[border, 0]], edges.faces[border, 1], edges.faces[border, 0])
        touched = np.bincount(part[beyond][part[beyond] >= 0], lengths[border][part[beyond] >= 0], minlength=1)
        if np.count_nonzero(touched) == 1 or (touched.any() and areas[piece].sum() < LEAST_AREA * areas.sum()):
            settled[piece] = int(np.argmax(touched))
        else:
            settled[piece] = count
            count += 1
    return settled, count


def pieces_of(faces: Labels, pairs: Labels, count: int) -> list[Labels]:
    """Some of `count` faces as connected pieces, by the pairs (E, 2) of faces that share an edge."""
    among = np.zeros(count, np.bool_)
    among[faces] = True
    label = connected(count, pairs[among[pairs].all(axis=1)])
    order = faces[np.argsort(label[faces], kind="stable")]
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(order) else []


def connected(count: int, pairs: NDArray[Any]) -> Labels:
    """The lowest number each of `count` things is connected to, (count,), by pairs (E, 2)."""
    label = np.arange(count)
    while len(pairs):
        low = label[pairs].min(axis=1)
        before = label.copy()
        np.minimum.at(label, pairs[:, 0], low)
        np.minimum.at(label, pairs[:, 1], low)
        label = label[label]
        if np.array_equal(label, before):
            break
    return label
