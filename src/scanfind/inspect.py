"""A design and scans of it in, what became of every element out; where they are in different frames, aligned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from scanfind.design.alignment import CELL_M, fitted, lies_at
from scanfind.design.elements import INSTALLED, installed, placements_of
from scanfind.design.thinned import Thinned
from scanfind.errors import AlignmentError
from scanfind.evidence.free_space import Spoken
from scanfind.find import find, models_of
from scanfind.library import ModelLibrary
from scanfind.parameters import PRESETS, Parameters
from scanfind.scans.sources import Sources

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from scanfind.design.elements import Element
    from scanfind.detection import Findings
    from scanfind.find import ModelInput
    from scanfind.library.model import Model
    from scanfind.pose import Pose
    from scanfind.progress import Progress
    from scanfind.scans.sources import Scan


def inspect(
    scans: Scan | Sequence[Scan],
    design: ModelInput | Sequence[ModelInput],
    *,
    parameters: Parameters | None = None,
    seed: int = 0,
    jobs: int | None = None,
    origin: ArrayLike | None = None,
    units: str | None = None,
    select: Sequence[str] = (),
    progress: Progress | None = None,
    align: Literal["auto", "always", "never"] = "auto",
    upright: bool = False,
) -> Findings:
    """Say of every element of a design what became of it: see `Findings.elements`.

        scans, parameters, seed, jobs, origin, units, select, progress : as for `find`
        design : models with their places, such as an IFC file, or models drawn where they should stand
        align : find from the elements where the design lies in the scans: "always"; "never", they are in one frame;
            "auto": where nothing at all is in its place
        upright : up is the same in design and scans

    `Findings.alignment` says where the design lies if that had to be found; elements are then where it puts them.

    Raises as `find` does; with "always" AlignmentError, where the design fits nowhere, or in two ways.
    """
    parameters = parameters or PRESETS["default"]
    models = models_of(design, parameters, units, select)

    def found(placed: Sequence[Model], *, at_design: bool, isolate: bool) -> Findings:
        with ModelLibrary.in_memory() as library:
            for model in placed:
                library.put(model)
            return find(
                scans, library, parameters=parameters, seed=seed, jobs=jobs, origin=origin, progress=progress,
                at_design=at_design, isolate=isolate,
            )  # fmt: skip

    before = found(models, at_design=align != "always", isolate=align != "always")
    in_place = any(element.status == INSTALLED for element in before.elements)
    if align == "never" or (align == "auto" and in_place):
        return before
    sources = Sources(scans, origin)
    try:
        start = lies_at(models, before, Thinned((chunk.xyz for chunk in sources.chunks()), CELL_M), upright=upright)
        placed = [moved(model, start) for model in models]
        findings = found(placed, at_design=True, isolate=True)
        alignment = fitted(models, findings, start)
    except AlignmentError as error:
        if align == "always":
            raise
        before.notes.append(f"nothing is where the design puts it, and {error}")
        return before
    findings.alignment = alignment
    by_name = {model.name: model for model in models}
    correction = alignment.scene_from_design @ start.inverse()
    findings.elements = [retold(each, by_name[each.model], findings, correction) for each in findings.elements]
    for stage, seconds in before.timings_s.items():
        findings.timings_s[stage] = findings.timings_s.get(stage, 0.0) + seconds
    return findings


def moved(model: Model, scene_from_design: Pose) -> Model:
    """A model with its places where a motion puts them."""
    places = tuple(
        replace(each, design_from_model=scene_from_design @ each.design_from_model) for each in placements_of(model)
    )
    mesh = None if model.mesh is None else replace(model.mesh, placements=places)
    return replace(model, placements=places, mesh=mesh)


def retold(element: Element, model: Model, findings: Findings, correction: Pose) -> Element:
    """An element whose place in the design was moved, by millimetres: how far off it is from there."""
    place = replace(element.placement, design_from_model=correction @ element.placement.design_from_model)
    found = next((each for each in findings if each.id == element.detection), None)
    if found is None:
        return replace(element, placement=place)
    shares = element.on, element.beside, element.through, element.hidden
    spoken = None if None in shares else Spoken(*(share or 0.0 for share in shares))
    return installed(model, place, found, spoken)
