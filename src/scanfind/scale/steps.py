"""Models in several sizes: what a scan of unknown scale may show of them."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, log
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.symmetry import Symmetry

if TYPE_CHECKING:
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

# From one size to the next, so that a scan is off the nearest by at most half of it. Of the spool in shops 0.75 of its
# samples lie on the scan at the right size, 0.60 at one 1.2 % off, 0.53 at 2.4 %, 0.36 at 4.9 %: as much as of wrong
# poses.
STEP = 0.035


def sizes_tried(share: float) -> Floats:
    """The sizes of models in a scan that is off by up to `share`, units of the scan a metre, evenly by ratio (K,)."""
    low, high = 1.0 - share, 1.0 + share
    return np.geomspace(low, high, ceil(log(high / low) / STEP) + 1)


def sized(model: Model, units: float) -> Model:
    """A model as a scan with so many units a metre shows it."""
    samples = OrientedCloud(units * model.samples.points, model.samples.normals, model.samples.signed)
    return replace(
        model, diameter=units * model.diameter, spacing=units * model.spacing, area=units**2 * model.area,
        samples=samples, mesh=None if model.mesh is None else model.mesh.scaled(units),
        cloud=None if model.cloud is None else replace(model.cloud, points=units * model.cloud.points),
        symmetry=Symmetry(units * model.symmetry.centre, model.symmetry.axes), similar=(),
    )  # fmt: skip
