"""Scenes made from a seed: a fabrication shop with the objects one looks for somewhere in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError
from scanfind.mesh import Mesh
from scanfind.simulate.layout import SHOP_M, Layout
from scanfind.simulate.scanner import Scanner, shares
from scanfind.simulate.scene import Scene, SceneObject

__all__ = ["SHOP_M", "Scene", "SceneObject", "shop"]

Floats = NDArray[np.float64]

SCANNER_HEIGHT_M = 1.6
# Outside the box frame, whose inside is nowhere farther from a member; and not so far that it drowns in the room.
SCANNER_NEAR_M, SCANNER_FAR_M = 1.1, 6.0
# The paper's clutter ratio: points elsewhere for each point on a target.
CLUTTER = (40.0, 180.0)
# The least share of a target's surface that the stations together must see.
LEAST_VISIBLE = 0.3
TRIES = 200
LAYOUTS = 50
# 10 mrad beams put 5,000 on a target that makes a hundredth of the scan, or its ratio within 2 %; what mixed pixels and
# dropouts take off it is as much again. So the pilot stays within the range asked for by PILOT_MARGIN.
PILOT = Scanner(step=0.01)
PILOT_MARGIN = 0.05


def shop(
    seed: int,
    target: Mesh | Sequence[Mesh],
    copies: int = 1,
    stations: int = 3,
    spools: int = 6,
    clutter: tuple[float, float] = CLUTTER,
) -> Scene:
    """A shop of 12 x 10 x 4.2 m: an office, columns, racks, tables, drums, other spools, and `copies` of each target.

    Flat targets, such as spools, rest on any side, on timber or on saw horses; others stand on the floor, turned
    anyhow. Nothing stands in anything else. `stations` scanners stand around the targets in free space; the points
    elsewhere for each point on a target (a copy's average) are within `clutter`, and LEAST_VISIBLE of each copy is
    in sight. Everything follows from `seed`. Raises UsageError when that cannot be had.
    """
    targets = [target] if isinstance(target, Mesh) else list(target)
    if not targets or copies < 1 or stations < 1:
        msg = f"a shop needs targets, copies and stations, got {len(targets)}, {copies} and {stations}"
        raise UsageError(msg)
    for attempt in range(LAYOUTS):
        layout = Layout((seed, attempt))
        if not all(layout.add_target(mesh) for mesh in targets for _ in range(copies)):
            continue
        layout.furnish(spools)
        scene = _with_stations(layout, stations, clutter)
        if scene is not None:
            return scene
    msg = f"no place in the shop of {SHOP_M} m for {copies} x {[mesh.name for mesh in targets]} in sight; give fewer"
    raise UsageError(msg)


def _with_stations(layout: Layout, count: int, clutter: tuple[float, float]) -> Scene | None:
    """The scene with scanners spread around its targets; None where no try sees them well."""
    rng = layout.rngs["stations"]
    unmanned = Scene(tuple(layout.objects), np.zeros((0, 3)))
    caster, ids = unmanned.caster(), unmanned.target_ids()
    surfaces = [layout.on_surface(unmanned.objects[k]) for k in ids]
    near = np.concatenate(surfaces)[:, :2]
    middle = near.mean(axis=0)
    for _ in range(20):
        ahead = rng.uniform(0.0, 2 * np.pi)
        sectors = ahead + 2 * np.pi * np.arange(count) / count
        found = [at for sector in sectors if (at := _station(layout, near, middle, sector, count)) is not None]
        if len(found) < count:
            continue
        stations = np.array(found)
        seen = [np.any([caster.sees(at, surface) for at in stations], axis=0).mean() for surface in surfaces]
        share = shares(caster, stations, PILOT)[ids].mean()
        least, most = clutter[0] * (1 + PILOT_MARGIN), clutter[1] * (1 - PILOT_MARGIN)
        if min(seen) >= LEAST_VISIBLE and least * share <= 1.0 - share <= most * share:
            return Scene(unmanned.objects, stations)
    return None


def _station(layout: Layout, near: Floats, middle: Floats, sector: float, count: int) -> Floats | None:
    """A free place (3,) for a scanner, about in direction `sector` from `middle`; None where there is none."""
    rng = layout.rngs["stations"]
    sides = [-0.3, 0.0, 0.3]
    body = np.stack(np.meshgrid(sides, sides, np.arange(0.05, 1.9, 0.1)), axis=-1).reshape(-1, 3)
    for _ in range(TRIES):
        angle = sector + rng.uniform(-0.7, 0.7) * np.pi / count
        x, y = middle + rng.uniform(SCANNER_NEAR_M, SCANNER_FAR_M) * np.array([np.cos(angle), np.sin(angle)])
        foot = np.array([x, y, 0.0])
        clear = np.linalg.norm(near - foot[:2], axis=1).min() > SCANNER_NEAR_M
        if clear and layout.room.fits(foot + body):
            return np.array([x, y, SCANNER_HEIGHT_M + rng.uniform(-0.1, 0.1)])
    return None
