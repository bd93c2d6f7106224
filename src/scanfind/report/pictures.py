"""A picture of one item: its points coloured by deviation, its model, and what stands about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.picture import Bytes, Dots, View, deviation_colours, draw, surface_dots, view_at

if TYPE_CHECKING:
    from scanfind.report.items import Item
    from scanfind.report.material import Material

Floats = NDArray[np.float64]

MODEL, MISSING, AROUND = (150, 163, 178), (214, 106, 96), (178, 178, 174)
DOTS = 100_000  # of a surface: no pixel of it stays open
YIELD_M = 0.02  # by which a model yields to the points on it
ROOM = 1.25  # so much more than the item is in its picture
STEEPNESS = 0.45  # how much the view looks down, where nobody stood


def picture_of(
    item: Item, material: Material, stations: Sequence[tuple[float, float, float]], full: float, width: int, height: int
) -> Bytes | None:
    """A picture (height, width, 3) of an item, seen from the nearest station's side; None where nothing is to be seen.

    full : deviation that has the colour of the scale's end, metres
    """
    layers, seen = layers_of(item, material, full)
    if not len(seen):
        return None
    view = view_of(seen, stations, width / height)
    around = material.all_points
    size = float(np.linalg.norm(np.ptp(seen, axis=0)))
    near = np.linalg.norm(around.xyz - seen.mean(axis=0), axis=1) < max(size, 0.5)
    # What would stand between the eye and the item is not drawn.
    near &= (around.xyz - seen.mean(axis=0)) @ view.forward > -0.5 * size
    light = (0.75 + 0.25 * around.values[near, None]) * np.array(AROUND)
    return draw(view, [Dots(around.xyz[near], light.astype(np.uint8), 2, YIELD_M), *layers], width, height)


def layers_of(item: Item, material: Material, full: float) -> tuple[list[Dots], Floats]:
    """What is drawn of an item, and points (N, 3) that must be in the picture."""
    layers, seen = [], [np.empty((0, 3))]
    points = None if item.found is None else material.points.get(item.found.id)
    if points is not None and len(points.xyz):
        layers.append(Dots(points.xyz, deviation_colours(points.values, full), 2))
        seen.append(points.xyz)
    shape, pose = material.shapes.get(item.model), item.scene_from_model or item.design_from_model
    if shape is not None and pose is not None:
        triangles = shape.placed(pose)
        colour = MODEL if item.found else MISSING
        if len(shape.faces):
            drawn = surface_dots(triangles, colour, seed=0, count=DOTS)._replace(behind=YIELD_M)
        else:
            drawn = Dots(triangles[:, 0], np.tile(np.array(colour, np.uint8), (len(triangles), 1)), 2)
        layers.insert(0, drawn)
        seen.append(triangles.reshape(-1, 3))
    return layers, np.concatenate(seen)


def view_of(seen: Floats, stations: Sequence[tuple[float, float, float]], aspect: float) -> View:
    """A view of points (N, 3) from the side that the nearest station saw, a little from above."""
    middle = seen.mean(axis=0)
    towards = np.array([0.55, 0.75, -STEEPNESS])
    if stations:
        nearest = min(stations, key=lambda station: float(np.linalg.norm(middle - station)))
        towards = middle - np.array(nearest)
        flat = float(np.hypot(towards[0], towards[1]))
        towards[2] = np.clip(towards[2], -0.8 * flat, -0.25 * flat)
        if flat < 1e-6:
            towards = np.array([0.55, 0.75, -STEEPNESS])
    return view_at(middle + ROOM * (seen - middle), towards, aspect=aspect)
