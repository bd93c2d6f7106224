"""A model ready for the search: what the paper's offline phase computes once (3.2, Algorithm 1)."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import CloudModel, OrientedCloud
from scanfind.library.cloud_surface import sample_cloud
from scanfind.library.onto_itself import OntoItself
from scanfind.library.pairs import PairParameters, PairTable, build_pairs, pair_count, require_apart
from scanfind.library.self_similar import Similar, find_similar
from scanfind.library.surface import SurfaceParameters, sample_mesh
from scanfind.library.symmetries import declared_symmetry, find_symmetry
from scanfind.mesh import Mesh, Placement
from scanfind.symmetry import Symmetry, parse_axes
from scanfind.threads import once

# Part of every model's hash: raise it when the samples or pairs of one and the same model come out differently.
RECIPE = "scanfind model, recipe 1"

FEWER, LEAST_COVER = 8, 40  # from one cover to the next so many times fewer samples, but never fewer than so many


@dataclass(frozen=True)
class ModelParameters:
    """How a model is prepared for the search.

    symmetry : axes of the model with their order, such as "x2", "z4,x2" or "z*" (every angle), or "none"; None: found
    """

    surface: SurfaceParameters = field(default_factory=SurfaceParameters)
    pairs: PairParameters = field(default_factory=PairParameters)
    symmetry: str | None = None

    def __post_init__(self) -> None:
        if self.symmetry is not None:
            parse_axes(self.symmetry)


DEFAULTS = ModelParameters()


class Cover(NamedTuple):
    """Points (N, 3) of a surface of which none is farther from them than a reach; metres."""

    points: NDArray[np.float64]
    reach: float


@dataclass(frozen=True, eq=False)
class Model:
    """A model ready for the search.

    sha256 : hash of geometry and parameters; the name is no part of it
    diameter : the paper's ρ = diam(M), metres
    spacing : distance between neighbouring samples, metres
    area : the surface a scanner could see, m²
    signed : the normals of the samples point outwards; False where nobody knows their side
    samples : (N,) oriented points a scanner could see, model frame, every prefix evenly spread
    mesh : the triangles, for isolation; None for a model that is a piece of scan
    cloud : that piece of scan; None for a mesh
    symmetry : the rotations after which no scan could tell that it was turned
    pair_count : how many pairs its samples make, as it was prepared; the pairs themselves are made when asked for
    similar : motions after which it could be taken for itself, though it is not, likeliest first
    placements : the design's products of this geometry
    """

    name: str
    sha256: str
    source: str
    diameter: float
    spacing: float
    area: float
    signed: bool
    samples: OrientedCloud
    mesh: Mesh | None
    cloud: CloudModel | None
    pair_count: int
    symmetry: Symmetry
    similar: tuple[Similar, ...]
    placements: tuple[Placement, ...]
    parameters: ModelParameters

    @once
    def pairs(self) -> PairTable:
        """The oriented pairs of the samples with their keys: made when a search first asks for them (decision 35)."""
        return build_pairs(self.samples, self.diameter, self.spacing, self.parameters.pairs)

    @once
    def covers(self) -> tuple[Cover, ...]:
        """The samples, model frame, and ever fewer of them: from far away few show as much."""
        from scanfind.kernels.sampling import farthest_from_first

        points, covers = self.samples.points, [Cover(self.samples.points, self.spacing)]
        while len(covers[-1].points) >= FEWER * LEAST_COVER:
            some = points[: len(covers[-1].points) // FEWER]
            covers.append(Cover(some, self.spacing + float(farthest_from_first(points, len(some)))))
        return tuple(covers)

    def area_of_a_sample(self) -> float:
        """The surface a sample stands for, m²."""
        return self.area / len(self.samples)


class ModelSummary(NamedTuple):
    """What a list of models shows: counts, and the diameter in metres. `triangles` is 0 for a piece of scan."""

    name: str
    sha256: str
    source: str
    diameter: float
    samples: int
    pairs: int
    triangles: int
    placements: int
    symmetry: Symmetry


def model_hash(model: Mesh | CloudModel, parameters: ModelParameters = DEFAULTS) -> str:
    """SHA-256 over the geometry and the parameters, as hexadecimal digits: equal hash, equal samples and pairs."""
    if isinstance(model, Mesh):
        arrays = [np.asarray(model.vertices, "<f8"), np.asarray(model.faces, "<i4")]
    else:
        arrays = [np.asarray(model.points, "<f8")]
        arrays += [] if model.origin is None else [np.asarray(model.origin, "<f8")]
    shapes = [array.shape for array in arrays]
    # The shapes go in front, so that no two lists of arrays run together into the same bytes.
    head = json.dumps([RECIPE, type(model).__name__, shapes, asdict(parameters)], sort_keys=True)
    digest = hashlib.sha256(head.encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def build_model(model: Mesh | CloudModel, parameters: ModelParameters = DEFAULTS) -> Model:
    """Sample a model's surface, and find what it could be taken for. Raises InvalidGeometryError."""
    if isinstance(model, Mesh):
        surface = sample_mesh(model, parameters.surface)
        # Of the notes, which are for the person who reads the file, the library keeps what the fit of parts needs.
        notes = {key: model.notes[key] for key in ("parts",) if key in model.notes}
        mesh, cloud = Mesh(model.name, model.vertices, model.faces, model.source, model.placements, notes), None
    else:
        surface = sample_cloud(model, parameters.surface)
        mesh, cloud = None, model
    require_apart(len(surface.samples), surface.diameter)
    itself = OntoItself(surface, mesh)
    declared = parameters.symmetry
    symmetry = find_symmetry(itself) if declared is None else declared_symmetry(itself, parse_axes(declared))
    return Model(
        name=model.name,
        sha256=model_hash(model, parameters),
        source=model.source,
        diameter=surface.diameter,
        spacing=surface.spacing,
        area=surface.area,
        signed=surface.signed,
        samples=surface.samples,
        mesh=mesh,
        cloud=cloud,
        pair_count=pair_count(surface.samples, surface.diameter, surface.spacing, parameters.pairs),
        symmetry=symmetry,
        similar=find_similar(itself, symmetry),
        placements=mesh.placements if mesh else (),
        parameters=parameters,
    )
