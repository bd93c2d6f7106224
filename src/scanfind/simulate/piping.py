"""A process plant made from a seed: a pipe rack with two tiers of lines, what they lead to, and spools among it all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate import equipment, furniture
from scanfind.simulate.equipment import FLANGE_OVER_PIPE, TOWARDS_X, flange_thickness
from scanfind.simulate.layout import TRIES, Layout, at, targets_of, yaw
from scanfind.simulate.objects import RIGHT_ANGLE, Route, other_spool, pipe_spool
from scanfind.simulate.parts import assemble, blocks
from scanfind.simulate.scene import Scene
from scanfind.simulate.stations import manned
from scanfind.simulate.steel import hollow_beam, i_beam

Floats = NDArray[np.float64]

PLANT_M = (18.0, 15.0, 6.5)
RACK_Y_M = (5.0, 9.0)
BENTS_M = (1.5, 6.5, 11.5, 16.5)
TIERS_M = (3.0, 4.3)
LINES_FROM_M, LINES_TO_M = 0.4, 17.6
SLEEPERS_M = (1.0, 4.2, 7.4, 10.6, 13.8, 17.0)
SHOE_M = 0.1
RADII_M = (0.03, 0.045, 0.057, 0.084, 0.11, 0.135)
# Where lines leave the rack, by side (of y) and tier, clear of its columns, the outermost first; the pumps there are
# 0.6 m wide, the vessels 1.7 m.
EXITS_M = {(1.0, 0): (3.0, 8.0, 13.0), (1.0, 1): (4.6, 9.6, 14.6)}
EXITS_M |= {(-1.0, 0): (3.6, 8.6, 13.6), (-1.0, 1): (5.0, 10.2, 15.2)}
LAYOUTS = 20


class Track(NamedTuple):
    """Where lines lie side by side along x: between y = low and high on steel or concrete at `level`, at x = rests.

    tier : of the rack, whose outer lines leave it; None for lines on the ground, which run through
    """

    level: float
    low: float
    high: float
    rests: tuple[float, ...]
    tier: int | None = None


TRACKS = (
    *(Track(level, RACK_Y_M[0] + 0.35, RACK_Y_M[1] - 0.35, BENTS_M, tier) for tier, level in enumerate(TIERS_M)),
    Track(0.25, 12.7, 14.6, SLEEPERS_M),
)


def plant(
    seed: int, target: Mesh | Sequence[Mesh] | None = None, copies: int = 3, stations: int = 4, spools: int = 4
) -> Scene:
    """A plant of 18 x 15 x 6.5 m in the open: a rack, lines with tees, valves and flanges, vessels, pumps, supports.

    `copies` of each target (the paper's spool unless given) and other spools rest under and about the rack, on timber,
    saw horses and goalposts. `stations` scanners stand where they see most of the targets, LEAST_VISIBLE of each.
    Everything follows from `seed`. Raises UsageError when that cannot be had.
    """
    targets = targets_of(pipe_spool() if target is None else target, copies, stations, "plant", PLANT_M)
    for attempt in range(LAYOUTS):
        layout = _empty_plant((seed, attempt))
        if not all(layout.add_target(mesh) for mesh in targets for _ in range(copies)):
            continue
        _furnish(layout, spools)
        if scene := manned(layout, stations):
            return scene
    msg = f"no place in the plant of {PLANT_M} m for {copies} x {[mesh.name for mesh in targets]} in sight; give fewer"
    raise UsageError(msg)


def _empty_plant(seed: tuple[int, int]) -> Layout:
    """Ground, rack, lines and what they lead to: all of which fits by construction."""
    x, y, _ = PLANT_M
    ground = blocks("ground", [((-4.0, -4.0, -0.3), (x + 4.0, y + 4.0, 0.0))])
    layout = Layout(seed, PLANT_M, ground, high=(0.75, 1.6, 2.2))
    rng = layout.rngs["furniture"]
    for mesh, pose in _rack():
        layout.fix([layout.painted(mesh.name, mesh, pose)])
    for track in TRACKS:
        for mesh, pose in _lines(rng, track):
            layout.fix([layout.painted(mesh.name, mesh, pose)])
    for x in SLEEPERS_M:
        sleeper = blocks("sleeper", [((x - 0.1, TRACKS[-1].low - 0.1, 0.0), (x + 0.1, TRACKS[-1].high + 0.1, 0.25))])
        layout.fix([layout.painted("sleeper", sleeper, Pose.identity())])
    return layout


def _rack() -> Iterator[tuple[Mesh, Pose]]:
    """Columns, beams of both tiers, struts, and braces in the end bays."""
    for x in BENTS_M:
        for y in RACK_Y_M:
            yield furniture.column(TIERS_M[-1] + 0.3), at(x, y)
        for z in TIERS_M:
            yield _named("beam", i_beam([x, RACK_Y_M[0] + 0.12, z - 0.1], [x, RACK_Y_M[1] - 0.12, z - 0.1], 0.15, 0.2))
    for a, b in pairwise(BENTS_M):
        for y in RACK_Y_M:
            yield _named("strut", i_beam([a + 0.12, y, 3.75], [b - 0.12, y, 3.75], 0.12, 0.16))
            if a in (BENTS_M[0], BENTS_M[-2]):
                yield _named("brace", hollow_beam([a + 0.25, y, 0.3], [b - 0.25, y, 3.4], 0.1))


def _lines(rng: np.random.Generator, track: Track) -> Iterator[tuple[Mesh, Pose]]:
    """Lines side by side; of those with exits the outer ones leave, the outermost first, the rest run through."""
    y, slots = track.low, list[tuple[float, float]]()
    while True:
        radius = float(rng.choice(RADII_M))
        y += FLANGE_OVER_PIPE * radius
        if y + FLANGE_OVER_PIPE * radius > track.high:
            break
        slots.append((y, radius))
        y += FLANGE_OVER_PIPE * radius + float(rng.uniform(0.02, 0.15))
    leaving = min(3, len(slots) // 3)
    for k, (across, radius) in enumerate(slots):
        start = np.array([LINES_FROM_M, across, track.level + SHOE_M + radius])
        line = Route(radius, Pose(TOWARDS_X.rotation, start))
        side, rank = (-1.0, k) if k < leaving else (1.0, len(slots) - 1 - k)
        leaves = track.tier is not None and rank < leaving
        until = EXITS_M[side, track.tier or 0][rank] + rng.uniform(-0.1, 0.1) if leaves else LINES_TO_M
        _line_along(rng, line, until, track.rests)
        if leaves:
            yield _leave(rng, line, side, track.tier or 0, rank)
        else:
            line.flange()
        yield assemble("pipe_run", _closed(line, start)), Pose.identity()
        rests = [x for x in track.rests if x < until - 3.0 * radius]
        low = track.level
        shoes = [((x - 0.06, across - 0.03, low), (x + 0.06, across + 0.03, low + SHOE_M)) for x in rests]
        if shoes:
            yield blocks("shoe", shoes), Pose.identity()


def _line_along(rng: np.random.Generator, line: Route, until: float, rests: Sequence[float]) -> None:
    """Lay a line along x until `until`, less its elbow: joints, valves, and branches with a valve on top.

    None where the line lies on something: flanges are wider than it.
    """
    until -= 3.0 * line.radius
    while (left := until - line.end.translation[0]) > 0.0:
        piece = min(left, float(rng.uniform(1.2, 3.0)))
        fits = left - piece > 1.5
        line.straight(piece if fits else left)
        if not fits:
            return
        x, what = line.end.translation[0], rng.random()
        if min(abs(x + 0.4 - rest) for rest in rests) < 0.6:
            continue
        if what < 0.35:
            line.joint()
        elif what < 0.55:
            # Handwheels upright: beside the line there is another one.
            line.valve(roll=_towards(line, [0.0, 0.0, 1.0]))
        elif what < 0.75:
            _vent(line)


def _vent(line: Route) -> None:
    """A small branch upwards with a valve and a blind flange."""
    radius = min(line.radius, 0.03)
    height = line.radius + 0.08
    side = line.branch(radius, 2.6 * max(radius, 0.5 * line.radius), height, roll=_towards(line, [0.0, 0.0, 1.0]))
    side.straight(0.05)
    side.valve(roll=_towards(side, [1.0, 0.0, 0.0]))
    side.straight(0.05)
    side.flange()


def _leave(rng: np.random.Generator, line: Route, side: float, tier: int, rank: int) -> tuple[Mesh, Pose]:
    """Take a line out of the rack towards side * y: to a vessel's nozzle, or down and through a valve to a pump."""
    out = [0.0, side, 0.0]
    line.bend(RIGHT_ANGLE, roll=_towards(line, out))
    edge = RACK_Y_M[1] if side > 0 else -RACK_Y_M[0]
    if side > 0 and tier == 0:
        radius = float(rng.uniform(0.5, 0.75))
        line.straight(edge + 0.6 - side * line.end.translation[1])
        line.joint()
        line.straight(0.5)
        line.flange()
        x, y, z = line.end.translation
        vessel = equipment.upright_vessel(radius, z + float(rng.uniform(0.3, 1.2)), z, line.radius)
        return vessel, at(x, y + radius + 0.2)
    if side < 0 and tier == 1 and rank == 1:
        radius, axis = 0.55, 1.1
        line.straight(edge + 3.3 - side * line.end.translation[1])
        line.bend(RIGHT_ANGLE, roll=_towards(line, [0.0, 0.0, -1.0]))
        line.straight(0.4)
        line.valve(roll=_towards(line, [1.0, 0.0, 0.0]))
        line.straight(line.end.translation[2] - (axis + radius + 0.2) - flange_thickness(line.radius))
        line.flange()
        x, y, _ = line.end.translation
        return equipment.drum_vessel(radius, 2.6, axis, line.radius), at(x, y)
    height = float(rng.uniform(0.6, 0.75))
    line.straight(edge + 0.35 + 0.25 * tier - side * line.end.translation[1])
    line.bend(RIGHT_ANGLE, roll=_towards(line, [0.0, 0.0, -1.0]))
    line.straight(line.end.translation[2] - 2.2)
    line.valve(roll=_towards(line, out))
    line.straight(line.end.translation[2] - height - 3.0 * line.radius)
    line.bend(RIGHT_ANGLE, roll=_towards(line, out))
    line.straight(0.1)
    line.flange()
    x, y, z = line.end.translation
    return equipment.pump(z, line.radius), at(x, y, z) @ yaw(0.0 if side > 0 else np.pi)


def _towards(line: Route, way: Sequence[float]) -> float:
    """The roll, a multiple of a right angle, that turns the x of a route's end towards `way` (3,), scene frame."""
    x, y = line.end.rotation[:, 0] @ way, line.end.rotation[:, 1] @ way
    return float(np.round(np.arctan2(y, x) / RIGHT_ANGLE) * RIGHT_ANGLE)


def _closed(line: Route, start: Floats) -> list[tuple[Mesh, Pose]]:
    """A line's parts, branches included, with a blind flange on its start."""
    lead = Route(line.radius, Pose(TOWARDS_X.rotation, start) @ Pose.from_rotation_vector([np.pi, 0.0, 0.0]))
    lead.flange()
    return [*lead.placed, *line.all_placed()]


def _furnish(layout: Layout, spools: int) -> None:
    """Other spools, bunds, drums and crates in what room there is."""
    rng = layout.rngs["spools"]
    for _ in range(spools):
        decoy = other_spool(rng)
        any(layout.rest(decoy, rng, lying=True) for _ in range(TRIES))
    rng = layout.rngs["furniture"]
    for _ in range(int(rng.integers(2, 5))):
        layout.stand(furniture.drum(), rng)
    for _ in range(2):
        layout.stand(furniture.crates(rng), rng)
    layout.stand(furniture.stairs(), rng, at_wall=True)


def _named(name: str, placed: tuple[Mesh, Pose]) -> tuple[Mesh, Pose]:
    mesh, pose = placed
    return Mesh(name, mesh.vertices, mesh.faces), pose
