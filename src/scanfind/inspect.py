"""A design and scans of it in, what became of every element out; where they are in different frames, aligned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING, Literal, Protocol

from scanfind.design.alignment import CELL_M, fitted, lies_at
from scanfind.design.elements import INSTALLED, installed, placements_of
from scanfind.design.thinned import Thinned
from scanfind.errors import AlignmentError, UsageError
from scanfind.evidence.free_space import Spoken
from scanfind.find import find
from scanfind.library import ModelLibrary
from scanfind.parameters import PRESETS, Parameters
from scanfind.priors.allowed import middle_of
from scanfind.scans.sources import Sources
from scanfind.sought import models_of
from scanfind.tolerances import judge_findings, profile_allowing

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from scanfind.design.elements import Element
    from scanfind.detection import Findings
    from scanfind.library.model import Model
    from scanfind.mesh import Placement
    from scanfind.pose import Pose
    from scanfind.priors import Priors
    from scanfind.progress import Progress
    from scanfind.scans.sources import Scan
    from scanfind.sought import ModelInput
    from scanfind.tolerances import Profile


class Searches(Protocol):
    """What searches scans: `find`, or `find_in_tiles` with its memory and workers given (functools.partial)."""

    def __call__(
        self, scans: Scan | Sequence[Scan], models: ModelInput | Sequence[ModelInput], /, *, parameters: Parameters,
        seed: int, jobs: int | None, origin: ArrayLike | None, progress: Progress | None, isolate: bool,
        at_design: bool,
    ) -> Findings:  # fmt: skip
        """As `find`."""
        ...


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
    allowed: float | str | PathLike[str] | Profile | None = None,
    search: Searches = find,
) -> Findings:
    """Say of every element of a design what became of it: see `Findings.elements`.

        scans, parameters, seed, jobs, origin, units, select, progress : as for `find`
        design : models with their places, such as an IFC file, or models drawn where they should stand; with a region
            among the priors those elements whose place is in it
        align : find from the elements where the design lies in the scans: "always"; "never", they are in one frame;
            "auto": where nothing at all is in its place
        upright : up is the same in design and scans
        allowed : by how much elements may be off, metres, or a tolerance profile, its file or a preset's name: gives
            installed elements a verdict
        search : what searches; for a large site `functools.partial(find_in_tiles, memory=…)`

    `Findings.alignment` says where the design lies if that had to be found; elements are then where it puts them.

    Raises as `find` does, and UsageError for what is no profile; with "always" AlignmentError, where the design fits
    nowhere, or in two ways.
    """
    parameters = parameters or PRESETS["default"]
    profile = None if allowed is None else profile_allowing(allowed)
    models, priors = models_of(design, parameters, units, select, jobs, progress), parameters.priors
    if priors.scale_free:
        msg = "inspect: how far off things are needs scans in metres: find the scale with `scanfind find --scale-free`"
        raise UsageError(msg)
    if priors.box() is not None or priors.near_design_m is not None:
        if align == "always":
            msg = "inspect: a region, or how near to the design, needs scans and design in one frame: leave out align"
            raise UsageError(msg)
        models, align = in_region(models, priors), "never"

    def found(placed: Sequence[Model], *, at_design: bool = True, isolate: bool = True) -> Findings:
        return search(
            scans, placed, parameters=parameters, seed=seed, jobs=jobs, origin=origin, progress=progress,
            isolate=isolate, at_design=at_design,
        )  # fmt: skip

    findings = found(models, at_design=align != "always", isolate=align != "always")
    in_place = any(element.status == INSTALLED for element in findings.elements)
    if align == "always" or (align == "auto" and not in_place):
        try:
            findings = realigned(models, findings, Sources(scans, origin), found, upright=upright)
        except AlignmentError as error:
            if align == "always":
                raise
            findings.notes.append(f"nothing is where the design puts it, and {error}")
    if profile is not None:
        with library_of(models) as library:
            judge_findings(findings, profile, library)
    return findings


def realigned(
    models: Sequence[Model], before: Findings, sources: Sources, found: Callable[[Sequence[Model]], Findings], *,
    upright: bool,
) -> Findings:  # fmt: skip
    """Findings of a design after it was put where instances found `before`, anywhere, say it lies.

    found : searches for models in their places; raises as `lies_at` does
    """
    start = lies_at(models, before, Thinned((chunk.xyz for chunk in sources.chunks()), CELL_M), upright=upright)
    findings = found([moved(model, start) for model in models])
    findings.alignment = alignment = fitted(models, findings, start)
    by_name = {model.name: model for model in models}
    correction = alignment.scene_from_design @ start.inverse()
    findings.elements = [retold(each, by_name[each.model], findings, correction) for each in findings.elements]
    for stage, seconds in before.timings_s.items():
        findings.timings_s[stage] = findings.timings_s.get(stage, 0.0) + seconds
    return findings


def in_region(models: Sequence[Model], priors: Priors) -> list[Model]:
    """The models with those of their places whose middle lies in the region; raises UsageError where there is none."""
    kept = []
    for model in models:
        middle = middle_of(model)[None]
        places = [each for each in placements_of(model) if priors.holds(each.design_from_model.move(middle)[0])]
        kept += [placed_at(model, places)] if places else []
    if not kept:
        msg = f"inspect: no element of the design has its place in the region {priors.region or priors.outline}"
        raise UsageError(msg)
    return kept


def placed_at(model: Model, places: Sequence[Placement]) -> Model:
    """A model at other places."""
    mesh = None if model.mesh is None else replace(model.mesh, placements=tuple(places))
    return replace(model, placements=tuple(places), mesh=mesh)


def library_of(models: Sequence[Model]) -> ModelLibrary:
    """Models in a library of their own, in memory; to be closed."""
    library = ModelLibrary.in_memory()
    for model in models:
        library.put(model)
    return library


def moved(model: Model, scene_from_design: Pose) -> Model:
    """A model with its places where a motion puts them."""
    places = [
        replace(each, design_from_model=scene_from_design @ each.design_from_model) for each in placements_of(model)
    ]
    return placed_at(model, places)


def retold(element: Element, model: Model, findings: Findings, correction: Pose) -> Element:
    """An element whose place in the design was moved, by millimetres: how far off it is from there."""
    place = replace(element.placement, design_from_model=correction @ element.placement.design_from_model)
    found = next((each for each in findings if each.id == element.detection), None)
    if found is None:
        return replace(element, placement=place)
    shares = element.on, element.beside, element.through, element.hidden
    spoken = None if None in shares else Spoken(*(share or 0.0 for share in shares))
    return replace(installed(model, place, found, spoken), stations=element.stations)
