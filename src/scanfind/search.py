"""RANSAC over the scene: draw, look up, pose, test (paper 3.3 and 3.4, Algorithm 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import require
from scanfind.moments import empty_hash
from scanfind.pairs import rung_distance, rungs_of
from scanfind.scene import flatness_above
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.library import JointTable
    from scanfind.model import Model
    from scanfind.scene import Scene

Floats = NDArray[np.float64]

# What was found first was easier to find than what was not: its rate is halved before it is asked of others.
LEARNT = 0.5
# Cells drawn from: fewer make pairs that repeat each other, more cost more to fit than they add to a round's pairs.
LEAST_POOL, MOST_POOL = 20_000, 60_000
ROUNDS_A_POOL = 4  # draw from mostly the same cells, which are fitted then; small parts need others in the long run
# The first round tells how easily an instance is found, and often finds all there is. Rounds after it: a little more
# than is missing, and enough to be worth refining; rather a little more in one round than two.
FIRST_ROUND, ROUND_MARGIN, LEAST_ROUND, MOST_ROUND = 0.3, 1.1, 0.15, 1.3
# With so many scanner positions nearly every sample faces one, and asking costs more than it tells.
FACING_ORIGINS = 6
SHAPED = 1000  # samples whose shape tells that of a model, each against all of them
PARTNERS_COUNTED = 40  # surfels whose partners are counted, each against all of the pool
# Bins a pair distance: 1,600 of them make the shell a partner is sought in (kernels.search.draw_seconds).
BINS_A_DISTANCE = 6
# Borders between classes of bend, in shares of the window: range noise of 2 mm on a plane is below the first for
# windows over 0.1 m, a pipe as wide as the window above the last.
BEND_BORDERS = (0.02, 0.05, 0.1)
# A pair that lies on an instance finds it when noise left its feature in the right cell of the hash table and one of
# the model's pairs there is near enough: measured 0.5 on spools, 0.05 – 0.4 on frames, far less on sparse ones. Only
# until an instance is found; then it is counted (Search.learn).
RIGHT_PAIR_FINDS = 0.006
# Where nothing at all is found, an instance is looked for that shows only half of λs, the paper's own 0.15, for so many
# full rounds. Of parts that lost 60 to 70 % of their points every one that was found then was found in the first.
DEEPER, DEEPER_ROUNDS = 0.5, 2.0
# A surfel's normal counts as clean below so much of a cell, noise apart; but never fewer than this share of a shape's.
# Drawing only those doubled the right poses a round finds, on spools and frames.
CLEAN_CELLS, CLEAN_SHARE = 0.1, 0.3


@dataclass(frozen=True)
class SearchParameters:
    """How the search is carried out.

    overlap_ratio : λs, the share of a model's samples that must lie on the scene (the paper: 0.15) …
    facing_only : … of those that face a scanner position, where all are known: a chunky part seen from one side shows a
        quarter of its surface
    time_limit_s : seconds for search, verification and refinement together; None: until nothing is likely to be missed
    miss_probability : stop when an instance that shows `overlap_ratio` of its surface has been missed with less than
        this chance; 0: use all of the time limit, as the paper does
    max_instances : stop after so many detections; None: all there are
    expected : instances of each model: one found so many times is looked for no further; None: nobody knows
    pairs_a_round, hypotheses_a_round : scene pairs drawn before any is tested; hypotheses tested before any is refined
    by_shape : draw points by the likelihood ratio of their local shape: how bent the surface around them is, on the
        model as against in the scene; walls and floors are most of a scan and little of a spool
    telling_first : test pairs first whose feature is rare in this scene: the chance of a pair to be right, over the
        cost of testing it, is one over how often the scene shows its feature
    each_once : of a model's pairs that its symmetry maps onto one another look up only one: a pipe's pairs are the same
        all around it, and so are the poses they lead to
    normal_length_m : of the normals in the four-point sets (the paper: 1); 0: its limit, the roll alone from normals
    max_tries : places tried for s2 before another s1 is drawn
    tests : model samples in the sequential test
    chance_overlap : share of samples of a wrong hypothesis that lie on the scene, for Wald's test
    test_cells_across : cells of the test along the smallest diameter of a model; fewer where the scan is sparse
    kept : hypotheses refined each round, for each model
    """

    overlap_ratio: float = 0.3
    time_limit_s: float | None = 60.0
    miss_probability: float = 0.01
    max_instances: int | None = None
    expected: int | None = None
    pairs_a_round: int = 100_000
    hypotheses_a_round: int = 200_000
    facing_only: bool = True
    by_shape: bool = True
    telling_first: bool = True
    each_once: bool = True
    normal_length_m: float = 0.0
    max_tries: int = 1000
    tests: int = 192
    chance_overlap: float = 0.15
    test_cells_across: float = 45.0
    kept: int = 48

    def __post_init__(self) -> None:
        require(0.0 < self.overlap_ratio <= 1.0, "overlap_ratio", self.overlap_ratio, "above 0 and at most 1")
        limit = self.time_limit_s
        require(limit is None or limit >= 0.0, "time_limit_s", limit, "0 seconds or more")
        require(0.0 <= self.miss_probability < 1.0, "miss_probability", self.miss_probability, "from 0 to below 1")
        require(
            limit is not None or self.miss_probability > 0.0, "time_limit_s", limit, "given where miss_probability is 0"
        )
        require(self.max_instances is None or self.max_instances >= 1, "max_instances", self.max_instances, "1 or more")
        require(self.expected is None or self.expected >= 1, "expected", self.expected, "1 or more")
        require(0.0 < self.chance_overlap < 0.5, "chance_overlap", self.chance_overlap, "above 0 and below 0.5")
        require(self.normal_length_m >= 0.0, "normal_length_m", self.normal_length_m, "0 or more metres")
        require(self.test_cells_across >= 4.0, "test_cells_across", self.test_cells_across, "4 or more")
        for name in ("pairs_a_round", "hypotheses_a_round", "max_tries", "tests", "kept"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "1 or more")


class ModelArrays(NamedTuple):
    """The samples of all models sought, end to end.

    starts : (models+1,) int64, where each model's begin
    points, normals : (N, 3), model frame, metres; samples : (N, 6) float32, both side by side
    centres, radii : (models, 3), (models,) of the samples: their mean, and their root mean square distance from it
    """

    starts: NDArray[np.int64]
    points: Floats
    normals: Floats
    samples: NDArray[np.float32]
    centres: Floats
    radii: Floats


class Hypotheses(NamedTuple):
    """H poses of models, the best first.

    models : (H,) int64; rotations (H, 3, 3), translations (H, 3) : scene_from_model, relative to the grid's offset
    support : (H,) share of the test's samples on the scene
    """

    models: NDArray[np.int64]
    rotations: Floats
    translations: Floats
    support: Floats

    def take(self, which: NDArray[np.intp]) -> Hypotheses:
        """Some of them."""
        return Hypotheses(self.models[which], self.rotations[which], self.translations[which], self.support[which])


def model_arrays(models: Sequence[Model]) -> ModelArrays:
    """Concatenate the models' samples."""
    sizes = [len(model.samples) for model in models]
    centres = np.array([model.samples.points.mean(axis=0) for model in models])
    radii = np.array(
        [
            np.sqrt(((m.samples.points - centre) ** 2).sum(axis=1).mean())
            for m, centre in zip(models, centres, strict=True)
        ]
    )
    return ModelArrays(
        np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        np.concatenate([m.samples.points for m in models]),
        np.concatenate([m.samples.normals for m in models]),
        np.concatenate([np.hstack([m.samples.points, m.samples.normals]) for m in models]).astype(np.float32),
        centres, radii,
    )  # fmt: skip


