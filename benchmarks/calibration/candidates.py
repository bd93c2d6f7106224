"""The candidates of a search, each right or wrong: what is believed and what came closest and was refused."""

from __future__ import annotations

from dataclasses import dataclass, replace

from benchmarks.calibration.questions import Question
from benchmarks.recognition.lines import NOISY_DEG, NOISY_MM
from benchmarks.recognition.parts import library_of
from benchmarks.recognition.sensors import SENSORS as NOISY
from benchmarks.recognition.trial import RIGHT_DEG, RIGHT_MM, right_deg
from scanfind.detection import Detection, Refused
from scanfind.find import find
from scanfind.parameters import PRESETS
from scanfind.recognition.candidate import OUTWEIGHED, SHOWS_LESS

# A tenth of the preset's: 250 searches in an hour. What a long search refuses in the end is like what it refuses first.
TIME_LIMIT_S = 6.0
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
    right: int
    error_mm: float
    error_deg: float
    seconds: float

    def key(self) -> tuple[int, int]:
        """Which of its search's candidates."""
        return (self.seed, self.number)


def candidates(asked: Question) -> list[Row]:
    """Search, and judge what is told and what is refused, best first: an instance that was told is not right again."""
    sensor = asked.sensor
    parameters = PRESETS.get(sensor, PRESETS["default"])
    parameters = replace(parameters, search=replace(parameters.search, time_limit_s=TIME_LIMIT_S))
    found = find(asked.clouds, library_of(asked.sought), parameters=parameters, seed=asked.seed, jobs=1, isolate=False)
    told: list[tuple[str, Detection | Refused]] = [(BELIEVED, one) for one in found]
    for one in sorted(found.refused, key=lambda one: -one.score):
        told.append((AGAINST_ANOTHER if one.reason in (OUTWEIGHED, SHOWS_LESS) else REFUSED, one))
    free = [thing for thing in asked.world.objects if thing.name in {part.name for part in asked.sought}]
    parts = {part.name: part for part in asked.sought}
    most_mm, least_deg = (NOISY_MM, NOISY_DEG) if sensor in NOISY else (RIGHT_MM, RIGHT_DEG)
    rows = []
    for number, (how, one) in enumerate(told):
        part = parts[one.model]
        errors = [(part.error(one.scene_from_model, thing.pose), thing) for thing in free if thing.name == one.model]
        error, thing = min(errors, key=lambda pair: pair[0].mm, default=(None, None))
        right = error is not None and error.within(most_mm, max(least_deg, right_deg(part)))
        if right:
            free.remove(thing)
        rows.append(
            Row(
                asked.seed, number, asked.scene, sensor, one.model, how, one.score, one.support, one.visible_support,
                one.penalty, int(right), error.mm if error else float("nan"), error.deg if error else float("nan"),
                found.timings_s["total"],
            )
        )  # fmt: skip
    return rows
