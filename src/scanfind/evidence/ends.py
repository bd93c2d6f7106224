"""Where a part ends along a motion that its faces leave open: what slides along itself is stopped by its ends alone.

ICP cannot tell: an end is a few square centimetres, and what a beam adjoins lies flush with it. But beams that go past
an end, and beams that end where it should be empty, tell on which side of each other the end and its design are. Each
beam speaks for the places along the motion where the part would have stopped it where it stopped, and against those
where it went on behind the part's surface; the place most speak for holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.free_space import Limits, beams_to, covers_of
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.evidence.neighbours import Design
    from scanfind.evidence.rays import RayCaster
    from scanfind.grid.depth import Beams
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

REACH_M = 0.15  # to either side: how far ICP may have slid, and an element may have been moved
COARSE, FINE_M = 31, 0.001  # beams that say the same in all of so many places say nothing; then a millimetre a place
# Where so many beams less speak for a place than for the best, or so large a share of those that tell, it is not near.
LEAST_LEAD, LEAD = 40, 0.2
# Were each beam that changes its mind between two places a coin, the difference would be within so many times the root
# of their number. Of the elements of a tuning scene that were not moved one exceeded it, along a neighbour's flange.
SURE = 3.0
AGREE = 2.0  # faces and ends that are farther apart than so many standard deviations speak of different things
FIXED = 3.0  # a slide of less than so many times its standard deviation is none


class Slid(NamedTuple):
    """How far along a motion a part stands from a pose of it, and the standard deviation of that; metres."""

    by: float
    sigma: float


def slid(
    model: Model, caster: RayCaster, placed: Pose, along: Floats, design: float | None, scanners: Sequence[Beams],
    limits: Limits, neighbours: Design | None = None, offset: Floats | None = None,
) -> Slid | None:  # fmt: skip
    """How far a placed model has to slide for its ends to be where beams say.

    None where they do not refute the design or, of one that stands anywhere, leave it open.

    placed : scene_from_model, relative to the grid's offset; along : (3,) unit direction of the slide, scene axes
    design : where along it the design has the model, metres from `placed`; None: it was moved, and stands anywhere
    neighbours, offset : the whole design: what ended on others of it speaks for none; the grid's offset, (3,)
    """
    if design is not None and abs(design) >= REACH_M:
        return None
    coarse = np.linspace(-REACH_M, REACH_M, COARSE)
    swept = covers_of(model, placed, swept=coarse[::5, None] * along)
    # Most beams of fifty rooms end before they are anywhere near: they say nothing, wherever it stands.
    short = 2.5 * (coarse[1] - coarse[0]) + limits.inlier / limits.facing
    beams, back = beams_to(swept, scanners, short=short), placed.inverse()
    origins, directions, way = back.move(beams.origins), beams.directions @ placed.rotation, back.turn(along[None])[0]
    near = comes_near(model, REACH_M * way, origins, directions, beams.ranges + limits.inlier / limits.facing)
    beams, origins, directions = beams.take(near), origins[near], directions[near]

    def votes(step: float, some: NDArray[np.intp]) -> NDArray[np.int8]:
        hits = caster.shoot(origins[some] - step * way, directions[some])
        met = np.isfinite(hits.distance) & (hits.cosine >= limits.facing)
        behind = beams.ranges[some] - np.where(met, hits.distance, 0.0)
        on = met & (np.abs(behind) * hits.cosine <= limits.inlier)
        return on.astype(np.int8) - (met & (behind > limits.margin)).astype(np.int8)

    every = np.arange(len(beams.ranges))
    said = np.stack([votes(step, every) for step in coarse])
    telling = np.flatnonzero((said != said[0]).any(axis=0))
    if neighbours is not None:
        theirs = beams.take(telling).moved(np.zeros(3) if offset is None else offset)
        met = neighbours.met(model.name, theirs.origins, theirs.directions, theirs.ranges, limits.inlier)
        telling = telling[~met]
    if not len(telling):
        return None
    roughly = said[:, telling].sum(axis=1, dtype=np.int64)
    likely = coarse[roughly >= roughly.max() - max(LEAST_LEAD, LEAD * len(telling))]
    steps = np.arange(-REACH_M, REACH_M + 0.5 * FINE_M, FINE_M)
    steps = steps[(np.abs(steps[:, None] - likely) < 1.5 * (coarse[1] - coarse[0])).any(axis=1)]
    sums = np.array([votes(step, telling).sum(dtype=np.int64) for step in steps], np.float64)
    weight = np.exp(sums - sums.max())
    weight /= weight.sum()
    by = float(weight @ steps)
    sigma = max(float(np.sqrt(weight @ (steps - by) ** 2)), FINE_M)
    if abs(by) + FIXED * sigma >= REACH_M:
        return None
    if design is not None:
        here, there = votes(by, telling), votes(design, telling)
        gain, changed = int(here.sum(dtype=np.int64) - there.sum(dtype=np.int64)), int(np.count_nonzero(here != there))
        if abs(by - design) < FIXED * sigma or gain <= SURE * np.sqrt(changed):
            return None
    return Slid(by, sigma)


def comes_near(model: Model, reach: Floats, origins: Floats, directions: Floats, ranges: Floats) -> NDArray[np.intp]:
    """Which beams come into the box of a model swept by ± reach (3,); all in its own frame, metres."""
    corners = model.samples.points if model.mesh is None else model.mesh.vertices
    far = np.abs(reach) + model.spacing
    low, high = corners.min(axis=0) - far, corners.max(axis=0) + far
    with np.errstate(divide="ignore", invalid="ignore"):  # along a face
        one, other = (low - origins) / directions, (high - origins) / directions
    entry, exit_ = np.fmin(one, other).max(axis=1), np.fmax(one, other).min(axis=1)
    return np.flatnonzero((entry <= exit_) & (exit_ > 0.0) & (ranges >= entry))


def with_faces(told: Slid, variance: float) -> Slid:
    """What ends say of a slide, and faces that put it at 0 with a variance, m²; 0: they say nothing of it.

    Where the two disagree the ends are believed: faces take a neighbour's for their own where the two are flush.
    """
    if variance <= 0.0 or told.by**2 > AGREE**2 * (told.sigma**2 + variance):
        return told
    share = variance / (variance + told.sigma**2)
    return Slid(share * told.by, float(np.sqrt(share) * told.sigma))
