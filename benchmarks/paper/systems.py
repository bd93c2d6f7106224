"""What is asked to find the target: scanfind, scanfind as the paper had it, and the rivals; one answer for all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.common import STAGES
from benchmarks.paper.definitions import Ints
from benchmarks.shop import WARM_UP_POINTS
from scanfind.cloud import CloudModel
from scanfind.errors import UsageError
from scanfind.find import find
from scanfind.library import ModelLibrary
from scanfind.library.model import ModelParameters
from scanfind.library.near_surface import near_model, signed_distances
from scanfind.mesh import Mesh
from scanfind.parameters import PRESETS, Parameters
from scanfind.pose import Pose
from scanfind.simulate.objects import pipe_spool
from scanfind.simulate.scanner import scan
from scanfind.simulate.scenes import shop

if TYPE_CHECKING:
    from benchmarks.paper.scenes import Cloud
    from scanfind.kernels.distance import NearSurface

# Within how much of the placed model a rival's points are cut: four times the scanner's noise along a beam.
RIVAL_TOLERANCE_M = 0.012
RIVAL_LIMIT_S = 60.0
OURS = {"scanfind": PRESETS["default"], "sharif2017": PRESETS["sharif2017"]}


@dataclass(frozen=True, eq=False)
class Answer:
    """What a system says of a scene.

    poses : scene_from_model, best first; isolated : the points of each, indices into the scene's
    seconds : by stage, and in total; refused : poses that came close and were not believed, with the reason
    ranked : the poses are a ranking of what may be there, not each a claim
    """

    poses: list[Pose]
    isolated: list[Ints]
    seconds: dict[str, float]
    refused: list[tuple[Pose, str]] = field(default_factory=list)
    error: str = ""
    ranked: bool = False


Sought = Mesh | CloudModel
System = Callable[["Cloud", Sought, int], Answer]


def scanfind_with(parameters: Parameters, cloud: Cloud, model: Sought, seed: int) -> Answer:
    """scanfind; the model is prepared once and for all, as in the paper's offline phase."""
    warm_up()
    found = find(cloud.stations(), library(model, parameters), parameters=parameters, seed=seed)
    isolated = [np.zeros(0, np.int64) if one.isolated is None else one.isolated.attributes["point"] for one in found]
    seconds = {stage: found.timings_s.get(stage, 0.0) for stage in (*STAGES, "total")}
    refused = [(one.scene_from_model, one.reason) for one in found.refused]
    return Answer([one.scene_from_model for one in found], isolated, seconds, refused)


@cache
def warm_up() -> None:
    """Load what is compiled, once a process: a first search takes seconds more, and a first one ever half a minute."""
    mesh = pipe_spool()
    find(scan(shop(0, mesh), points=WARM_UP_POINTS).stations, mesh)


@cache
def library(model: Sought, parameters: Parameters) -> ModelLibrary:
    """The model, prepared with these parameters."""
    made = ModelLibrary.in_memory()
    made.add(model, ModelParameters(parameters.surface, parameters.pairs))
    return made


@lru_cache(maxsize=8)
def surface_of(model: Sought, reach: float) -> NearSurface:
    """The model's surface as isolation sees it, to be asked for distances up to `reach` metres."""
    return near_model(library(model, PRESETS["default"]).models()[0], reach)


def rival(name: str, cloud: Cloud, model: Sought, seed: int) -> Answer:
    """A rival's answer. Points are cut for it, and at no cost in time, since none of them does."""
    run = import_module("benchmarks.rivals").run
    mesh = model if isinstance(model, Mesh) else as_mesh(model)
    said = run(name, cloud.xyz, cloud.origins, cloud.station, mesh, time_limit_s=RIVAL_LIMIT_S, seed=seed)
    stages = {"grid": "planes", "search": "match", "refine": "refine", "total": "total"}
    seconds = {ours: said.seconds.get(theirs, 0.0) for ours, theirs in stages.items()}
    surface = surface_of(model, RIVAL_TOLERANCE_M)
    near = [signed_distances(surface, pose.inverse().move(cloud.xyz))[0] for pose in said.poses]
    return Answer(said.poses, [np.flatnonzero(~np.isnan(d)) for d in near], seconds, error=said.error, ranked=True)


def as_mesh(model: CloudModel) -> Mesh:
    """A piece of scan as a rival takes it: a small triangle a sample, facing as the sample does."""
    prepared = library(model, PRESETS["default"]).models()[0]
    points, normals = prepared.samples.points, prepared.samples.normals
    across = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    across *= prepared.spacing / 2 / np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(normals, across)
    corners = np.stack([points - across - other, points + across - other, points + 2 * other], axis=1).reshape(-1, 3)
    return Mesh.of(model.name, corners, np.arange(len(corners)).reshape(-1, 3))


def systems(names: Sequence[str]) -> dict[str, System]:
    """Those named; `rivals` are all there are here. Raises UsageError for one that is not."""
    known: dict[str, System] = {name: partial(scanfind_with, parameters) for name, parameters in OURS.items()}
    known |= {name: partial(rival, name) for name in available_rivals()}
    wanted = [one for name in names for one in (available_rivals() if name == "rivals" else [name])]
    if unknown := [name for name in wanted if name not in known]:
        msg = f"no system {unknown[0]!r} here; there are {', '.join(known)}"
        raise UsageError(msg)
    return {name: known[name] for name in dict.fromkeys(wanted)}


def available_rivals() -> list[str]:
    """The rivals installed here; none where `benchmarks.rivals` itself is not."""
    try:
        return list(import_module("benchmarks.rivals").available())
    except ModuleNotFoundError:
        return []


def retries(parameters: Parameters) -> list[Parameters]:
    """4.3: what the paper did after a failure: more time, a lower λs as well, a higher one where several were found."""
    search = parameters.search
    longer = replace(search, time_limit_s=None if search.time_limit_s is None else 2.0 * search.time_limit_s)
    ratio = search.overlap_ratio
    tried = (longer, replace(longer, overlap_ratio=ratio / 2), replace(longer, overlap_ratio=min(1.0, 2 * ratio)))
    return [replace(parameters, search=one) for one in tried]
