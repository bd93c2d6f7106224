"""What is asked to find the target: scanfind, scanfind as the paper had it, and the rivals; one answer for all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.common import STAGES
from benchmarks.paper.definitions import Ints
from scanfind.errors import UsageError
from scanfind.find import find
from scanfind.library import ModelLibrary
from scanfind.mesh import Mesh
from scanfind.model import ModelParameters
from scanfind.near_surface import near_triangles, signed_distances
from scanfind.parameters import PRESETS, Parameters
from scanfind.pose import Pose

if TYPE_CHECKING:
    from benchmarks.paper.scenes import Cloud

# Within how much of the placed model a rival's points are cut: scanfind's own rule, four times the scan's noise.
RIVAL_TOLERANCE_M = 0.012
RIVAL_LIMIT_S = 60.0
OURS = {"scanfind": PRESETS["default"], "sharif2017": PRESETS["sharif2017"]}


@dataclass(frozen=True, eq=False)
class Answer:
    """What a system says of a scene.

    poses : scene_from_model, best first; isolated : the points of each, indices into the scene's
    seconds : by stage, and in total; refused : poses that came close and were not believed, with the reason
    """

    poses: list[Pose]
    isolated: list[Ints]
    seconds: dict[str, float]
    refused: list[tuple[Pose, str]] = field(default_factory=list)
    error: str = ""


System = Callable[["Cloud", Mesh, int], Answer]


def scanfind_with(parameters: Parameters, cloud: Cloud, mesh: Mesh, seed: int) -> Answer:
    """scanfind; the model is prepared once and for all, as in the paper's offline phase."""
    found = find(cloud.stations(), library(mesh, parameters), parameters=parameters, seed=seed)
    isolated = [np.zeros(0, np.int64) if one.isolated is None else one.isolated.attributes["point"] for one in found]
    seconds = {stage: found.timings_s.get(stage, 0.0) for stage in (*STAGES, "total")}
    refused = [(one.scene_from_model, one.reason) for one in found.refused]
    return Answer([one.scene_from_model for one in found], isolated, seconds, refused)


@cache
def library(mesh: Mesh, parameters: Parameters) -> ModelLibrary:
    """The model, prepared with these parameters."""
    made = ModelLibrary.in_memory()
    made.add(mesh, ModelParameters(parameters.surface, parameters.pairs))
    return made


def rival(name: str, cloud: Cloud, mesh: Mesh, seed: int) -> Answer:
    """A rival's first answer; points are cut for it and at no cost in time, since none of them does."""
    from benchmarks import rivals

    said = rivals.run(name, cloud.xyz, cloud.origins, cloud.station, mesh, time_limit_s=RIVAL_LIMIT_S, seed=seed)
    stages = {"grid": "planes", "search": "match", "refine": "refine", "total": "total"}
    seconds = {ours: said.seconds.get(theirs, 0.0) for ours, theirs in stages.items()}
    surface = near_triangles(mesh.triangles(), RIVAL_TOLERANCE_M)
    best = said.poses[:1]
    near = [signed_distances(surface, pose.inverse().move(cloud.xyz))[0] for pose in best]
    return Answer(best, [np.flatnonzero(~np.isnan(d)) for d in near], seconds, error=said.error)


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
        from benchmarks import rivals
    except ImportError:
        return []
    return list(rivals.available())


def retries(parameters: Parameters) -> list[Parameters]:
    """4.3: what the paper did after a failure: more time; then a lower λs as well; a higher one where several were found."""
    search = parameters.search
    longer = replace(search, time_limit_s=None if search.time_limit_s is None else 2.0 * search.time_limit_s)
    ratio = search.overlap_ratio
    tried = (longer, replace(longer, overlap_ratio=ratio / 2), replace(longer, overlap_ratio=min(1.0, 2 * ratio)))
    return [replace(parameters, search=one) for one in tried]
