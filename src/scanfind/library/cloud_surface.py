"""The surface of a model that is itself a piece of scan: "find more of this"."""

from __future__ import annotations

import numpy as np

from scanfind.cloud import CloudModel, OrientedCloud, PointChunk
from scanfind.errors import InvalidGeometryError
from scanfind.grid.moments import MomentGrid
from scanfind.grid.surfels import Surfels
from scanfind.library.surface import MAX_LEVELS, SHRINK, ModelSurface, SurfaceParameters, surface_of

# A piece of scan is resampled as finely as its points allow, between these shares of its size.
FINEST, COARSEST = 1.0 / 250.0, 1.0 / 30.0
POINTS_A_CELL = 4.0
MIN_NEIGHBOURS = 5
# A plane that meets a cube, anyhow turned, has this much of the cube's face in it on average: volume over mean width.
AREA_OF_A_CELL = 2.0 / 3.0


def resample(cloud: CloudModel) -> Surfels:
    """A piece of scan as surfels: means with normals by PCA, towards its scanner if that is known.

    Raises InvalidGeometryError for a piece without extent.
    """
    size = float(np.linalg.norm(np.ptp(cloud.points, axis=0))) if len(cloud.points) else 0.0
    if not size > 0.0:
        msg = f"model {cloud.name!r} is a point cloud without extent ({len(cloud.points)} points); cut a larger piece"
        raise InvalidGeometryError(msg)
    grid = MomentGrid(size * FINEST)
    origin = None if cloud.origin is None else np.asarray(cloud.origin, np.float64)
    grid.add(PointChunk(cloud.points, {}, np.arange(len(cloud.points)), 0, origin))
    while grid.points_per_row() < POINTS_A_CELL and 2.0 * grid.cell <= size * COARSEST:
        grid = grid.coarser()
    return Surfels(grid, MIN_NEIGHBOURS).fit()


def oriented(cloud: CloudModel) -> tuple[OrientedCloud, float]:
    """The surfels of a piece of scan that have a normal, in its own frame, and the edge of their cells, metres."""
    surfels = resample(cloud)
    sound = surfels.has_normal()
    if np.count_nonzero(sound) < 2:
        msg = f"model {cloud.name!r} is too sparse for normals ({len(cloud.points)} points); cut a denser piece"
        raise InvalidGeometryError(msg)
    points = surfels.means[sound] + surfels.cells.offset
    return OrientedCloud(points, np.ascontiguousarray(surfels.normals[sound]), surfels.signed), surfels.cell


def sample_cloud(cloud: CloudModel, parameters: SurfaceParameters, seed: int = 0) -> ModelSurface:
    """Evenly spread samples of a piece of scan, every prefix evenly spread, as `sample_mesh` gives of a mesh.

    Raises InvalidGeometryError for a piece without extent or too sparse for normals.
    """
    from scanfind.kernels.sampling import poisson_order

    surface, cell = oriented(cloud)
    shuffled = np.random.default_rng(seed).permutation(len(surface))
    points, normals = surface.points[shuffled], surface.normals[shuffled]
    reach = float(np.linalg.norm(np.ptp(points, axis=0)))
    order, spacing = poisson_order(points, normals, parameters.samples, reach / 2.0, SHRINK, MAX_LEVELS)
    return surface_of(OrientedCloud(points[order], normals[order], surface.signed), spacing, len(surface) * AREA_OF_A_CELL * cell**2)
