"""The picture of docs/score.md: what beams say of a part where it is, and of the same part taken for its likeness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cyclopts
import numpy as np

from benchmarks.common import ROOT
from benchmarks.page.pictures import VIEW
from benchmarks.recognition.lines import near_duplicate
from benchmarks.recognition.parts import pipe_spool_part
from benchmarks.recognition.scenes import CLUTTER, meant, points_for
from scanfind.cloud import PointCloud
from scanfind.evidence.free_space import BESIDE, HIDDEN, ON, THROUGH, Limits, Verdicts, caster_of, verdicts
from scanfind.grid.moments import MomentGrid
from scanfind.library import ModelLibrary
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.scans.sources import Sources
from scanfind.simulate.scanner import scan
from scanfind.simulate.scenes import shop

COLOURS = {
    ON: ("#3a9e5c", "on it"),
    BESIDE: ("#e8a33d", "beside it"),
    THROUGH: ("#d33b3b", "through it"),
    HIDDEN: ("#c4c8cf", "hidden"),
}
# As a search has them in a scan of 2 mm noise and cells of 18 mm.
LIMITS = Limits(inlier=0.0087, margin=0.036, facing=0.25)
CELL_M = 0.018


def main(seed: int = 20, out: Path = ROOT / "docs" / "pictures" / "evidence.png") -> None:
    """Draw the paper's spool where it stands, and where one stands whose riser is a hand's breadth along.

    :param seed: of the shop.
    :param out: the PNG.
    """
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    part = pipe_spool_part()
    scene = shop(seed, [part.mesh, near_duplicate(part)], clutter=CLUTTER)
    there = meant(scene, [part.name])
    scanned = scan(there, seed=seed, points=points_for(there))
    stands = {thing.name: thing.pose for thing in scene.objects if thing.target}
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    for axis, (name, title) in zip(
        axes, ((part.name, "where it is"), (near_duplicate(part).name, "where its likeness is")), strict=True
    ):
        told = said(scanned.stations, part.mesh, stands[name])
        at = VIEW.move(told.where)
        for says, (colour, words) in COLOURS.items():
            some = told.says == says
            share = told.area[some].sum() / told.area[told.says <= THROUGH].sum() if says <= THROUGH else None
            label = words if share is None else f"{words} {share:.1%}"
            axis.scatter(*at[some, :2].T, s=2.0, c=colour, label=label, linewidths=0)
        axis.set_title(title, fontsize=10)
        axis.set_aspect("equal")
        axis.axis("off")
        axis.legend(markerscale=5.0, fontsize=8, frameon=False, loc="upper left")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=90, metadata={"Software": None}, pil_kwargs={"optimize": True})


def said(stations: Sequence[PointCloud], mesh: Mesh, scene_from_model: Pose) -> Verdicts:
    """What the beams of a scan say of a mesh at a pose."""
    grid = MomentGrid(CELL_M)
    for chunk in Sources(stations).chunks():
        grid.add(chunk)
    offset = np.zeros(3) if grid.offset is None else grid.offset
    with ModelLibrary.in_memory() as library:
        library.add(mesh)
        (model,) = library.models()
    placed = Pose(scene_from_model.rotation, scene_from_model.translation - offset)
    return verdicts(model, caster_of(model), placed, grid.beams(), LIMITS)


if __name__ == "__main__":
    cyclopts.run(main)
