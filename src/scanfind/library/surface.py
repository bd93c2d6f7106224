"""The surface of a model as a scanner could see it: evenly spread oriented points (paper 3.2, Algorithm 1).

The paper samples the CAD surface by Poisson disks. A model as people have it also holds what no scanner meets: pipes
that run into each other, the inner faces of an assembly, the bore of a closed section. Such surface would count as
missing in every scene, so only points that see out of the model are kept, each with its normal on the side that sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.errors import InvalidGeometryError, UsageError

if TYPE_CHECKING:
    from scanfind.mesh import Mesh

    Floats = NDArray[np.float64]

# 8 darts a sample leave no hole: a Poisson disk of jammed radius holds 17 of them, so one in 10^7 holds none.
DARTS_PER_SAMPLE = 8
# … and at most 5 rounds of them, where nearly all of the surface is hidden.
MAX_ROUNDS = 5
# From level to level disks shrink by 2^(-1/8), a fifth in number: a prefix covers within 1.09 times its own spacing.
SHRINK = 2.0**-0.125
MAX_LEVELS = 128  # down to 1.5e-5 of the model's size, for candidates that coincide
# Rays start this far off the surface, as a share of the model's half diagonal: 10 times what single precision asks
# for, and 20 µm on a spool of 4 m, thinner than any gap a scanner looks into.
OFFSET = 1e-5
# Directions within 10° of the surface do not count: a beam that grazes brings nothing back.
GRAZING = 0.17


@dataclass(frozen=True)
class SurfaceParameters:
    """How a model's surface is sampled.

    samples : how many samples are wanted
    min_visible : share of the directions above a point from which it must be seen from outside the model; 0.1 keeps
        the corner of a steel section (0.25) and drops the bore of a pipe deeper than its own width
    directions : how many directions over the sphere are tried, half of them on each side of the surface
    two_sided : a sheet without thickness is seen from either side and sampled on both; False for a surface that was
        itself scanned from one side: then the side that sees out more
    """

    samples: int = 3000
    min_visible: float = 0.1
    directions: int = 48
    two_sided: bool = True

    def __post_init__(self) -> None:
        if self.samples < 2:
            msg = f"samples must be 2 or more, got {self.samples}"
            raise UsageError(msg)
        if not 0.0 < self.min_visible <= 1.0:
            msg = f"min_visible must lie in (0, 1], got {self.min_visible}"
            raise UsageError(msg)
        if self.directions < 8:
            msg = f"directions must be 8 or more, got {self.directions}"
            raise UsageError(msg)


@dataclass(frozen=True, eq=False)
class ModelSurface:
    """What a scanner could see of a model.

    samples : (N,) points and unit normals, model frame, metres; every prefix is itself evenly spread
    spacing : no two samples are closer, unless their normals are more than 120° apart (a thin plate), metres
    diameter : the largest distance between two samples, the paper's ρ = diam(M), metres
    area : what they stand for, both sides of a sheet, m²
    signed : the normals point outwards; False where nobody knows their side
    """

    samples: OrientedCloud
    spacing: float
    diameter: float
    area: float
    signed: bool


def sample_mesh(mesh: Mesh, parameters: SurfaceParameters, seed: int = 0) -> ModelSurface:
    """Poisson-disk samples of the part of a mesh that can be seen, with exact face normals pointing out.

    The winding of the faces is not trusted: a normal points to the side that sees out. Same seed, same samples.
    Raises InvalidGeometryError where nothing of the mesh can be seen.
    """
    from scanfind.kernels.sampling import poisson_order

    rng = np.random.default_rng(seed)
    candidates, area = _visible_candidates(mesh, parameters, rng)
    reach = float(np.linalg.norm(np.ptp(candidates.points, axis=0)))
    order, spacing = poisson_order(
        candidates.points, candidates.normals, parameters.samples, reach / 2.0, SHRINK, MAX_LEVELS
    )
    return surface_of(OrientedCloud(candidates.points[order], candidates.normals[order]), spacing, area)


def surface_of(samples: OrientedCloud, spacing: float, area: float) -> ModelSurface:
    """Samples with their diameter, which is exact: all pairs are tried."""
    from scanfind.kernels.sampling import largest_distance

    return ModelSurface(samples, float(spacing), float(largest_distance(samples.points)), area, samples.signed)


def _visible_candidates(
    mesh: Mesh, parameters: SurfaceParameters, rng: np.random.Generator
) -> tuple[OrientedCloud, float]:
    """Random points of the visible surface, in random order, several for each sample wanted; and its area, m²."""
    sight = _Sight(mesh, parameters.directions)
    points, normals, found, thrown = [], [], 0, 0
    for _ in range(MAX_ROUNDS):
        thrown += DARTS_PER_SAMPLE * parameters.samples
        p, n = random_points(mesh, DARTS_PER_SAMPLE * parameters.samples, rng)
        # Where both sides may be seen it need not be told by how much, which spares half of the rays.
        enough = parameters.min_visible if parameters.two_sided else 1.0
        front, back = (sight.free_shares(p, side, enough) for side in (n, -n))
        if parameters.two_sided:
            sides = [(front, n), (back, -n)]
        else:
            sides = [(np.maximum(front, back), np.where((front >= back)[:, None], n, -n))]
        for share, side in sides:
            seen = share >= parameters.min_visible
            points.append(p[seen])
            normals.append(side[seen])
            found += int(seen.sum())
        if found >= DARTS_PER_SAMPLE * parameters.samples // 2:
            break
    if not found:
        msg = f"nothing of mesh {mesh.name!r} can be seen from outside; lower min_visible ({parameters.min_visible})"
        raise InvalidGeometryError(msg)
    order = rng.permutation(found)
    return OrientedCloud(np.concatenate(points)[order], np.concatenate(normals)[order]), mesh.area() * found / thrown


def random_points(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Points spread over the surface by area and the normals of their faces, (count, 3) each."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    crosses = np.cross(b - a, c - a)
    areas = np.linalg.norm(crosses, axis=1)
    ends = np.cumsum(areas)
    # One draw in each of `count` equal shares of the area: no face gets more than one above or below its due.
    shares = (np.arange(count) + rng.random(count)) / count
    face = np.minimum(np.searchsorted(ends, shares * ends[-1], side="right"), len(ends) - 1)
    # Square root: uniform over the triangle (Turk 1990).
    u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    points = (1.0 - u) * a[face] + u * (1.0 - v) * b[face] + u * v * c[face]
    return points, crosses[face] / areas[face, None]


class _Sight:
    """Tells from which sides points of a mesh see out of it, with Embree."""

    def __init__(self, mesh: Mesh, directions: int) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        used = mesh.vertices[np.unique(mesh.faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        # Embree has single precision: about the centre and in half diagonals, a mesh 500 km from zero keeps its digits.
        self.centre: Floats = (low + high) / 2.0
        self.scale = 2.0 / float(np.linalg.norm(high - low))
        self.directions = fibonacci_sphere(directions)
        self._scene: Any = EmbreeScene()
        TriangleMesh(self._scene, self._to_embree(mesh.vertices), mesh.faces)

    def _to_embree(self, points: Floats) -> NDArray[np.float32]:
        return ((points - self.centre) * self.scale).astype(np.float32)

    def free_shares(self, points: Floats, normals: Floats, enough: float = 1.0) -> Floats:
        """The share of the directions above each of N points that leave the mesh without a hit, (N,).

        Counting stops at `enough`: a share above it may be larger than told.
        """
        cosines = normals @ self.directions.T
        total = np.maximum((cosines > GRAZING).sum(axis=1), 1)
        origins = self._to_embree(points) + (OFFSET * normals).astype(np.float32)
        free = np.zeros(len(points))
        for direction, cosine in zip(self.directions.astype(np.float32), cosines.T, strict=True):
            asked = np.flatnonzero((cosine > GRAZING) & (free < enough * total))
            hits = self._scene.run(origins[asked], direction[None], query="OCCLUDED")
            free[asked] += hits < 0  # Embree: -1 is no hit
        shares: Floats = free / total
        return shares


def fibonacci_sphere(count: int) -> Floats:
    """Directions spread evenly over the sphere, (count, 3) (golden-angle spiral)."""
    k = np.arange(count)
    z = 1.0 - (2.0 * k + 1.0) / count
    turn = k * np.pi * (3.0 - np.sqrt(5.0))
    rim = np.sqrt(1.0 - z * z)
    return np.column_stack([rim * np.cos(turn), rim * np.sin(turn), z])
