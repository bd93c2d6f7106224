"""Verification: what the whole scene says of a refined pose, and which of several poses may claim a surface.

Support is the paper's λs = ms/m (3.4); penalty is Papazov & Burschka's (2010): surface a beam has passed through (see
free_space). Surface hidden behind something is no evidence at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import require
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.evidence.free_space import Spoken
    from scanfind.grid.depth import DepthMap
    from scanfind.grid.scene import Scene
    from scanfind.grid.surfels import Surfels
    from scanfind.search.hypotheses import Hypotheses, ModelArrays

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class VerifyParameters:
    """When a pose is believed.

    min_score : least score of a detection
    min_support : least share of samples on the scene
    min_support_blind : the same where no scanner position is known and free space can say nothing
    gate_cells : a sample is supported by a surfel at most this far away, in cells …
    inlier_noises, inlier_cells : … whose plane it meets within so many times the scan's noise and so much of a cell: a
        bent surface leaves the plane of a surfel by h²/8r, a twentieth of a cell on a pipe as wide as five cells
    normal_agreement : least cosine between a sample's and its surfel's normal
    margin_inliers, margin_cells : a beam passed through a sample if it went on so far behind it
    least_facing : cosine to the beam below which a surface may return nothing
    penalty_weight : how much surface that beams passed through counts against as much on the scan; 0: the paper, which
        looks at support
    beside_weight : the same for surface beside which they ended, of a pose that explains much (WELL_EXPLAINED)
    shared : share of its support a detection may have in common with a better one
    alternatives : how many poses a model could be mistaken for, by its own symmetry, are tried against the best
    """

    min_score: float = 0.9
    min_support: float = 0.1
    min_support_blind: float = 0.35
    gate_cells: float = 1.0
    inlier_noises: float = 3.0
    inlier_cells: float = 0.15
    normal_agreement: float = 0.8
    margin_inliers: float = 2.0
    margin_cells: float = 1.0
    least_facing: float = 0.25
    penalty_weight: float = 20.0
    beside_weight: float = 0.75
    shared: float = 0.2
    alternatives: int = 24

    def __post_init__(self) -> None:
        for name in ("min_score", "min_support", "min_support_blind", "normal_agreement", "least_facing", "shared"):
            require(0.0 <= getattr(self, name) <= 1.0, name, getattr(self, name), "from 0 to 1")
        require(0.0 < self.gate_cells <= 4.0, "gate_cells", self.gate_cells, "above 0 and at most 4")
        for name in (
            "inlier_noises",
            "inlier_cells",
            "margin_inliers",
            "margin_cells",
            "penalty_weight",
            "beside_weight",
        ):
            require(getattr(self, name) >= 0.0, name, getattr(self, name), "0 or more")
        require(self.alternatives >= 0, "alternatives", self.alternatives, "0 or more")


# Share of a model's surface that scans from a few sides show: full marks where nothing tells hidden from missing.
EXPECTED_BLIND = 0.5
BELIEVED_SUPPORT = 0.04
# Telling share of a pose that explains so much of its surroundings that it may be off here and there, as built things
# are (a spool 6 mm long with a flange askew: 5 % beside). Of one that explains less, beside counts more in proportion.
WELL_EXPLAINED = 0.5
# Where the model is not known to the noise it does not, and through counts so much: a piece of scan has ragged edges,
# parts that are fitted one by one were not built to the drawing, and neighbours lean on an element in its place.
ROUGHLY_THROUGH = 0.3
# On the coarse level a sample seen through counts so much against one supported: there many are by mistake.
ROUGH_WEIGHT = 2.0
# Points in a coarse cell up to which the eight fine ones in it are mostly empty.
THIN_POINTS = 2.0


class Evidence(NamedTuple):
    """What the scene says of the samples of one pose.

    samples : N; supported : how many of them lie on the scene
    telling : share of all samples that are supported, each counted by how much its surfel tells (Search.telling)
    rms : of the supported samples' distances to the scene, metres
    spoken : what the beams say of the surface
    claims : surfels that support it, ascending
    lines : of its lines, how much lies on the scene's beyond chance (lines.LineSearch); 0 where these were not asked
    rough : the model is not known to the noise
    """

    samples: int
    supported: int
    telling: float
    rms: float
    spoken: Spoken
    claims: NDArray[np.intp]
    lines: float = 0.0
    rough: bool = False

    def there(self, parameters: VerifyParameters, *, in_place: bool = False) -> float:
        """The share of the looked-at surface that is there, where what is not counts by its weights; see `score`."""
        on, beside, through, _ = self.spoken
        if not on:
            return 0.0
        rough = self.rough or in_place
        beside *= parameters.beside_weight * (1.0 if rough else max(1.0, WELL_EXPLAINED / max(self.telling, 1e-9)))
        through *= parameters.penalty_weight * (ROUGHLY_THROUGH if rough else 1.0)
        return on / (on + beside + through)

    def support(self) -> float:
        """The paper's λs."""
        return self.supported / self.samples

    def penalty(self) -> float:
        """Papazov & Burschka's share of the surface that occludes what was seen behind it, of all that beams asked."""
        asked = sum(self.spoken)
        return self.spoken.through / asked if asked else 0.0

    def visible_support(self) -> float:
        """Share of the surface the scanners could see that is there."""
        seen = self.spoken.looked_at()
        return self.spoken.on / seen if seen else 0.0


