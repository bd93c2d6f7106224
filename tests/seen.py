"""What two scanners see of a few meshes before a wall, as the grid keeps it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanfind.grid.depth import Beams
from scanfind.kernels.grid import NO_BEAM, cube_place, pack_beam
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.parts import blocks
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject

Floats = NDArray[np.float64]

WALL = blocks("wall", [((-4.0, 3.0, -2.0), (4.0, 3.1, 3.0))])
STATIONS = np.array([[-1.0, -4.0, 0.6], [2.0, -4.0, 1.2]])


def seen_of(placed: Sequence[tuple[Mesh, Pose]]) -> list[Beams]:
    """What they keep of some meshes before it."""
    scene = Scene(
        tuple(SceneObject(mesh.name, mesh, pose) for mesh, pose in [(WALL, Pose.identity()), *placed]), STATIONS
    )
    return [beams_about(cloud.xyz, where) for cloud, where in
            zip(scan(scene, scanner=Scanner(step=0.004), seed=1).stations, STATIONS, strict=True)]  # fmt: skip


def beams_about(points: Floats, origin: Floats, edge: int = 360) -> Beams:
    """What a scanner would keep of points it saw, (N, 3)."""
    nearest = np.full(6 * edge**2, NO_BEAM)
    for way in points - origin:
        pixel, packed = pack_beam(*cube_place(*way), edge, float(np.linalg.norm(way)))
        nearest[pixel] = min(nearest[pixel], packed)
    return Beams(origin, nearest, edge)
