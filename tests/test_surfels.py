"""The surfel grid: the same to the last bit whatever the chunks, order, threads or place; normals as PCA has them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import naive
from scanfind.cloud import PointChunk, PointCloud
from scanfind.grid.moments import MomentGrid, empty_hash
from scanfind.grid.scene import GridParameters, Scene, build_scene, without_sparse_levels
from scanfind.grid.surfels import Surfels
from scanfind.kernels.blocks import BIAS, fill_hash, find_block, pack_block, row_at, unpack_block
from scanfind.kernels.surfels import smallest_eigenvector
from scanfind.scans.sources import Sources

Floats = NDArray[np.float64]

CELL = 0.05
ORIGIN = np.array([0.3, -2.0, 3.0])


def chunk(xyz: Floats, origin: Floats | None = ORIGIN) -> PointChunk:
    return PointChunk(np.ascontiguousarray(xyz), {}, np.arange(len(xyz)), origin=origin)


def grid_of(parts: Sequence[PointChunk], cell: float = CELL, offset: Floats | None = None, jobs: int = 1) -> MomentGrid:
    grid = MomentGrid(cell, np.zeros(3) if offset is None else offset, jobs)
    for part in parts:
        grid.add(part)
    return grid


def bumpy(count: int, seed: int = 0) -> Floats:
    """A rolling floor with a wall, 2 × 2 m, 2 mm of noise, and stray points above it."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1, 1, (2, count))
    floor = np.stack([x, y, 0.1 * np.sin(3 * x) * np.cos(2 * y)], axis=1)
    wall = np.stack([x, np.full(count, 0.9), np.abs(y)], axis=1)
    points = np.where(rng.random(count)[:, None] < 0.7, floor, wall) + rng.normal(scale=0.002, size=(count, 3))
    points[::50] = rng.uniform(-1, 1, (len(points[::50]), 3))
    return points


def fitted(grid: MomentGrid, least: int = 5, jobs: int = 1) -> Surfels:
    return Surfels(grid, least, jobs).fit()


