"""The rows of Tables 5 to 12 and beyond: what each asks for, and how its scene is cut from the seed's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from benchmarks.paper.definitions import RIGHT_MM, clutter_ratio, completeness_ratio, density_ratio
from benchmarks.paper.scenes import Cloud, cropped, hall_scene, paper_scene, sized, thinned
from benchmarks.paper.targets import Target, paper
from scanfind.cloud import CloudModel
from scanfind.mesh import Mesh
from scanfind.pose import Pose

# Scenes of these seeds and above are never looked at while anything is tuned; those below 100 are for that.
PUBLICATION_SEEDS = 5000
# Beyond the paper's own rows.
MORE_CLUTTER = (100.0, 200.0, 500.0)
MORE_COMPLETENESS = (0.5, 0.4, 0.3)
# 20 scenes make the 100 runs of Tables 11 and 12.
RUNS_PER_SCENE = 5
BRANCHES = 3  # stream of chance

Key = tuple[str, str, str, int, int]
Missing = Callable[[str, str, str, int, int], bool]


@dataclass(frozen=True, eq=False)
class Case:
    """One scene to be searched for one instance of one model.

    target : the model's name in the tables; row : the row's, unique within experiment and target
    asked, had : the ratio the row is about; run : which of several searches of the same scene
    model : what is sought; cloud.truth is where it is, `others` where further instances of it are
    right_mm : how far the centre of a right pose may be off
    turn : model_from_model, after which what is left of the object looks as before, so that either pose is right
    """

    experiment: str
    target: str
    row: str
    asked: float
    had: float
    seed: int
    run: int
    cloud: Cloud
    model: Mesh | CloudModel
    others: tuple[Pose, ...] = ()
    right_mm: float = RIGHT_MM
    turn: Pose | None = None

    def key(self) -> Key:
        """What it is about: experiment, target, row, seed, run."""
        return (self.experiment, self.target, self.row, self.seed, self.run)


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
    """A row of a table: its name, the ratio it asks for, and how its scene is cut; runs a scene; turn as in Case."""

    name: str
    asked: float
    cut: Callable[[Scenes], Cloud]
    had: Callable[[Cloud, Scenes], float]
    runs: int = 1
    turn: Pose | None = None


def density(target: Target) -> list[Row]:
    """Tables 5, 6: the fully cluttered scene, down-sampled. What clutter the paper's had is not said; so, all of it."""
    table = paper()[f"table{_number(target, 5)}_density_{target.key}"][0]
    rows = zip(table["density_ratio"], table["scene_points"], strict=True)
    return [Row(f"{ratio:g}", ratio, partial(_thinned, points), _density) for ratio, points in rows]


def clutter(target: Target) -> list[Row]:
    """Tables 7, 8: cropped to what is near the target. Beyond them: a hall, at the points of the paper's full scene.

    So the target in a hall is sparser as well: at a ratio of 500 it has 643 points.
    """
    near = paper()[f"table{_number(target, 7)}_clutter_{target.key}"][0]["clutter_ratio"]
    return [
        *(Row(f"{ratio:g}", ratio, partial(_cropped, ratio), _clutter) for ratio in near),
        *(Row(f"{ratio:g}", ratio, partial(_in_hall, ratio), _clutter) for ratio in MORE_CLUTTER),
    ]


def completeness(target: Target) -> list[Row]:
    """Tables 9, 10: branches removed in random order, of the last a part, until the ratio is met; clutter stays.

    The target's telling branches are left: what is to be found must be told from itself slid along or turned over.
    """
    of_paper = paper()[f"table{_number(target, 9)}_completeness_{target.key}"][0]["completeness_ratio"]
    ratios = sorted({*of_paper, *MORE_COMPLETENESS}, reverse=True)
    return [Row(f"{ratio:g}", ratio, partial(_incomplete, ratio), _left) for ratio in ratios]


def branch(target: Target) -> list[Row]:
    """Is any branch critical, as one was in Table 9? Each is removed by itself, however much of the object it is."""
    nan = float("nan")
    return [Row(one.name, nan, partial(_without, k), _left, turn=one.turn) for k, one in enumerate(target.branches)]


def effectiveness(_: Target) -> list[Row]:
    """Tables 11, 12: the fully cluttered scene, again and again."""
    return [Row("full", 1.0, lambda scenes: scenes.full, _left, RUNS_PER_SCENE)]


EXPERIMENTS: dict[str, Callable[[Target], list[Row]]] = {
    "density": density,
    "clutter": clutter,
    "completeness": completeness,
    "branch": branch,
    "effectiveness": effectiveness,
}


def cases(experiments: Sequence[str], target: Target, seed: int, missing: Missing) -> Iterator[Case]:
    """The cases of a target and seed that are `missing`; scenes of no such case are not made."""
    scenes = Scenes(target, seed)
    for experiment in experiments:
        for row in EXPERIMENTS[experiment](target):
            runs = [run for run in range(row.runs) if missing(experiment, target.key, row.name, seed, run)]
            if not runs:
                continue
            cloud = row.cut(scenes)
            had = row.had(cloud, scenes)
            for run in runs:
                yield Case(
                    experiment, target.key, row.name, row.asked, had, seed, run, cloud, target.mesh, turn=row.turn
                )  # fmt: skip


def _thinned(points: int, scenes: Scenes) -> Cloud:
    return thinned(scenes.full, points)


def _cropped(ratio: float, scenes: Scenes) -> Cloud:
    return cropped(scenes.full, ratio)


def _in_hall(ratio: float, scenes: Scenes) -> Cloud:
    return sized(scenes.hall, ratio, scenes.target.scene_points)


def _incomplete(ratio: float, scenes: Scenes) -> Cloud:
    """The full scene with `ratio` of the target's points left."""
    cloud, branches = scenes.full, scenes.target.branches
    rng = np.random.default_rng([scenes.seed, BRANCHES])
    gone = np.zeros(len(cloud), dtype=bool)
    surplus = cloud.object_points() - round(ratio * cloud.object_points())
    for number in rng.permutation([k for k, one in enumerate(branches) if one.name not in scenes.target.telling]):
        points = np.flatnonzero(cloud.branch == number)
        along = cloud.truth.inverse().move(cloud.xyz[points])[:, branches[number].along()]
        from_an_end = np.argsort(along * rng.choice([-1.0, 1.0]))
        gone[points[from_an_end[:surplus]]] = True
        surplus -= min(surplus, len(points))
    return cloud.take(~gone)


def _without(number: int, scenes: Scenes) -> Cloud:
    return scenes.full.take(scenes.full.branch != number)


def _density(cloud: Cloud, _: Scenes) -> float:
    return density_ratio(len(cloud))


def _clutter(cloud: Cloud, _: Scenes) -> float:
    return clutter_ratio(len(cloud), cloud.object_points())


def _left(cloud: Cloud, scenes: Scenes) -> float:
    return completeness_ratio(cloud.object_points(), scenes.full.object_points())


def _number(target: Target, of_spool: int) -> int:
    """The paper's tables come in twos: the spool's, the frame's."""
    return of_spool + (target.key == "BF")
