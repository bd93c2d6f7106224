"""A steel frame building made from a seed: columns, beams, joists, braces, a deck, stairs, modules standing in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from scanfind.errors import UsageError
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate import furniture
from scanfind.simulate.layout import Floor, Layout, at, targets_of
from scanfind.simulate.objects import box_frame
from scanfind.simulate.parts import assemble, blocks
from scanfind.simulate.scene import Scene
from scanfind.simulate.stations import manned
from scanfind.simulate.steel import along, hollow_beam, i_beam

FRAME_M = (22.0, 14.0, 8.4)
GRID_X_M, GRID_Y_M = (2.0, 8.0, 14.0, 20.0), (2.5, 7.0, 11.5)
# Tops of the steel: the deck, 0.12 m, lies on the lower one and ends at 4 m; the upper one carries nothing yet.
LEVELS_M, DECK_M = (3.88, 7.8), 4.0
COLUMN_M, BEAM_M, JOIST_M = 0.26, (0.15, 0.3), (0.1, 0.2)
# Bays along x whose deck is on: the building is half done.
DECKED = 2
LAYOUTS = 20


def frame(
    seed: int, target: Mesh | Sequence[Mesh] | None = None, copies: int = 2, stations: int = 4, stacks: int = 4
) -> Scene:
    """A steel frame of 18 x 9 x 7.8 m, two storeys, half its deck on: I columns and beams, joists, HSS cross braces.

    `copies` of each target (the paper's box frame unless given) stand on the ground and on the deck, among stacks of
    steel, crates and drums. `stations` scanners stand where they see most of the targets, LEAST_VISIBLE of each.
    Everything follows from `seed`. Raises UsageError when that cannot be had.
    """
    targets = targets_of(box_frame() if target is None else target, copies, stations, "frame", FRAME_M)
    for attempt in range(LAYOUTS):
        layout = _empty_frame((seed, attempt))
        if not all(layout.add_target(mesh) for mesh in targets for _ in range(copies)):
            continue
        _furnish(layout, stacks)
        if scene := manned(layout, stations):
            return scene
    msg = f"no place in the frame of {FRAME_M} m for {copies} x {[mesh.name for mesh in targets]} in sight; give fewer"
    raise UsageError(msg)


def _empty_frame(seed: tuple[int, int]) -> Layout:
    """Ground and structure, which touch each other by design."""
    x, y, _ = FRAME_M
    ground = blocks("ground", [((-5.0, -5.0, -0.3), (x + 5.0, y + 5.0, 0.0))])
    deck = Floor(DECK_M, (GRID_X_M[0], GRID_Y_M[0]), (GRID_X_M[DECKED], GRID_Y_M[-1]))
    layout = Layout(seed, FRAME_M, ground, decks=(deck,))
    for mesh, pose in _structure():
        layout.fix([layout.painted(mesh.name, mesh, pose)])
    layout.fix([layout.painted("deck", _deck(), Pose.identity())], sunk=0.06)
    return layout


def _structure() -> Iterator[tuple[Mesh, Pose]]:
    """Every member where it belongs, 10 mm off the column it is fixed to."""
    half = COLUMN_M / 2 + 0.01
    for x in GRID_X_M:
        for y in GRID_Y_M:
            yield _column(), at(x, y)
    for top in LEVELS_M:
        z = top - BEAM_M[1] / 2
        for y in GRID_Y_M:
            for a, b in pairwise(GRID_X_M):
                yield _named("beam", i_beam([a + half, y, z], [b - half, y, z], *BEAM_M))
        for c, d in pairwise(GRID_Y_M):
            for x in GRID_X_M:
                yield _named("beam", i_beam([x, c + half, z], [x, d - half, z], *BEAM_M))
            ends = c + BEAM_M[0] / 2 + 0.01, d - BEAM_M[0] / 2 - 0.01
            for a, b in pairwise(GRID_X_M):
                for x in np.linspace(a, b, 4)[1:-1]:
                    level = top - JOIST_M[1] / 2
                    yield _named("joist", i_beam([x, ends[0], level], [x, ends[1], level], *JOIST_M))
    yield from _braces()
    yield _stairs()
    yield from _handrails()


def _braces() -> Iterator[tuple[Mesh, Pose]]:
    """Crosses of hollow sections in the middle bay of both long sides, the two of a cross side by side."""
    a, b = GRID_X_M[1] + 0.25, GRID_X_M[2] - 0.25
    for y in (GRID_Y_M[0], GRID_Y_M[-1]):
        for low, high in ((0.25, LEVELS_M[0] - 0.5), (DECK_M + 0.2, LEVELS_M[1] - 0.5)):
            yield _named("brace", hollow_beam([a, y - 0.05, low], [b, y - 0.05, high], 0.09))
            yield _named("brace", hollow_beam([a, y + 0.05, high], [b, y + 0.05, low], 0.09))


def _column() -> Mesh:
    steel = i_beam([0.0, 0.0, 0.02], [0.0, 0.0, LEVELS_M[-1] + 0.1], COLUMN_M, COLUMN_M)
    base = blocks("base", [((-0.22, -0.22, 0.0), (0.22, 0.22, 0.03))])
    return assemble("column", [steel, (base, Pose.identity())])


def _deck() -> Mesh:
    """The floor on the first bays, left open around the columns that pass through it."""
    low, open_ = LEVELS_M[0], 0.17
    x_end = GRID_X_M[DECKED] + 0.2
    strips = [((GRID_X_M[0] - 0.2, c + open_, low), (x_end, d - open_, DECK_M)) for c, d in pairwise(GRID_Y_M)]
    strips += [
        ((a + open_, GRID_Y_M[0] - 0.2, low), (b - open_, GRID_Y_M[-1] + 0.2, DECK_M))
        for a, b in pairwise(GRID_X_M[: DECKED + 1])
    ]
    return blocks("deck", strips)


def _stairs() -> tuple[Mesh, Pose]:
    """Outside the first long side, up to the deck."""
    return furniture.stairs(steps=20), at(GRID_X_M[0] + 0.5, GRID_Y_M[0] - 1.25)


def _handrails() -> Iterator[tuple[Mesh, Pose]]:
    """Along the deck's open end and its far side."""
    end, far = GRID_X_M[DECKED] + 0.17, GRID_Y_M[-1] + 0.17
    yield _rail(GRID_Y_M[-1] - GRID_Y_M[0] - 0.5), at(end, GRID_Y_M[0] + 0.25, DECK_M) @ along([0, 0, 0], [0, 1, 0])
    yield _rail(GRID_X_M[DECKED] - GRID_X_M[0]), at(GRID_X_M[0], far, DECK_M) @ along([0, 0, 0], [1, 0, 0])


def _rail(length: float) -> Mesh:
    """A handrail 1.1 m high, along z, y up."""
    s = 0.02
    posts = [((-s, 0.0, u - s), (s, 1.1, u + s)) for u in np.linspace(s, length - s, max(2, round(length / 1.5) + 1))]
    return blocks("handrail", [*posts, *[((-s, y, 0.0), (s, y + 2 * s, length)) for y in (0.55, 1.06)]])


def _furnish(layout: Layout, stacks: int) -> None:
    """Stacks of sections on timber, crates and drums."""
    rng = layout.rngs["furniture"]
    for _ in range(stacks):
        layout.stand(_stack(rng), rng)
    for _ in range(3):
        layout.stand(furniture.crates(rng), rng)
    for _ in range(int(rng.integers(2, 5))):
        layout.stand(furniture.drum(), rng)


def _stack(rng: np.random.Generator) -> Mesh:
    """Beams side by side on two pieces of timber."""
    length, width, depth = float(rng.uniform(2.0, 5.0)), 0.15, float(rng.choice([0.15, 0.2, 0.3]))
    count = int(rng.integers(2, 6))
    across = (np.arange(count) - (count - 1) / 2) * (width + 0.03)
    timber = [
        ((u - 0.05, across[0] - 0.2, 0.0), (u + 0.05, across[-1] + 0.2, 0.1)) for u in (-0.3 * length, 0.3 * length)
    ]
    beams = [
        i_beam([-length / 2 + s, y, 0.1 + depth / 2], [length / 2 + s, y, 0.1 + depth / 2], width, depth)
        for y, s in zip(across, rng.uniform(-0.1, 0.1, count), strict=True)
    ]
    return assemble("stack", [(blocks("timber", timber), Pose.identity()), *beams])


def _named(name: str, placed: tuple[Mesh, Pose]) -> tuple[Mesh, Pose]:
    mesh, pose = placed
    return Mesh(name, mesh.vertices, mesh.faces), pose
