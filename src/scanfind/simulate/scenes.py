"""Scenes made from a seed: a fabrication shop with the objects one looks for somewhere in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate import furniture
from scanfind.simulate.layout import TRIES, Layout, at, targets_of
from scanfind.simulate.objects import other_spool
from scanfind.simulate.parts import assemble
from scanfind.simulate.scanner import Scanner, shares
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.simulate.stations import LEAST_VISIBLE, SCANNER_HEIGHT_M, SCANNER_NEAR_M, scanner_fits

__all__ = ["SHOP_M", "Scene", "SceneObject", "shop"]

Floats = NDArray[np.float64]

SHOP_M = (12.0, 10.0, 4.2)
OFFICE_M = (3.0, 2.6)
COLUMNS_M = ((0.2, 3.3), (0.2, 6.7), (11.8, 3.3), (4.0, 9.8), (8.0, 0.2))
TRAYS_M = (2.5, 6.0)
# Not so far that a target drowns in the room.
SCANNER_FAR_M = 6.0
# The paper's clutter ratio: points elsewhere for each point on a target.
CLUTTER = (40.0, 180.0)
STATION_TRIES = 200
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
    targets = targets_of(target, copies, stations, "shop", SHOP_M)
    for attempt in range(LAYOUTS):
        layout = _empty_shop((seed, attempt))
        if not all(layout.add_target(mesh) for mesh in targets for _ in range(copies)):
            continue
        _furnish(layout, spools)
        scene = _with_stations(layout, stations, clutter)
        if scene is not None:
            return scene
    msg = f"no place in the shop of {SHOP_M} m for {copies} x {[mesh.name for mesh in targets]} in sight; give fewer"
    raise UsageError(msg)


def _empty_shop(seed: tuple[int, int]) -> Layout:
    """The hall with its office and columns."""
    office = (furniture.office(*OFFICE_M, SHOP_M[2]), at(*SHOP_M[:2]))
    layout = Layout(seed, SHOP_M, assemble("room", [(furniture.hall(*SHOP_M), Pose.identity()), office]))
    # Of the background only the office takes room: hall and occupancy end at the same planes.
    layout.room.take(layout.on_surface(SceneObject("office", *office)))
    for x, y in COLUMNS_M:
        layout.put([layout.painted("column", furniture.column(SHOP_M[2]), at(x, y))])
    return layout


def bay(seed: tuple[int, int], spools: int) -> Layout:
    """A shop with everything but targets and stations."""
    layout = _empty_shop(seed)
    _furnish(layout, spools)
    return layout


def _furnish(layout: Layout, spools: int) -> None:
    """Put racks, tables, stairs, drums, crates, cable trays and other spools: as many as fit."""
    rng = layout.rngs["furniture"]
    for _ in range(3):
        layout.stand(furniture.rack(rng), rng, at_wall=True)
    layout.stand(furniture.stairs(), rng, at_wall=True)
    for _ in range(3):
        layout.stand(furniture.table(*rng.uniform([1.6, 0.7], [2.4, 1.1])), rng)
    for _ in range(int(rng.integers(2, 5))):
        layout.stand(furniture.drum(), rng)
    for _ in range(3):
        layout.stand(furniture.crates(rng), rng)
    for y in TRAYS_M:
        layout.put([layout.painted("cable_tray", furniture.cable_tray(11.0), at(0.5, y, SHOP_M[2] - 0.6))])
    rng = layout.rngs["spools"]
    for _ in range(spools):
        decoy = other_spool(rng)
        any(layout.rest(decoy, rng, lying=True) for _ in range(TRIES))


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
    for _ in range(STATION_TRIES):
        angle = sector + rng.uniform(-0.7, 0.7) * np.pi / count
        x, y = middle + rng.uniform(SCANNER_NEAR_M, SCANNER_FAR_M) * np.array([np.cos(angle), np.sin(angle)])
        foot = np.array([x, y, 0.0])
        clear = np.linalg.norm(near - foot[:2], axis=1).min() > SCANNER_NEAR_M
        if clear and scanner_fits(layout.room, foot):
            return np.array([x, y, SCANNER_HEIGHT_M + rng.uniform(-0.1, 0.1)])
    return None