def score(evidence: Evidence, blind: bool, parameters: VerifyParameters, *, in_place: bool = False) -> float:
    """0 … 1: the share of the looked-at surface that is there, less the weighted share that is not (Papazov 2010).

    blind : no scanner position is known; then only support speaks, and half the surface is all that is expected of it
    in_place : the design puts it there, so that it is not there by chance, whatever its shape
    """
    if blind:
        return min(1.0, evidence.support() / EXPECTED_BLIND)
    if in_place:
        return evidence.there(parameters, in_place=True)
    # Few supported samples can agree by chance: the visible share is believed as far as their number goes. More than
    # half of a part lies on no floor or wall, whatever its shape tells: where a scan shows it alone, nothing tells.
    believed = evidence.telling + max(0.0, evidence.support() - 0.5) + evidence.lines
    return evidence.there(parameters) * float(1.0 - np.exp(-believed / BELIEVED_SUPPORT))


def rough_score(rough: Rough, blind: bool) -> float:
    """The same from the coarse level, but for how much the supported surface tells."""
    if blind:
        return min(1.0, rough.supported / rough.samples / EXPECTED_BLIND)
    spoken = rough.supported + ROUGH_WEIGHT * spread(rough.seen_through, rough.hidden, rough.silent)
    return rough.supported / spoken if spoken else 0.0


def why_refused(evidence: Evidence, blind: bool, parameters: VerifyParameters, *, in_place: bool = False) -> str:
    """Why a pose is not believed, in words; empty where it is.

    in_place : see `score`; beams tell how much of it shows then, and not surfels, which know no flat bar of 8 mm
    """
    least = parameters.min_support_blind if blind else parameters.min_support
    if (blind or not in_place) and max(evidence.support(), evidence.lines) < least:
        return f"only {evidence.support():.0%} of its surface lies on the scan, {least:.0%} is asked for"
    if score(evidence, blind, parameters, in_place=in_place) >= parameters.min_score:
        return ""
    if blind:
        return f"{evidence.support():.0%} of its surface lies on the scan, and no free space is known to tell more"
    _, beside, through, _ = evidence.spoken
    seen = max(evidence.spoken.looked_at(), 1e-300)
    if evidence.there(parameters, in_place=in_place) < parameters.min_score:
        if parameters.penalty_weight * through < parameters.beside_weight * beside:
            return f"{beside / seen:.0%} of the surface that scanners should have seen lies beside what they saw"
        return f"beams passed through {through / seen:.0%} of the surface that scanners should have seen"
    reached = f"score {score(evidence, blind, parameters):.4f}, {parameters.min_score} is asked for"
    return f"what lies on the scan is too little, or of a shape the scan is full of (floors, walls), to tell: {reached}"


