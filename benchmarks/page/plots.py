"""RR and time against density, clutter and completeness, one curve a system: SVG that comes out the same each time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.page.results import FIRST, PAPER, RATIOS, TABLES, TARGETS, Results, middle, printed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Letters stay letters and names of parts do not change: equal rows give equal files.
STYLE: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "scanfind", "font.size": 8, "axes.spines.top": False,
         "axes.spines.right": False, "path.simplify": False}  # fmt: skip
# From a tenth of what is asked of scanfind to what is left a rival, and its preparation.
SECONDS = (0.05, 120.0)
COLOURS = {FIRST[0]: "#0b5fa5", FIRST[1]: "#6fb0e6", PAPER: "#c0392b"}
OTHERS = ("#7f7f7f", "#2e8b57", "#b8860b", "#8e44ad", "#d2691e", "#20b2aa", "#999933", "#444444")


def draw(results: Results, folder: Path) -> list[Path]:
    """A file an experiment that has rows: the spool above, the frame below; RR on the left, time on the right."""
    import matplotlib as mpl

    mpl.use("svg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for experiment in TABLES:
        with mpl.rc_context(STYLE):
            figure, axes = plt.subplots(2, 2, figsize=(8.0, 5.4), layout="constrained", sharex="all")
            for (key, noun), (left, right) in zip(TARGETS.items(), axes, strict=True):
                curves(results, experiment, key, left, right)
                left.set_title(f"{noun}: recognition rate", loc="left")
                right.set_title(f"{noun}: seconds", loc="left")
                for axis in (left, right):
                    axis.set_xscale("linear" if experiment == "completeness" else "log")
                    axis.xaxis.set_major_formatter("{x:g}")
                    axis.set_xlabel(RATIOS[experiment].replace("_", " "))
                left.set_ylim(-0.05, 1.05)
                right.set_yscale("log")
                right.set_ylim(SECONDS)
                right.yaxis.set_major_formatter("{x:g}")
            handles = {
                label: handle
                for axis in axes.flat
                for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
            }
            if handles:
                figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5, frameon=False)
            paths.append(folder / f"{experiment}.svg")
            figure.savefig(paths[-1], metadata={"Date": None, "Creator": None})
            plt.close(figure)
    return paths


def curves(results: Results, experiment: str, key: str, left: Axes, right: Axes) -> None:
    """Medians over all scenes against the ratio asked for, and the paper's own, a failure being an RR of 0."""
    lines = {PAPER: sorted((float(name), one.rr, one.seconds) for name, one in printed(experiment, key).items())}
    for system in results.systems(experiment, key):
        groups = (results.of(system, experiment, key, row) for row in results.row_names(experiment, key))
        found = [group for group in groups if group]
        medians = ((rows[0].asked, middle(rows, lambda r: r.rr), middle(rows, lambda r: r.total_s)) for rows in found)
        lines[system] = sorted(medians)
    spare = iter(OTHERS * len(lines))
    for system, line in lines.items():
        ratio, rr, seconds = zip(*line, strict=True)
        look: dict[str, Any] = {"label": system, "color": COLOURS.get(system) or next(spare), "marker": "o"}
        # Where all are at 1 the last one drawn hides the others: ours is told from them by its width.
        look |= {"linewidth": 2.6, "zorder": 3.0} if system == FIRST[0] else {"linewidth": 1.1}
        if not all(math.isnan(value) for value in rr):
            left.plot(ratio, rr, markersize=3.0, **look)
        right.plot(ratio, seconds, markersize=3.0, **look)
