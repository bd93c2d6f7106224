"""What a rival has to offer: trained on a model, it proposes poses in a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from scanfind.cloud import OrientedCloud
from scanfind.pose import Pose

# (scene at one voxel, seed) → scene_from_model, best first. One try; the child makes several.
Matcher = Callable[[OrientedCloud, int], list[Pose]]


@dataclass(frozen=True)
class Model:
    """What a rival is trained on: the model at one voxel, as the scene will look. Lengths in metres."""

    cloud: OrientedCloud
    voxel: float
    diameter: float


def trainer(where: str) -> Callable[[Model], Matcher]:
    """The function that `module:function` names: what can be done before a scene is seen is done there."""
    module, _, name = where.partition(":")
    train: Callable[[Model], Matcher] = getattr(import_module(module), name)
    return train