class Level(NamedTuple):
    """A level of the scene that samples are held against.

    surfels : fitted around the poses; telling : (V,) how much those of each cell tell (Search.telling)
    samples : at most so many of each model; inlier : metres, see VerifyParameters
    """

    surfels: Surfels
    telling: Floats
    samples: int
    inlier: float

    def margin(self, parameters: VerifyParameters) -> float:
        """How far behind a surface a beam must have gone on to have passed through it, metres."""
        return parameters.margin_inliers * self.inlier + parameters.margin_cells * self.surfels.cell


class Held(NamedTuple):
    """What a level says of each sample of some poses, end to end: see kernels.evidence.

    ends : (H,) where each pose's samples end; states, residuals, claims : a sample each
    """

    ends: NDArray[np.int64]
    states: NDArray[np.uint8]
    residuals: NDArray[np.float32]
    claims: NDArray[np.int32]

    def poses(self) -> Iterator[slice]:
        """The samples of each pose."""
        return map(slice, np.concatenate([[0], self.ends[:-1]]).tolist(), self.ends.tolist())


class Rough(NamedTuple):
    """What a level and the depth maps say of the samples of one pose: how many are what."""

    samples: int
    supported: int
    seen_through: int
    hidden: int
    silent: int


class Supported(NamedTuple):
    """How much of one pose lies on the scene: see Evidence."""

    samples: int
    supported: int
    telling: float
    rms: float
    claims: NDArray[np.intp]


def gather_rough(
    hypotheses: Hypotheses, scene: Scene, level: Level, arrays: ModelArrays, signed: bool,
    parameters: VerifyParameters, jobs: int,
) -> list[Rough]:  # fmt: skip
    """What a level and the depth maps say of each of H hypotheses."""
    from scanfind.kernels.evidence import HIDDEN, SEEN_THROUGH, SILENT, SUPPORTED

    held = held_against(hypotheses, scene, level, scene.depths, arrays, signed, parameters, jobs)
    return [
        Rough(len(state), *(int(np.count_nonzero(state == of)) for of in (SUPPORTED, SEEN_THROUGH, HIDDEN, SILENT)))
        for state in (held.states[samples] for samples in held.poses())
    ]


def gather_support(
    hypotheses: Hypotheses, scene: Scene, level: Level, thin: Level | None, arrays: ModelArrays, signed: bool,
    parameters: VerifyParameters, jobs: int,
) -> list[Supported]:  # fmt: skip
    """How much of each of H hypotheses lies on the scene.

    thin : a coarser level, which speaks where its cells hold so few points that the cells of `level` are mostly empty
    """
    from scanfind.kernels.evidence import SUPPORTED

    held = held_against(hypotheses, scene, level, [], arrays, signed, parameters, jobs)
    _, states, residuals, claims = held
    tells = np.where(claims >= 0, level.telling[level.surfels.cell_of[claims]], 0.0)
    if thin is not None:
        _, others, apart, lent = held_against(hypotheses, scene, thin, [], arrays, signed, parameters, jobs)
        lends = (states != SUPPORTED) & (others == SUPPORTED)
        lends[lends] = thin.surfels.points[lent[lends]] <= THIN_POINTS
        states[lends], residuals[lends] = SUPPORTED, apart[lends]
        tells[lends] = thin.telling[thin.surfels.cell_of[lent[lends]]]
    found = []
    for samples in held.poses():
        claim, on = claims[samples], states[samples] == SUPPORTED
        squares = residuals[samples][on].astype(np.float64) ** 2
        found.append(
            Supported(
                len(on), int(np.count_nonzero(on)), float(tells[samples].sum()) / len(on),
                float(np.sqrt(squares.mean())) if len(squares) else float("inf"),
                np.unique(claim[claim >= 0]).astype(np.intp),
            )
        )  # fmt: skip
    return found


