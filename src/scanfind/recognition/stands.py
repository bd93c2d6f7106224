"""Where the elements of a design stand: all of them, as designed or as they were found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from scanfind.design.elements import assigned, placements_of
from scanfind.evidence.neighbours import Design, Placed

if TYPE_CHECKING:
    from scanfind.detection import Detection
    from scanfind.library.model import Model
    from scanfind.pose import Pose


def as_designed(models: Sequence[Model]) -> Design | None:
    """Elements where the design has them; None where it has no meshes."""
    return as_found(models, ())


def as_found(models: Sequence[Model], detections: Sequence[Detection]) -> Design | None:
    """Elements where they were found, else where the design has them, and what was found besides; None of no meshes."""
    placed = [
        Placed(model.name, model.mesh, pose)
        for model in models
        if model.mesh is not None
        for pose in poses_of(model, detections)
    ]
    return Design(placed) if placed else None


def poses_of(model: Model, detections: Sequence[Detection]) -> Iterator[Pose]:
    """scene_from_model of every element of a model, and of what of it was found besides."""
    places = placements_of(model)
    taken = assigned(model, places, detections)
    for k, place in enumerate(places):
        yield taken[k].scene_from_model if k in taken else place.design_from_model
    elements = {one.id for one in taken.values()}
    yield from (one.scene_from_model for one in detections if one.model == model.name and one.id not in elements)
