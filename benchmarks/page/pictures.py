"""Pictures like the paper's Figures 9 to 11: a scene with the model where it was found, and what was isolated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.common import Floats
from benchmarks.paper.experiments import Case, cases
from benchmarks.paper.systems import OURS, Answer, scanfind_with
from benchmarks.paper.targets import target
from scanfind.library.surface import SurfaceParameters, sample_mesh
from scanfind.pose import Pose

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIGURES = {
    "figure_9": ("density", ("20", "5", "1")),
    "figure_10": ("clutter", ("51.295", "12.191", "1.473")),
    "figure_11": ("completeness", ("0.84", "0.822", "0.539", "0.3")),
}
# From above and aside, as one looks at a model.
VIEW = Pose.from_rotation_vector([np.radians(-55.0), 0.0, 0.0]) @ Pose.from_rotation_vector(
    [0.0, 0.0, np.radians(35.0)]
)
AROUND_M = 2.5


def draw(folder: Path, seed: int) -> list[Path]:
    """A PNG a figure, of the pipe spool in the scene of `seed`."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, (experiment, rows) in FIGURES.items():
        shown = list(cases([experiment], target("PS"), seed, lambda *key, rows=rows: key[2] in rows))
        shown.sort(key=lambda case: rows.index(case.row))
        figure, axes = plt.subplots(2, len(rows), figsize=(3.0 * len(rows), 5.0), layout="constrained")
        for case, (above, below) in zip(shown, axes.T, strict=True):
            panel(case, scanfind_with(OURS["scanfind"], case.cloud, case.model, seed), above, below)
            above.set_title(f"{experiment} ratio {case.row}", fontsize=9)
        paths.append(folder / f"{name}.png")
        figure.savefig(paths[-1], dpi=80, metadata={"Software": None}, pil_kwargs={"optimize": True})
        plt.close(figure)
    return paths


def panel(case: Case, answer: Answer, above: Axes, below: Axes) -> None:
    """Above, what is around the target and the model found; below, the isolated points."""
    cloud = case.cloud
    centre = cloud.truth.move(target("PS").mesh.vertices).mean(axis=0)
    near = np.abs(cloud.xyz - centre).max(axis=1) < AROUND_M
    # Thin scenes in thicker dots, or nothing is seen of them.
    size = min(6.0, 0.3 * target("PS").scene_points / len(cloud))
    dots(above, cloud.xyz[near] - centre, "#808080", size)
    for axis in (above, below):
        axis.set_aspect("equal")
        axis.set_axis_off()
        axis.set_xlim(-AROUND_M, AROUND_M)
        axis.set_ylim(-AROUND_M, AROUND_M)
    if not answer.poses:
        below.text(0.0, 0.0, "not found", ha="center", fontsize=9)
        return
    model = sample_mesh(target("PS").mesh, SurfaceParameters(samples=3000)).samples.points
    dots(above, answer.poses[0].move(model) - centre, "#e67e22", 0.4)
    dots(below, cloud.xyz[answer.isolated[0]] - centre, "#0b5fa5", 0.6)


def dots(axis: Axes, points: Floats, colour: str, size: float) -> None:
    """Points (N, 3) about the middle of the picture, the nearest drawn last."""
    seen = VIEW.move(points)
    order: Sequence[int] = np.argsort(seen[:, 2]).tolist()
    axis.scatter(seen[order, 0], seen[order, 1], s=size, c=colour, marker=".", linewidths=0, rasterized=True)
