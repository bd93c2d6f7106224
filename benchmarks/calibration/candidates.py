"""The candidates of a search, each right or wrong: what is believed and what came closest and was refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.calibration.questions import Question
from benchmarks.common import Floats, PoseError
from benchmarks.recognition.lines import NOISY_DEG, NOISY_MM
from benchmarks.recognition.parts import Part, library_of
from benchmarks.recognition.sensors import SENSORS as NOISY
from benchmarks.recognition.trial import RIGHT_DEG, RIGHT_MM, right_deg
from scanfind.detection import Detection, Refused
from scanfind.find import find
from scanfind.parameters import PRESETS
from scanfind.recognition.candidate import FOR_ANOTHER
from scanfind.simulate.scene import SceneObject

# 250 searches in an hour: what a long search refuses in the end is much like what it refuses first.
MISSED, TIME_LIMIT_S = 0.1, 10.0
NAN = float("nan")
BELIEVED, REFUSED, AGAINST_ANOTHER = "believed", "refused", "outweighed"


@dataclass(frozen=True)
class Row:
    """One candidate; see benchmarks/README.md for the columns."""

    seed: int
    number: int
    scene: str
    sensor: str
    model: str
    told: str
    score: float
    support: float
    visible_support: float
    penalty: float
    rival: float
    right: int
    error_mm: float
    error_deg: float
    on: str
    on_mm: float
    seconds: float

    def key(self) -> tuple[int, int]:
        """Which of its search's candidates."""
        return (self.seed, self.number)


def candidates(asked: Question) -> list[Row]:
    """Search, and judge what is told and what is refused, best first: an instance that was told is not right again."""
    preset = PRESETS.get(asked.sensor, PRESETS["default"])
    search = replace(preset.search, deeper=False, miss_probability=MISSED, time_limit_s=TIME_LIMIT_S)
    parameters = replace(preset, search=search)
    if not any(len(cloud) for cloud in asked.clouds):  # a frame of structured light that looks past everything
        return []
    found = find(asked.clouds, library_of(asked.sought), parameters=parameters, seed=asked.seed, jobs=1, isolate=False)
    parts = {part.name: part for part in asked.sought}
    standing = [thing for thing in asked.world.objects if thing.name in parts]
    untold = list(standing)
    most_mm, least_deg = (NOISY_MM, NOISY_DEG) if asked.sensor in NOISY else (RIGHT_MM, RIGHT_DEG)
    refused = sorted(found.refused, key=lambda one: -one.score)
    rows = []
    for number, one in enumerate([*found, *refused]):
        part = parts[one.model]
        middle = one.scene_from_model.move(part.symmetry.centre[None])[0]
        own = [thing for thing in untold if thing.name == one.model]
        errors = [part.error(one.scene_from_model, thing.pose) for thing in own]
        error = min(errors, key=lambda error: error.mm, default=PoseError(NAN, NAN))
        right = error.within(most_mm, max(least_deg, right_deg(part)))
        if right:
            untold.remove(own[errors.index(error)])
        apart = {thing.name: float(np.linalg.norm(middle_of(thing, parts) - middle)) for thing in standing}
        on = min(apart, key=lambda name: apart[name], default="")
        rows.append(
            Row(
                asked.seed, number, asked.scene, asked.sensor, one.model, how_told(one), one.score, one.support,
                one.visible_support, one.penalty, one.rival, int(right), error.mm, error.deg, on,
                1e3 * apart.get(on, NAN), found.timings_s["total"],
            )
        )  # fmt: skip
    return rows


def how_told(one: Detection | Refused) -> str:
    """Told, refused for what the scene says of it, or for what it says of another."""
    if isinstance(one, Detection):
        return BELIEVED
    return AGAINST_ANOTHER if one.reason in FOR_ANOTHER else REFUSED


def middle_of(thing: SceneObject, parts: Mapping[str, Part]) -> Floats:
    """The middle (3,) of a part where it stands."""
    middle: Floats = thing.pose.move(parts[thing.name].symmetry.centre[None])[0]
    return middle
