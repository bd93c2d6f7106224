"""The last word on each part: its fit to the raw points, once the second pass has brought them.

A surfel is the mean of a cell a fifth of a branch wide; a raw point is where the beam met the pipe. Each point is held
against the nearest triangle of the part it is nearest to.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly.fit import Matches, PlacedParts, hinges_of, stepped, tukey
from scanfind.library.near_surface import near_triangles, signed_distances

if TYPE_CHECKING:
    from scanfind.assembly.parts import Assembly
    from scanfind.kernels.distance import NearSurface
    from scanfind.mesh import Mesh
    from scanfind.pose import Pose

Floats = NDArray[np.float64]

# How far from the surface points are read: where all but a flange lies along a leg, surfels leave its slide 15 mm open.
REACH_M = 0.025
STEPS, SHRINK = 12, 0.7  # of the gate, from REACH_M down to …
# … so many spreads of a part's points about it: farther ones are mixed pixels, or something else.
GATE_SPREADS, SPREAD_OF_MEDIAN = 3.5, 1.4826
LEAST_POINTS = 30
MOST_POINTS = 20_000  # of a part: with 2 mm noise they tell 0.02 mm, less than any scanner is calibrated to
# Points as near as this to another part as well say little of either: fillets, welds, what of one runs into the other.
APART_M = 0.005


def fitted_to_points(parts: PlacedParts, mesh: Mesh, assembly: Assembly, points: Floats) -> PlacedParts:
    """The parts of one placed model, in their order, fitted to raw points (N, 3) within REACH_M, the parts' frame.

    A part that meets too few of them stays as it is.
    """
    corners = mesh.triangles()
    own = [corners[assembly.part_of_face == k] for k in range(len(assembly.names))]
    # Points are told apart by the parts as they were placed by the surfels, within which they hardly move now.
    surfaces = [near_triangles(faces, REACH_M + APART_M) for faces in own]
    far = np.stack([
        np.abs(signed_distances(surface, parts.pose(k).inverse().move(points))[0]) for k, surface in enumerate(surfaces)
    ])  # fmt: skip
    far = np.where(np.isnan(far), np.inf, far)
    nearest, two = np.argmin(far, axis=0), np.partition(far, 1, axis=0)[:2]
    clear = (two[0] <= REACH_M) & (two[1] >= two[0] + APART_M)
    mine = [spread_out(np.flatnonzero(clear & (nearest == k))) for k in range(len(own))]
    normals = [face_normals(faces) for faces in own]
    fitted = parts
    for gate in REACH_M * SHRINK ** np.arange(STEPS):
        found = [met(fitted.pose(k), surfaces[k], normals[k], points[mine[k]], gate) for k in range(len(own))]
        fitted = stepped(fitted, found, hinges_of(assembly.joints, fitted, parts), assembly.arrays)
    for k in np.flatnonzero([not len(one.gaps) for one in found]):
        for column, before in zip(fitted[1:], parts[1:], strict=True):
            column[k] = before[k]
    return fitted


def met(pose: Pose, surface: NearSurface, normals: Floats, points: Floats, gate: float) -> Matches:
    """Where a part meets its raw points (N, 3), scene frame; nowhere where these are too few.

    normals : (F, 3) of its faces; gate : metres, widened to what the points are spread by
    """
    distance, face = signed_distances(surface, pose.inverse().move(points))
    on = np.flatnonzero(face >= 0)
    if len(on) < LEAST_POINTS:
        on = on[:0]
    gaps, normal = distance[on].astype(np.float64), pose.turn(normals[face[on]])
    if len(on):
        gate = min(max(gate, GATE_SPREADS * SPREAD_OF_MEDIAN * float(np.median(np.abs(gaps)))), REACH_M)
    return Matches(points[on] - gaps[:, None] * normal, normal, gaps, tukey(gaps, gate), 1.0)


def face_normals(corners: Floats) -> Floats:
    """Unit normals (F, 3) of faces that have an area."""
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals: Floats = crosses / np.maximum(np.linalg.norm(crosses, axis=1), 1e-300)[:, None]
    return normals


def spread_out(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """At most MOST_POINTS of them, evenly."""
    return rows if len(rows) <= MOST_POINTS else rows[np.linspace(0, len(rows) - 1, MOST_POINTS).astype(np.intp)]


def placed_faces(mesh: Mesh, assembly: Assembly, parts: PlacedParts, there: Sequence[bool]) -> Floats:
    """The faces (F, 3, 3) of the parts that are there, each where it was built, the parts' frame."""
    corners = mesh.triangles()
    moved = [
        parts.pose(k).move(corners[assembly.part_of_face == k].reshape(-1, 3)) for k, one in enumerate(there) if one
    ]
    return np.concatenate(moved).reshape(-1, 3, 3)
