"""A model's sample where a pose puts it."""

from __future__ import annotations

from scanfind.kernels.jit import kernel


@kernel
def placed(points, normals, i, rotation, translation):
    """Point and normal of sample i of (N, 3), moved by a pose: x, y, z, nx, ny, nz.

    Elements, not rows: a view of a row counts references, which costs two threads more than the arithmetic.
    """
    px, py, pz = points[i, 0], points[i, 1], points[i, 2]
    mx, my, mz = normals[i, 0], normals[i, 1], normals[i, 2]
    return (
        rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + translation[0],
        rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + translation[1],
        rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz + translation[2],
        rotation[0, 0] * mx + rotation[0, 1] * my + rotation[0, 2] * mz,
        rotation[1, 0] * mx + rotation[1, 1] * my + rotation[1, 2] * mz,
        rotation[2, 0] * mx + rotation[2, 1] * my + rotation[2, 2] * mz,
    )