def held_against(
    hypotheses: Hypotheses, scene: Scene, level: Level, depths: Sequence[DepthMap], arrays: ModelArrays, signed: bool,
    parameters: VerifyParameters, jobs: int,
) -> Held:  # fmt: skip
    """What a level, and depth maps, say of each sample of H hypotheses."""
    from scanfind.kernels.evidence import gather_evidence

    sizes = np.minimum(arrays.starts[1:] - arrays.starts[:-1], level.samples)[hypotheses.models]
    ends, total = np.cumsum(sizes), int(sizes.sum())
    states, residuals, claims = np.empty(total, np.uint8), np.empty(total, np.float32), np.empty(total, np.int32)
    surfels, cells, cell = level.surfels, level.surfels.cells, level.surfels.cell
    edge = depths[0].edge if depths else 1
    origins = np.array([depth.origin for depth in depths]).reshape(-1, 3)
    ranges = np.array([depth.ranges for depth in depths], np.float32).reshape(-1, 6 * edge**2)
    margin = level.margin(parameters)
    in_threads(
        jobs, len(sizes),
        lambda start, stop: gather_evidence(
            start, stop, hypotheses.models, arrays.starts, arrays.points, arrays.normals, level.samples,
            hypotheses.rotations, hypotheses.translations, parameters.gate_cells * cell, level.inlier,
            parameters.normal_agreement, signed, cell, cells.hash_keys, cells.hash_values, cells.filled,
            cells.block_rows, surfels.first_surfel, surfels.sides, surfels.means, surfels.normals, origins, ranges,
            edge, margin, parameters.least_facing, ends - sizes, states, residuals, claims,
        ),
    )  # fmt: skip
    return Held(ends, states, residuals, claims)


def spread(through: int, hidden: int, silent: int) -> int:
    """How many samples beams would have passed through, had there been beams enough to ask of all: the silent ones are
    like those that spoke.
    """
    return through + round(silent * through / (through + hidden)) if through else 0


def distinct(
    hypotheses: Hypotheses, arrays: ModelArrays, apart: Floats, most: int | None = None, in_all: int | None = None,
    known: Hypotheses | None = None,
) -> NDArray[np.intp]:  # fmt: skip
    """The first of each group of poses that nearly coincide (indices), at most `most` of each model and `in_all`.

        apart : (models,) metres; poses that move no point of the model's outline farther than this are one
        known : poses whose groups are left out

    Thousands of poses that roll about a straight pipe pass the sequential test; one of each group is refined.
    """
    from scanfind.kernels.apart import first_apart

    every = len(hypotheses.models)
    met = known if known is not None else hypotheses.take(np.empty(0, np.intp))
    kept = np.empty(every, np.int64)
    count = first_apart(
        outlines(hypotheses, arrays), hypotheses.models, apart, outlines(met, arrays), met.models,
        every if most is None else most, every if in_all is None else in_all, kept,
    )  # fmt: skip
    return kept[:count]


def outlines(hypotheses: Hypotheses, arrays: ModelArrays) -> Floats:
    """Seven points of each placed model, (H, 7, 3): its centre, and its radius away along each axis."""
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    points = arrays.centres[hypotheses.models][:, None] + arrays.radii[hypotheses.models][:, None, None] * corners
    return np.asarray(np.einsum("hij,hkj->hki", hypotheses.rotations, points) + hypotheses.translations[:, None])


def distances(outline: Floats, others: Floats) -> Floats:
    """How far a pose moves the farthest of its seven points from another's, (H,), metres."""
    return np.asarray(np.linalg.norm(others - outline, axis=2).max(axis=1))


def nearest(some: Floats, others: Floats) -> Floats:
    """Of each of some outlines (H, 7, 3) how far it is from the nearest of others (K, 7, 3), (H,); inf of none."""
    found = np.full(len(some), np.inf)
    for other in others:
        np.minimum(found, np.linalg.norm(some - other, axis=2).max(axis=1), out=found)
    return found
