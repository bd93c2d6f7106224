"""A design and scans of it in, what became of every element out; where they are in different frames, aligned."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from scanfind.alignment import align
from scanfind.elements import INSTALLED, placements_of
from scanfind.errors import AlignmentError
from scanfind.find import find, models_of
from scanfind.library import ModelLibrary
from scanfind.parameters import PRESETS, Parameters

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from scanfind.alignment import Alignment
    from scanfind.detection import Findings
    from scanfind.find import ModelInput
    from scanfind.model import Model
    from scanfind.progress import Progress
    from scanfind.sources import Scan


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
    align_by: Literal["auto", "always", "never"] = "auto",
    upright: bool = False,
) -> Findings:
    """Say of every element of a design what became of it: see `Findings.elements`.

        scans, parameters, seed, jobs, origin, units, select, progress : as for `find`
        design : models with their places, such as an IFC file, or models drawn where they should stand
        align_by : find from the elements where the design lies in the scans: "always"; "never", they are in one frame;
            "auto": where nothing at all is in its place
        upright : up is the same in design and scans

    `Findings.alignment` says where the design lies if that had to be found; elements are then where it puts them.

    Raises as `find` does; with "always" AlignmentError, where the design fits nowhere, or in two ways.
    """
    parameters = parameters or PRESETS["default"]
    models = models_of(design, parameters, units, select)

    def found(placed: Sequence[Model], *, at_design: bool) -> Findings:
        with ExitStack() as stack:
            library = stack.enter_context(ModelLibrary.in_memory())
            for model in placed:
                library.put(model)
            return find(
                scans, library, parameters=parameters, seed=seed, jobs=jobs, origin=origin, progress=progress,
                at_design=at_design,
            )  # fmt: skip

    before = found(models, at_design=align_by != "always")
    in_place = any(element.status == INSTALLED for element in before.elements)
    if align_by == "never" or (align_by == "auto" and in_place):
        return before
    try:
        alignment = align(models, before, upright=upright)
    except AlignmentError as error:
        if align_by == "always":
            raise
        before.notes.append(f"nothing is where the design puts it, and {error}")
        return before
    findings = found([moved(model, alignment) for model in models], at_design=True)
    findings.alignment = alignment
    for stage, seconds in before.timings_s.items():
        findings.timings_s[stage] = findings.timings_s.get(stage, 0.0) + seconds
    return findings


def moved(model: Model, alignment: Alignment) -> Model:
    """A model with its places where an alignment puts them in the scans."""
    places = tuple(
        replace(each, design_from_model=alignment.scene_from_design @ each.design_from_model)
        for each in placements_of(model)
    )
    mesh = None if model.mesh is None else replace(model.mesh, placements=places)
    return replace(model, placements=places, mesh=mesh)
