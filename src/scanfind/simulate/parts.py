"""Parametric parts: pipes, elbows, tees, flanges, steel sections, and what is put together from them.

Every part is an outer surface only, outward normals, metres. Round parts begin at the origin and run along +z; their
rings have SIDES corners at equal angles, the first towards +x, so that parts put end to end share their corners and
an assembly closes without a seam.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.errors import InvalidGeometryError
from scanfind.mesh import Mesh
from scanfind.pose import Pose

Floats = NDArray[np.float64]
Faces = NDArray[np.int64]

# 48 corners: a 0.1 m pipe is then flat by at most 0.2 mm, a tenth of the range noise.
SIDES = 48
WELD_M = 1e-6


def pipe(radius: float, length: float) -> Mesh:
    """A pipe's outside without its ends: radius, length along +z."""
    _check_positive(radius=radius, length=length)
    return revolve("pipe", [(radius, 0.0), (radius, length)])


def cylinder(radius: float, length: float) -> Mesh:
    """A closed cylinder along +z."""
    _check_positive(radius=radius, length=length)
    return revolve("cylinder", [(0.0, 0.0), (radius, 0.0), (radius, length), (0.0, length)])


def flange(pipe_radius: float, flange_radius: float, thickness: float) -> Mesh:
    """A blind flange that ends a pipe: open ring of pipe_radius at z = 0, closed face at z = thickness."""
    _check_positive(pipe_radius=pipe_radius, step=flange_radius - pipe_radius, thickness=thickness)
    return revolve("flange", [(pipe_radius, 0.0), (flange_radius, 0.0), (flange_radius, thickness), (0.0, thickness)])


def elbow(radius: float, bend_radius: float, angle: float) -> Mesh:
    """A bend towards +x by `angle` radians about a centre at x = bend_radius; open ends. It ends at `elbow_end`."""
    _check_positive(radius=radius, angle=angle, clearance=bend_radius - radius)
    rings = max(2, int(np.ceil(angle / (2 * np.pi / SIDES))) + 1)
    ring = _ring(radius)
    return _swept("elbow", [elbow_end(bend_radius, a).move(ring) for a in np.linspace(0.0, angle, rings)])


def elbow_end(bend_radius: float, angle: float) -> Pose:
    """start_from_end of an elbow."""
    return Pose.from_rotation_vector(
        [0.0, angle, 0.0], [bend_radius * (1 - np.cos(angle)), 0.0, bend_radius * np.sin(angle)]
    )


def tee(radius: float, branch_radius: float, length: float, height: float) -> Mesh:
    """A run along +z with a branch towards +x from its middle up to x = height; three open ends, no inside.

    The run's skin is unrolled to a rectangle (turn × length) with the branch's footprint cut out; rows of corners
    lead from the footprint's rim to the rectangle's.
    """
    _check_positive(branch_radius=branch_radius, length=length - 2 * branch_radius, height=height - radius)
    if branch_radius > radius:
        msg = f"a tee's branch cannot be thicker than its run, got {branch_radius} m on {radius} m"
        raise InvalidGeometryError(msg)
    around = 4 * SIDES
    psi = -0.75 * np.pi + 2 * np.pi * np.arange(around) / around
    rim = np.stack([np.arcsin(branch_radius / radius * np.cos(psi)), branch_radius * np.sin(psi)], axis=1)
    go, stay = np.arange(SIDES) / SIDES * 2 - 1, np.ones(SIDES)
    square = np.concatenate([np.c_[go, -stay], np.c_[stay, go], np.c_[-go, stay], np.c_[-stay, -go]])
    rectangle = square * [np.pi, length / 2]
    share = np.linspace(0.0, 1.0, SIDES // 2 + 1)[:, None, None]
    turn, along = np.moveaxis(rim + share * (rectangle - rim), -1, 0)
    skin = np.stack([radius * np.cos(turn), radius * np.sin(turn), along + length / 2], axis=-1)

    # The port's first corner lies at -z of the run, a quarter turn before psi's zero: begin above psi's first.
    port = tee_branch(length, height).move(_ring(branch_radius))
    first = int(np.argmin(np.linalg.norm(port - [height, *skin[0, 0, 1:]], axis=1)))
    branch = np.concatenate([skin[0], np.roll(port, -first, axis=0)])
    return _welded("tee", [(skin.reshape(-1, 3), _strip(len(skin), around)), (branch, _reduction(around, SIDES))])


def tee_branch(length: float, height: float) -> Pose:
    """run_from_branch: where the branch of a tee ends, its z leading out."""
    return Pose.from_rotation_vector([0.0, np.pi / 2, 0.0], [height, 0.0, length / 2])


def box(x: float, y: float, z: float) -> Mesh:
    """A closed box from the origin to (x, y, z)."""
    _check_positive(x=x, y=y, z=z)
    return blocks("box", [((0.0, 0.0, 0.0), (x, y, z))])


def plate(x: float, y: float, thickness: float) -> Mesh:
    """A plate from the origin: x by y, `thickness` along z."""
    return box(x, y, thickness)


def hollow_section(width: float, depth: float, length: float) -> Mesh:
    """The outside of a square or rectangular hollow section (HSS) centred on z, ends closed."""
    _check_positive(width=width, depth=depth, length=length)
    return blocks("hss", [((-width / 2, -depth / 2, 0.0), (width / 2, depth / 2, length))])


def i_section(width: float, depth: float, flange_thickness: float, web_thickness: float, length: float) -> Mesh:
    """An I section centred on z, ends closed: flanges `width` along x, `depth` along y."""
    _check_positive(web=depth - 2 * flange_thickness, width=width - web_thickness, length=length)
    w, d, t, s = width / 2, depth / 2, flange_thickness, web_thickness / 2
    return blocks(
        "i_section",
        [((-w, -d, 0.0), (w, -d + t, length)), ((-w, d - t, 0.0), (w, d, length)), ((-s, -d, 0.0), (s, d, length))],
    )


def assemble(name: str, placed: Iterable[tuple[Mesh, Pose]]) -> Mesh:
    """One mesh of several, each moved by its pose (assembly_from_part); corners that meet become one."""
    return _welded(name, [(pose.move(mesh.vertices), mesh.faces.astype(np.int64)) for mesh, pose in placed])


def blocks(name: str, boxes: Sequence[ArrayLike], holes: Sequence[ArrayLike] = ()) -> Mesh:
    """The outside of the union of axis-parallel boxes, each ((x, y, z) low, (x, y, z) high).

    holes : flat rectangles of the same form, left out of the surface: where something else is welded on
    Space is cut at every box's sides; faces between a cell inside and one outside remain.
    """
    low, high = np.moveaxis(np.array([np.asarray(b, dtype=np.float64) for b in boxes]), 1, 0)
    gaps = np.array([np.asarray(h, dtype=np.float64) for h in holes]).reshape(-1, 2, 3)
    corners = np.concatenate([low, high, gaps[:, 0], gaps[:, 1]])
    lines = [np.unique(np.round(corners[:, a], 9)) for a in range(3)]
    middles = [(line[1:] + line[:-1]) / 2 for line in lines]
    inside = np.zeros([len(m) + 2 for m in middles], dtype=bool)
    for lo, hi in zip(low, high, strict=True):
        x, y, z = ((m > lo[a]) & (m < hi[a]) for a, m in enumerate(middles))
        inside[1:-1, 1:-1, 1:-1] |= x[:, None, None] & y[None, :, None] & z[None, None, :]

    shape = tuple(len(line) for line in lines)
    quads = []
    for axis in range(3):
        u, v = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        for side in (0, 1):
            beyond = np.roll(inside, 1 - 2 * side, axis=axis)
            cell = np.argwhere(inside & ~beyond) - 1
            base = cell + np.eye(3, dtype=np.int64)[axis] * side
            quad = np.stack([base, base + u, base + u + v, base + v], axis=1)
            quads.append(quad if side else quad[:, ::-1])
    quad = np.concatenate(quads)
    centre = np.stack([lines[a][quad[:, :, a]].mean(axis=1) for a in range(3)], axis=1)
    for lo, hi in gaps:
        kept = ((centre < lo - 1e-9) | (centre > hi + 1e-9)).any(axis=1)
        quad, centre = quad[kept], centre[kept]

    flat = np.ravel_multi_index(tuple(np.moveaxis(quad, -1, 0)), shape)
    used, index = np.unique(flat, return_inverse=True)
    at = np.unravel_index(used, shape)
    vertices = np.stack([lines[a][at[a]] for a in range(3)], axis=1)
    index = index.reshape(-1, 4)
    return Mesh.of(name, vertices, np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]]))


