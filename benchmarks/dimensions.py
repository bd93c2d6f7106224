"""Are key dimensions right, and their sigmas true? Spools built off by known amounts, scanned, searched, measured.

python -m benchmarks.dimensions --seeds 8000-8019
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cyclopts
import numpy as np

import scanfind
from benchmarks.common import seeds_of, tell, write_csv
from scanfind.detection import ANGLE, LINEAR, RADIUS
from scanfind.dimensions import Plan, plan_of
from scanfind.dimensions.fits import designed
from scanfind.isolation.own import IsolationParameters
from scanfind.mesh import Mesh
from scanfind.parameters import Parameters
from scanfind.pose import Pose, random_rotation
from scanfind.simulate.equipment import TOWARDS_X
from scanfind.simulate.objects import RIGHT_ANGLE, Route
from scanfind.simulate.parts import SIDES, assemble, blocks
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject

# Of the circle through its corners: what a tessellated pipe measures on average.
OF_FACETS = 1.0 - (np.pi / SIDES) ** 2 / 3.0
MOST_LONG_M, MOST_ASKEW_DEG = 0.008, 1.0
COVERED = {1.0: 0.68, 2.0: 0.95}
MEASURING = Parameters(isolate=IsolationParameters(dimensions=True))


@dataclass(frozen=True)
class Row:
    """One dimension of one spool; millimetres or degrees; `error` is measured minus true."""

    seed: int
    dimension: str
    kind: str
    off: float
    error: float
    sigma: float


def main(seeds: str = "8000-8019", step: float = 0.003, date: str = "") -> None:
    """Build a spool off, scan it from four stations, find it by its design, and hold its dimensions against the truth.

    :param seeds: of the scenes, `8000-8019` or `1,5,9`.
    :param step: angle between beams, radians.
    :param date: written to the CSV.
    """
    design = spool(1.2, 0.0)
    rows = [row for seed in seeds_of(seeds) for row in rows_of(design, seed, step)]
    tell(lines := summary(rows), write_csv("dimensions", rows, seeds, date, lines))


def spool(length: float, askew_deg: float) -> Mesh:
    """Flange, pipe, elbow, pipe, flange; the last one askew."""
    lead, route = Route(0.1, TOWARDS_X @ Pose.from_rotation_vector([np.pi, 0.0, 0.0])), Route(0.1, TOWARDS_X)
    lead.flange()
    route.straight(length)
    route.bend(RIGHT_ANGLE)
    route.straight(0.6)
    route.end = route.end @ Pose.from_rotation_vector([0.0, np.radians(askew_deg), 0.0])
    route.flange()
    return assemble("spool", [*lead.placed, *route.placed])


def rows_of(design: Mesh, seed: int, step: float) -> list[Row]:
    """What is measured of one spool."""
    rng = np.random.default_rng(seed)
    built = spool(1.2 + rng.uniform(-1, 1) * MOST_LONG_M, rng.uniform(-1, 1) * MOST_ASKEW_DEG)
    turn = random_rotation(rng)
    low = np.array([0.0, 0.0, 0.2 - (built.vertices @ turn.T)[:, 2].min()])
    placed = SceneObject("spool", built, Pose(turn, low))
    floor = SceneObject("floor", blocks("floor", [((-5, -5, -0.1), (5, 5, 0))]), Pose.identity())
    turns = rng.uniform(0, 2 * np.pi) + np.arange(4) * RIGHT_ANGLE
    stations = np.stack([3.5 * np.cos(turns), 3.5 * np.sin(turns), rng.uniform(0.8, 2.5, 4)], axis=1)
    scanned = scan(Scene((floor, placed), stations), scanner=Scanner(step=step), seed=seed)
    # The design's dimensions, of the spool as built: askew it would be drawn with others.
    plan, drawn = plan_of(design), plan_of(built)
    told, true = values(plan), values(replace(plan, features=drawn.features))
    rows = []
    for found in scanfind.find(scanned.stations, design, parameters=MEASURING, seed=seed)[:1]:
        for one in found.dimensions:
            if one.kind in {LINEAR, RADIUS, ANGLE} and np.isfinite(one.built):
                unit = np.degrees(1.0) if one.kind == ANGLE else 1e3
                truth = true[one.name] * (OF_FACETS if one.kind == RADIUS else 1.0)
                off, error = truth - told[one.name], one.built - truth
                rows.append(Row(seed, one.name, one.kind, unit * off, unit * error, unit * one.sigma))
    print(seed, *(f"{row.error:+.2f}±{row.sigma:.2f}" for row in rows), flush=True)
    return rows


def values(plan: Plan) -> dict[str, float]:
    """Each dimension of a model as it is drawn."""
    return {one.name: one.value(*(designed(plan.features[k]) for k in one.of)) for one in plan.wanted}


def summary(rows: list[Row]) -> list[str]:
    """Errors in their units and in sigmas, by kind."""
    lines = []
    for kind in (LINEAR, ANGLE, RADIUS):
        of_kind = [row for row in rows if row.kind == kind]
        errors, sigmas = np.array([[row.error, row.sigma] for row in of_kind]).reshape(-1, 2).T
        shares = ", ".join(f"{np.mean(np.abs(errors) < k * sigmas):.0%} within {k:g} sigma" for k in COVERED)
        lines.append(
            f"{kind}: {len(errors)} measured, median error {np.median(np.abs(errors)):.3f}, largest "
            f"{np.abs(errors).max():.3f}, mean square in sigmas {np.mean((errors / sigmas) ** 2):.2f}, {shares}"
        )
    return lines


if __name__ == "__main__":
    cyclopts.run(main)