def wald_table(tests: int, right: float, wrong: float, lost: float = 0.02) -> NDArray[np.int64]:
    """Least hits after k = 0 … tests samples below which a hypothesis is given up (Wald's sequential test).

    right, wrong : chance of a sample to lie on the scene under a right and a wrong hypothesis; lost : accepted chance
    of giving up a right one.
    """
    right = max(right, 1.5 * wrong)
    hit, miss = log(right / wrong), log((1.0 - right) / (1.0 - wrong))
    k = np.arange(tests + 1)
    least = np.ceil((log(lost) - k * miss) / (hit - miss)).clip(0)
    # What is left at the end must have the overlap itself, less what chance does to a sample of this size.
    least[-1] = max(least[-1], np.floor(tests * right - 2.0 * np.sqrt(tests * right * (1.0 - right))))
    return np.asarray(least, np.int64)


class Search:
    """The rounds of RANSAC over one scene, for all models together; the same seed gives the same rounds."""

    def __init__(
        self, scene: Scene, models: Sequence[Model], table: JointTable, arrays: ModelArrays,
        parameters: SearchParameters, seed: int, jobs: int,
    ) -> None:  # fmt: skip
        self.scene, self.models, self.table, self.arrays = scene, models, table, arrays
        self.parameters, self.seed, self.jobs = parameters, seed, jobs
        self.pairs = models[0].parameters.pairs
        self.rungs = sorted({rung for m in models for rung in rungs_of(m.diameter, m.parameters.pairs)}, reverse=True)
        window = 3.0 * scene.around.cell
        self._classes = shape_classes(flatness_above(scene.fine, 2, scene.around), window)
        self._free = np.ones(len(scene.fine.cells), np.bool_)
        known = parameters.facing_only and scene.fine.signed and len(scene.depths) <= FACING_ORIGINS
        self._origins = scene.origins() if known else np.empty((0, 3))
        self.model_shapes = np.array([model_shape(model, window) for model in models])
        # As far as two samples of a model may be off, but never less than the scene's own resampling.
        self._tolerance = max(scene.fine.cell, self.pairs.tolerance * min(model.spacing for model in models))
        self.rounds, self.effort, self._last_share = 0, 0.0, 1.0
        self.pool = np.empty(0, np.intp)
        self._fill_pool()
        self._expected = np.zeros(len(models))
        self._served = np.zeros(len(models), np.bool_)  # models of which no further instance is wanted
        self._learned = np.zeros((len(models), 2))  # hits, and what was shown, of the instances found
        self._sides = 1 if scene.fine.signed and all(m.signed for m in models) else 4
        self._look_for(parameters.overlap_ratio)

    def _look_for(self, overlap_ratio: float) -> None:
        """Look for instances that show this share of their surface, and more."""
        self._shown, self._until, chance = overlap_ratio, 0.0, self.parameters.chance_overlap
        # A right hypothesis puts so many of its samples on the scene, and chance some of the others.
        right = overlap_ratio + (1.0 - overlap_ratio) * chance
        self._least_hits = wald_table(self.parameters.tests, right, chance)

    def look_deeper(self) -> bool:
        """Look for instances that show half of λs for some rounds; False where that is done already."""
        deeper = DEEPER * self.parameters.overlap_ratio
        if self._shown <= deeper or not self.pool_left():
            return False
        self._look_for(deeper)
        self._until = self.effort + DEEPER_ROUNDS
        return True

    def served(self, models: NDArray[np.bool_]) -> None:
        """Of these models (models,) no further instance is wanted: the search need not go on for them."""
        self._served = models

    def withdraw(self, cells: NDArray[np.bool_]) -> None:
        """Draw no more from these cells (V,): they are explained."""
        self._free &= ~cells
        self._stale = True

    def _fill_pool(self) -> None:
        """Choose the surfels that may be drawn: each cell's with a chance by the likelihood ratio of its shape."""
        counts, kept = self._likelihood(self._free)
        kept = kept * min(1.0, MOST_POOL / max(float(kept @ counts), 1.0))
        # Where the telling cells are few, the others fill up: they may be all there is to draw from.
        while 0 < np.minimum(kept, 1.0) @ counts < min(LEAST_POOL, 0.9 * counts.sum()):
            kept = kept * 1.25
        self._kept = np.minimum(kept, 1.0)
        luck = np.random.default_rng([self.seed, self.rounds // ROUNDS_A_POOL]).random(len(self._classes), np.float32)
        chance = self._kept.astype(np.float32)[self._classes]
        fine = self.scene.fine
        surfels = fine.of(np.flatnonzero(self._free & (luck < chance)))
        surfels = surfels[fine.has_normal()[surfels]]
        self.pool = surfels[self._clean(surfels)]
        self._stale = False
        self._bins = {
            rung: bin_pool(self.pool, fine.means, rung_distance(rung, self.pairs), self._tolerance)
            for rung in self.rungs
        }

    def _clean(self, surfels: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which surfels have a normal to rely on: flat but for noise, or among the flatter ones of their shape.

        Across an edge a normal is of neither face, and near edges is where most of the telling surfels are.
        """
        fine, classes = self.scene.fine, self._classes[self.scene.fine.cell_of[surfels]]
        flatness = fine.flatness[surfels]
        clean: NDArray[np.bool_] = flatness <= np.hypot(self.scene.noise, CLEAN_CELLS * fine.cell)
        for shape in np.unique(classes):
            alike = classes == shape
            clean[alike] |= flatness[alike] <= np.quantile(flatness[alike], CLEAN_SHARE)
        return clean

    def telling(self) -> tuple[Floats, Floats]:
        """How much the surfels of each fine and of each coarse cell tell, (V,), 0 … 1: the root of the likelihood ratio
        of their shape, model against scene.

        A plate flush with a floor lies on the scene with all of its samples, and that means nothing.
        """
        _, likelihood = self._likelihood(np.ones(len(self._classes), np.bool_))
        scene, tells = self.scene, np.sqrt(likelihood)
        coarse = shape_classes(flatness_above(scene.coarse, 1, scene.around), 3.0 * scene.around.cell)
        return tells[self._classes], tells[coarse]

    def _likelihood(self, among: NDArray[np.bool_]) -> tuple[NDArray[np.intp], Floats]:
        """Of C classes of shape, how many of some cells are in each, and its likelihood ratio over the largest, (C,).

        among : (V,) which cells
        """
        counts = np.bincount(self._classes[among], minlength=len(BEND_BORDERS) + 1)
        if not self.parameters.by_shape:
            return counts, np.ones(len(counts))
        ratio = np.where(counts > 0, self.model_shapes.mean(axis=0) / np.maximum(counts, 1), 0.0)
        return counts, ratio / max(ratio.max(), 1e-300)

    def may_stop(self) -> bool:
        """Is nothing left to draw from, or the chance to have missed an instance of any model below the one allowed?"""
        if not self.pool_left():
            return True
        return self.effort >= self._until if self._until else self.chance_missed() < self.parameters.miss_probability

    def pool_left(self) -> bool:
        """Is there a pair left to draw?"""
        return len(self.pool) > 1 and bool(np.count_nonzero(self._free) > 1)

    def chance_missed(self) -> float:
        """Chance to have missed an instance that shows λs of its surface, for the model worst served so far."""
        expected = np.where(self._learned[:, 1] > 0.0, self.effort * self._rate(), self._expected)
        return exp(-float(expected.min(initial=np.inf, where=~self._served)))

    def _share(self) -> float:
        """The share of a full round that the next one needs be: as much as is missing."""
        allowed, missed = self.parameters.miss_probability, self.chance_missed()
        if allowed == 0.0 or self._until:
            return 1.0
        if self.effort == 0.0:
            return FIRST_ROUND
        if missed == 1.0:
            return 1.0
        needed = self.effort * (log(allowed) / log(missed) - 1.0)
        return min(MOST_ROUND, max(LEAST_ROUND, ROUND_MARGIN * needed))

    def learn(self, model: int, hits: int, support: float) -> None:
        """Learn from an instance how often the last round hit it: pairs on it go with the square of what it shows."""
        self._learned[model] += max(hits, 1), self._last_share * (support / self.parameters.overlap_ratio) ** 2
        self._look_for(self.parameters.overlap_ratio)  # others are looked for as at first

    def _rate(self) -> Floats:
        """Hits a full round of an instance of each model that shows λs of its surface, from those found, (models,)."""
        return np.asarray(LEARNT * self._learned[:, 0] / np.maximum(self._learned[:, 1], 1e-300))

    def round(self) -> Hypotheses:
        """One round: draw pairs, look them up, test their hypotheses; the best of each pair that pass, best first."""
        from scanfind.kernels.search import test_pairs

        if self._stale:
            self._fill_pool()
        if len(self.pool) < 2:
            return Hypotheses(np.empty(0, np.int64), np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0))
        share = self._last_share = self._share()
        first, second, signs, keys = self._telling_pairs(share)
        count = len(first)
        support, models = np.zeros(count), np.zeros(count, np.int64)
        rotations, translations = np.empty((count, 3, 3)), np.empty((count, 3))
        fine, tolerant, table, arrays = self.scene.fine, self.scene.tolerant, self.table, self.arrays

        in_threads(
            self.jobs, count,
            lambda start, stop: test_pairs(
                start, stop, first, second, signs, keys, fine.means, fine.normals,
                table.offsets, table.model, table.first, table.second, arrays.starts, arrays.points, arrays.normals,
                arrays.samples, self.parameters.normal_length_m, tolerant.cell, tolerant.hash_keys,
                tolerant.hash_values, tolerant.occupied, tolerant.masks, self._least_hits, self._origins,
                support, models, rotations, translations,
            ),
        )  # fmt: skip
        self.rounds += 1
        self.effort += share
        order = np.argsort(-support, kind="stable")[: np.count_nonzero(support)]
        return Hypotheses(models[order], rotations[order], translations[order], support[order])

    def _telling_pairs(self, share: float) -> tuple[NDArray[np.int64], ...]:
        """Draw a round's pairs; of those the library knows, the most telling that the round can afford to test.

        share : of a full round, 0 … 1
        """
        count = round(share * self.parameters.pairs_a_round / len(self.rungs))
        columns = [self._draw(rung, count) for rung in self.rungs]
        first, second, signs, keys = (np.concatenate(column) for column in zip(*columns, strict=True))
        cost = (self.table.offsets[1:] - self.table.offsets[:-1])[keys]
        known = cost > 0
        common = np.bincount(keys, minlength=len(self.table.offsets) - 1)
        order = np.flatnonzero(known)
        if self.parameters.telling_first:
            order = order[np.argsort(common[keys[order]], kind="stable")]
        # Three of four choices of sides are wrong: as many more hypotheses are tested for the same right pairs.
        most = share * self.parameters.hypotheses_a_round * self._sides
        affordable = np.searchsorted(np.cumsum(cost[order]), most) + 1
        order = order[:affordable]
        self._expect(count, keys, keys[order])
        return first[order], second[order], signs[order], keys[order]

    def _draw(self, rung: int, count: int) -> tuple[NDArray[np.int64], ...]:
        """Pairs of scene points at one rung's distance: first, second, signs, keys, those that met a second point."""
        from scanfind.kernels.search import draw_firsts, draw_seconds, key_pairs

        fine = self.scene.fine
        bins, distance, stream = self._bins[rung], rung_distance(rung, self.pairs), self.rounds * 1024 + rung
        first, second = np.empty(count, np.int64), np.empty(count, np.int64)
        draw_firsts(self.seed, stream, len(bins.pool), first)
        order = np.argsort(bins.bin_of[first], kind="stable")
        in_threads(
            self.jobs, count,
            lambda start, stop: draw_seconds(
                start, stop, order, first, self.seed, stream, bins.keys, bins.bin_of, bins.hash_keys,
                bins.hash_values, bins.starts, bins.points, bins.shell, distance, self._tolerance,
                self.parameters.max_tries, second,
            ),
        )  # fmt: skip
        met = second >= 0
        first, second = bins.pool[first[met]], bins.pool[second[met]]
        # Where nobody knows a normal's side, each pair is looked up with all four choices of sides.
        sides = self._sides
        signs = np.repeat(np.arange(sides), len(first))
        first, second = np.tile(first, sides), np.tile(second, sides)
        keys = np.empty(len(first), np.int64)
        key_pairs(
            first, second, signs, fine.means, fine.normals, self.pairs.angle_cell(), self.pairs.angle_bins(), keys
        )
        pairs = keys >= 0
        keys[pairs] += rung * self.pairs.cells_per_rung()
        return first[pairs], second[pairs], signs[pairs], keys[pairs]

    def _expect(self, drawn_here: int, drawn: NDArray[np.int64], tested: NDArray[np.int64]) -> None:
        """Add how many right pairs this round tested of an instance of each model that shows `overlap_ratio`.

        drawn_here : pairs at each rung; drawn, tested : keys of those that met a second point, and of those tested
        """
        cells, fine, shown = len(self.table.offsets) - 1, self.scene.fine, self.parameters.overlap_ratio
        count = np.bincount(drawn, minlength=cells)
        # None of a feature that was not drawn was left out: without this a scan too small for a pair is never done.
        share = np.where(count > 0, np.bincount(tested, minlength=cells) / np.maximum(count, 1), 1.0)
        for number, model in enumerate(self.models):
            samples, rung_of_pair = len(model.samples), model.pairs.keys // self.pairs.cells_per_rung()
            # What of an instance that shows λs of its surface would be in the pool.
            on_it = shown * model.exposed_area() / fine.cell**2 * float((self.model_shapes[number] * self._kept).sum())
            first_on_it = min(1.0, on_it / max(len(self.pool), 1))
            for rung in rungs_of(model.diameter, model.parameters.pairs):
                keys = model.pairs.keys[rung_of_pair == rung]
                if not len(keys):
                    continue
                # The share of its samples a pair's length away, as against all of the pool so far away.
                shell = 2.0 * model.parameters.pairs.tolerance * model.spacing
                partners = on_it * len(keys) / samples**2 * 2.0 * self._tolerance / shell
                second_on_it = partners / max(self._partners(rung), partners, 1e-9)
                right = drawn_here * first_on_it * second_on_it * float(share[keys].mean())
                self._expected[number] += RIGHT_PAIR_FINDS * right

    def _partners(self, rung: int) -> float:
        """How many surfels of the pool lie at a rung's distance from one of them, on average."""
        from scanfind.kernels.search import count_partners

        bins = self._bins[rung]
        if bins.partners < 0.0:
            some = bins.points[:: max(1, len(bins.points) // PARTNERS_COUNTED)]
            found = count_partners(some, bins.points, rung_distance(rung, self.pairs), self._tolerance)
            self._bins[rung] = bins = bins._replace(partners=float(found))
        return bins.partners


class Bins(NamedTuple):
    """The pool sorted into cubes of one edge: bin b holds pool[starts[b]:starts[b+1]].

    pool : (W,) surfels; points : (W, 3) where they are, side by side; bin_of : (W,) the bin of each
    keys : (bins,) packed coordinates; hash_keys, hash_values : from them to the bin
    shell : (Q, 3) int64, from a bin to all those that may hold a point at the pair distance from one in it
    partners : how many of the pool lie at the distance from one of them; -1 until counted (see Search)
    """

    pool: NDArray[np.intp]
    points: Floats
    bin_of: NDArray[np.int64]
    keys: NDArray[np.int64]
    hash_keys: NDArray[np.int64]
    hash_values: NDArray[np.int32]
    starts: NDArray[np.int64]
    shell: NDArray[np.int64]
    partners: float


def bin_pool(pool: NDArray[np.intp], means: Floats, distance: float, tolerance: float) -> Bins:
    """Sort surfels into cubes, BINS_A_DISTANCE of them a pair distance ± tolerance, metres."""
    from scanfind.kernels.blocks import BIAS, fill_hash

    points, edge = means[pool], distance / BINS_A_DISTANCE
    x, y, z = (np.floor(points / edge).astype(np.int64) + BIAS).T
    keys = (x << 40) | (y << 20) | z
    order = np.argsort(keys, kind="stable")
    bins, starts = np.unique(keys[order], return_index=True)
    starts = np.append(starts, len(pool))
    hash_keys, hash_values = empty_hash(len(bins))
    fill_hash(bins, np.arange(len(bins)), hash_keys, hash_values)
    return Bins(
        pool[order], points[order], np.repeat(np.arange(len(bins)), np.diff(starts)), bins, hash_keys, hash_values,
        starts, shell_of(distance / edge, tolerance / edge), -1.0,
    )  # fmt: skip


def shell_of(distance: float, tolerance: float) -> NDArray[np.int64]:
    """Steps (Q, 3) between unit cubes that hold points at distance ± tolerance from one another."""
    reach = int(np.ceil(distance + tolerance)) + 1
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest = np.linalg.norm(np.maximum(np.abs(steps) - 1, 0), axis=1)
    farthest = np.linalg.norm(np.abs(steps) + 1, axis=1)
    return np.asarray(steps[(nearest <= distance + tolerance) & (farthest >= distance - tolerance)])


def shape_classes(bends: NDArray[np.floating], window: float) -> NDArray[np.int8]:
    """Class of each point by how bent the surface around it is, (N,); bends : (N,), window : both metres."""
    return np.asarray(np.digitize(bends, np.array(BEND_BORDERS) * window), np.int8)


def model_shape(model: Model, window: float) -> Floats:
    """Share of a model's samples in each class, (C,); none is quite zero: scan and model are not sampled alike."""
    from scanfind.kernels.shape import bend_of_samples

    # The first ones lie as evenly over the model as all of them.
    bends = np.empty(min(len(model.samples), SHAPED))
    bend_of_samples(model.samples.points, model.samples.normals, window, bends)
    shares = np.bincount(shape_classes(bends, window), minlength=len(BEND_BORDERS) + 1) / len(bends)
    return np.asarray((shares + 0.02) / (shares + 0.02).sum())
