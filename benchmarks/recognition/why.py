"""Why something was missed or believed: the search's own evidence at a pose, and what a perfect scan would say."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from benchmarks.recognition.parts import Part, library_of
from benchmarks.recognition.trial import Trial
from scanfind.evidence.verify import distances, outlines, why_refused
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import build_scene, first_cell
from scanfind.library.model import Model
from scanfind.parameters import PRESETS
from scanfind.pose import Pose
from scanfind.recognition.recognise import Recognition
from scanfind.scans.sources import Sources
from scanfind.search.hypotheses import Hypotheses
from scanfind.threads import available_cores

# A beam that ends so near to a sample speaks for it; one that goes on so far behind it has passed through it.
ON_M, THROUGH_M = 0.015, 0.03
# cosine to the beam below which a surface may return nothing
LEAST_FACING = 0.25
# ICP draws in poses that move no point of a part's outline by more than this share of its diameter.
DRAWN_IN = 0.1


class Weighed(NamedTuple):
    """What scanfind would say of the true pose, were it led to it.

    drawn : hypotheses of the first round near enough to be drawn in by ICP
    score, support, penalty : of the evidence, after refinement; reason : why it refuses it, empty where it does not
    """

    drawn: int
    score: float
    support: float
    penalty: float
    reason: str

    def told(self) -> str:
        """In words."""
        drawn = f"drawn {self.drawn} times in the first round" if self.drawn else "not drawn in the first round"
        words = f"{drawn}, worth {self.score:.2f} (support {self.support:.0%}, seen through {self.penalty:.1%})"
        return f"{words}: {self.reason}" if self.reason else words


@lru_cache(maxsize=1)
def searched(trial: Trial) -> tuple[Recognition, Hypotheses]:
    """A trial's scene, resampled as `find` does it for the whole library, and the first round of its search."""
    models, parameters, jobs = library_of(trial.sought).models(), PRESETS["default"], available_cores()
    diameters = [model.diameter for model in models]
    grid = MomentGrid(first_cell(diameters, parameters.grid), jobs=jobs)
    for chunk in Sources(trial.scanned.stations).chunks():
        grid.add(chunk)
    scene = build_scene(grid, min(diameters), parameters.grid, parameters.search.test_cells_across, jobs)
    search = Recognition(scene, models, parameters, trial.seed, jobs)
    return search, search.search.round()


def weighed(trial: Trial, part: Part, pose: Pose) -> Weighed:
    """How often the search draws a pose, and the evidence where scanfind's own refinement leads from it."""
    search, drawn = searched(trial)
    scene, verify, arrays = search.ground.scene, search.ground.parameters.verify, search.ground.arrays
    number = [model.name for model in search.models].index(part.name)
    offset = pose.translation - scene.fine.cells.offset
    truth = Hypotheses(np.array([number]), pose.rotation[None], offset[None], np.ones(1))
    own = outlines(drawn.take(np.flatnonzero(drawn.models == number)), arrays)
    apart = distances(outlines(truth, arrays)[0], own)
    times = int(np.count_nonzero(apart < DRAWN_IN * search.models[number].diameter))
    candidates = search.weighing.candidates(search.refine(truth))
    if not candidates:
        return Weighed(times, 0.0, 0.0, 0.0, "refinement drops it")
    best = max(candidates, key=lambda candidate: candidate.score)
    reason = why_refused(best.evidence, not scene.depths, verify)
    return Weighed(times, best.score, best.evidence.support(), best.evidence.penalty(), reason)


class Ideal(NamedTuple):
    """What a scan without noise or gaps would say of a pose: shares of the model's samples.

    on : a surface is where they are; through : beams pass; hidden : behind something, or facing away
    object_name : what most of those that are on something lie on
    """

    on: float
    through: float
    hidden: float
    object_name: str

    def told(self) -> str:
        """In words."""
        return f"{self.on:.0%} on a surface in sight, {self.through:.1%} seen through, {self.hidden:.0%} hidden"


def ideal(trial: Trial, model: Model, pose: Pose) -> Ideal:
    """Ask the true scene about each sample of a placed model."""
    points, normals = pose.move(model.samples.points), pose.turn(model.samples.normals)
    objects, caster = trial.scene.objects, trial.scene.caster()
    owner = np.full(len(points), -1)
    passed = np.zeros(len(points), np.bool_)
    for station in trial.scene.stations:
        away = points - station
        length = np.linalg.norm(away, axis=1)
        beam = away / length[:, None]
        hits = caster.shoot(station, beam)
        on = np.abs(hits.distance - length) <= ON_M
        owner[on] = hits.owner[on]
        facing = -np.einsum("ij,ij->i", beam, normals) > LEAST_FACING
        passed |= facing & (hits.distance > length + THROUGH_M)
    on = owner >= 0
    counts = np.bincount(owner[on], minlength=len(objects))
    name = objects[int(counts.argmax())].name if on.any() else "nothing"
    shown, through = float(on.mean()), float((passed & ~on).mean())
    return Ideal(shown, through, 1.0 - shown - through, name)
