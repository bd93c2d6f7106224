"""RANSAC over the scene: draw, look up, pose, test (paper 3.3 and 3.4, Algorithm 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import require
from scanfind.grid.air import no_air
from scanfind.library.joint import joint_table
from scanfind.library.pairs import key_count, rungs_of
from scanfind.priors import Priors
from scanfind.priors.allowed import NOTHING_KNOWN, allowed_poses
from scanfind.search.draws import Draws, Trial, affordable, air_table, wald_table
from scanfind.search.hypotheses import Hypotheses, joined, no_hypotheses
from scanfind.search.pool import Pool
from scanfind.search.served import MOST_HYPOTHESES, Served, models_share

if TYPE_CHECKING:
    from scanfind.grid.scene import Scene
    from scanfind.library.joint import JointTable
    from scanfind.library.model import Model
    from scanfind.search.hypotheses import ModelArrays
    from scanfind.search.served import Tally

Floats = NDArray[np.float64]

# Full rounds that draw from one choice of surfels: of a part far away the few in it make forty pairs, and drawing these
# twenty times over found nothing (of three such spools and headers in a plant none, with new choices two).
A_CHOICE = 2.0
# Of fewer hypotheses most are tested before the air between things is found: the first round of one model, in which it
# is found if it is there.
WORTH_AIR = 150_000
# With so many scanner positions nearly every sample faces one, and asking costs more than it tells.
FACING_ORIGINS = 6
# Of the samples that show, so many lie on the scene under a right hypothesis: noise turns normals and moves it. Asked
# for all of λs, the test refused every right pose of twelve parts that showed 30 %; asked for this, none.
MEETS = 0.67
# Where nothing at all is found, an instance is looked for that shows only half of λs, the paper's own 0.15, for so many
# full rounds. Of parts that lost 60 to 70 % of their points every one that was found then was found in the first.
DEEPER, DEEPER_ROUNDS = 0.5, 2.0


@dataclass(frozen=True)
class SearchParameters:
    """How the search is carried out.

    overlap_ratio : λs, the share of a model's samples that must lie on the scene (the paper: 0.15) …
    facing_only : … of those that face a scanner position, where all are known: a chunky part seen from one side shows a
        quarter of its surface
    deeper : where nothing at all is found, look for instances that show half of `overlap_ratio`
    time_limit_s : seconds for search, verification and refinement together, of what is looked for anywhere: places of a
        design are all tried; None: until nothing is likely to be missed
    miss_probability : stop when an instance that shows `overlap_ratio` of its surface has been missed with less than
        this chance; 0: use all of the time limit, as the paper does
    max_instances : stop after so many detections; None: all there are
    pairs_a_round, hypotheses_a_round : scene pairs drawn before any is tested; hypotheses tested before any is refined,
        of up to ten models; of more, as many more
    by_shape : draw points by the likelihood ratio of their local shape: how bent the surface around them is, on the
        model as against in the scene; walls and floors are most of a scan and little of a spool
    telling_first : test pairs first whose feature is rare in this scene: the chance of a pair to be right, over the
        cost of testing it, is one over how often the scene shows its feature
    each_once : of a model's pairs that its symmetry maps onto one another look up only one: a pipe's pairs are the same
        all around it, and so are the poses they lead to
    by_air : give up what hangs in the air that beams went through, where scanner positions are known
    by_lines : where nothing is found, look for a model of thin members by these, as lines (see lines)
    normal_length_m : of the normals in the four-point sets (the paper: 1); 0: its limit, the roll alone from normals
    max_tries : places tried for s2 before another s1 is drawn
    tests : model samples in the sequential test
    chance_overlap : share of samples of a wrong hypothesis that lie on the scene, for Wald's test
    test_cells_across : cells of the test along the smallest diameter of a model; fewer where the scan is sparse
    kept : hypotheses refined each round, for each model
    """

    overlap_ratio: float = 0.3
    deeper: bool = True
    time_limit_s: float | None = 60.0
    miss_probability: float = 0.01
    max_instances: int | None = None
    pairs_a_round: int = 40_000
    hypotheses_a_round: int = 200_000
    facing_only: bool = True
    by_shape: bool = True
    telling_first: bool = True
    each_once: bool = True
    by_air: bool = True
    by_lines: bool = True
    normal_length_m: float = 0.0
    max_tries: int = 1000
    tests: int = 192
    chance_overlap: float = 0.15
    test_cells_across: float = 45.0
    kept: int = 32

    def __post_init__(self) -> None:
        require(0.0 < self.overlap_ratio <= 1.0, "overlap_ratio", self.overlap_ratio, "above 0 and at most 1")
        limit = self.time_limit_s
        require(limit is None or limit >= 0.0, "time_limit_s", limit, "0 seconds or more")
        require(0.0 <= self.miss_probability < 1.0, "miss_probability", self.miss_probability, "from 0 to below 1")
        require(
            limit is not None or self.miss_probability > 0.0, "time_limit_s", limit, "given where miss_probability is 0"
        )
        require(self.max_instances is None or self.max_instances >= 1, "max_instances", self.max_instances, "1 or more")
        require(0.0 < self.chance_overlap < 0.5, "chance_overlap", self.chance_overlap, "above 0 and below 0.5")
        require(self.normal_length_m >= 0.0, "normal_length_m", self.normal_length_m, "0 or more metres")
        require(self.test_cells_across >= 4.0, "test_cells_across", self.test_cells_across, "4 or more")
        for name in ("pairs_a_round", "hypotheses_a_round", "max_tries", "tests", "kept"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "1 or more")


class Search:
    """The rounds of RANSAC over one scene, for all models together; the same seed gives the same rounds."""

    def __init__(
        self, scene: Scene, models: Sequence[Model], arrays: ModelArrays,
        parameters: SearchParameters, seed: int, jobs: int, learnt: Sequence[float] = (),
        priors: Priors = NOTHING_KNOWN,
    ) -> None:  # fmt: skip
        """Take a scene; learnt : of each model, the share of right pairs that found it elsewhere, 0: nobody knows."""
        self.scene, self.models, self.arrays = scene, models, arrays
        self._allowed = allowed_poses(models, priors, scene.fine.cells.offset)
        self.parameters, self.seed, self.jobs = parameters, seed, jobs
        self.pairs = models[0].parameters.pairs
        self.rungs = sorted({rung for m in models for rung in rungs_of(m.diameter, m.parameters.pairs)}, reverse=True)
        known = parameters.facing_only and scene.fine.signed and len(scene.depths) <= FACING_ORIGINS
        self._origins = scene.origins() if known else np.empty((0, 3))
        self._most_in_air = air_table(parameters.tests)
        # As far as two samples of a model may be off, but never less than the scene's own resampling.
        self._tolerance = max(scene.fine.cell, self.pairs.tolerance * min(model.spacing for model in models))
        # Pairs are hashed of what is searched for: of most elements of a building, which stand in their places, never.
        self._hashed = np.zeros(len(models), np.bool_)
        self._table: JointTable | None = None
        self.choices = 0  # of surfels that were drawn from
        self.pool = Pool(scene, models, by_shape=parameters.by_shape, seed=seed, jobs=jobs)
        self._draws = self._draws_of_pool()
        a_round = parameters.hypotheses_a_round * self._draws.sides * models_share(len(models))
        self.served = Served(len(models), parameters, MOST_HYPOTHESES / a_round, learnt)
        self._look_for(parameters.overlap_ratio)

    def _look_for(self, overlap_ratio: float) -> None:
        """Look for instances that show this share of their surface, and more."""
        self._shown, self._until, chance = overlap_ratio, 0.0, self.parameters.chance_overlap
        # A right hypothesis puts so many of its samples on the scene, and chance some of the others.
        meets = MEETS * overlap_ratio
        self._least_hits = wald_table(self.parameters.tests, meets + (1.0 - meets) * chance, chance)

    def look_deeper(self) -> bool:
        """Look for instances that show half of λs for some rounds; False where that is done already."""
        deeper = DEEPER * self.parameters.overlap_ratio
        if not self.parameters.deeper or self._shown <= deeper or not self.pool_left():
            return False
        self._look_for(deeper)
        self._until = self.served.effort + DEEPER_ROUNDS
        return True

    def withdraw(self, cells: NDArray[np.bool_]) -> None:
        """Draw no more from these cells (V,): they are explained."""
        self.pool.withdraw(cells)

    def _draws_of_pool(self) -> Draws:
        """The pool as it is now, to be drawn from."""
        return Draws(self.pool.points(), self.pairs, self.rungs, self._tolerance, self.jobs)

    def may_stop(self) -> bool:
        """Is nothing left to draw from, or every model served?"""
        if not self.pool_left():
            return True
        return self.served.effort >= self._until if self._until else self.served.enough()

    def pool_left(self) -> bool:
        """Is there a pair left to draw?"""
        return self.pool.left()

    def tally(self) -> Tally:
        """How the search has gone so far."""
        return self.served.tally(pairs_left=self.pool_left())

    def learn(self, model: int, hits: int, support: float, *, by_lines: bool = False) -> None:
        """Learn from an instance how often the last round hit it, see Served.learn."""
        self.served.learn(model, hits, support, by_lines=by_lines)
        self._look_for(self.parameters.overlap_ratio)  # others are looked for as at first

    def round(self) -> Hypotheses:
        """One round: draw pairs, look them up, test their hypotheses; the best of each pair and model, best first.

        A long one has parts, each with a choice of its own to draw from.
        """
        served = self.served
        share, sought = (1.0, served.wanted) if self._until else (served.share(), served.searched())
        parts = ceil(share / A_CHOICE)
        found, right = [no_hypotheses()], np.zeros(len(self.models))
        for _ in range(parts):
            if self.pool.refilled(self.choices):
                self._draws = self._draws_of_pool()
            if len(self.pool) >= 2:
                hypotheses, tested = self._drawn(share / parts, sought)
                found.append(hypotheses)
                right += tested
            self.choices += 1
        if len(found) > 1:
            served.took(share, sought, right)
        return joined(found).best_first()

    def _drawn(self, share: float, sought: NDArray[np.bool_]) -> tuple[Hypotheses, Floats]:
        """The hypotheses that pass of pairs of the present pool, and how many right pairs were tested of each model.

        share : of a full round; sought : (models,) which are searched
        """
        limits, table = self.parameters, self._table_of(sought)
        count = round(share * limits.pairs_a_round / len(self.rungs))
        drawn = self._draws.draw(count, self.seed, self.choices, limits.max_tries)
        # Three of four choices of sides are wrong: as many more hypotheses are tested for the same right pairs.
        most = share * limits.hypotheses_a_round * self._draws.sides * models_share(int(sought.sum()))
        tested = affordable(drawn, table.entries_of(sought), most, rarest_first=limits.telling_first)
        trial = Trial(
            table,
            self.arrays,
            self.scene.tolerant,
            self._origins,
            self.scene.air if limits.by_air and most >= WORTH_AIR else no_air(),
            self._least_hits,
            self._most_in_air,
            limits.normal_length_m,
            self._allowed,
            sought,
        )
        right = self._right_pairs(sought, count, drawn.keys, tested.keys)
        return trial.test(tested, self._draws.points, self.jobs), right

    def _table_of(self, sought: NDArray[np.bool_]) -> JointTable:
        """The hash table of the models (models,) that are sought, and of those that were."""
        if self._table is None or (sought & ~self._hashed).any():
            self._hashed |= sought
            self._table = joint_table(self.models, self._hashed, each_once=self.parameters.each_once, jobs=self.jobs)
        return self._table

    def _right_pairs(
        self, sought: NDArray[np.bool_], drawn_here: int, drawn: NDArray[np.int64], tested: NDArray[np.int64]
    ) -> Floats:
        """How many right pairs a round tested of an instance that shows `overlap_ratio`, of each model that was sought,
        (models,).

        drawn_here : pairs at each rung; drawn, tested : keys of those that met a second point, and of those tested
        """
        cells, shown = key_count(self.pairs), self.parameters.overlap_ratio
        right = np.zeros(len(self.models))
        count = np.bincount(drawn, minlength=cells)
        # None of a feature that was not drawn was left out: without this a scan too small for a pair is never done.
        share = np.where(count > 0, np.bincount(tested, minlength=cells) / np.maximum(count, 1), 1.0)
        for number in np.flatnonzero(sought).tolist():
            model = self.models[number]
            samples, every, of_a_rung = len(model.samples), model.pairs.keys, self.pairs.cells_per_rung()
            on_it = shown * self.pool.on(number)
            first_on_it = min(1.0, on_it / max(len(self.pool), 1))
            for rung in rungs_of(model.diameter, model.parameters.pairs):
                keys = every[slice(*np.searchsorted(every, [rung * of_a_rung, (rung + 1) * of_a_rung]))]
                if not len(keys):
                    continue
                # The share of its samples a pair's length away, as against all of the pool so far away.
                shell = 2.0 * model.parameters.pairs.tolerance * model.spacing
                partners = on_it * len(keys) / samples**2 * 2.0 * self._draws.tolerance / shell
                second_on_it = partners / max(self._draws.partners(rung), partners, 1e-9)
                right[number] += drawn_here * first_on_it * second_on_it * float(share[keys].mean())
        return right
