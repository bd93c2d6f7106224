"""What an instance could be taken for: the model turned over onto itself, or another of the library in its place.

Of twins that differ in one branch the wrong one may be drawn first, and fit well enough: where it is believed nothing
is drawn any more, and nothing leads to the right one. So what a doubtful pose is like is tried before it is believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from scanfind.pose import Pose
from scanfind.recognition.swaps import onto, sides_of

if TYPE_CHECKING:
    from scanfind.library.model import Model

# Sides of the box about a twin differ by no more than this share of the diameter: a branch moved, a rise added.
ALIKE = 0.1
# Another model in the same place must explain so much more: of less, noise decides.
CLEARLY = 1.02


class Likenesses:
    """The poses that a pose of some models could be mistaken for."""

    def __init__(self, models: Sequence[Model], alternatives: int) -> None:
        """Take models; alternatives : see VerifyParameters."""
        self._models, self._alternatives = models, alternatives
        self._sides = np.array([sides_of(model) for model in models])
        self._twins: dict[int, dict[int, list[Pose]]] = {}

    def of_itself(self, number: int) -> list[Pose]:
        """The motions after which a model could be taken for itself. Symmetries are not tried: nothing tells."""
        return [each.motion for each in self._models[number].similar[: self._alternatives]]

    def of_others(self, number: int) -> dict[int, list[Pose]]:
        """What puts other models where this one is, by number: in its own frame, and box onto box in each way."""
        if number not in self._twins:
            model = self._models[number]
            off = np.abs(self._sides - self._sides[number]).max(axis=1)
            like = np.flatnonzero(off < ALIKE * model.diameter).tolist() if self._alternatives else []
            self._twins[number] = {
                other: [Pose.identity(), *onto(self._models[other], model)] for other in like if other != number
            }
        return self._twins[number]
