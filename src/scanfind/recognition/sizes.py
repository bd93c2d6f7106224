"""Models of several sizes in one scene: each size is searched at its own resolution, the large ones first.

One pass over the points serves all of them: the cells of the smallest, summed to larger ones for the others. A valve of
15 cm and a truss of 20 m have no cell in common that shows the one and does not drown in the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import shift_for
from scanfind.grid.scene import first_cell
from scanfind.library.near_surface import near_model
from scanfind.recognition.candidate import Standing
from scanfind.recognition.stands import as_found
from scanfind.threads import each_in_threads

if TYPE_CHECKING:
    from scanfind.design.elements import Element
    from scanfind.detection import Detection, Refused
    from scanfind.library.model import Model
    from scanfind.parameters import Parameters
    from scanfind.recognition.recognise import Recognition
    from scanfind.recognition.witnesses import Witnesses

Floats = NDArray[np.float64]
Told = TypeVar("Told")

# Models within two octaves are searched together: what draws, tests and depth maps cost once is then shared.
SPAN = 4.0
# Cells along the diameter of the smallest model of all but the largest size: what a valve needs to be told from others,
# where the cells that tell a truss best would be as many as the points.
CELLS_ACROSS_SMALLER = 60.0


def by_size(models: Sequence[Model]) -> list[list[Model]]:
    """The models in groups whose diameters are within SPAN of one another, largest first; each in the order given."""
    groups: list[list[Model]] = []
    for model in sorted(models, key=lambda each: -each.diameter):
        if not groups or model.diameter * SPAN < groups[-1][0].diameter:
            groups.append([])
        groups[-1].append(model)
    order = {model.name: place for place, model in enumerate(models)}
    return [sorted(group, key=lambda each: order[each.name]) for group in groups]


class Size(NamedTuple):
    """Models that are searched together: number k of n such groups."""

    models: list[Model]
    k: int
    n: int

    @property
    def patience(self) -> float:
        """The share of the time limit that may be over when this group is done."""
        return (self.k + 1) / self.n

    def progress(self, own: float) -> float:
        """How far all groups are when this one is `own` far, 0 … 1."""
        return (self.k + own) / self.n


class Sizes:
    """The searches for all sizes, told as one; `all` in the order they were made."""

    def __init__(self, models: Sequence[Model], parameters: Parameters) -> None:
        self._models, self._parameters = models, parameters
        self.all: list[Recognition] = []

    def finest_cell(self) -> float:
        """The edge of the cells that the raw points are summed in, metres."""
        if self._parameters.grid.cell_m is not None:
            return self._parameters.grid.cell_m
        largest, *smaller = ([model.diameter for model in size.models] for size in self.groups())
        needed = [min(diameters) / CELLS_ACROSS_SMALLER for diameters in smaller]
        return min([first_cell(largest, self._parameters.grid), *needed])

    def smallest(self) -> float:
        """The diameter of the smallest model, metres."""
        return min(model.diameter for model in self._models)

    def groups(self) -> list[Size]:
        """The models in groups, in the order in which to search for them."""
        groups = by_size(self._models)
        return [Size(group, k, len(groups)) for k, group in enumerate(groups)]

    def add(self, search: Recognition) -> None:
        """Take a search that is over."""
        self.all.append(search)

    def standing(self) -> list[Standing]:
        """What was found so far: no smaller model may claim its surface."""
        reach = 2.0 * max((search.reach() for search in self.all), default=0.0)
        near = {}
        for search in self.all:
            for number in {candidate.model for candidate in search.believed}:
                near[search.models[number].name] = near_model(search.models[number], reach)
        return [
            Standing(near[search.models[candidate.model].name], search.ground.in_scans(candidate.pose()))
            for search in self.all
            for candidate in search.believed
        ]

    def detections(self) -> list[Detection]:
        """What is believed, best first, numbered from 1, in the scans' own frame."""
        believed = [(candidate, search) for search in self.all for candidate in search.reported()]
        believed.sort(key=lambda one: (-round(one[0].score, 3), -one[0].area))
        return [
            search.telling.detection(number, candidate, search.rival(candidate))
            for number, (candidate, search) in enumerate(believed[: self._parameters.search.max_instances], start=1)
        ]

    def refused(self) -> list[Refused]:
        """What came closest of each model and why it was not believed."""
        return [each for search in self.all for each in search.refused()]

    def built(self) -> dict[int, Floats]:
        """By detection, where it was fitted in parts: its faces (F, 3, 3) as built, scan frame, metres."""
        return {number: faces for search in self.all for number, faces in search.telling.built().items()}

    def measured(self, found: Detection, points: Floats | None) -> Detection:
        """A detection with its parts fitted to raw points (N, 3) around it, scan frame; None: it has no parts."""
        return found if points is None else self._of(found.model).telling.measured(found, points)

    def told(
        self, detections: Sequence[Detection], stations: Floats, *, at_design: bool
    ) -> tuple[list[Detection], list[Element]]:
        """Detections with what their ends and each station say, and what became of each element of the design.

        stations : where all of them stood, in order, (S, 3); at_design : there are elements, in the order of the models
        """
        elements: dict[str, list[Element]] = {}
        by_ends = {one.id: one for one in detections}
        asked = [(search.models, search.weighing.witnesses) for search in self.all]
        if at_design:
            for each in self._each(asked, lambda model, witnesses: witnesses.with_ends(model, detections)):
                by_ends |= each
            stand = as_found(self._models, detections)
            asked = [(models, witnesses.among(stand)) for models, witnesses in asked]
        found = list(by_ends.values())
        if len(stations) > 1:
            of_model = {model.name: [one for one in found if one.model == model.name] for model in self._models}
            told = self._each(
                asked,
                lambda model, witnesses: [
                    witnesses.with_stations(model, one, stations) for one in of_model[model.name]
                ],
            )
            by_id = {one.id: one for some in told for one in some}
            found = [by_id[one.id] for one in found]
        if at_design:
            told_of = self._each(asked, lambda model, witnesses: witnesses.elements(model, found, stations))
            names = [model.name for models, _ in asked for model in models]
            elements = dict(zip(names, told_of, strict=True))
        return found, [element for model in self._models for element in elements.get(model.name, ())]

    def _each(
        self, asked: Sequence[tuple[Sequence[Model], Witnesses]], ask: Callable[[Model, Witnesses], Told]
    ) -> list[Told]:
        """What the witnesses of each size say of each of its models, in order; models are asked for side by side."""
        whose = [(model, witnesses) for models, witnesses in asked for model in models]
        return each_in_threads(self.all[0].ground.jobs, whose, lambda each: ask(*each))

    def noise(self) -> float:
        """Spread of the raw points about the largest parts found, metres."""
        return self._largest().noise()

    def cell(self) -> float:
        """Edge of the cells these were measured with, metres."""
        return self._largest().ground.scene.fine.cell

    def shift(self) -> tuple[float, float, float]:
        """What was taken off far coordinates while computing, metres."""
        x, y, z = shift_for(self.all[0].ground.offset).tolist()
        return x, y, z

    def notes(self) -> list[str]:
        """What a user should know about how far the answer may be trusted, each once."""
        return list(dict.fromkeys(note for search in self.all for note in search.notes()))

    def _largest(self) -> Recognition:
        return next((search for search in self.all if search.believed), self.all[-1])

    def _of(self, name: str) -> Recognition:
        return next(search for search in self.all if any(model.name == name for model in search.models))