def revolve(name: str, profile: Sequence[tuple[float, float]]) -> Mesh:
    """A profile of (radius, z) turned about z; outside is on the right hand of its way, as for a pipe going up."""
    return _swept(name, [np.pad(_ring(radius)[:, :2], ((0, 0), (0, 1)), constant_values=z) for radius, z in profile])


def _ring(radius: float) -> Floats:
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(SIDES)], axis=1)


def _swept(name: str, rings: Sequence[Floats]) -> Mesh:
    """A skin over rings of SIDES corners each, anticlockwise seen against the way."""
    return _welded(name, [(np.concatenate(rings), _strip(len(rings), SIDES)[:, ::-1])])


def _strip(rows: int, around: int) -> Faces:
    """Faces (F, 3) between consecutive closed rows of corners, the next row to the right of this one's way."""
    i = np.arange(around)
    j = (i + 1) % around
    row = (np.arange(rows - 1) * around)[:, None]
    a, b, c, d = (row + i, row + around + i, row + around + j, row + j)
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


def _reduction(many: int, few: int) -> Faces:
    """Faces (F, 3) between a closed row of `many` corners and one of `few` to its left, `many` four times `few`."""
    fine = (4 * np.arange(few)[:, None] + np.arange(5)) % many
    this, after = many + np.arange(few), many + (np.arange(few) + 1) % few
    a, b, c, d, e = fine.T
    corners = [(a, b, this), (b, c, this), (c, after, this), (c, d, after), (d, e, after)]
    return np.concatenate([np.stack(three, axis=1) for three in corners])


def _welded(name: str, pieces: Iterable[tuple[Floats, NDArray[Any]]]) -> Mesh:
    vertices, faces, count = [], [], 0
    for v, f in pieces:
        vertices.append(v)
        faces.append(f + count)
        count += len(v)
    if not vertices:
        msg = f"nothing to assemble for {name!r}: give at least one part"
        raise InvalidGeometryError(msg)
    every = np.concatenate(vertices)
    # An odd part of a step aside: drawn sizes and their halves and thirds must not lie where rounding is a toss.
    keys = np.floor(every / WELD_M + 0.4142).astype(np.int64)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    f = index.reshape(-1)[np.concatenate(faces)]
    distinct = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])
    return Mesh.of(name, every[first], f[distinct])


def _check_positive(**sizes: float) -> None:
    for what, size in sizes.items():
        if not (np.isfinite(size) and size > 0.0):
            msg = f"{what} must be a positive length, got {size}"
            raise InvalidGeometryError(msg)
