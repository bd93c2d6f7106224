"""Which models could stand in each other's place: one section, other lengths.

The shorter of two beams that were swapped lies wholly on the longer one, and of the longer one a few per cent are
missing at its ends: each of them, asked alone, looks like itself. Asked together, both places say whose they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
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


def sides_of(model: Model) -> Floats:
    """The sides of the box about a model, shortest first, (3,) metres."""
    return np.sort(np.ptp(model.samples.points, axis=0))


def are_alike(one: Model, other: Model) -> bool:
    """Could one be taken for the other at a glance, and told from it at a second one?"""
    here, there = sides_of(one), sides_of(other)
    section, longer = np.abs(here - there)[:2].max(), abs(here[2] - there[2])
    return bool(section < SECTION_M and LONGER_M < longer < LONGER * max(here[2], there[2]))


def pairs_alike(models: Sequence[Model]) -> set[tuple[int, int]]:
    """Numbers of the models that could be taken for each other, the lower first."""
    return {(one, other) for one, other in combinations(range(len(models)), 2) if are_alike(models[one], models[other])}


def onto(model: Model, other: Model) -> list[Pose]:
    """What puts a model where another is, side along side and middle to middle: in each of four ways round."""
    frames, middles = [], []
    for each in (model, other):
        points = each.samples.points
        axes = np.eye(3)[np.argsort(-np.ptp(points, axis=0), kind="stable")]
        axes[2] *= np.linalg.det(axes)
        frames.append(axes)
        middles.append(0.5 * (points.min(axis=0) + points.max(axis=0)))
    found = []
    for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        turn = frames[1].T @ np.diag(signs) @ frames[0]
        found.append(Pose(turn, middles[1] - turn @ middles[0]))
    return found


def explained(spoken: Spoken) -> float:
    """How much surface a pose explains, m²: that is there, less that which should be and is not."""
    return spoken.on - spoken.beside - spoken.through


def looked_at(spoken: Spoken) -> float:
    """How much surface scanners looked at, m²."""
    return spoken.on + spoken.beside + spoken.through
