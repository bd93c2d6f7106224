"""Where to stand: free places for a scanner, and of them the few that together see most of what is looked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError
from scanfind.simulate.layout import Floor, Layout
from scanfind.simulate.placement import Occupancy, sample_points
from scanfind.simulate.scene import Scene

Floats = NDArray[np.float64]

SCANNER_HEIGHT_M = 1.6
# Outside the box frame, whose inside is nowhere farther from a member.
SCANNER_NEAR_M = 1.1
# The least share of a target's surface that the stations together must see.
LEAST_VISIBLE = 0.3
# Candidates tried, and points of each target's surface they are judged by: shares within 2 %.
SPOTS, SAMPLES = 80, 1500


def manned(layout: Layout, count: int) -> Scene | None:
    """A filled place with `count` scanners where they see most; None if less than LEAST_VISIBLE of a target is seen."""
    unmanned = Scene(tuple(layout.objects), np.zeros((0, 3)))
    where, seen = best_stations(unmanned, free_spots(layout.room, layout.floors, layout.rngs["stations"]), count)
    return Scene(unmanned.objects, where) if seen.min() >= LEAST_VISIBLE else None


def scanner_fits(room: Occupancy, foot: Floats) -> bool:
    """Whether a scanner on its tripod, 0.6 m across and 1.9 m high, stands free with its middle at `foot` (3,)."""
    sides = [-0.3, 0.0, 0.3]
    body = np.stack(np.meshgrid(sides, sides, np.arange(0.05, 1.9, 0.1)), axis=-1).reshape(-1, 3)
    return room.fits(foot + body)


def free_spots(room: Occupancy, floors: Sequence[Floor], rng: np.random.Generator, count: int = SPOTS) -> Floats:
    """Up to `count` places (M, 3) where a scanner's eye could be, spread over a room's floors."""
    found = []
    for _ in range(20 * count):
        floor = floors[int(rng.integers(len(floors)))]
        foot = np.array([*rng.uniform(floor.low, floor.high), floor.height])
        if scanner_fits(room, foot):
            foot[2] += SCANNER_HEIGHT_M + rng.uniform(-0.1, 0.1)
            found.append(foot)
        if len(found) == count:
            break
    return np.array(found).reshape(-1, 3)


def best_stations(scene: Scene, spots: Floats, count: int) -> tuple[Floats, Floats]:
    """`count` of the places (M, 3), each that which adds most, and the shares of the targets seen: (count, 3), (T,).

    What counts is the share of each target's surface in sight from any station, twice as much while it is below
    a half, lest one be left out for the sake of another; and, as one more target, all the rest but the background.
    """
    if not 1 <= count <= len(spots):
        msg = f"there is free room for {len(spots)} stations, got {count}: give positions of your own, or fewer"
        raise UsageError(msg)
    caster = scene.caster()

    def surface(k: int, points: int) -> Floats:
        thing = scene.objects[k]
        return thing.pose.move(sample_points(thing.mesh, np.random.default_rng(k), points))

    ids = scene.target_ids()
    rest = [k for k in range(1, len(scene.objects)) if k not in ids] or [0]
    surfaces = [surface(k, SAMPLES) for k in ids]
    surfaces.append(np.concatenate([surface(k, max(1, 2 * SAMPLES // len(rest))) for k in rest]))
    every = np.concatenate(surfaces)
    ends = np.cumsum([len(surface) for surface in surfaces])[:-1]
    sees = np.array([caster.sees(at, every) & (np.linalg.norm(every - at, axis=1) > SCANNER_NEAR_M) for at in spots])

    def shares(seen: NDArray[np.bool_]) -> Floats:
        return np.array([part.mean() for part in np.split(seen, ends)])

    def worth(seen: NDArray[np.bool_]) -> float:
        share = shares(seen)
        return float(np.sum(share + np.minimum(share, 0.5)))

    chosen: list[int] = []
    so_far = np.zeros(len(every), dtype=bool)
    for _ in range(count):
        left = [k for k in range(len(spots)) if k not in chosen]
        best = max(left, key=lambda k: worth(so_far | sees[k]))
        chosen.append(best)
        so_far |= sees[best]
    return spots[chosen], shares(so_far)[: len(ids)]
