"""Which models could stand in each other's place: one section, other lengths.

The shorter of two beams that were swapped lies wholly on the longer one, and of the longer one a few per cent are
missing at its ends: each of them, asked alone, looks like itself. Asked together, both places say whose they are.
"""

from __future__ import annotations

from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.evidence.free_space import Spoken
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

# By how much the sections' sides differ at most, and the lengths: of one length, nothing tells them apart.
SECTION_M, LONGER_M, LONGER = 0.02, 0.015, 0.25
# Of what scanners looked at, so much more must be explained in both places. What is known of a share is known to half a
# per cent, and here the same beams are asked of both.
GAIN = 0.005
ROUGH_GAIN = 0.02  # before it is fitted what stands there may seem to explain so much less


def sides_of(model: Model) -> Floats:
    """The sides of the box about a model, shortest first, (3,) metres."""
    return np.sort(np.ptp(model.samples.points, axis=0))


def pairs_alike(sides: Floats) -> set[tuple[int, int]]:
    """Numbers of the models that could be taken for each other at a glance, and told apart at a second one, the lower
    first; sides : (models, 3) of each, as `sides_of` has them.
    """
    one, other = np.triu_indices(len(sides), 1)
    off, longest = np.abs(sides[one] - sides[other]), np.maximum(sides[one, 2], sides[other, 2])
    alike = (off[:, :2].max(axis=1) < SECTION_M) & (off[:, 2] > LONGER_M) & (off[:, 2] < LONGER * longest)
    return set(zip(one[alike].tolist(), other[alike].tolist(), strict=True))


def onto(model: Model, other: Model) -> list[Pose]:
    """What puts a model where another is, middle to middle and sides along sides of about their length: in each way."""
    boxes = [(each.samples.points.min(axis=0), each.samples.points.max(axis=0)) for each in (model, other)]
    (mine, my_middle), (theirs, middle) = ((high - low, 0.5 * (low + high)) for low, high in boxes)
    sides = list(permutations(range(3)))
    turns = [np.diag(signs)[list(order)] for order in sides for signs in product((1.0, -1.0), repeat=3)]
    turns = [turn for turn in turns if np.linalg.det(turn) > 0.0]
    misfit = np.array([np.abs(np.abs(turn) @ mine - theirs).max() for turn in turns])
    ways = np.flatnonzero(misfit < misfit.min() + SECTION_M)
    return [Pose(turns[k], middle - turns[k] @ my_middle) for k in ways]


def explained(spoken: Spoken) -> float:
    """How much surface a pose explains, m²: that is there, less that which should be and is not."""
    return spoken.on - spoken.beside - spoken.through


def more_explained(instead: Spoken, stands: Spoken) -> float:
    """How much more one explains than another in the same place, as a share of what was looked at of that other."""
    return (explained(instead) - explained(stands)) / max(stands.looked_at(), 1e-300)


def missing(spoken: Spoken) -> float:
    """The share of the surface looked at that is not there."""
    return (spoken.beside + spoken.through) / max(spoken.looked_at(), 1e-300)
