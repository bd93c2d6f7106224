"""The rows of Tables 5 to 12 and beyond: what each asks for, and how its scene is cut from the seed's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from benchmarks.paper.definitions import clutter_ratio, completeness_ratio, density_ratio
from benchmarks.paper.scenes import Cloud, cropped, hall_scene, paper_scene, sized, thinned
from benchmarks.paper.targets import Target, paper

# Beyond the paper's own rows.
MORE_CLUTTER = (100.0, 200.0, 500.0)
MORE_COMPLETENESS = (0.5, 0.4, 0.3)
# 20 scenes make the 100 runs of Tables 11 and 12.
RUNS_PER_SCENE = 5
BRANCHES = 3  # stream of chance


@dataclass(frozen=True, eq=False)
class Case:
    """One scene to be searched, of one row.

    row : its name, unique within experiment and target; asked, had : the ratio the row is about
    run : which of several searches of the same scene
    """

    experiment: str
    target: Target
    row: str
    asked: float
    had: float
    seed: int
    run: int
    cloud: Cloud


class Scenes:
    """The scenes of one target and seed, each made when first asked for."""

    def __init__(self, target: Target, seed: int) -> None:
        self.target, self.seed = target, seed

    @cached_property
    def full(self) -> Cloud:
        """The paper's fully cluttered scene."""
        return paper_scene(self.target, self.seed)

    @cached_property
    def hall(self) -> Cloud:
        """A hall with clutter for every row beyond the paper's."""
        most = self.target.object_points(min(MORE_CLUTTER), self.target.scene_points)
        return hall_scene(self.target, self.seed, max(MORE_CLUTTER), most)


@dataclass(frozen=True)
class Row:
    """A row of a table: its name, the ratio it asks for, and how its scene comes from the seed's; runs a scene."""

    name: str
    asked: float
    cut: Callable[[Scenes], Cloud]
    had: Callable[[Cloud, Scenes], float]
    runs: int = 1


def density(target: Target) -> list[Row]:
    """Tables 5, 6: the fully cluttered scene, down-sampled. What clutter the paper's had is not said; so, all of it."""
    table = paper()[f"table{_number(target, 5)}_density_{target.key}"][0]
    return [
        Row(
            name=f"{ratio:g}",
            asked=ratio,
            cut=lambda scenes, count=points: thinned(scenes.full, count),
            had=lambda cloud, _: density_ratio(len(cloud)),
        )
        for ratio, points in zip(table["density_ratio"], table["scene_points"], strict=True)
    ]


def clutter(target: Target) -> list[Row]:
    """Tables 7, 8: cropped to what is near the target. Beyond them: a hall, at the points of the paper's full scene.

    So the target of a hall is sparser as well: at a ratio of 500 it has 643 points.
    """
    table = paper()[f"table{_number(target, 7)}_clutter_{target.key}"][0]
    had = lambda cloud, _: clutter_ratio(len(cloud), cloud.object_points())  # noqa: E731
    near = [Row(f"{r:g}", r, lambda scenes, ratio=r: cropped(scenes.full, ratio), had) for r in table["clutter_ratio"]]
    points = target.scene_points
    far = [Row(f"{r:g}", r, lambda scenes, ratio=r: sized(scenes.hall, ratio, points), had) for r in MORE_CLUTTER]
    return [*near, *far]


def completeness(target: Target) -> list[Row]:
    """Tables 9, 10: branches removed in random order, of the last a part, until the ratio is met; clutter stays."""
    table = paper()[f"table{_number(target, 9)}_completeness_{target.key}"][0]
    ratios = sorted({*table["completeness_ratio"], *MORE_COMPLETENESS}, reverse=True)
    return [Row(f"{r:g}", r, lambda scenes, ratio=r: incomplete(scenes, ratio), _left) for r in ratios]


def branch(target: Target) -> list[Row]:
    """Is any branch critical, as one was in Table 9? Each is removed by itself; the ratio asked for is the scene's own."""
    return [
        Row(one.name, float("nan"), lambda scenes, number=k: without(scenes.full, number), _left)
        for k, one in enumerate(target.branches)
    ]


def effectiveness(target: Target) -> list[Row]:
    """Tables 11, 12: the fully cluttered scene, again and again."""
    return [Row("full", 1.0, lambda scenes: scenes.full, _left, RUNS_PER_SCENE)]


EXPERIMENTS: dict[str, Callable[[Target], list[Row]]] = {
    "density": density,
    "clutter": clutter,
    "completeness": completeness,
    "branch": branch,
    "effectiveness": effectiveness,
}


def cases(
    experiments: Sequence[str], target: Target, seed: int, wanted: Callable[[str, str, int], bool]
) -> Iterator[Case]:
    """The cases of a seed; only scenes that something is `wanted` of (experiment, row, run) are made."""
    scenes = Scenes(target, seed)
    for experiment in experiments:
        for row in EXPERIMENTS[experiment](target):
            runs = [run for run in range(row.runs) if wanted(experiment, row.name, run)]
            if not runs:
                continue
            cloud = row.cut(scenes)
            had = row.had(cloud, scenes)
            for run in runs:
                yield Case(experiment, target, row.name, row.asked, had, seed, run, cloud)


def incomplete(scenes: Scenes, ratio: float) -> Cloud:
    """The full scene with `ratio` of the target's points left."""
    cloud, target = scenes.full, scenes.target
    rng = np.random.default_rng([scenes.seed, BRANCHES])
    gone = np.zeros(len(cloud), dtype=bool)
    surplus = cloud.object_points() - round(ratio * cloud.object_points())
    for number in rng.permutation(len(target.branches)):
        one = target.branches[number]
        points = np.flatnonzero(cloud.branch == number)
        at = cloud.truth.inverse().move(cloud.xyz[points])[:, one.along()] * rng.choice([-1.0, 1.0])
        gone[points[np.argsort(at)][:surplus]] = True
        surplus -= min(surplus, len(points))
    return cloud.take(~gone)


def without(cloud: Cloud, number: int) -> Cloud:
    """The scene without one branch."""
    return cloud.take(cloud.branch != number)


def _left(cloud: Cloud, scenes: Scenes) -> float:
    return completeness_ratio(cloud.object_points(), scenes.full.object_points())


def _number(target: Target, of_spool: int) -> int:
    """The paper's tables come in twos: the spool's, the frame's."""
    return of_spool + (target.key == "BF")
