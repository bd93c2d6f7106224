"""One hash table for several models: what a pair of scene points is looked up in (paper 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import LibraryError
from scanfind.library.pairs import PairTable, key_count
from scanfind.threads import each_in_threads

if TYPE_CHECKING:
    from scanfind.library.model import Model


class JointTable(NamedTuple):
    """The pairs of several models by key, in CSR form: pairs offsets[k] … offsets[k + 1] have key k.

    offsets : (C + 1,) int64 over the C keys
    model, first, second : (K,) int32, the model's place in the list and its two samples; sorted by model within a key
    """

    offsets: NDArray[np.int64]
    model: NDArray[np.int32]
    first: NDArray[np.int32]
    second: NDArray[np.int32]

    def entries_of(self, models: NDArray[np.bool_]) -> NDArray[np.int64]:
        """How many pairs of some models, (models,), have each key, (C,)."""
        if models.all():
            return np.diff(self.offsets)
        before = np.concatenate([[0], np.cumsum(models[self.model], dtype=np.int64)])
        return np.diff(before[self.offsets])


def joint_table(
    models: Sequence[Model], among: NDArray[np.bool_] | None = None, *, each_once: bool = False, jobs: int = 1
) -> JointTable:
    """One hash table for several models, so that a pair of scene points is looked up once (paper 3.4).

    among : (models,) whose pairs are wanted; None: all
    each_once : of pairs that a model's symmetry maps onto one another only one: their hypotheses look the same
    jobs : threads that make the pairs nobody has asked for yet

    Raises LibraryError for no models, or models whose keys do not mean the same.
    """
    layouts = {(m.parameters.pairs.angle_cell_deg, m.parameters.pairs.rungs_per_octave) for m in models}
    if len(layouts) != 1:
        what = f"(angle_cell_deg, rungs_per_octave) {sorted(layouts)}" if layouts else "no models"
        msg = f"models searched together must share one layout of keys, got {what}; add them with the same parameters"
        raise LibraryError(msg)
    cells = key_count(models[0].parameters.pairs)
    numbers = np.arange(len(models)) if among is None else np.flatnonzero(among)
    wanted = [models[number] for number in numbers.tolist()]
    tables = each_in_threads(jobs, wanted, lambda model: pairs_once(model) if each_once else model.pairs)
    offsets = np.zeros(cells + 1, np.int64)
    for pairs in tables:
        offsets[1:] += np.bincount(pairs.keys, minlength=cells)
    np.cumsum(offsets, out=offsets)
    table = JointTable(offsets, *(np.empty(offsets[-1], np.int32) for _ in range(3)))
    # Each model's keys are sorted already: a pair goes to its cell's next free place plus its rank within the cell.
    free = offsets[:-1].copy()
    for number, pairs in zip(numbers, tables, strict=True):
        counts = np.bincount(pairs.keys, minlength=cells)
        starts = np.cumsum(counts) - counts
        place = (free - starts)[pairs.keys] + np.arange(len(pairs.keys))
        table.model[place], table.first[place], table.second[place] = number, pairs.first, pairs.second
        free += counts
    return table


def pairs_once(model: Model) -> PairTable:
    """The pairs of a model but for those that its symmetry makes of others: whose first sample stands for its like."""
    kept = model.symmetry.stands_for_its_like(model.samples.points)[model.pairs.first]
    return PairTable(*(column[kept] for column in model.pairs))
