"""A model's surface, ready to be asked how far points are from it and on which side.

Built once a model, in its own frame, whatever the number of its instances. Two kinds, one interface:

- triangles: exact distance to the nearest one, signed by its pseudo-normal;
- oriented samples (a piece of scan as a model): distance to the plane of the nearest sample.

Parts that run into one another (pipes modelled as solids through each other) need no union: a line from a point outside
to a face within the union meets the union's own surface first, so outside the nearest face is a true one and so is its
sign. Inside, and behind the wall of a hollow part, a face that no scanner can see may be nearer than the true surface:
name those in `hidden`, and no point is measured from them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.cloud import OrientedCloud, as_points
from scanfind.errors import InvalidGeometryError
from scanfind.library.cloud_surface import oriented

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

# Corners are rounded to a 2^21st of the model's extent (3 m: 1.4 µm) to be compared: three such make one int64.
WELD_STEPS = 2**21 - 1
# A triangle lower than this share of its length has no normal to speak of (3 m: 30 nm): it is measured as its edges.
NEEDLE = 1e-8


def near_triangles(
    triangles: ArrayLike, reach: float, hidden: NDArray[np.bool_] | None = None, signed: bool = True
) -> NearSurface:
    """The surface of a mesh, to be asked for distances up to `reach`.

    triangles : (F, 3, 3) corners of each face, model frame, metres, counter-clockwise seen from outside
    reach : metres
    hidden : (F,) faces nobody can see, from which no point is measured; None for none
    signed : False where the faces are not turned consistently: distances are given without a sign

    Raises InvalidGeometryError for wrong shapes, NaN, no face that can be seen, or a reach that is not positive.
    """
    corners = np.ascontiguousarray(triangles, dtype=np.float64)
    if corners.ndim != 3 or corners.shape[1:] != (3, 3):
        msg = f"triangles must have shape (F, 3, 3), got {corners.shape}"
        raise InvalidGeometryError(msg)
    seen = np.ones(len(corners), dtype=np.bool_) if hidden is None else ~np.asarray(hidden, dtype=np.bool_)
    if seen.shape != (len(corners),):
        msg = f"hidden must have one entry for each of {len(corners)} faces, got shape {seen.shape}"
        raise InvalidGeometryError(msg)
    check_surface(corners, reach, int(seen.sum()))
    normals = unit_normals(corners)
    # Of 23,000 faces they take 0.1 s.
    toward_outside = pseudonormals(corners, normals) if signed else np.zeros((len(corners), 6, 3), np.float32)
    return in_tree_order(corners, normals, toward_outside, np.flatnonzero(seen), reach, 0.0, signed)


def near_model(model: Model, reach: float) -> NearSurface:
    """The surface of a model from the library: the triangles of a mesh, the points of a piece of scan."""
    if model.mesh is not None:
        return near_triangles(model.mesh.triangles(), reach)
    if model.cloud is None:
        return near_samples(model.samples, model.spacing, reach)
    surface, cell = oriented(model.cloud)
    return near_samples(surface, 1.5 * cell, reach)


def near_samples(cloud: OrientedCloud, spacing: float, reach: float) -> NearSurface:
    """The surface that oriented samples stand for, to be asked for distances up to `reach`.

    A point is measured from the plane of its nearest sample, if it lies no farther than `spacing` from it along that
    plane and `reach` across. Without a sign where the cloud has none.

    spacing : distance of neighbouring samples, metres

    Raises InvalidGeometryError for no sample, NaN, or a spacing or reach that is not positive.
    """
    if not (np.isfinite(spacing) and spacing > 0):
        msg = f"the spacing of samples must be positive, in metres, got {spacing}"
        raise InvalidGeometryError(msg)
    points, normals = as_points(cloud.points), as_points(cloud.normals, "normals")
    if len(points) != len(normals):
        msg = f"each sample needs a normal, got {len(points)} points and {len(normals)} normals"
        raise InvalidGeometryError(msg)
    corners = np.repeat(points[:, None, :], 3, axis=1)
    check_surface(corners, reach, len(points))
    none = np.empty((len(points), 0, 3), dtype=np.float32)
    return in_tree_order(corners, normals, none, np.arange(len(points)), reach, float(spacing), cloud.signed)


def signed_distances(near: NearSurface, points: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """How far N points (N, 3) of the model frame are from the surface, and from which of its faces.

    Returns distances (N,) in metres, + outside, NaN beyond reach; faces (N,), -1 beyond reach, the lowest number where
    several are equally near. Raises InvalidGeometryError for wrong shapes.
    """
    from scanfind.kernels.distance import distances

    xyz = as_points(points)
    distance, face = distances(near, np.eye(3), np.zeros(3), np.zeros(3), xyz, np.arange(len(xyz)))
    return distance, face


def check_surface(corners: Floats, reach: float, seen: int) -> None:
    """The door of both kinds; raises InvalidGeometryError."""
    if not seen:
        msg = "a surface needs at least one face or sample that can be seen, got none"
        raise InvalidGeometryError(msg)
    if not np.isfinite(corners).all():
        msg = "a surface must have finite coordinates, got NaN or infinity"
        raise InvalidGeometryError(msg)
    if not (np.isfinite(reach) and reach > 0):
        msg = f"the reach of a surface must be positive, in metres, got {reach}"
        raise InvalidGeometryError(msg)


def in_tree_order(
    corners: Floats,
    normals: Floats,
    toward_outside: NDArray[np.float32],
    faces: NDArray[np.int64],
    reach: float,
    spacing: float,
    signed: bool,
) -> NearSurface:
    """The surface of the chosen `faces`, (K,), with its tree of boxes."""
    from scanfind.kernels.distance import LEAF, NearSurface, box_order

    leaves = 1
    while leaves * LEAF < len(faces):
        leaves *= 2
    order = np.arange(len(faces))
    box_order(corners[faces].mean(axis=1), leaves, order)
    order = faces[order]
    chosen = np.ascontiguousarray(corners[order])
    return NearSurface(
        corners=chosen,
        normals=np.ascontiguousarray(normals[order]),
        pseudonormals=np.ascontiguousarray(toward_outside[order]),
        face=order.astype(np.int32),
        boxes=box_tree(chosen, leaves),
        reach=float(reach),
        spacing=spacing,
        signed=bool(signed),
    )


def box_tree(corners: Floats, leaves: int) -> Floats:
    """The boxes (2 leaves, 6) of corners (F, 3, 3) that are in the order of the tree, see NearSurface."""
    starts = len(corners) * np.arange(leaves) // leaves
    boxes = np.empty((2 * leaves, 6))
    boxes[leaves:, :3] = np.minimum.reduceat(corners.min(axis=1), starts)
    boxes[leaves:, 3:] = np.maximum.reduceat(corners.max(axis=1), starts)
    while leaves > 1:
        children, leaves = boxes[leaves : 2 * leaves].reshape(-1, 2, 6), leaves // 2
        boxes[leaves : 2 * leaves, :3] = children[:, :, :3].min(axis=1)
        boxes[leaves : 2 * leaves, 3:] = children[:, :, 3:].max(axis=1)
    return boxes


def unit_normals(corners: Floats) -> Floats:
    """Unit normals (F, 3); zero for needles."""
    edges = np.roll(corners, -1, axis=1) - corners
    normals: Floats = np.cross(edges[:, 0], edges[:, 1])
    doubled_area = np.linalg.norm(normals, axis=1)
    longest = (edges**2).sum(axis=2).max(axis=1)
    flat = doubled_area > NEEDLE * longest
    return np.where(flat[:, None], normals / np.where(flat, doubled_area, 1.0)[:, None], 0.0)


def pseudonormals(corners: Floats, normals: Floats) -> NDArray[np.float32]:
    """What points outwards at edges ab, bc, ca and corners a, b, c of each face, (F, 6, 3), of any length.

    At an edge the sum of the normals of its faces, at a corner that sum weighted by the angles there (Bærentzen & Aanæs
    2005, 3). Corners are welded first: an STL file knows no shared ones.
    """
    corner = weld(corners)
    edge_from, edge_to = corner, np.roll(corner, -1, axis=1)
    packed = np.minimum(edge_from, edge_to) * (corner.max() + 1) + np.maximum(edge_from, edge_to)
    edge: NDArray[np.int64] = np.unique(packed, return_inverse=True)[1].reshape(corner.shape)
    ones = np.ones_like(corner, dtype=np.float64)
    at_edges = summed(edge, ones, normals)
    at_corners = summed(corner, angles(corners), normals)
    return np.concatenate([at_edges, at_corners], axis=1).astype(np.float32)


def summed(group: NDArray[np.int64], weight: Floats, normals: Floats) -> Floats:
    """Weighted sum of the normals (F, 3) of all faces in each group; groups, weights and result are (F, 3[, 3])."""
    total = np.zeros((group.max() + 1, 3))
    for k in range(3):
        total[:, k] = np.bincount(group.ravel(), (weight * normals[:, k, None]).ravel())
    sums: Floats = total[group]
    return sums


def angles(corners: Floats) -> Floats:
    """The angles (F, 3) at the corners of each face, radians."""
    onward = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    # atan2 keeps its digits at the sharp corners of slivers, where arccos has none.
    across: Floats = np.linalg.norm(np.cross(onward, back), axis=2)
    angle: Floats = np.arctan2(across, (onward * back).sum(axis=2))
    return angle


def weld(corners: Floats) -> NDArray[np.int64]:
    """A number (F, 3) for each corner, the same where corners are equal, and mostly where they nearly are."""
    low = corners.min(axis=(0, 1))
    extent = float((corners.max(axis=(0, 1)) - low).max()) or 1.0
    steps = np.round((corners - low) * (WELD_STEPS / extent)).astype(np.int64)
    packed = (steps[..., 0] << 42) | (steps[..., 1] << 21) | steps[..., 2]
    _, number = np.unique(packed, return_inverse=True)
    return number.reshape(packed.shape)
