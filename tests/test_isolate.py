"""Laws of isolation: each raw point has one owner, whatever the chunks, threads, order or place on Earth."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud, PointChunk
from scanfind.detection import Detection, IsolatedPoints
from scanfind.errors import InvalidGeometryError, UsageError
from scanfind.isolation.isolate import IsolateParameters, Isolator, Placed, isolate, left_over
from scanfind.isolation.own import IsolationParameters, with_own_points
from scanfind.library.near_surface import near_samples, near_triangles, signed_distances
from scanfind.pose import Pose

Floats = NDArray[np.float64]

TOLERANCE = 0.02
PARAMETERS = IsolateParameters(TOLERANCE)
BOX = near_triangles(np.asarray(trimesh.creation.box((0.8, 0.6, 0.4)).triangles), TOLERANCE)
TUBE = near_triangles(np.asarray(trimesh.creation.cylinder(0.2, 1.5, sections=24).triangles), 3 * TOLERANCE)


def poses(count: int, rng: np.random.Generator) -> list[Pose]:
    """Close enough together that surfaces cut each other."""
    return [Pose.from_rotation_vector(rng.normal(size=3), rng.uniform(-0.5, 0.5, 3)) for _ in range(count)]


def scene(placed: list[Placed], rng: np.random.Generator, clutter: int = 2000) -> PointChunk:
    """Clutter, and points around the corners and faces of every placed model."""
    parts = [rng.uniform(-1.5, 1.5, (clutter, 3))]
    for p in placed:
        weights = rng.dirichlet(np.ones(3), size=(len(p.near.corners), 10))
        on_surface = (weights[..., None] * p.near.corners[:, None]).sum(axis=2).reshape(-1, 3)
        parts.append(p.scene_from_model.move(on_surface) + rng.normal(scale=TOLERANCE, size=on_surface.shape))
    xyz = rng.permutation(np.concatenate(parts))
    n = len(xyz)
    attributes: dict[str, NDArray[Any]] = {
        "intensity": rng.random(n).astype(np.float32),
        "red": rng.integers(0, 65536, n).astype(np.uint16),
    }
    return PointChunk(xyz, attributes, np.arange(n) * 3 + 5, scan=2, origin=np.zeros(3), dropped=7)


def assert_same(one: dict[int, IsolatedPoints], other: dict[int, IsolatedPoints]) -> None:
    assert one.keys() == other.keys()
    for key, mine in one.items():
        theirs = other[key]
        for name in ("xyz", "scan_id", "source_index", "deviation"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
        assert mine.attributes.keys() == theirs.attributes.keys()
        for name, values in mine.attributes.items():
            assert values.dtype == theirs.attributes[name].dtype
            np.testing.assert_array_equal(values, theirs.attributes[name])


def cut_at(chunk: PointChunk, ends: list[int]) -> list[PointChunk]:
    """The same points in several chunks, some of them empty."""
    sides = [0, *sorted(e % (len(chunk) + 1) for e in ends), len(chunk)]
    return [
        PointChunk(
            chunk.xyz[a:b],
            {name: values[a:b] for name, values in chunk.attributes.items()},
            chunk.source_index[a:b],
            chunk.scan,
            chunk.origin,
        )
        for a, b in pairwise(sides)
    ]


@pytest.fixture
def crowd() -> tuple[list[Placed], PointChunk]:
    """Five placed models that run into one another, and their points among others."""
    rng = np.random.default_rng(11)
    placed = [
        Placed(k + 1, near, pose)
        for k, (near, pose) in enumerate(zip([BOX, TUBE, BOX, TUBE, BOX], poses(5, rng), strict=True))
    ]
    return placed, scene(placed, rng)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.sampled_from([0.013, 0.04, 0.3]))
def test_the_nearest_surface_within_tolerance_has_the_point(seed: int, count: int, cell: float) -> None:
    rng = np.random.default_rng(seed)
    placed = [Placed(3 * k + 2, [BOX, TUBE][k % 2], pose) for k, pose in enumerate(poses(count, rng))]
    chunk = scene(placed, rng, 500)
    owner, deviation = Isolator(placed, IsolateParameters(TOLERANCE, cell)).cut(chunk)
    # The twin: every point against every model, no cells.
    each = np.array([signed_distances(p.near, p.scene_from_model.inverse().move(chunk.xyz))[0] for p in placed])
    gap = np.nan_to_num(np.abs(each), nan=1.0)
    winner = gap.argmin(axis=0)
    least = gap.min(axis=0)
    brink = np.abs(least - TOLERANCE) < 1e-6
    second = np.sort(gap, axis=0)[1] if count > 1 else np.full(len(chunk), 2.0)
    clear = ~brink & (second - least > 1e-6)
    want = np.where(least <= TOLERANCE, 3 * winner + 2, 0)
    np.testing.assert_array_equal(owner[clear], want[clear])
    mine = clear & (want > 0)
    np.testing.assert_allclose(deviation[mine], each[winner, np.arange(len(chunk))][mine], atol=1e-8)
    np.testing.assert_array_equal(np.isnan(deviation), owner == 0)


def test_each_point_has_one_owner_or_remains(crowd: tuple[list[Placed], PointChunk]) -> None:
    placed, chunk = crowd
    found = isolate([chunk], placed, PARAMETERS)
    rest = list(left_over([chunk], found.values()))
    index = np.concatenate([*(f.source_index for f in found.values()), rest[0].source_index])
    np.testing.assert_array_equal(np.sort(index), chunk.source_index)
    assert all(len(f) for f in found.values())
    row = {int(i): k for k, i in enumerate(chunk.source_index)}
    for f in found.values():
        rows = [row[int(i)] for i in f.source_index]
        np.testing.assert_array_equal(f.xyz, chunk.xyz[rows])
        for name, values in f.attributes.items():
            np.testing.assert_array_equal(values, chunk.attributes[name][rows])
        assert (f.scan_id == 2).all()
        assert (np.abs(f.deviation) <= np.float32(TOLERANCE)).all()
    assert (rest[0].scan, rest[0].dropped, rest[0].origin is chunk.origin) == (2, 7, True)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(0, 10**6), max_size=8))
def test_chunks_do_not_matter(ends: list[int]) -> None:
    rng = np.random.default_rng(12)
    placed = [Placed(k + 1, TUBE, pose) for k, pose in enumerate(poses(2, rng))]
    chunk = scene(placed, rng)
    whole = isolate([chunk], placed, PARAMETERS)
    parts = isolate(cut_at(chunk, ends), placed, PARAMETERS)
    assert_same(whole, parts)
    rest, rests = (list(left_over(chunks, whole.values())) for chunks in ([chunk], cut_at(chunk, ends)))
    np.testing.assert_array_equal(np.concatenate([r.xyz for r in rests]), rest[0].xyz)


def test_a_writer_may_follow_the_stream(crowd: tuple[list[Placed], PointChunk]) -> None:
    placed, chunk = crowd
    isolator = Isolator(placed, PARAMETERS)
    whole = isolate([chunk], placed, PARAMETERS)
    streamed: dict[int, list[Floats]] = {p.id: [] for p in placed}
    for part in cut_at(chunk, [100, 3000]):
        for key, piece in isolator.pieces(part):
            streamed[key].append(piece.xyz)
    for key, pieces in streamed.items():
        np.testing.assert_array_equal(np.concatenate(pieces), whole[key].xyz)


def test_threads_do_not_matter(crowd: tuple[list[Placed], PointChunk]) -> None:
    placed, chunk = crowd
    results = [isolate([chunk], placed, PARAMETERS, jobs=jobs) for jobs in (1, 2, 4)]
    assert_same(results[0], results[1])
    assert_same(results[0], results[2])


def test_the_order_of_models_does_not_matter(crowd: tuple[list[Placed], PointChunk]) -> None:
    placed, chunk = crowd
    assert_same(isolate([chunk], placed, PARAMETERS), isolate([chunk], placed[::-1], PARAMETERS))


def test_the_order_of_points_does_not_matter(crowd: tuple[list[Placed], PointChunk]) -> None:
    placed, chunk = crowd
    order = np.random.default_rng(13).permutation(len(chunk))
    isolator = Isolator(placed, PARAMETERS)
    owner, deviation = isolator.cut(chunk)
    other_owner, other_deviation = isolator.cut(PointChunk(chunk.xyz[order], {}, chunk.source_index[order]))
    np.testing.assert_array_equal(other_owner, owner[order])
    np.testing.assert_array_equal(other_deviation, deviation[order])


def test_the_same_model_twice_in_one_place_goes_to_the_lower_id(crowd: tuple[list[Placed], PointChunk]) -> None:
    placed, chunk = crowd
    twin = replace(placed[0], id=9)
    owner, _ = Isolator([twin, placed[0]], PARAMETERS).cut(chunk)
    assert set(owner.tolist()) == {0, 1}


@pytest.mark.parametrize("far", [1e3, 5e6])
@pytest.mark.parametrize("shifted", [True, False])
def test_moving_the_scene_moves_nothing_else(crowd: tuple[list[Placed], PointChunk], far: float, shifted: bool) -> None:
    placed, chunk = crowd
    rng = np.random.default_rng(14)
    move = Pose.from_rotation_vector(rng.normal(size=3), rng.uniform(-far, far, 3))
    shift = np.round(move.translation, -2) if shifted else np.zeros(3)
    moved = [Placed(p.id, p.near, Pose(np.eye(3), -shift) @ move @ p.scene_from_model) for p in placed]
    owner, deviation = Isolator(placed, PARAMETERS).cut(chunk)
    other_owner, other_deviation = Isolator(moved, PARAMETERS, shift).cut(replace(chunk, xyz=move.move(chunk.xyz)))
    # Coordinates of 5,000 km are a nanometre apart: a point on the brink may change hands, one in 10^5.
    assert (owner != other_owner).mean() < 1e-3
    same = (owner == other_owner) & (owner > 0)
    np.testing.assert_allclose(other_deviation[same], deviation[same], atol=2e-8)


def test_a_piece_of_scan_isolates_too() -> None:
    rng = np.random.default_rng(15)
    x, y = np.meshgrid(np.arange(0, 0.5, 0.01), np.arange(0, 0.5, 0.01))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    cloud = OrientedCloud(flat, np.tile([0.0, 0, 1], (x.size, 1)))
    placed = Placed(1, near_samples(cloud, 0.01, TOLERANCE), poses(1, rng)[0])
    points = rng.uniform([0, 0, -0.05], [0.49, 0.49, 0.05], (5000, 3))
    chunk = PointChunk(placed.scene_from_model.move(points), {}, np.arange(5000))
    owner, deviation = Isolator([placed], PARAMETERS).cut(chunk)
    clear = np.abs(np.abs(points[:, 2]) - TOLERANCE) > 1e-6
    np.testing.assert_array_equal((owner == 1)[clear], (np.abs(points[:, 2]) <= TOLERANCE)[clear])
    np.testing.assert_allclose(deviation[owner == 1], points[owner == 1, 2], atol=1e-8)


def test_fields_that_some_scans_lack_are_filled() -> None:
    surface = BOX.corners.reshape(-1, 3)
    n = len(surface)
    first = PointChunk(surface, {"red": np.full(n, 9, np.uint8), "range": np.ones(n, np.float32)}, np.arange(n), scan=0)
    second = PointChunk(surface, {"red": np.full(n, 900, np.uint16)}, np.arange(n), scan=1)
    nobody = PointChunk(surface + 50.0, {"row": np.zeros(n, np.int32)}, np.arange(n), scan=2)
    found = isolate(
        [first, second, nobody],
        [Placed(1, BOX, Pose.identity()), Placed(2, BOX, Pose(np.eye(3), np.full(3, 9.0)))],
        PARAMETERS,
    )
    mine, none = found[1], found[2]
    assert len(mine) == 2 * n
    np.testing.assert_array_equal(mine.attributes["red"], np.repeat([9, 900], n))
    np.testing.assert_array_equal(mine.attributes["range"], np.repeat(np.array([1, np.nan], np.float32), n))
    np.testing.assert_array_equal(mine.attributes["row"], np.zeros(2 * n))
    np.testing.assert_array_equal(mine.scan_id, np.repeat([0, 1], n))
    assert len(none) == 0
    assert {k: v.dtype for k, v in none.attributes.items()} == {k: v.dtype for k, v in mine.attributes.items()}
    assert mine.attributes["red"].dtype == np.uint16


def test_a_site_of_kilometres_only_grows_the_cells() -> None:
    placed = [Placed(1, BOX, Pose.identity()), Placed(2, BOX, Pose(np.eye(3), np.array([4e4, 3e4, 2e3])))]
    isolator = Isolator(placed, PARAMETERS)
    corners = np.concatenate([p.scene_from_model.move(BOX.corners.reshape(-1, 3)) for p in placed])
    owner, _ = isolator.cut(PointChunk(corners, {}, np.arange(len(corners))))
    np.testing.assert_array_equal(owner, np.repeat([1, 2], len(corners) // 2))


def test_nothing_placed_or_nothing_scanned(crowd: tuple[list[Placed], PointChunk]) -> None:
    placed, chunk = crowd
    assert isolate([chunk], [], PARAMETERS) == {}
    owner, deviation = Isolator([], PARAMETERS).cut(chunk)
    assert not owner.any()
    assert np.isnan(deviation).all()
    assert {k: len(v) for k, v in isolate([], placed, PARAMETERS).items()} == dict.fromkeys(range(1, 6), 0)


def test_the_door() -> None:
    here = Pose.identity()
    for ids in ([1, 1], [0, 1]):
        with pytest.raises(UsageError, match="different ids"):
            Isolator([Placed(k, BOX, here) for k in ids], PARAMETERS)
    with pytest.raises(UsageError, match="reach"):
        Isolator([Placed(1, BOX, here)], IsolateParameters(2 * TOLERANCE))
    with pytest.raises(InvalidGeometryError, match=r"\(3,\)"):
        Isolator([Placed(1, BOX, here)], PARAMETERS, [1.0, 2.0])
    for tolerance, cell in ((0.0, 0.04), (np.nan, 0.04), (0.02, -1.0)):
        with pytest.raises(UsageError, match="positive"):
            IsolateParameters(tolerance, cell)


def around(off: Floats) -> Detection:
    """A detection with points so far from it, (N,) metres."""
    nobody = np.zeros(len(off), np.int32)
    points = IsolatedPoints(np.zeros((len(off), 3)), {}, nobody, np.arange(len(off)), off.astype(np.float32))
    return Detection(1, "tube", Pose.identity(), 1.0, 1.0, 1.0, 0.0, 1.0, 0.0, isolated=points)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.0005, 0.004), st.floats(0.0, 0.3), st.integers(0, 99))
def test_own_points_lie_as_near_as_most_of_them_do(noise: float, neighbours: float, seed: int) -> None:
    """Four of their own sigmas, whatever the grid took for noise, and though others' points lie about."""
    rng, gate = np.random.default_rng(seed), 0.05
    own = rng.normal(scale=noise, size=1000)
    others = rng.uniform(-gate, gate, int(1000 * neighbours))
    kept = with_own_points(around(np.concatenate([own, others])), IsolationParameters(), gate, 0.002)
    assert kept.tolerance_m is not None
    assert kept.isolated is not None
    assert 3.5 * noise < kept.tolerance_m < 7.0 * noise
    assert np.abs(kept.isolated.deviation).max() <= np.float32(kept.tolerance_m)
    assert (kept.isolated.source_index < len(own)).sum() >= 0.99 * len(own)


def test_own_points_never_lie_beyond_the_gate_nor_within_a_rounding() -> None:
    wide = np.linspace(-0.05, 0.05, 101)
    assert with_own_points(around(wide), IsolationParameters(), 0.05, 0.002).tolerance_m == 0.05
    assert with_own_points(around(0.0 * wide), IsolationParameters(), 0.05, 0.002).tolerance_m == 0.1 * 0.002
    given = with_own_points(around(wide), IsolationParameters(tolerance_m=0.05), 0.05, 0.002)
    assert (given.tolerance_m, len(given.isolated or ())) == (0.05, 101)