def assert_equal(one: Surfels, other: Surfels) -> None:
    """To the last bit; the grids' own rows and blocks may lie in any order."""
    for name in ("means", "normals", "flatness", "points", "cell_of", "signed"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    np.testing.assert_array_equal(one.cells.block_keys[one.cells.order], other.cells.block_keys[other.cells.order])
    for name in ("first_cell", "locals", "cell"):
        np.testing.assert_array_equal(getattr(one.cells, name), getattr(other.cells, name), err_msg=name)
    for name in ("first_surfel", "sides"):
        mine, theirs = getattr(one, name)[one.cells.rows], getattr(other, name)[other.cells.rows]
        np.testing.assert_array_equal(mine, theirs, err_msg=name)


def assert_same_moments(one: MomentGrid, other: MomentGrid) -> None:
    for mine, theirs in zip(moments_of(one), moments_of(other), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def moments_of(grid: MomentGrid) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Address (block, cell, view) and moments of every row, by address."""
    blocks = grid.blocks()
    cells = grid.block_rows.of(blocks)
    block, local = np.nonzero(cells >= 0)
    row, found = cells[block, local], []
    while len(row):  # along each cell's chain of views
        found.append(np.stack([grid.block_keys[blocks][block], local, grid.links[row, 0], row], axis=1))
        more = grid.links[row, 1] >= 0
        block, local, row = block[more], local[more], grid.links[row, 1][more]
    every = np.concatenate(found)
    every = every[np.lexsort(every[:, :3].T[::-1])]
    return every[:, :3], grid.moments[every[:, 3]]


# ── addresses ──


@settings(deadline=None)
@given(*[st.one_of(st.integers(-BIAS, BIAS - 1), st.sampled_from([-BIAS, -1, 0, BIAS - 1]))] * 3)
def test_packing_a_block_loses_nothing(x: int, y: int, z: int) -> None:
    key = pack_block(x, y, z)
    assert key >= 0  # -1 is an empty slot
    assert unpack_block(key) == (x, y, z)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.integers(1, 3000), st.sampled_from([3, 100, BIAS - 1]))
def test_a_hash_finds_what_was_put_in_and_nothing_else(seed: int, count: int, reach: int) -> None:
    rng = np.random.default_rng(seed)
    keys = np.unique([pack_block(*at) for at in rng.integers(-reach, reach + 1, (2 * count, 3)).tolist()])
    there, absent = keys[: len(keys) // 2 + 1], keys[len(keys) // 2 + 1 :]
    hash_keys, hash_values = empty_hash(len(there))
    assert len(hash_keys) & (len(hash_keys) - 1) == 0
    assert len(hash_keys) >= 2 * len(there)
    fill_hash(there, np.arange(len(there)), hash_keys, hash_values)
    assert [find_block(hash_keys, hash_values, key) for key in there] == list(range(len(there)))
    assert all(find_block(hash_keys, hash_values, key) == -1 for key in absent)


def test_only_octants_with_a_point_have_room() -> None:
    # Cells 0 and 63 of a block's eight octants are its corners and its middle.
    corners = np.array([[x, y, z] for x in (0, 7) for y in (0, 7) for z in (0, 7)])
    for some in ([0], [2, 5], list(range(8))):
        grid = grid_of([chunk((corners[some] + 0.5) * CELL)])
        (block,) = grid.blocks()
        places = corners[some] @ [64, 8, 1]
        rows = grid.block_rows.of(np.array([block]))[0]
        np.testing.assert_array_equal(np.flatnonzero(rows >= 0), np.sort(places))
        assert [row_at(grid.block_rows, block, place) for place in range(512)] == rows.tolist()
        assert grid.moments[rows[places], 0].tolist() == [1] * len(some)
        assert np.count_nonzero(grid.block_rows.octants[block] >= 0) == len(some)


# ── sums ──


@settings(deadline=None, max_examples=30)
@given(st.lists(st.integers(0, 5000), max_size=100), st.integers(0, 2**32))
def test_chunks_and_order_change_nothing(cuts: list[int], seed: int) -> None:
    points = bumpy(5000)
    whole = grid_of([chunk(points)])
    shuffled = np.random.default_rng(seed).permutation(points)
    pieces = grid_of([chunk(part) for part in np.split(shuffled, sorted(cuts))])
    assert_same_moments(whole, pieces)
    assert_equal(fitted(whole), fitted(pieces))
    for one, other in zip(whole.beams(), pieces.beams(), strict=True):
        np.testing.assert_array_equal(one.nearest, other.nearest)


@pytest.mark.parametrize("jobs", [1, 3])
def test_arrays_grow_without_a_trace(monkeypatch: pytest.MonkeyPatch, jobs: int) -> None:
    # Far more blocks and cells than there is room for at first, in one chunk and in many.
    points = np.random.default_rng(0).uniform(-12, 12, (100_000, 3))
    roomy = grid_of([chunk(points)], 0.1)
    monkeypatch.setattr("scanfind.grid.moments.EMPTY_BLOCKS", 1 << 10)
    monkeypatch.setattr("scanfind.grid.moments.EMPTY_OCTANTS", 1 << 12)
    monkeypatch.setattr("scanfind.grid.moments.EMPTY_ROWS", 1 << 14)
    whole = grid_of([chunk(points)], 0.1, jobs=jobs)
    assert len(whole.block_keys) > 1 << 10
    assert len(whole.block_rows.cells) > 1 << 12
    assert len(whole.moments) > 1 << 14
    assert_same_moments(whole, roomy)
    assert_same_moments(whole.coarser(), roomy.coarser())
    assert_equal(fitted(whole), fitted(grid_of([chunk(p) for p in np.array_split(points, 7)], 0.1)))


@pytest.mark.parametrize("jobs", [2, 3, 8, 20])
def test_threads_that_share_a_pass_change_nothing(jobs: int) -> None:
    points, other = bumpy(20_000), bumpy(3000, seed=1)
    parts = [chunk(points), chunk(other, np.array([1.0, 1.0, 2.0])), chunk(other[::-1])]
    alone, together = grid_of(parts), grid_of(parts, jobs=jobs)
    assert_same_moments(alone, together)
    assert_same_moments(alone.coarser().coarser(), together.coarser().coarser())
    assert_equal(fitted(alone), fitted(together, jobs=jobs))
    for one, two in zip(alone.beams(), together.beams(), strict=True):
        np.testing.assert_array_equal(one.origin, two.origin)
        np.testing.assert_array_equal(one.nearest, two.nearest)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.integers(1, 3))
def test_a_coarser_level_is_the_grid_of_larger_cells(seed: int, levels: int) -> None:
    # On the lattice of the coarse cells' units (1/65536 of a cell, a power of two) nothing is rounded at any level.
    cell = 2.0**-5
    points = np.random.default_rng(seed).integers(-(2**20), 2**20, (2000, 3)) * (cell * 2**levels / 65536.0)
    coarse, direct = grid_of([chunk(points)], cell), grid_of([chunk(points)], cell * 2**levels)
    for _ in range(levels):
        coarse = coarse.coarser()
    (addresses, sums), (same, expected) = moments_of(coarse), moments_of(direct)
    np.testing.assert_array_equal(addresses, same)
    # A unit is a share of the finest cell; the sums count in it, of degree 0, 1 and 2.
    degree = np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2, 0, 0, 0])
    np.testing.assert_array_equal(sums, expected * 2 ** (levels * degree))
    mine, theirs = fitted(coarse), fitted(direct)
    np.testing.assert_allclose(mine.means, theirs.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(mine.flatness, theirs.flatness, rtol=0, atol=1e-9)


def test_every_point_is_counted_once_or_said_to_be_too_far() -> None:
    points = bumpy(3000)
    points[:7, 1] = [1e7, -1e7, 1e300, -1e300, 3e5, 1e18, 1e19]  # ± 209 km are reached with cells of 5 cm
    grid = grid_of([chunk(points)])
    assert grid.points == 3000
    assert grid.unaddressable == 7
    assert moments_of(grid)[1][:, 0].sum() == 2993
    assert fitted(grid.coarser()).points.sum() == 2993
    assert fitted(grid).points.sum() == 2993


def test_the_reach_is_half_a_million_blocks() -> None:
    edge = 8 * (BIAS - 2) * CELL
    points = np.array([[edge - 1.0, 0, 0], [1.0 - edge, 0, 0], [edge + 1.0, 0, 0], [0, 0, -edge - 1.0]])
    grid = grid_of([chunk(points)])
    assert grid.unaddressable == 2
    np.testing.assert_allclose(np.sort(fitted(grid).means[:, 0]), [1.0 - edge, edge - 1.0], rtol=0, atol=1e-6)


def test_what_is_no_number_never_gets_in() -> None:
    points = bumpy(1000)
    points[::10, 0], points[1::10, 1], points[2::10] = np.nan, np.inf, [np.inf, -np.inf, 0.0]
    sources = Sources(PointCloud(points))
    chunks = list(sources.chunks())
    assert sum(map(len, chunks)) == 700
    assert all(np.isfinite(c.xyz).all() for c in chunks)
    assert sources.all[0].told().dropped == 300
    assert sources.all[0].told().points == 700


@settings(deadline=None, max_examples=20)
@given(st.tuples(*[st.integers(-5_000_000, 5_000_000).map(lambda k: 2 * k)] * 3))
def test_a_scan_far_away_gives_the_same_surfels(far: tuple[int, int, int]) -> None:
    # Points on a lattice of 2^-20 m (1 µm): adding whole metres, the grid's own rounding included, is exact.
    points = np.round(bumpy(2000) * 2.0**20) / 2.0**20
    shift = np.array(far, np.float64)
    here, there = MomentGrid(CELL), MomentGrid(CELL)
    here.add(chunk(points))
    there.add(chunk(points + shift, ORIGIN + shift))
    one, other = fitted(here), fitted(there)
    np.testing.assert_array_equal(other.cells.offset - one.cells.offset, shift)
    assert_equal(one, other)
    np.testing.assert_array_equal(here.beams()[0].nearest, there.beams()[0].nearest)


# ── surfels ──


@pytest.mark.parametrize("jobs", [2, 3, 8])
def test_threads_change_nothing(jobs: int) -> None:
    grid = grid_of([chunk(bumpy(20_000))])
    assert_equal(fitted(grid), fitted(grid, jobs=jobs))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.integers(1, 6))
def test_cells_fitted_in_turn_are_those_fitted_at_once(seed: int, turns: int) -> None:
    grid, rng = grid_of([chunk(bumpy(5000)), chunk(bumpy(2000, 1), ORIGIN + 4.0)]), np.random.default_rng(seed)
    whole, pieces = fitted(grid), Surfels(grid)
    for _ in range(turns):
        some = rng.integers(0, len(whole.cells), 300)
        of_all, of_some = whole.of(some), pieces.of(some)
        for name in ("means", "normals", "flatness", "points", "cell_of"):
            np.testing.assert_array_equal(getattr(whole, name)[of_all], getattr(pieces, name)[of_some], err_msg=name)
    assert len(np.unique(pieces.cell_of)) <= 300 * turns  # and no other
    pieces.fit()
    assert len(pieces) == len(whole)
    every = np.arange(len(whole.cells))
    np.testing.assert_array_equal(pieces.means[pieces.of(every)], whole.means[whole.of(every)])


@pytest.mark.parametrize("least", [1, 5, 12])
def test_means_and_normals_are_those_of_plain_pca(least: int) -> None:
    points = bumpy(4000, 3)
    found = fitted(grid_of([chunk(points)]), least)
    expected = naive.surfels(points, np.broadcast_to(ORIGIN, points.shape), CELL, least)
    assert len(found.means) == len(expected)
    assert (found.sides[found.cells.rows] == 1).all()  # a single scanner sees one side of everything
    compared = 0
    for mean, normal in zip(found.means, found.normals, strict=True):
        mean_expected, normal_expected, sure = expected[tuple(np.floor(mean / CELL).astype(int).tolist())]
        # Half of 1/65536 of a cell each way.
        np.testing.assert_allclose(mean, mean_expected, rtol=0, atol=CELL / 65536.0)
        assert bool(normal.any()) == bool(normal_expected.any())
        if sure:
            assert normal @ normal_expected > np.cos(0.02)
            compared += 1
    assert compared > 200
    np.testing.assert_array_equal(found.has_normal(), found.normals.any(axis=1))
    np.testing.assert_allclose(np.linalg.norm(found.normals[found.has_normal()], axis=1), 1.0, rtol=0, atol=1e-12)


def test_a_cell_with_few_neighbours_has_presence_and_no_normal() -> None:
    rng = np.random.default_rng(0)
    lonely = np.array([5.01, 5.01, 5.01]) + rng.uniform(0, 0.02, (50, 3))
    found = fitted(grid_of([chunk(np.concatenate([bumpy(5000), lonely]))]))
    there = np.abs(found.means - 5.02).max(axis=1) < 0.05
    assert np.count_nonzero(there) == 1
    assert not found.normals[there].any()
    assert found.points[there] == 50


def sphere(count: int, noise: float = 0.0) -> Floats:
    rng = np.random.default_rng(4)
    ways = rng.standard_normal((count, 3))
    points: Floats = ways / np.linalg.norm(ways, axis=1)[:, None] * (1.0 + noise * rng.standard_normal(count)[:, None])
    return points


@pytest.mark.parametrize("inside", [True, False])
def test_normals_point_to_the_scanner(inside: bool) -> None:
    points, at = sphere(60_000, 0.001), np.zeros(3) if inside else np.array([8.0, 3.0, 2.0])
    if not inside:
        points = points[points @ at > 1.3]  # what a scanner out there sees of it
    found = fitted(grid_of([chunk(points, at)]))
    sound = found.has_normal()
    radial = found.means[sound] / np.linalg.norm(found.means[sound], axis=1)[:, None]
    facing = (found.normals[sound] * radial).sum(axis=1) * (-1.0 if inside else 1.0)
    assert np.count_nonzero(sound) > 300
    assert (facing > 0.9).mean() > 0.97  # the rim of what is seen has one-sided neighbours
    assert ((at - found.means[sound]) * found.normals[sound]).sum(axis=1).min() > -1e-9


def test_without_a_scanner_normals_have_no_side() -> None:
    points = bumpy(3000)
    assert fitted(grid_of([chunk(points)])).signed
    assert not fitted(grid_of([chunk(points, None)])).signed
    mixed = grid_of([chunk(points), chunk(points, None)])
    assert not fitted(mixed).signed
    assert len(mixed.beams()) == 1


def plate(count: int, thickness: float, turn: Floats) -> tuple[Floats, Floats]:
    """Points on the upper and on the lower face of a plate of 1 × 1 m in z = ± thickness / 2, turned."""
    rng = np.random.default_rng(5)
    faces = []
    for z in (0.5 * thickness, -0.5 * thickness):
        xy = rng.uniform(-0.5, 0.5, (count, 2))
        faces.append(np.column_stack([xy, z + rng.normal(scale=0.0005, size=count)]) @ turn.T)
    return faces[0], faces[1]


@pytest.mark.parametrize("tilt", [0.0, 0.3, 0.8])
def test_a_thin_plate_seen_from_both_sides_has_two_faces(tilt: float) -> None:
    from scanfind.pose import rotation_from_vector

    turn = rotation_from_vector([tilt, 0.0, 0.0])
    up = turn[:, 2]
    # 10 mm of steel within cells of 50 mm, its middle in the middle of a layer of cells where it is level.
    middle = 0.5 * CELL * np.array([0.0, 0.0, 1.0])
    front, back = (face + middle for face in plate(40_000, 0.01, turn))
    parts = [chunk(front, 4.0 * up + 0.3), chunk(back, -4.0 * up + 0.3)]
    found = fitted(grid_of(parts))
    inner = found.has_normal() & (np.abs((found.means - middle) @ turn[:, :2]).max(axis=1) < 0.4)
    inner &= found.points >= 20  # the mean of so many is right within a fifth of their noise
    height, facing = (found.means[inner] - middle) @ up, found.normals[inner] @ up
    assert (np.abs(facing) > 0.99).all()
    np.testing.assert_allclose(height, np.sign(facing) * 0.005, rtol=0, atol=0.001)
    assert np.count_nonzero(facing > 0) == pytest.approx(np.count_nonzero(facing < 0), rel=0.1)
    if tilt == 0.0:
        cells = found.sides[found.cells.rows]
        assert (cells == 2).mean() > 0.8


def test_a_slanted_thin_plate_between_two_near_scanners_has_two_faces() -> None:
    across = np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    turn = np.stack([np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0), np.array([0.0, 0.0, 1.0]), across], axis=1)
    front, back = plate(40_000, 0.01, turn)
    found = fitted(grid_of([chunk(front, np.array([5.0, 1.0, 1.0])), chunk(back, np.array([1.0, 5.0, 1.0]))]))
    inner = found.has_normal() & (np.abs(found.means @ turn[:, :2]).max(axis=1) < 0.4)
    np.testing.assert_allclose(np.abs(found.means[inner] @ across), 0.005, rtol=0, atol=0.001)


@settings(deadline=None, max_examples=300)
@given(
    st.integers(0, 2**32),
    st.sampled_from([(0.0, 1.0, 2.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 2.0), (1e-9, 1.0, 1.0), (0.0,) * 3]),
    st.sampled_from([1e-8, 1.0, 1e9]),
)
def test_smallest_eigenvector_is_eigh_s(seed: int, values: tuple[float, float, float], scale: float) -> None:
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((3, 3)))[0] if seed % 3 else np.eye(3)[rng.permutation(3)]
    matrix = scale * (basis @ np.diag(values) @ basis.T)
    matrix = 0.5 * (matrix + matrix.T)
    a, b, c = matrix
    *vector, low, middle, high = smallest_eigenvector(a[0], a[1], a[2], b[1], b[2], c[2])
    size = scale * max(*values, 1e-30)
    np.testing.assert_allclose([low, middle, high], np.linalg.eigvalsh(matrix), rtol=0, atol=1e-7 * size)
    assert np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-9)
    if values[1] - values[0] > 1e-3 * values[2]:  # the vector of a double value is anyone's
        np.testing.assert_allclose(matrix @ vector, np.array(vector) * low, rtol=0, atol=1e-7 * size)


def test_flatness_is_the_noise_across_a_plane() -> None:
    rng = np.random.default_rng(6)
    points = np.column_stack([rng.uniform(-1, 1, (200_000, 2)), 0.02 + rng.normal(scale=0.003, size=200_000)])
    found = fitted(grid_of([chunk(points)]))
    assert np.median(found.flatness) == pytest.approx(0.003, rel=0.02)


# ── the scene made of them ──


def resampled(points: Floats, cell: float, parameters: GridParameters) -> Scene:
    """As for a model of 2 m, sought with cells of 50 mm in the sequential test."""
    return build_scene(grid_of([chunk(points)], cell), 2.0, parameters, 40.0, 2)


def test_cells_grow_until_most_points_have_a_normal_and_no_further() -> None:
    points = bumpy(4000)
    for share in (0.3, 0.9, 1.0):
        parameters = GridParameters(points_per_cell=0.0, normal_share=share, least_cells_across=10.0)
        scene = resampled(points, 0.01, parameters)
        assert scene.fine.cell <= 0.2
        assert scene.coarse.cell == 2 * scene.fine.cell
        assert scene.fine.cell >= 0.1 or share_with_normal(points, scene.fine.cell) >= share
        assert scene.fine.cell == 0.01 or share_with_normal(points, 0.5 * scene.fine.cell) < share
    assert resampled(points, 0.01, GridParameters(cell_m=0.01, normal_share=1.0)).fine.cell == 0.01


@pytest.mark.parametrize("across", [10.0, 60.0])
def test_no_scene_is_built_of_levels_that_are_too_sparse(across: float) -> None:
    points, parameters = bumpy(4000), GridParameters(least_cells_across=across)
    whole = grid_of([chunk(points)], 0.01)
    rest = without_sparse_levels(whole, 2.0, parameters)
    assert rest.cell > whole.cell
    for diameter in (2.0, 5.0):  # the smallest model, and one searched for in cells of its own
        mine, theirs = (build_scene(grid, diameter, parameters, 40.0, 1) for grid in (rest, whole))
        assert_equal(mine.fine.fit(), theirs.fine.fit())
        assert_equal(mine.around, theirs.around)
    kept = GridParameters(cell_m=0.01, least_cells_across=across)
    assert without_sparse_levels(whole, 2.0, kept) is whole


def test_cells_grow_until_the_scan_fills_them() -> None:
    points = bumpy(4000)
    for sparse in (2.0, 8.0, 1e9):
        scene = resampled(points, 0.01, GridParameters(points_per_cell=sparse, least_cells_across=10.0))
        full = scene.fine.cell >= 0.1 or grid_of([chunk(points)], scene.fine.cell).points_per_row() >= sparse
        assert full
    assert resampled(points, 0.01, GridParameters(cell_m=0.01, points_per_cell=1e9)).fine.cell == 0.01


def share_with_normal(points: Floats, cell: float) -> float:
    """Of the points, in cells of that size; the middle of the grid is where the scene has it."""
    found = fitted(grid_of([chunk(points)], cell))
    return float(found.points[found.has_normal()].sum() / len(points))


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.zeros((500, 3)), np.array([[0.0, 0, 0], [1.0, 1, 1]])])
def test_scenes_of_next_to_nothing_are_scenes(points: Floats) -> None:
    scene = resampled(points, CELL, GridParameters())
    assert not scene.fine.has_normal().any()
    assert scene.points == len(points)


def test_of_points_outside_of_a_box_only_beams_are_noted() -> None:
    """The grid holds what one of the points inside would, and every depth map is that of all points."""
    rng, origin = np.random.default_rng(0), np.array([0.3, 0.2, 0.1])
    xyz, box = rng.uniform(-2.0, 2.0, (20_000, 3)), np.array([[-1.0, -0.5, -2.0], [1.0, 2.0, 0.5]])
    inside = ((xyz >= box[0]) & (xyz <= box[1])).all(axis=1)
    grids = [MomentGrid(0.1, np.zeros(3), jobs=jobs, box=limits) for jobs, limits in ((3, box), (1, None), (1, None))]
    for grid, points in zip(grids, (xyz, xyz, xyz[inside]), strict=True):
        for half in np.array_split(points, 2):
            grid.add(PointChunk(half, {}, np.arange(len(half)), origin=origin))
        grid.release()
    boxed, whole, few = grids
    assert boxed.points == few.points == inside.sum()
    np.testing.assert_array_equal(np.concatenate(list(boxed.rows())), np.concatenate(list(few.rows())))
    np.testing.assert_array_equal(boxed.beams()[0].nearest, whole.beams()[0].nearest)
