"""A pose drawn to points from farther away than ICP on a scene may look: where they are known to be the model's own.

What ICP on the scene cannot do: there the nearest surface is a neighbour's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.fit.patches import touching
from scanfind.pose import Pose, rotation_from_vector

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface

Floats = NDArray[np.float64]

LEAST_POINTS = 12  # twice the unknowns
STAYS = 1e-3  # of the mean information, for every motion: what points do not say of one leaves it as it is


def pulled(near: NearSurface, pose: Pose, xyz: Floats, gates: Floats) -> Pose:
    """A pose after one step of least squares for each gate, metres: to points no farther off, the nearer the more.

    near : the model's surface, asked for as far as a gate reaches
    pose : scene_from_model; xyz : (N, 3) scene frame
    """
    low, high = near.boxes[1].reshape(2, 3)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    one_scan = np.zeros(len(xyz), np.int64)
    for gate in gates.tolist():
        on = touching(near._replace(reach=gate), pose, pose, xyz, one_scan, 1)
        if len(on.off) < LEAST_POINTS:
            return pose
        rows = np.concatenate([np.cross(on.points - centre, on.normals) / radius, on.normals], axis=1)
        weighted = rows * ((1.0 - (on.off / gate) ** 2) ** 2)[:, None]
        normal = weighted.T @ rows
        normal += STAYS * np.trace(normal) / 6.0 * np.eye(6)
        step = np.linalg.solve(normal, weighted.T @ on.off)
        turned = rotation_from_vector(step[:3] / radius)
        pose = pose @ Pose(turned, centre - turned @ centre + step[3:])
    return pose
