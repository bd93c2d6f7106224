"""Poses on trial, and the samples of the models they are poses of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scanfind.library.model import Model

Floats = NDArray[np.float64]


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
    """H poses of models, mostly the best first.

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

    def best_first(self) -> Hypotheses:
        """The same by their support; of equal ones the earlier is first."""
        return self.take(np.argsort(-self.support, kind="stable"))


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


def joined(parts: Sequence[Hypotheses]) -> Hypotheses:
    """Several lists of hypotheses as one."""
    models, rotations, translations, support = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Hypotheses(models, rotations, translations, support)


def no_hypotheses() -> Hypotheses:
    """None."""
    return Hypotheses(np.empty(0, np.int64), np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0))
