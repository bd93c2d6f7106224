"""Where a real project's steel lies in scans of another frame: found from its elements, and how far that is off.

python -m benchmarks.alignment --seeds 6-8
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import cyclopts
import numpy as np

import scanfind
from benchmarks.common import ROOT, median, seeds_of, tell, write_csv
from benchmarks.inspection import STEEL, changed, scanned
from scanfind.design.elements import INSTALLED
from scanfind.mesh import Mesh
from scanfind.models import read_models
from scanfind.pose import random_rotation, rotation_vector

FAR_M = 50.0  # the spread of how far the scans are shifted


@dataclass(frozen=True)
class Row:
    """One scan; see README.md for the columns."""

    seed: int
    agreeing: int
    found: int
    installed: int
    error_mm: float
    told_mm: float
    error_deg: float
    told_deg: float
    squared_over_told: float
    total_s: float


def main(
    seeds: str = "6-8", points: float = 2e6, time_limit: float = 20.0, data: Path = ROOT.parent / "shared" / "data",
    date: str = "",
) -> None:  # fmt: skip
    """Inspect scans, turned and shifted arbitrarily, of the steel of a housing project, a row a scan.

    :param seeds: of what is changed, of the scans, and of how they are moved.
    :param points: about how many a scan has.
    :param time_limit: for instances anywhere, seconds.
    :param data: folder that holds ifc/schependomlaan.
    :param date: written to the CSV.
    """
    meshes = [mesh for mesh in read_models(data / STEEL) if isinstance(mesh, Mesh) and "Kubus" not in mesh.name]
    rows = [row_of(seed, meshes, int(points), time_limit) for seed in seeds_of(seeds)]
    error, told, angle, told_angle, squared = (
        median([getattr(row, column) for row in rows])
        for column in ("error_mm", "told_mm", "error_deg", "told_deg", "squared_over_told")
    )
    lines = [
        f"median: middle off by {error:.2f} mm, told {told:.2f}; turned by {angle:.4f}°, told {told_angle:.4f}",
        f"squared error over the covariance told, of which 6 is right: {squared:.1f} (median)",
    ]
    tell(lines, write_csv("alignment", rows, seeds, date, lines))


def row_of(seed: int, meshes: list[Mesh], points: int, time_limit: float) -> Row:
    """One scan, moved."""
    rng = np.random.default_rng(seed)
    truth = scanfind.Pose(random_rotation(rng), rng.normal(size=3) * FAR_M)
    stations = [
        replace(each, xyz=truth.move(each.xyz), origin=truth.move(np.asarray(each.origin)[None])[0])
        for each in scanned(changed(seed, meshes), seed, points)
    ]
    parameters = scanfind.PRESETS["default"]
    parameters = replace(parameters, search=replace(parameters.search, time_limit_s=time_limit))
    began = time.perf_counter()
    findings = scanfind.inspect(stations, meshes, parameters=parameters, align="always")
    total_s = time.perf_counter() - began
    alignment = findings.alignment
    assert alignment is not None  # with "always" it is an error
    pivot = np.array(alignment.pivot)[None]
    shift = truth.move(alignment.scene_from_design.inverse().move(pivot))[0] - pivot[0]
    turn = rotation_vector(truth.rotation @ alignment.scene_from_design.rotation.T)
    error = np.concatenate([turn, shift])
    return Row(
        seed=seed,
        agreeing=alignment.agreeing,
        found=alignment.found,
        installed=sum(element.status == INSTALLED for element in findings.elements),
        error_mm=1e3 * float(np.linalg.norm(shift)),
        told_mm=1e3 * alignment.sigma_m,
        error_deg=float(np.degrees(np.linalg.norm(turn))),
        told_deg=float(np.degrees(alignment.sigma_rad)),
        squared_over_told=float(error @ np.linalg.solve(alignment.covariance, error)),
        total_s=total_s,
    )


if __name__ == "__main__":
    cyclopts.run(main)
