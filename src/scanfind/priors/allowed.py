"""Priors held against poses: quickly, of a hypothesis that is a little off, and exactly, of a pose refined."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError
from scanfind.pose import Pose
from scanfind.priors import Priors, direction
from scanfind.symmetry import pose_error

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from scanfind.kernels.allowed import Allowed
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

# How far from the pose it leads to a hypothesis may be, in diameters and degrees. Of 132 near the spool or frame of ten
# shops the farthest was 0.05 off, the most turned 10.5°, and 95 % less than 7.7°, of which a lean is but a part.
DRAWN_IN = 0.1
LEANING_DEG = 10.0
# An instance whose middle lies so little outside of a region, in diameters, is looked for as well, though not told: its
# surface there is its own, and no pose of a middle inside may have it.
RIM = 0.25
OUTSIDE = "its middle lies outside of the region searched"
NOTHING_KNOWN = Priors()


def allowed_poses(models: Sequence[Model], priors: Priors, offset: Floats) -> Allowed:
    """What hypotheses of some models are held against before they are tested; offset : (3,) of the grid."""
    from scanfind.kernels.allowed import Allowed

    diameters = [model.diameter for model in models]
    box = priors.box((RIM + DRAWN_IN) * max(diameters))
    up = np.zeros(3) if priors.up is None else unit(direction(priors.up))
    tilt = np.radians(priors.tilt_deg + LEANING_DEG)
    cones: list[Floats] = []
    places: list[Floats] = []
    for model, diameter in zip(models, diameters, strict=True):
        around = np.empty((0, 4)) if priors.up is None else cones_of(model, direction(priors.model_up))
        least, most = np.cos(np.minimum(around[:, 3] + tilt, np.pi)), np.cos(np.maximum(around[:, 3] - tilt, 0.0))
        cones.append(np.column_stack([around[:, :3], least - 1e-9, most + 1e-9]))
        near = priors.near_design_m
        middles = [] if near is None else [at.move(middle_of(model)[None])[0] - offset for at in designs_of(model)]
        reach = (near or 0.0) + DRAWN_IN * diameter
        places.append(np.array([[*middle, reach] for middle in middles]).reshape(-1, 4))
    known = (priors.region, priors.outline, priors.up, priors.near_design_m) != (None, None, None, None)
    return Allowed(
        known, np.array([middle_of(model) for model in models]),
        np.array([[-np.inf] * 3, [np.inf] * 3]) if box is None else box - offset, up,
        np.concatenate(cones), starts(cones), np.concatenate(places), starts(places),
    )  # fmt: skip


def box_around(models: Sequence[Model], priors: Priors) -> Floats | None:
    """The box (2, 3), scans' frame, that holds all of every instance priors allow for; None: they may be anywhere."""
    margin = max(model.diameter for model in models)
    box = priors.box(margin)
    if priors.near_design_m is None:
        return box
    middles = np.array([at.move(middle_of(model)[None])[0] for model in models for at in designs_of(model)])
    reach = margin + priors.near_design_m
    near = np.array([middles.min(axis=0) - reach, middles.max(axis=0) + reach])
    return near if box is None else np.array([np.maximum(box[0], near[0]), np.minimum(box[1], near[1])])


def why_not(model: Model, priors: Priors, pose: Pose) -> str:
    """Why priors do not allow for a pose, in words; empty where they do, or where it is in the rim of a region.

    pose : scene_from_model, the scans' frame
    """
    middle = pose.move(middle_of(model)[None])[0]
    box = priors.box(RIM * model.diameter)
    if box is not None and not ((middle >= box[0]) & (middle <= box[1])).all():
        return OUTSIDE
    if priors.up is not None:
        leans = np.degrees(lean_of(model, direction(priors.model_up), pose, direction(priors.up)))
        if leans > priors.tilt_deg:
            return f"it leans by {leans:.0f}° from how it was drawn, {priors.tilt_deg:g}° are allowed"
    if priors.near_design_m is None:
        return ""
    off = [float(np.linalg.norm(design.move(middle_of(model)[None])[0] - middle)) for design in designs_of(model)]
    if min(off) > priors.near_design_m:
        return f"it is {min(off):.2f} m from where the design puts it, {priors.near_design_m:g} m are allowed"
    if priors.turned_deg is None:
        return ""
    near = [design for design, apart in zip(designs_of(model), off, strict=True) if apart <= priors.near_design_m]
    turned = min(np.degrees(pose_error(pose, design, model.symmetry).rotation_rad) for design in near)
    if turned > priors.turned_deg:
        return f"it is turned by {turned:.0f}° from the design, {priors.turned_deg:g}° are allowed"
    return ""


def lean_of(model: Model, drawn_up: Floats, pose: Pose, up: Floats) -> float:
    """By what angle a placed model leans from how it was drawn, radians, where symmetry does not count."""
    if model.symmetry.sphere:
        return 0.0
    cones = cones_of(model, drawn_up)
    angles = np.arccos(np.clip(cones[:, :3] @ (pose.rotation.T @ unit(up)), -1.0, 1.0))
    return float(np.abs(angles - cones[:, 3]).min())


def cones_of(model: Model, drawn_up: Floats) -> Floats:
    """Which directions of a model were up where it was drawn, as cones (K, 4): an axis, and its angle to all on it.

    drawn_up : (3,) in the drawing, in which a design may have placed the model in several ways. Each, and what finite
    symmetry makes of it, is a ray, of angle 0; what a free axis makes of it lies around that; of a sphere all are up.
    """
    symmetry, cones = model.symmetry, []
    for up in [design.rotation.T @ unit(drawn_up) for design in designs_of(model)]:
        axis = symmetry.free[0] if len(symmetry.free) else up
        angle = float(np.arccos(np.clip(axis @ up, -1.0, 1.0)))
        cones += [[*(turn @ axis), angle] for turn in symmetry.turns]
    return np.empty((0, 4)) if symmetry.sphere else np.unique(np.round(cones, 9), axis=0)


def designs_of(model: Model) -> list[Pose]:
    """Where the design puts a model; as it was drawn where the format knows no placements."""
    return [each.design_from_model for each in model.placements] or [Pose.identity()]


def middle_of(model: Model) -> Floats:
    """The middle (3,) of a model's surface, its own frame: what lies in a region or does not."""
    return np.asarray(model.samples.points.mean(axis=0))


def starts(lists: Sequence[Floats]) -> NDArray[np.int64]:
    """Where each of some arrays begins when they are laid end to end, and where the last ends."""
    return np.concatenate([[0], np.cumsum([len(each) for each in lists])]).astype(np.int64)


def unit(vector: Floats) -> Floats:
    """Of length 1."""
    return np.asarray(vector / np.linalg.norm(vector))


def box_searched(library: Sequence[Model], priors: Priors, most: int | None) -> Floats | None:
    """The box (2, 3), scans' frame, metres, that holds every instance the priors allow for; None: anywhere.

    most : instances in all, None: any number

    Raises UsageError for priors that do not fit the models.
    """
    priors.check([model.name for model in library], most)
    return box_around(library, priors)


def require_points_in(box: Floats | None, points: int, begins: ArrayLike | None) -> None:
    """Raise UsageError where of a scan that `begins` at (3,) no point lies where instances are looked for."""
    if box is not None and begins is not None and not points:
        low, high, there = (" ".join(f"{x:.1f}" for x in corner) for corner in (*box, np.asarray(begins)))
        msg = (
            f"no point lies where the region, or the design with near_design_m, allows for an instance, {low} to "
            f"{high}; the scan begins about {there}: give both in metres, in the scan's own frame"
        )
        raise UsageError(msg)
