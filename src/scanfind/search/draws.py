"""Pairs of oriented points: drawn at the distances of a library's, looked up, posed and tested (paper 3.3, 3.4).

What is drawn from may be the surface with its normals, or lines with their directions (see `lines`).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.grid.blocks import packed
from scanfind.grid.moments import empty_hash
from scanfind.library.pairs import rung_distance
from scanfind.search.hypotheses import Hypotheses, no_hypotheses
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.cloud import OrientedCloud
    from scanfind.grid.air import Air
    from scanfind.grid.scene import OrientationGrid
    from scanfind.kernels.allowed import Allowed
    from scanfind.library.joint import JointTable
    from scanfind.library.pairs import PairParameters
    from scanfind.search.hypotheses import ModelArrays

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Bins a pair distance: 380 of them make the shell a partner is sought in (kernels.search.draw_seconds). With six, and
# 1,600, visiting them cost twice as much as the partners did that are met in vain.
BINS_A_DISTANCE = 3
LOST = 0.02  # chance of giving up a right hypothesis that Wald's tests accept
# Of the samples of a pose that is right within a tenth of the diameter and passes 0.02 hang in the air in the median,
# 0.2 of one in twenty; of a wrong one 0.4.
RIGHT_IN_AIR, WRONG_IN_AIR = 0.1, 0.3
PARTNERS_COUNTED = 40  # points whose partners are counted, each against all of them


class Pairs(NamedTuple):
    """K pairs of oriented points: their numbers, which of them are turned (bit 0 the first, bit 1 the second), keys."""

    first: Ints
    second: Ints
    signs: Ints
    keys: Ints

    def take(self, which: NDArray[np.integer] | NDArray[np.bool_]) -> Pairs:
        """Some of them."""
        return Pairs(self.first[which], self.second[which], self.signs[which], self.keys[which])


class Draws:
    """Oriented points that pairs are drawn from.

    points : (W,) of them; sides : choices of sides a pair is looked up with, 4 where nobody knows a direction's
    tolerance : how far from a rung's distance a pair may be, metres
    """

    def __init__(
        self, points: OrientedCloud, layout: PairParameters, rungs: Sequence[int], tolerance: float, jobs: int
    ) -> None:
        self.points, self.sides, self.rungs, self.tolerance = points, 1 if points.signed else 4, rungs, tolerance
        self._layout, self._jobs = layout, jobs
        every = np.arange(len(points))
        self._bins = {
            rung: bin_pool(every, points.points, rung_distance(rung, layout), tolerance) for rung in self.rungs
        }

    def draw(self, count: int, seed: int, number: int, max_tries: int) -> Pairs:
        """`count` pairs at each rung's distance, less those that met no second point; the same for the same number."""
        columns = [self._draw(rung, count, seed, number * 1024 + rung, max_tries) for rung in self.rungs]
        return Pairs(*(np.concatenate(column) for column in zip(*columns, strict=True)))

    def _draw(self, rung: int, count: int, seed: int, stream: int, max_tries: int) -> Pairs:
        from scanfind.kernels.search import draw_firsts, draw_seconds, key_pairs

        bins, distance, layout = self._bins[rung], rung_distance(rung, self._layout), self._layout
        first, second = np.empty(count, np.int64), np.empty(count, np.int64)
        draw_firsts(seed, stream, len(bins.pool), first)
        order = np.argsort(bins.bin_of[first], kind="stable")
        in_threads(
            self._jobs, count,
            lambda start, stop: draw_seconds(
                start, stop, order, first, seed, stream, bins.keys, bins.bin_of, bins.hash_keys, bins.hash_values,
                bins.starts, bins.points, bins.shell, distance, self.tolerance, max_tries, second,
            ),
        )  # fmt: skip
        met = second >= 0
        first, second = bins.pool[first[met]], bins.pool[second[met]]
        # Where nobody knows a direction's side, each pair is looked up with all four choices of sides.
        signs = np.repeat(np.arange(self.sides), len(first))
        first, second = np.tile(first, self.sides), np.tile(second, self.sides)
        keys, of = np.empty(len(first), np.int64), self.points
        key_pairs(first, second, signs, of.points, of.normals, layout.edges, keys)
        pairs = Pairs(first, second, signs, keys).take(keys >= 0)
        return pairs._replace(keys=pairs.keys + rung * layout.cells_per_rung())

    def partners(self, rung: int) -> float:
        """How many of the points lie at a rung's distance from one of them, on average."""
        from scanfind.kernels.search import count_partners

        bins = self._bins[rung]
        if bins.partners < 0.0:
            some = bins.points[:: max(1, len(bins.points) // PARTNERS_COUNTED)]
            found = count_partners(some, bins.points, rung_distance(rung, self._layout), self.tolerance)
            self._bins[rung] = bins = bins._replace(partners=float(found))
        return bins.partners


def affordable(pairs: Pairs, entries: Ints, hypotheses: float, *, rarest_first: bool) -> Pairs:
    """Those of some pairs that a table knows, until their hypotheses are as many as one can afford.

    entries : (cells,) of the table, how many hypotheses a pair leads to by its key
    rarest_first : by how often their feature was drawn: the chance of a pair to be right, over the cost of testing it,
        is one over how often the scene shows its feature
    """
    cost = entries[pairs.keys]
    order = np.flatnonzero(cost > 0)
    if rarest_first:
        common = np.bincount(pairs.keys, minlength=len(entries))
        order = order[np.argsort(common[pairs.keys[order]], kind="stable")]
    return pairs.take(order[: np.searchsorted(np.cumsum(cost[order]), hypotheses) + 1])


class Trial(NamedTuple):
    """What the hypotheses of pairs come from and are tested on.

    table, arrays : the models' pairs, and the oriented points these are of
    marks : cells of the scene that know which way what is in them faces
    origins : (K, 3) scanner positions: samples that face none are passed over; empty: all are tested
    air : where nothing is
    least_hits : see `wald_table`; most_in_air : see `air_table`
    normal_length : metres, see SearchParameters.normal_length_m
    allowed : which poses are worth a test; sought : (models,) which models are
    """

    table: JointTable
    arrays: ModelArrays
    marks: OrientationGrid
    origins: Floats
    air: Air
    least_hits: Ints
    most_in_air: Ints
    normal_length: float
    allowed: Allowed
    sought: NDArray[np.bool_]

    def test(self, pairs: Pairs, of: OrientedCloud, jobs: int) -> Hypotheses:
        """The best hypothesis of each pair of each model that pass, best first; of : the points the pairs are of."""
        from scanfind.kernels.search import test_pairs

        table, arrays, marks, air = self.table, self.arrays, self.marks, self.air
        passed = in_threads(
            jobs, len(pairs.first),
            lambda start, stop: test_pairs(
                start, stop, *pairs, of.points, of.normals, table.offsets, table.model, table.first, table.second,
                arrays.starts, arrays.points, arrays.normals, arrays.samples, self.normal_length, *marks,
                self.least_hits, self.most_in_air, self.origins, *air, self.allowed, self.sought,
            ),
        )  # fmt: skip
        if not passed:
            return no_hypotheses()
        support, models, rotations, translations = (np.concatenate(column) for column in zip(*passed, strict=True))
        return Hypotheses(models, rotations, translations, support).best_first()


def wald_table(tests: int, right: float, wrong: float, lost: float = LOST) -> NDArray[np.int64]:
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


def air_table(tests: int, right: float = RIGHT_IN_AIR, wrong: float = WRONG_IN_AIR) -> NDArray[np.int64]:
    """Most samples in the air after k = 0 … tests of them beyond which a hypothesis is given up; the same test."""
    k = np.arange(tests + 1)
    in_air, not_in_air = log(wrong / right), log((1.0 - right) / (1.0 - wrong))
    return np.asarray(np.floor((log(1.0 / LOST) + k * not_in_air) / (in_air + not_in_air)), np.int64)


class Bins(NamedTuple):
    """The pool sorted into cubes of one edge: bin b holds pool[starts[b]:starts[b+1]].

    pool : (W,) surfels; points : (W, 3) where they are, side by side; bin_of : (W,) the bin of each
    keys : (bins,) packed coordinates; hash_keys, hash_values : from them to the bin
    shell : (Q, 3) int64, from a bin to all those that may hold a point at the pair distance from one in it
    partners : how many of the pool lie at the distance from one of them; -1 until counted (see Draws)
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
    from scanfind.kernels.blocks import fill_hash

    points, edge = means[pool], distance / BINS_A_DISTANCE
    keys = packed(np.floor(points / edge).astype(np.int64))
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
