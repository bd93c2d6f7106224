"""Parts of thin members (frames, racks, pipes) seen as lines, where surface is too sparse or too little to be found by.

A normal needs about eight points across a face. A member of 100 mm with 60 mm between points has none; but that it is
long and thin, and which way it runs, ten points tell within 5°. So the same pairs are drawn, looked up and tested once
more, of lines: the middle of what lies in a window some widths of a member across, and its direction, which has no
sign. Few things in a scene are lines, and a wrong pose puts next to none of a part on them (decisions/0016-lines.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import log2
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.grid.air import no_air
from scanfind.grid.scene import orientation_grid
from scanfind.grid.surfels import number
from scanfind.library.joint import joint_table
from scanfind.library.pairs import rungs_of
from scanfind.priors import Priors
from scanfind.priors.allowed import NOTHING_KNOWN, allowed_poses
from scanfind.search.draws import Draws, Trial, affordable, air_table, wald_table
from scanfind.search.hypotheses import Hypotheses, joined, model_arrays, no_hypotheses
from scanfind.search.served import models_share
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.grid.moments import MomentGrid
    from scanfind.grid.scene import Scene
    from scanfind.library.model import Model
    from scanfind.search.surface import SearchParameters

Floats = NDArray[np.float64]

REACH = 2.5  # cells from the middle of a window to its border: fewer are too coarse to be round, more cost more
LINEAR = 0.75  # share of the largest spread in a window that the second may fall short of it, for a line
LEAST_CELLS = 4  # occupied ones that make a line
# A model has a window in which so much of it is lines, and which is no larger than this share of its diameter; else it
# is not asked for by lines. A frame of 100 mm members of 4.5 m: 0.86 in windows of 0.22 m radius; a pump skid: 0.26.
LEAST_SHARE, LARGEST_WINDOW = 0.6, 0.2
SHAPED = 500  # samples that tell that share
MARKED_CELLS = 2.0  # edge of the test's cells; a line supports samples half of one beside it
# Lines are looked for of instances that show so much of themselves; of a wrong pose's lines 0.05 lie on the scene's.
SHOWN, CHANCE = 0.15, 0.05
MORE_PAIRS = 2.5  # are drawn than in a round of surface: there is one round, and lines are few
LINES = 1000  # of a model, at most: as evenly spread over it as all of its samples
# Windows no larger than this share of the diameter tell what is not there: of 31 frames and thin spools in sight 30
# were hit, by 13 pairs and more (a frame in sight by a fifth, by 589); in a second round the same ones. Larger windows
# take in what stands beside a part: of 25 spools 14 were hit. A round counts for so many hits.
TELLING_WINDOW, TOLD_HITS = 0.12, 4.6
PLACED = 300  # poses with one line of the model laid along one of the scene's: what chance alone puts on lines


class LineSearch:
    """The search by lines for those of some models that have them; the same seed gives the same rounds.

    wanted : (models,) which are looked for
    """

    def __init__(
        self, scene: Scene, models: Sequence[Model], wanted: NDArray[np.bool_], parameters: SearchParameters,
        seed: int, jobs: int, priors: Priors = NOTHING_KNOWN,
    ) -> None:  # fmt: skip
        by_level: dict[int, list[int]] = {}
        for at in np.flatnonzero(wanted).tolist():
            if (level := level_of(models[at], scene.fine.cell)) is not None:
                by_level.setdefault(level, []).append(at)
        self._windows = [
            _Window(scene, level, [models[at] for at in some], some, parameters, seed, jobs, priors)
            for level, some in sorted(by_level.items())
        ]

    def __bool__(self) -> bool:
        """Is there a model with lines?"""
        return bool(self._windows)

    def round(self) -> Hypotheses:
        """One round: draw pairs of lines, look them up, test their hypotheses; those that pass, best first."""
        return joined([no_hypotheses(), *(window.round() for window in self._windows)]).best_first()

    def told(self, models: int) -> Floats:
        """How many hits a round counts for, of an instance of each of so many models, (models,): see TOLD_HITS."""
        told = np.zeros(models)
        for window in self._windows:
            told[window.which[window.telling]] = TOLD_HITS
        return told

    def beyond_chance(self, hypotheses: Hypotheses) -> Floats:
        """How much of each pose's lines lies on the scene's, beyond the most that chance put there, (H,) 0 … 1."""
        told = np.zeros(len(hypotheses.models))
        for window in self._windows:
            window.tell(hypotheses, told)
        return told


class _Window:
    """Lines in windows of one size, of the scene and of the models that have them there.

    level : of the octree above the fine cells; which : the models' numbers among all
    telling : (models,) of which an instance that is there is found, as good as always
    """

    def __init__(
        self, scene: Scene, level: int, models: Sequence[Model], which: Sequence[int], parameters: SearchParameters,
        seed: int, jobs: int, priors: Priors,
    ) -> None:  # fmt: skip
        cell = scene.fine.cell * 2.0**level
        self._parameters, self._seed, self._jobs, self._rounds = parameters, seed, jobs, 0
        self.which = np.array(which)
        self.telling = np.array([REACH * cell <= TELLING_WINDOW * model.diameter for model in models])
        self._lines = lines_of_scene(scene.fine.grid, level, jobs)
        as_lines = [model_as_lines(model, REACH * cell) for model in models]
        edge = MARKED_CELLS * cell
        marks = orientation_grid(beside(self._lines, 0.5 * edge), 0.0, edge)
        layout = models[0].parameters.pairs
        rungs = sorted({rung for m in models for rung in rungs_of(m.diameter, layout)}, reverse=True)
        tolerance = max(scene.fine.cell, layout.tolerance * min(model.spacing for model in models))
        self._draws = Draws(self._lines, layout, rungs, tolerance, jobs)
        self._trial = Trial(
            joint_table(as_lines, jobs=jobs), model_arrays(as_lines), marks, np.empty((0, 3)),
            scene.air if parameters.by_air else no_air(),
            wald_table(parameters.tests, SHOWN + (1.0 - SHOWN) * CHANCE, CHANCE), air_table(parameters.tests), 0.0,
            allowed_poses(models, priors, scene.fine.cells.offset), np.ones(len(models), np.bool_),
        )  # fmt: skip
        self._by_chance = self._highest_by_chance()

    def round(self) -> Hypotheses:
        """Hypotheses of these models, under their numbers among all."""
        if len(self._lines) < 2:
            return no_hypotheses()
        limits = self._parameters
        drawn = self._draws.draw(
            round(MORE_PAIRS * limits.pairs_a_round / len(self._draws.rungs)), self._seed, self._rounds,
            limits.max_tries,
        )  # fmt: skip
        self._rounds += 1
        most = limits.hypotheses_a_round * models_share(len(self.which))
        tested = affordable(drawn, np.diff(self._trial.table.offsets), most, rarest_first=limits.telling_first)
        found = self._trial.test(tested, self._lines, self._jobs)
        return found._replace(models=self.which[found.models])

    def tell(self, hypotheses: Hypotheses, told: Floats) -> None:
        """Write what lines say of the poses of these models."""
        theirs = np.flatnonzero(np.isin(hypotheses.models, self.which))
        mine = hypotheses.take(theirs)
        mine = mine._replace(models=np.searchsorted(self.which, mine.models))
        chance = self._by_chance[mine.models]
        told[theirs] = np.maximum(0.0, self._shares(mine) - chance) / np.maximum(1.0 - chance, 1e-9)

    def _shares(self, poses: Hypotheses) -> Floats:
        """The share of each pose's lines that lie on the scene's, (H,)."""
        from scanfind.kernels.lines import shares_on_scene

        shares, arrays, marks = np.empty(len(poses.models)), self._trial.arrays, self._trial.marks
        in_threads(
            self._jobs, len(shares),
            lambda start, stop: shares_on_scene(
                start, stop, poses.models, arrays.starts, arrays.samples, poses.rotations, poses.translations,
                *marks, no_air().where, shares,
            ),
        )  # fmt: skip
        return shares

    def _highest_by_chance(self) -> Floats:
        """The largest share of a model's lines on the scene's among poses with one laid along one, (models,)."""
        if not len(self._lines):
            return np.ones(len(self.which))
        rng, arrays, highest = np.random.default_rng([self._seed, PLACED]), self._trial.arrays, []
        for model, (start, stop) in enumerate(pairwise(arrays.starts.tolist())):
            ours, theirs = rng.integers(start, stop, PLACED), rng.integers(0, len(self._lines), PLACED)
            here = frames(arrays.normals[ours], np.zeros(PLACED))
            there = frames(self._lines.normals[theirs], rng.uniform(0.0, 2.0 * np.pi, PLACED))
            rotations = there @ here.transpose(0, 2, 1)
            moved = np.einsum("kij,kj->ki", rotations, arrays.points[ours])
            poses = Hypotheses(np.full(PLACED, model), rotations, self._lines.points[theirs] - moved, np.ones(PLACED))
            highest.append(float(self._shares(poses).max()))
        return np.array(highest)


def level_of(model: Model, cell: float) -> int | None:
    """The lowest level above cells of this edge, metres, in whose windows enough of a model is lines; None: nowhere."""
    most = int(np.floor(log2(max(LARGEST_WINDOW * model.diameter / (REACH * cell), 0.5))))
    for level in range(most + 1):
        if (fitted_to(model, REACH * cell * 2.0**level, SHAPED)[:, 6] > LINEAR).mean() >= LEAST_SHARE:
            return level
    return None


def model_as_lines(model: Model, reach: float) -> Model:
    """A model of which samples and pairs are lines, in windows of radius `reach`, metres."""
    return replace(model, samples=_lines(fitted_to(model, reach, LINES)), signed=False)


def fitted_to(model: Model, reach: float, most: int) -> Floats:
    """The line about each of a model's first samples, at most so many: see kernels.lines.lines_of_samples."""
    from scanfind.kernels.lines import lines_of_samples

    # The first ones lie as evenly over the model as all of them.
    fitted = np.empty((min(len(model.samples), most), 7))
    lines_of_samples(model.samples.points, reach, len(fitted), fitted)
    return fitted


