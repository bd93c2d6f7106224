"""Point-pair features and their keys (paper 3.2, Algorithm 1).

F = (∠(n1, d), ∠(n2, d), ∠(n1, n2)) for two oriented points at a constant distance; quantised to cells of Δθ.

The paper takes d = 0.75 ρ for its one model. A library holds models of many sizes, and a pair of scene points can be
looked up for all of them at once only if they share the distance. So distances stand on a ladder of a few rungs an
octave; a model uses the rungs next to the shares of its diameter it asks for, and the rung is part of the key.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import ceil, log2, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.errors import InvalidGeometryError, require

SHORTEST_M = 1e-3  # the ladder's foot; nothing smaller is sought with a laser scanner
OCTAVES = 17  # … and its top: 2^17 mm = 131 m


@dataclass(frozen=True)
class PairParameters:
    """How pairs are taken and hashed.

    distances : pair distances as shares of the model's diameter ρ; the paper's is 0.75. Shorter ones survive occlusion
        (the paper's spool is lost at completeness 0.798 because a long pair needs both ends): of spools that show 30 %
        these find twice as many right poses as 0.75 and 0.4, and as many of whole ones
    rungs_per_octave : how finely distances are told apart between models; 4 keeps d within 9 % of what was asked
    tolerance : half width of the distance shell, in sample spacings
    angle_cell_deg : Δθ, the edge of a hash cell, degrees
    """

    distances: tuple[float, ...] = (0.4, 0.2)
    rungs_per_octave: int = 4
    tolerance: float = 0.5
    angle_cell_deg: float = 12.0

    def __post_init__(self) -> None:
        require(
            len(self.distances) > 0 and all(0.0 < share <= 1.0 for share in self.distances),
            "distances", self.distances, "shares of the diameter, above 0 and at most 1",
        )  # fmt: skip
        require(1 <= self.rungs_per_octave <= 64, "rungs_per_octave", self.rungs_per_octave, "from 1 to 64")
        require(self.tolerance > 0.0, "tolerance", self.tolerance, "more than 0 spacings")
        require(3.0 <= self.angle_cell_deg <= 90.0, "angle_cell_deg", self.angle_cell_deg, "from 3 to 90 degrees")

    def angle_bins(self) -> int:
        """Cells along each of the three angles."""
        return ceil(180.0 / self.angle_cell_deg - 1e-9)

    @cached_property
    def edges(self) -> NDArray[np.float64]:
        """The cosines of the angles at which one cell ends and the next begins, (angle_bins - 1,)."""
        return np.asarray(np.cos(radians(self.angle_cell_deg) * np.arange(1, self.angle_bins())))

    def cells_per_rung(self) -> int:
        """Hash cells of one distance."""
        return self.angle_bins() ** 3


class PairTable(NamedTuple):
    """The pairs of one model, sorted by key (then by first, second): keys, first, second all (K,) int32."""

    keys: NDArray[np.int32]
    first: NDArray[np.int32]
    second: NDArray[np.int32]


def key_count(parameters: PairParameters) -> int:
    """How many keys there can be: rungs × hash cells."""
    return (OCTAVES * parameters.rungs_per_octave + 1) * parameters.cells_per_rung()


def rungs_of(diameter: float, parameters: PairParameters) -> list[int]:
    """The ladder's rungs a model of this diameter uses, longest first, no rung twice."""
    wanted = [log2(share * diameter / SHORTEST_M) * parameters.rungs_per_octave for share in parameters.distances]
    top = OCTAVES * parameters.rungs_per_octave
    return sorted({min(max(round(rung), 0), top) for rung in wanted}, reverse=True)


def rung_distance(rung: int, parameters: PairParameters) -> float:
    """The pair distance d of a rung, metres."""
    return float(SHORTEST_M * 2.0 ** (rung / parameters.rungs_per_octave))


def build_pairs(samples: OrientedCloud, diameter: float, spacing: float, parameters: PairParameters) -> PairTable:
    """All oriented pairs of a model's surface samples at its distances (Algorithm 1).

        samples : (N,) oriented points, model frame
        diameter : ρ, metres
        spacing : distance between neighbouring samples, metres

    Raises InvalidGeometryError for a model with fewer than two samples.
    """
    from scanfind.kernels.features import fill_pairs, sort_pairs

    require_apart(len(samples), diameter)
    points, normals = np.ascontiguousarray(samples.points.T), np.ascontiguousarray(samples.normals.T)
    cells, parts = parameters.cells_per_rung(), []
    for rung in rungs_of(diameter, parameters):
        shell = rung_distance(rung, parameters), parameters.tolerance * spacing
        counts = _partners(points, *shell)
        ends = np.cumsum(counts)
        found, in_order = (PairTable(*(np.empty(ends[-1], np.int32) for _ in range(3))) for _ in range(2))
        fill_pairs(points, normals, *shell, parameters.edges, ends - counts, *found)
        sort_pairs(*found, np.zeros(cells + 1, np.int64), *in_order)
        parts.append(in_order._replace(keys=in_order.keys + np.int32(rung * cells)))
    parts.reverse()  # lowest rung first: then the concatenation is sorted by key
    return PairTable(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def pair_count(samples: OrientedCloud, diameter: float, spacing: float, parameters: PairParameters) -> int:
    """How many pairs `build_pairs` makes, at a fifth of the cost."""
    points, tolerance = np.ascontiguousarray(samples.points.T), parameters.tolerance * spacing
    rungs = rungs_of(diameter, parameters)
    return sum(int(_partners(points, rung_distance(rung, parameters), tolerance).sum()) for rung in rungs)


def _partners(points: NDArray[np.float64], distance: float, tolerance: float) -> NDArray[np.int64]:
    """How many of points (3, N) lie at distance ± tolerance from each, (N,)."""
    from scanfind.kernels.features import count_pairs

    counts = np.empty(points.shape[1], np.int64)
    count_pairs(points, distance, tolerance, counts)
    return counts


def require_apart(samples: int, diameter: float) -> None:
    """Raise InvalidGeometryError for a surface too small for a pair: so many samples within so many metres."""
    if samples < 2 or not diameter > 0.0:
        msg = f"pairs need at least two samples apart from each other, got {samples} over {diameter} m"
        raise InvalidGeometryError(msg)
