"""How well each model is served: how often an instance that shows λs of its surface would have been hit by now."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, inf, log
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scanfind.search.surface import SearchParameters

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# What was found first was easier to find than what was not: its rate is halved before it is asked of others.
LEARNT = 0.5
# The first round tells how easily an instance is found, and often finds all there is. Rounds after it: a little more
# than is missing, and enough to be worth refining; rather a little more in one round than two, and what has taken long
# in rounds twice as long: each ends with the fit of what passed.
FIRST_ROUND, ROUND_MARGIN, LEAST_ROUND, MOST_ROUND = 0.3, 1.1, 0.15, 3.0
# A pair foreseen to lie on an instance finds it when it does lie there, noise left its feature in the right cell of the
# hash table, and one of the model's pairs there is near enough: in plants 0.09 in the median of spools, 0.07 of valves,
# headers and frames, less than 0.02 of one in six. Only until an instance is found; then it is counted (Served.learn).
RIGHT_PAIR_FINDS = 0.02
# A round can afford so many models: of more, each has its share. With 200,000 hypotheses for 40 spools only pairs were
# tested whose feature was drawn once or twice, which is mostly noise: of a spool found alone in its first round not one
# right hypothesis in five rounds.
MODELS_A_ROUND = 10
# A model is not waited for that needs more hypotheses than this, some ten seconds of them: a scan whose points are too
# far apart for a flange shows no more of it for being searched all day.
MOST_HYPOTHESES = 15e6


def models_share(models: int) -> float:
    """How many times the hypotheses of a round so many models need."""
    return max(1.0, models / MODELS_A_ROUND)


class Tally(NamedTuple):
    """How the search for each of some models went, (models,).

    tested : right pairs tested of an instance that shows λs of its surface, had there been one; inf where no pair is
        left to draw
    hits, shown : of the instances found: how often they were hit, and by how many right pairs
    """

    tested: Floats
    hits: Floats
    shown: Floats


class Served:
    """What rounds have done for each of some models, and which are still to be searched for.

    wanted : (models,) of which further instances are wanted
    effort : rounds so far, in full ones
    right : (models,) right pairs tested of an instance that shows λs, had there been one
    """

    def __init__(
        self, models: int, parameters: SearchParameters, most_effort: float, learnt: Sequence[float] = ()
    ) -> None:
        """Nothing yet; most_effort : full rounds that a model is worth; learnt : see Search."""
        self._allowed, self._overlap, self._most = parameters.miss_probability, parameters.overlap_ratio, most_effort
        self._finds = np.maximum(RIGHT_PAIR_FINDS, learnt or 0.0)
        self.effort, self._last_share = 0.0, 1.0
        self._efforts, self.right, self._last_right = (np.zeros(models) for _ in range(3))
        self.wanted = np.ones(models, np.bool_)
        # Of the instances found: hits, and what they showed, in full rounds and in right pairs of one that shows λs.
        self._learned = np.zeros((models, 3))
        self._by_lines = np.zeros((models, 2))  # of those found by lines: hits, and what they showed
        self._told_by_lines = np.zeros(models)  # hits that a round of lines counts for

    def tally(self, *, pairs_left: bool) -> Tally:
        """How the search has gone so far; pairs_left : some are left to draw."""
        tested = self.right if pairs_left else np.full(len(self.right), inf)
        return Tally(tested, self._learned[:, 0], self._learned[:, 2])

    def took(self, share: float, searched: Flags, right: Floats) -> None:
        """A round was taken, that part of a full one, for these models (models,), of each with so many right pairs."""
        self.effort += share
        self._last_share, self._last_right = share, np.where(searched, right, 0.0)
        self._efforts += share * searched
        self.right += self._last_right

    def lines_asked(self, told: Floats) -> None:
        """Lines were asked for what surface did not find; told : hits that counts for, (models,): LineSearch.told."""
        self._told_by_lines = told

    def learn(self, model: int, hits: int, support: float, *, by_lines: bool = False) -> None:
        """Learn from an instance how often the last round hit it: pairs on it go with the square of what it shows.

        by_lines : that was a round of lines (see lines), which tells nothing of surface
        """
        shown = (support / self._overlap) ** 2
        if by_lines:
            self._by_lines[model] += max(hits, 1), shown
        else:
            self._learned[model] += max(hits, 1), self._last_share * shown, self._last_right[model] * shown

    def chance_missed(self) -> float:
        """Chance to have missed an instance that shows λs of its surface, for the model worst served so far."""
        waited = self.wanted & ~self.beyond_reach()
        if not waited.any():
            waited = self.wanted
        return exp(-float(self._hits(self._efforts).min(initial=inf, where=waited)))

    def enough(self) -> bool:
        """Is that chance below the one allowed for all models worth waiting for? With none, after what one is worth."""
        waited = (self.wanted & ~self.beyond_reach()).any()
        return self.chance_missed() < self._allowed or (not waited and self.effort >= self._most)

    def unserved(self) -> Flags:
        """Of which wanted models an instance may well have been missed, (models,)."""
        return self.wanted & (self._hits(self._efforts) < self._needed())

    def beyond_reach(self) -> Flags:
        """Which models would not be served by as many rounds as they are worth, (models,)."""
        if self.effort == 0.0 or self._allowed <= 0.0:
            return np.zeros_like(self.wanted)
        return self._hits(np.maximum(self._efforts, self._most)) < self._needed()

    def searched(self) -> Flags:
        """Which models the next round is for, (models,): of many the wanted ones not served yet, else all wanted."""
        # Of no more than a round affords all are searched, or plants lose what is hard to find (29 of 30 → 27).
        short = self.unserved()
        return short if short.any() and len(short) > MODELS_A_ROUND else self.wanted

    def share(self) -> float:
        """The part of a full round that the next one needs be: as much as is missing."""
        if self._allowed <= 0.0:
            return 1.0
        if self.effort == 0.0:
            return FIRST_ROUND
        most, waited = max(MOST_ROUND, self.effort), self.wanted & ~self.beyond_reach()
        if not waited.any():
            return most
        missing = np.maximum(0.0, self._needed() - self._hits(self._efforts))
        a_round = self._by_surface(self._efforts) / np.maximum(self._efforts, 1e-300)
        rounds = (missing / np.maximum(a_round, 1e-300))[waited].max()
        return float(np.clip(ROUND_MARGIN * rounds, LEAST_ROUND, most))

    def _needed(self) -> float:
        """Hits foreseen that make the chance to have met none the one allowed."""
        return -log(self._allowed) if self._allowed > 0.0 else inf

    def _hits(self, efforts: Floats) -> Floats:
        """Hits foreseen of an instance of each model after so many full rounds, (models,)."""
        return self._by_surface(efforts) + believed_of_others(*self._by_lines.T) + self._told_by_lines

    def _by_surface(self, efforts: Floats) -> Floats:
        """The same by pairs of surface alone."""
        # Never less than is believed of a model that nobody saw: nothing is searched longer for having been seen.
        foreseen = self._finds * self.right * efforts / np.maximum(self._efforts, 1e-300)
        return np.maximum(efforts * believed_of_others(self._learned[:, 0], self._learned[:, 1]), foreseen)


def believed_of_others(hits: Floats, shown: Floats) -> Floats:
    """What instances found tell of those that were not: hits for each unit of what was shown, less what was easy."""
    return np.asarray(LEARNT * hits / np.maximum(shown, 1e-300))