def lines_of_scene(grid: MomentGrid, level: int, jobs: int) -> OrientedCloud:
    """Where a scene looks like a line, some levels above a grid: middles, relative to its offset, and directions."""
    from scanfind.kernels.lines import fit_lines

    for _ in range(level):
        grid = grid.coarser()
    cells = number(grid, jobs)
    fitted = np.empty((len(cells), 7))
    in_threads(
        jobs, len(cells.order),
        lambda start, stop: fit_lines(
            start, stop, cells.first_cell, cells.locals, cells.order, cells.block_keys, cells.hash_keys,
            cells.hash_values, cells.block_rows, grid.moments, grid.links, cells.cell, grid.units, REACH, LEAST_CELLS,
            fitted,
        ),
    )  # fmt: skip
    return _lines(fitted)


def _lines(fitted: Floats) -> OrientedCloud:
    """What is a line of what was fitted, (N, 7)."""
    lines = fitted[fitted[:, 6] > LINEAR]
    return OrientedCloud(lines[:, 0:3].copy(), lines[:, 3:6].copy(), signed=False)


def beside(lines: OrientedCloud, reach: float) -> OrientedCloud:
    """Lines, and the same moved by `reach` metres across themselves to four sides."""
    one, other, along = frames(lines.normals, np.zeros(len(lines))).transpose(2, 0, 1)
    moves = (0.0 * one, reach * one, -reach * one, reach * other, -reach * other)
    return OrientedCloud(
        np.concatenate([lines.points + move for move in moves]), np.tile(along, (len(moves), 1)), signed=False
    )


def frames(directions: Floats, turns: Floats) -> Floats:
    """Rotations (N, 3, 3) that take z to unit directions (N, 3), each turned about its own, radians (N,)."""
    # Any first direction across does: the one from the coordinate axis that is farthest off.
    one = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)])
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    other = np.cross(directions, one)
    c, s = np.cos(turns)[:, None], np.sin(turns)[:, None]
    return np.stack([c * one + s * other, c * other - s * one, directions], axis=2)
