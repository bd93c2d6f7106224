"""Which poses are thought of at all: a hypothesis that no user would believe is given up before it is tested."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.kernels.jit import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Allowed(NamedTuple):
    """What is known of the poses of some models; scene coordinates are relative to the grid's offset.

    known : False: nothing is, and every pose is allowed
    centres : (models, 3) their middles, model frame
    box : (2, 3) low and high corner of where these may be
    up : (3,) unit, the scene's
    cones : (K, 5) a unit direction of the model, and the least and most cosine it may make with `up`: one must hold
    cone_starts : (models+1,) where each model's begin; a model with none may lean anyhow
    places : (P, 4) where a model's middle may be, and how far from there, metres: one must hold
    place_starts : (models+1,) likewise
    """

    known: bool
    centres: Floats
    box: Floats
    up: Floats
    cones: Floats
    cone_starts: Ints
    places: Floats
    place_starts: Ints


@kernel
def may_be(allowed, which, rotation, translation):
    """May model number `which` have this pose, rotation (3, 3) and translation (3,) scene_from_model?"""
    if not allowed.known:
        return True
    mx, my, mz = allowed.centres[which, 0], allowed.centres[which, 1], allowed.centres[which, 2]
    x = rotation[0, 0] * mx + rotation[0, 1] * my + rotation[0, 2] * mz + translation[0]
    y = rotation[1, 0] * mx + rotation[1, 1] * my + rotation[1, 2] * mz + translation[1]
    z = rotation[2, 0] * mx + rotation[2, 1] * my + rotation[2, 2] * mz + translation[2]
    box = allowed.box
    if not (box[0, 0] <= x <= box[1, 0] and box[0, 1] <= y <= box[1, 1] and box[0, 2] <= z <= box[1, 2]):
        return False
    first, last = allowed.cone_starts[which], allowed.cone_starts[which + 1]
    if first < last:
        up = allowed.up
        ux = rotation[0, 0] * up[0] + rotation[1, 0] * up[1] + rotation[2, 0] * up[2]
        uy = rotation[0, 1] * up[0] + rotation[1, 1] * up[1] + rotation[2, 1] * up[2]
        uz = rotation[0, 2] * up[0] + rotation[1, 2] * up[1] + rotation[2, 2] * up[2]
        upright = False
        for k in range(first, last):
            cosine = ux * allowed.cones[k, 0] + uy * allowed.cones[k, 1] + uz * allowed.cones[k, 2]
            if allowed.cones[k, 3] <= cosine <= allowed.cones[k, 4]:
                upright = True
                break
        if not upright:
            return False
    first, last = allowed.place_starts[which], allowed.place_starts[which + 1]
    for k in range(first, last):
        dx, dy, dz = x - allowed.places[k, 0], y - allowed.places[k, 1], z - allowed.places[k, 2]
        if dx * dx + dy * dy + dz * dz <= allowed.places[k, 3] ** 2:
            return True
    return first == last
