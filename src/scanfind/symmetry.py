"""Motions that bring much of a model onto itself: the wrong poses a search is most likely to take for the right one.

The box frame of the paper, turned over, still covers nine tenths of itself. Such poses are tried against the best one
before it is believed.
"""

from __future__ import annotations

from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.model import Model

Floats = NDArray[np.float64]

SAMPLES_TRIED = 200
# Below this a motion leads to another pose altogether, which the search would find by itself.
LEAST_OVERLAP = 0.35


def self_similar(model: Model, most: int = 24) -> list[Pose]:
    """Motions model_from_model, other than none, that bring at least `LEAST_OVERLAP` of the samples onto samples.

    Tried are the 23 turns of a cube about the middle of the model's box, along its own axes and along its principal
    ones; the best `most` are returned, best first.
    """
    from scanfind.kernels.overlap import self_overlap

    points, normals = model.samples.points, model.samples.normals
    centred = points - points.mean(axis=0)
    principal = np.linalg.svd(centred, full_matrices=False)[2]
    principal[2] *= np.sign(np.linalg.det(principal))
    found: list[tuple[float, Pose]] = []
    for axes in (np.eye(3), principal):
        along = points @ axes.T
        middle = 0.5 * (along.min(axis=0) + along.max(axis=0)) @ axes
        for turn in cube_turns():
            rotation = axes.T @ turn @ axes
            pose = Pose(rotation, middle - rotation @ middle)
            if any(pose.difference(other)[1] < 0.05 for _, other in [(1.0, Pose.identity()), *found]):
                continue
            overlap = float(
                self_overlap(
                    points, normals, min(SAMPLES_TRIED, len(points)), pose.rotation, pose.translation, 2 * model.spacing
                )
            )
            if overlap >= LEAST_OVERLAP:
                found.append((overlap, pose))
    found.sort(key=lambda pair: -pair[0])
    return [pose for _, pose in found[:most]]


def cube_turns() -> list[Floats]:
    """The 24 rotations (3, 3) that map the coordinate axes onto each other."""
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[np.arange(3), order] = signs
        if np.linalg.det(turn) > 0:
            turns.append(turn)
    return turns
