"""Hypotheses fitted to the scene: on coarse surfels, on fine ones, and where these are too few to beams."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.free_space import towards
from scanfind.evidence.verify import distinct, nearest, outlines
from scanfind.fit.polish import polish
from scanfind.fit.refine import Refined, icp, shrinking
from scanfind.library.near_surface import near_model
from scanfind.pose import Pose
from scanfind.search.hypotheses import joined, no_hypotheses
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.grid.surfels import Surfels
    from scanfind.kernels.distance import NearSurface
    from scanfind.recognition.ground import Ground
    from scanfind.recognition.weighing import Weighing
    from scanfind.search.hypotheses import Hypotheses

Floats = NDArray[np.float64]

LOOKED_AT = 8  # poses of each model a round, whatever the coarse surfels say of them
MOST_AT_ONCE = 192  # poses of all models fitted to coarse surfels together; half as many to fine ones
BATCHES = 2  # of hypotheses refined a round, each far from where those before it went: none of 66 came of a third
DRIFT_CELLS = 3  # of a gate of one cell, and two that a pose may still move after the coarse steps
# Where lines find so many times what surface does, cells are too empty for normals: of frames of 450 points found by
# lines 4.7 to 19 times, of those in a plant 2.5, and ICP brought these to a millimetre.
LINES_ALONE = 3.0
ON_BEAMS_CELLS, ON_BEAMS_STEPS = 1.5, 2  # how near the surface beams end that a pose is fitted to, and how often


class Fitting:
    """ICP of poses of the models sought, and which of them are worth it.

    drawn_in : (models,) from how far off ICP leads to a pose, metres; apart : from which on poses are two
    """

    def __init__(self, ground: Ground, weighing: Weighing) -> None:
        self._ground, self._weighing = ground, weighing
        diameters = np.array([model.diameter for model in ground.models])
        # Poses closer than a thirtieth of the diameter meet in one ICP; after it a hundredth tells them apart.
        self._apart_before, self.apart = diameters / 30.0, diameters / 100.0
        self._the_same = diameters / 1000.0
        self.drawn_in = diameters / 10.0
        self._near: dict[int, NearSurface] = {}
        self._refuted = no_hypotheses()

    def refine(self, hypotheses: Hypotheses) -> Refined:
        """ICP of what is distinct among the hypotheses on the coarse surfels; of what these do not refute, the fine.

        What an earlier round brought to the same place was weighed there, and is not fitted again: see `look_again`.
        """
        kept, met = self._ground.parameters.search.kept, None
        # One good instance passes the test hundreds of times: those poses must not use up the place of the others.
        apart = distinct(hypotheses, self._ground.arrays, self._apart_before)
        hypotheses = self._weighing.best_drawn(hypotheses.take(apart))
        rough: list[Refined] = []
        for _ in range(BATCHES):
            some = distinct(hypotheses, self._ground.arrays, self._apart_before, kept, MOST_AT_ONCE, met)
            batch = hypotheses.take(some)
            if not len(batch.models):
                break
            rough.append(self.coarse(batch))
            met = joined([r.hypotheses for r in rough])
            # Nor those that would be drawn to where these went already.
            hypotheses = hypotheses.take(self._far_from(hypotheses, met, self.drawn_in))
        if met is None:
            return self.fine(hypotheses)
        better = self._weighing.best_fitted(met)
        better = better.take(distinct(better, self._ground.arrays, self.apart, kept, MOST_AT_ONCE // 2))
        better = better.take(self._weighing.promising(better, LOOKED_AT))
        better = better.take(self._far_from(better, self._refuted, self._the_same))
        self._refuted = joined([self._refuted, better])
        fine = self.fine(better)
        if self._weighing.lines and self._ground.parameters.refine.raw_steps:
            told = self._weighing.lines.beyond_chance(fine.hypotheses)
            fine = self.on_beams(fine, (told > 0.0) & (told > LINES_ALONE * fine.matched))
        fine = fine.take(np.argsort(-fine.matched, kind="stable"))
        # What ended at one place is asked once.
        return fine.take(distinct(fine.hypotheses, self._ground.arrays, self._the_same, kept, MOST_AT_ONCE // 2))

    def look_again(self) -> None:
        """Fit again what rounds so far ended at: what is believed or asked has changed, and it may hold now."""
        self._refuted = no_hypotheses()

    def on_beams(self, refined: Refined, some: NDArray[np.bool_]) -> Refined:
        """Refined poses, some of them (H,) fitted to where beams ended that went towards them.

        Where cells are too empty for normals, or a model is thinner than they are, ICP ends within a cell; held against
        the model's own faces the beams themselves bring that to a millimetre, in ten milliseconds.
        """
        found, which = refined.hypotheses, np.flatnonzero(some)
        for number in np.unique(found.models[which]):
            self.near(int(number))

        def fit(start: int, stop: int) -> None:
            for k in which[start:stop]:
                pose = self._onto_beams(int(found.models[k]), Pose(found.rotations[k], found.translations[k]))
                found.rotations[k], found.translations[k] = pose.rotation, pose.translation

        in_threads(self._ground.jobs, len(which), fit)
        return refined

    def _onto_beams(self, number: int, pose: Pose) -> Pose:
        """A pose of a model fitted to where beams ended."""
        ground, near = self._ground, self.near(number)
        for _ in range(ON_BEAMS_STEPS):
            ends = towards(ground.models[number], pose, ground.scene.beams, near.reach).ends()
            fitted = polish(near, pose, ends, np.zeros(len(ends), np.int64), ground.parameters.refine)
            pose = fitted.scene_from_model if fitted else pose
        return pose

    def near(self, model: int) -> NearSurface:
        """The surface of a model, to be asked for distances up to ON_BEAMS_CELLS fine cells."""
        if model not in self._near:
            reach = ON_BEAMS_CELLS * self._ground.scene.fine.cell
            self._near[model] = near_model(self._ground.models[model], reach)
        return self._near[model]

    def _far_from(self, hypotheses: Hypotheses, met: Hypotheses, far: Floats) -> NDArray[np.intp]:
        """The hypotheses so far, metres for each model, (models,), or farther from all those in `met` (indices)."""
        theirs, placed = outlines(met, self._ground.arrays), outlines(hypotheses, self._ground.arrays)
        kept = np.ones(len(placed), np.bool_)
        for model in np.unique(hypotheses.models):
            mine = hypotheses.models == model
            kept[mine] = nearest(placed[mine], theirs[met.models == model]) >= far[model]
        return np.flatnonzero(kept)

    def coarse(self, hypotheses: Hypotheses) -> Refined:
        """ICP on the coarse surfels."""
        refine, coarse = self._ground.parameters.refine, self._ground.scene.coarse
        gates = shrinking(refine.coarse_gates, refine.coarse_iterations, coarse.cell)
        return self.icp(hypotheses, coarse, gates, refine.coarse_samples)

    def fine(self, hypotheses: Hypotheses) -> Refined:
        """ICP on the fine surfels, which are fitted around the poses."""
        refine, fine = self._ground.parameters.refine, self._ground.scene.fine
        self._ground.fit_near(hypotheses, DRIFT_CELLS)
        gates = shrinking(refine.fine_gates, refine.fine_iterations, fine.cell)
        return self.icp(hypotheses, fine, gates, refine.fine_samples)

    def icp(self, hypotheses: Hypotheses, surfels: Surfels, gates: Floats, most_samples: int) -> Refined:
        """ICP with these gates, metres, one a step."""
        ground, agreement = self._ground, self._ground.parameters.refine.normal_agreement
        return icp(hypotheses, surfels, ground.arrays, ground.signed, gates, most_samples, agreement, ground.jobs)
