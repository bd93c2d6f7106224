"""Air: nothing lies in it, beams went on beyond it, and a pose that hangs in it is given up."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import PointChunk
from scanfind.grid.air import COARSEST_PIXELS, Air, air_of, blocks_about, no_air, pyramids
from scanfind.grid.blocks import block_table, packed, unpacked
from scanfind.grid.depth import DepthMap
from scanfind.grid.moments import MomentGrid
from scanfind.kernels.air import pixel_beside
from scanfind.kernels.blocks import block_in, unpack_block
from scanfind.kernels.grid import cube_pixel
from scanfind.search.draws import air_table

Floats = NDArray[np.float64]

SIDE, CELL = 3.0, 0.2
STATIONS = np.array([[-2.1, -1.7, 0.3], [2.0, 1.9, -0.4]])
# A box in the middle of the room, which hides part of it from each station.
BOX = 0.6


@cache
def seen_from(station: int) -> Floats:
    """What a scanner sees of the walls of a room and of the box in it, (N, 3)."""
    ways = np.random.default_rng(station).standard_normal((60_000, 3))
    origin = STATIONS[station]
    with np.errstate(divide="ignore"):
        to_wall = np.max(np.stack([(SIDE - origin) / ways, (-SIDE - origin) / ways]), axis=0).min(axis=1)
        into, out = np.sort(np.stack([(BOX - origin) / ways, (-BOX - origin) / ways]), axis=0)
    into, out = into.max(axis=1), out.min(axis=1)
    reach = np.where((into < out) & (into > 0.0), into, to_wall)
    return np.asarray(origin + ways * reach[:, None])


@cache
def room() -> tuple[list[DepthMap], Floats]:
    """What both saw, as maps and as points."""
    grid = MomentGrid(0.05, np.zeros(3))
    for station in range(2):
        points = seen_from(station)
        grid.add(PointChunk(points, {}, np.arange(len(points)), origin=STATIONS[station]))
    return [beams.ranges() for beams in grid.beams()], np.concatenate([seen_from(0), seen_from(1)])


@cache
def air(jobs: int = 1) -> Air:
    return air_of(*room(), CELL, jobs)


def cells_of(air: Air) -> Floats:
    """The middles of all cells of air, (N, 3)."""
    found = []
    for key, block in zip(air.where.hash_keys.tolist(), air.where.hash_values.tolist(), strict=True):
        if key >= 0:
            bits = np.unpackbits(air.cells[block].view(np.uint8), bitorder="little")
            at = np.flatnonzero(bits)
            local = np.stack([at >> 6, (at >> 3) & 7, at & 7], axis=1)
            found.append((8 * np.array(unpack_block(key)) + local + 0.5) * air.cell)
    return np.concatenate(found)


def test_all_beams_of_a_scanner_through_a_cell_of_air_went_on() -> None:
    cells = cells_of(air())
    assert len(cells) > 5000
    for cell in cells[:: len(cells) // 300]:
        went_on = []
        for station in range(2):
            ends = seen_from(station) - STATIONS[station]
            with np.errstate(divide="ignore"):
                sides = np.stack([cell - STATIONS[station] + side * 0.5 * CELL for side in (-1.0, 1.0)])
                into, out = np.sort(sides[:, None] / ends, axis=0)
            into, out = into.max(axis=1), out.min(axis=1)
            through = (into <= out) & (out > 0.0)
            went_on.append(through.any() and bool((out[through] < 1.0).all()))
        assert any(went_on)


def test_most_of_what_is_seen_through_is_air_and_nothing_behind_a_wall() -> None:
    cells = cells_of(air())
    assert (np.abs(cells) < SIDE).all()
    assert not (np.abs(cells) < BOX).all(axis=1).any()
    # Of the room less what is near its walls, the box and the scanners.
    inner = np.abs(cells).max(axis=1) < SIDE - 0.6
    assert inner.sum() * CELL**3 > 0.4 * ((2 * (SIDE - 0.6)) ** 3 - (2 * BOX) ** 3)


def test_where_something_is_there_is_no_air() -> None:
    found, (_, points) = air(), room()
    for point in points[::500]:
        cell = np.floor(point / found.cell).astype(int)
        block = block_in(found.where, *(cell >> 3).tolist())
        x, y, z = (cell & 7).tolist()
        assert block >= 0
        assert not int(found.cells[block, x]) >> (8 * y + z) & 1


def test_threads_mark_the_same_air() -> None:
    np.testing.assert_array_equal(air(2).cells, air(1).cells)


def test_nobody_knows_of_air_without_a_scanner() -> None:
    for nothing in (air_of([], room()[1], CELL, 1), air_of(room()[0], np.empty((0, 3)), CELL, 1), no_air()):
        assert len(nothing.cells) == 0
        assert block_in(nothing.where, 0, 0, 0) == -1


def test_where_no_beam_came_back_nothing_is_known() -> None:
    maps, points = room()
    blind = [depth._replace(ranges=np.full_like(depth.ranges, np.inf)) for depth in maps]
    assert not air_of(blind, points, CELL, 1).cells.any()


def test_a_stray_point_far_away_costs_the_blocks_about_it() -> None:
    keys = blocks_about(np.array([[0.0, 0.0, 0.0], [4e5, 0.0, 0.0]]), 1.0)
    assert len(keys) == 2 * 7**3
    assert {unpack_block(int(key)) for key in keys} >= {(0, 0, 0), (400_000, 0, 0), (3, -3, 3), (400_003, 3, -3)}


@given(st.integers(0, 5), st.integers(-1, 8), st.integers(-1, 8))
def test_beside_a_pixel_at_the_edge_of_a_face_is_one_of_the_next(face: int, i: int, j: int) -> None:
    edge = 8
    pixel = int(pixel_beside(face, i, j, edge))
    assert 0 <= pixel < 6 * edge**2
    inside = 0 <= i < edge and 0 <= j < edge
    assert (pixel // edge**2 == face) == inside


def test_coarser_maps_hold_the_nearest_of_the_finer() -> None:
    maps, _ = room()
    edges, starts, ranges = pyramids(maps)
    assert edges[0] == maps[0].edge
    assert edges[-1] >= COARSEST_PIXELS
    assert ranges.shape == (2, (6 * edges**2).sum())
    for way in np.random.default_rng(0).standard_normal((300, 3)):
        seen = [ranges[:, start + cube_pixel(*way, edge)] for edge, start in zip(edges, starts, strict=True)]
        assert (np.diff(np.minimum(seen, 1e9), axis=0) <= 0.0).all()
        np.testing.assert_array_equal(seen[0], [depth.ranges[cube_pixel(*way, edges[0])] for depth in maps])


@pytest.mark.parametrize("most", [1 << 20, 10])
def test_blocks_are_found_whether_their_box_is_small_or_large(most: int) -> None:
    at = np.unique(np.random.default_rng(4).integers(-9, 9, (300, 3)), axis=0)
    table = block_table(packed(at), most)
    assert (len(table.places) > 0) == (most > 10)
    np.testing.assert_array_equal(unpacked(packed(at)), at)
    number = {tuple(block): k for k, block in enumerate(at.tolist())}
    for block in np.random.default_rng(5).integers(-12, 12, (3000, 3)).tolist():
        assert block_in(table, *block) == number.get(tuple(block), -1)


# ── Wald's test ──


def survivors(chance: float, runs: int = 4000) -> tuple[float, float]:
    """Share of hypotheses kept when samples hang in the air with a chance, and the mean number looked at."""
    most = air_table(192)
    lost = np.cumsum(np.random.default_rng(3).random((runs, 192)) < chance, axis=1) > most[1:]
    looked = np.where(lost.any(axis=1), lost.argmax(axis=1) + 1, 192)
    return float((~lost.any(axis=1)).mean()), float(looked.mean())


@pytest.mark.parametrize(("chance", "least", "most"), [(0.0, 1.0, 1.0), (0.05, 0.99, 1.0), (0.1, 0.97, 1.0)])
def test_a_pose_that_hardly_hangs_in_the_air_is_kept(chance: float, least: float, most: float) -> None:
    assert least <= survivors(chance)[0] <= most


@pytest.mark.parametrize(("chance", "looked"), [(0.3, 30.0), (0.42, 15.0), (1.0, 5.0)])
def test_one_that_does_is_given_up_early(chance: float, looked: float) -> None:
    kept, mean = survivors(chance)
    assert kept < 0.005
    assert mean < looked
