"""Is the covariance of a pose true? Errors in units of what was told, over simulated scenes, against χ².

python -m benchmarks.uncertainty --seeds 7000-7049
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import erf, exp, gamma, log, sqrt

import cyclopts
import numpy as np

import scanfind
from benchmarks.common import Floats, median, pose_error, seeds_of, tell, write_csv
from benchmarks.shop import FOUND_DEG, FOUND_MM, TARGETS, WARM_UP_POINTS
from scanfind.pose import Pose
from scanfind.simulate.scanner import scan
from scanfind.simulate.scenes import shop

NAN = float("nan")
COVERED = (0.68, 0.95)


@dataclass(frozen=True)
class Row:
    """One target in one scene; see README.md for the columns."""

    target: str
    seed: int
    points: int
    isolated: int
    found: int
    error_mm: float
    error_deg: float
    sigma_mm: float
    sigma_deg: float
    dof: int
    nees: float
    quantile: float


def main(seeds: str = "7000-7049", points: float = 6e5, targets: str = "ps,bf", date: str = "") -> None:
    """Find targets in shop scenes and hold each error against the covariance told; a row a scene, and a summary.

    :param seeds: of the scenes, `7000-7049` or `1,5,9`; one scene for each target.
    :param points: about how many a scene has.
    :param targets: of ps (pipe spool) and bf (box frame).
    :param date: written to the CSV.
    """
    rows = []
    for target in targets.split(","):
        mesh = TARGETS[target]()
        scanfind.find(scan(shop(0, mesh), points=WARM_UP_POINTS).stations, mesh)
        for seed in seeds_of(seeds):
            rows.append(row := row_of(target, mesh, seed, int(points)))
            print(row, flush=True)
    lines = summary(rows)
    tell(lines, write_csv("uncertainty", rows, seeds, date, lines))


def row_of(target: str, mesh: scanfind.Mesh, seed: int, points: int) -> Row:
    """Scan a shop, search it, and weigh the error of the right detection by its covariance."""
    scanned = scan(shop(seed, mesh), seed=seed, points=points)
    truth = scanned.truth[mesh.name][0]
    for found in scanfind.find(scanned.stations, mesh, seed=seed):
        if found.covariance is None or found.pivot is None or found.isolated is None:
            continue
        pivot = np.array(found.pivot)
        off = pose_error(found.scene_from_model, truth, found.scene_from_model.inverse().move(pivot[None])[0])
        if not off.within(FOUND_MM, FOUND_DEG):
            continue
        nees, dof = normalised(error_of(found.scene_from_model, truth, pivot), found.covariance)
        return Row(
            target, seed, len(scanned), len(found.isolated), 1, off.mm, off.deg, 1e3 * found.sigma_m,
            float(np.degrees(found.sigma_rad)), dof, nees, chi2_quantile(nees, dof),
        )  # fmt: skip
    return Row(target, seed, len(scanned), 0, 0, NAN, NAN, NAN, NAN, 0, NAN, NAN)


def error_of(found: Pose, truth: Pose, pivot: Floats) -> Floats:
    """What turns and shifts a found pose onto the true one, (6,): rotation vector about the pivot (3,), translation."""
    turn = truth.rotation @ found.rotation.T
    # Of an error of a hundredth of a degree the sine is the angle to nine digits.
    rotation = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.concatenate([rotation, (truth @ found.inverse()).move(pivot[None])[0] - pivot])


def normalised(error: Floats, covariance: Floats) -> tuple[float, int]:
    """The normalised error squared, eᵀ C⁺ e over what the data fix, and how many motions that is."""
    # Radians and metres are brought to one scale first: what is zero is told from what is small.
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    fixed = values > 1e-9
    along = vectors[:, fixed].T @ (error / scale)
    return float((along**2 / values[fixed]).sum()), int(fixed.sum())


def chi2_quantile(value: float, dof: int) -> float:
    """The share of χ² of `dof` degrees of freedom that is below a value."""
    half, first = max(value, 1e-300) / 2.0, 2 - dof % 2
    below = erf(sqrt(half)) if first == 1 else 1.0 - exp(-half)
    return below - sum(exp(0.5 * k * log(half) - half) / gamma(0.5 * k + 1.0) for k in range(first, dof, 2))


def kolmogorov(quantiles: Sequence[float]) -> float:
    """The p-value of quantiles being uniform (Kolmogorov–Smirnov, Stephens' correction for few)."""
    n = len(quantiles)
    ranked = np.sort(quantiles)
    apart = float(max((np.arange(1, n + 1) / n - ranked).max(), (ranked - np.arange(n) / n).max()))
    scaled = apart * (sqrt(n) + 0.12 + 0.11 / sqrt(n))
    tail = sum((1.0 if k % 2 else -1.0) * exp(-2.0 * (k * scaled) ** 2) for k in range(1, 101))
    return min(1.0, max(0.0, 2.0 * tail))


def summary(rows: Sequence[Row]) -> list[str]:
    """Of all targets together and of each."""
    return [line for name in ("all", *dict.fromkeys(row.target for row in rows)) for line in lines_of(name, rows)]


def lines_of(name: str, rows: Sequence[Row]) -> list[str]:
    """What a target's rows, or all, say."""
    mine = [row for row in rows if name in ("all", row.target)]
    right = [row for row in mine if row.found]
    if not right:
        return [f"{name}: found 0 of {len(mine)}"]
    dof = sum(row.dof for row in right)
    quantiles = [row.quantile for row in right]
    inside = ", ".join(f"{np.mean(np.array(quantiles) < share):.2f} within {share:.0%}" for share in COVERED)
    return [
        f"{name}: found {len(right)} of {len(mine)}, median error {median([r.error_mm for r in right]):.3f} mm, "
        f"{median([r.error_deg for r in right]):.4f} deg, told {median([r.sigma_mm for r in right]):.3f} mm, "
        f"{median([r.sigma_deg for r in right]):.4f} deg",
        f"{name}: NEES/dof {sum(row.nees for row in right) / dof:.3f} (± {sqrt(2.0 / dof):.3f} by chance), {inside}, "
        f"KS p {kolmogorov(quantiles):.2f}",
    ]


if __name__ == "__main__":
    cyclopts.run(main)
