"""The virtual scanner: parts have their formulas' areas, scans lie on what was scanned, truth is true."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from naive_simulate import distances_to, first_hit
from scanfind.errors import InvalidGeometryError, UsageError
from scanfind.evidence.rays import RayCaster
from scanfind.mesh import Mesh
from scanfind.pose import Pose, random_rotation
from scanfind.simulate import parts
from scanfind.simulate.objects import (
    CLEARLY_DIFFERENT_M,
    FRAME_SIZE_M,
    Route,
    box_frame,
    other_spool,
    pipe_spool,
)
from scanfind.simulate.placement import surface_points
from scanfind.simulate.scanner import Scanner, SimulatedScan, scan
from scanfind.simulate.scene import BACKGROUND, Scene, SceneObject
from scanfind.simulate.scenes import CLUTTER, SHOP_M, shop

Floats = NDArray[np.float64]

EXACT = Scanner(noise=0.0, beam_diameter=0.0, beam_divergence=0.0)
# A circle of SIDES corners has less girth, and less area, than the round one: by these factors.
GIRTH = parts.SIDES / np.pi * np.sin(np.pi / parts.SIDES)
DISC = parts.SIDES / (2 * np.pi) * np.sin(2 * np.pi / parts.SIDES)


@pytest.fixture(scope="module")
def spool() -> Mesh:
    return pipe_spool()


@pytest.fixture(scope="module")
def spool_shop(spool: Mesh) -> Scene:
    return shop(3, spool)


@pytest.fixture(scope="module")
def spool_scan(spool_shop: Scene) -> SimulatedScan:
    return scan(spool_shop, seed=3, points=100_000)


def closed(mesh: Mesh) -> bool:
    """Every edge between two faces that agree which side is outside, and outside is outside."""
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return bool(body.is_watertight and body.is_winding_consistent and body.volume > 0)


def boundary_edges(mesh: Mesh) -> int:
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    assert counts.max() <= 2
    return int((counts == 1).sum())


@pytest.mark.parametrize(
    "mesh",
    [
        parts.cylinder(0.1, 1.0),
        parts.box(1.0, 2.0, 3.0),
        parts.plate(1.0, 2.0, 0.01),
        parts.hollow_section(0.1, 0.15, 2.0),
        parts.i_section(0.2, 0.3, 0.015, 0.009, 4.0),
        box_frame(),
        pipe_spool(),
        other_spool(np.random.default_rng(0)),
    ],
    ids=lambda mesh: mesh.name,
)
def test_solid_parts_are_closed(mesh: Mesh) -> None:
    assert closed(mesh)


@pytest.mark.parametrize(
    ("mesh", "ends"),
    [
        (parts.pipe(0.1, 1.0), 2),
        (parts.elbow(0.1, 0.3, np.pi / 2), 2),
        (parts.tee(0.1, 0.08, 0.3, 0.2), 3),
        (parts.tee(0.1, 0.1, 0.3, 0.2), 3),
        (parts.flange(0.1, 0.17, 0.03), 1),
    ],
)
def test_pipework_is_open_at_its_ends_only(mesh: Mesh, ends: int) -> None:
    assert boundary_edges(mesh) == ends * parts.SIDES


@pytest.mark.parametrize(
    ("mesh", "area"),
    [
        (parts.pipe(0.1, 1.5), 2 * np.pi * 0.1 * 1.5 * GIRTH),
        (parts.cylinder(0.2, 1.0), 2 * np.pi * 0.2 * GIRTH + 2 * np.pi * 0.2**2 * DISC),
        (
            parts.flange(0.1, 0.17, 0.03),
            2 * np.pi * 0.17 * 0.03 * GIRTH + np.pi * (2 * 0.17**2 - 0.1**2) * DISC,
        ),
        (parts.hollow_section(0.1, 0.15, 2.0), 2 * (0.1 + 0.15) * 2.0 + 2 * 0.1 * 0.15),
        (
            parts.i_section(0.2, 0.3, 0.015, 0.009, 4.0),
            (4 * 0.2 + 2 * 0.3 - 2 * 0.009) * 4.0 + 2 * (2 * 0.2 * 0.015 + 0.27 * 0.009),
        ),
    ],
    ids=lambda value: value.name if isinstance(value, Mesh) else "",
)
def test_areas_are_the_formulas(mesh: Mesh, area: float) -> None:
    assert mesh.area() == pytest.approx(area, rel=1e-9)


def test_elbow_has_the_area_of_pappus() -> None:
    assert parts.elbow(0.1, 0.3, np.pi / 2).area() == pytest.approx(2 * np.pi * 0.1 * 0.3 * np.pi / 2, rel=3e-3)


def test_tee_has_the_area_of_both_pipes_less_what_is_inside() -> None:
    radius, branch, length, height = 0.1, 0.08, 0.4, 0.3
    psi = np.linspace(0, 2 * np.pi, 20_001)[:-1]
    foot = np.sqrt(radius**2 - (branch * np.cos(psi)) ** 2)
    side = branch * 2 * np.pi * np.mean(height - foot)
    y = np.linspace(-branch, branch, 200_001)[1:-1]
    footprint = np.trapezoid(2 * np.sqrt(branch**2 - y**2) * radius / np.sqrt(radius**2 - y**2), y)
    whole = 2 * np.pi * radius * length - footprint + side
    assert parts.tee(radius, branch, length, height).area() == pytest.approx(whole, rel=3e-3)


@given(st.lists(st.tuples(*[st.floats(0.0, 1.0)] * 3, *[st.floats(0.05, 1.0)] * 3), min_size=1, max_size=5))
@settings(max_examples=30, deadline=None)
def test_blocks_enclose_the_union_of_their_boxes(drawn: list[tuple[float, ...]]) -> None:
    boxes = [(low, low + size) for low, size in ((np.round(b[:3], 3), np.round(b[3:], 3)) for b in drawn)]
    mesh = parts.blocks("union", boxes)
    # Volume by the divergence theorem against a count of cells: both exact on a millimetre raster of corners.
    a, b, c = np.moveaxis(mesh.triangles(), 1, 0)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    lines = [np.unique(np.round([edge[axis] for box in boxes for edge in box], 9)) for axis in range(3)]
    middles = np.stack(np.meshgrid(*[(x[1:] + x[:-1]) / 2 for x in lines], indexing="ij"), axis=-1)
    cells = np.prod(np.stack(np.meshgrid(*[np.diff(x) for x in lines], indexing="ij")), axis=0)
    inside = np.any([((middles > low) & (middles < high)).all(axis=-1) for low, high in boxes], axis=0)
    assert volume == pytest.approx(cells[inside].sum(), rel=1e-9)


@pytest.mark.parametrize(
    "make",
    [
        lambda: parts.pipe(-0.1, 1.0),
        lambda: parts.flange(0.2, 0.1, 0.03),
        lambda: parts.elbow(0.2, 0.1, 1.0),
        lambda: parts.tee(0.1, 0.2, 0.6, 0.3),
        lambda: parts.box(1.0, 0.0, 1.0),
        lambda: parts.cylinder(0.1, float("nan")),
        lambda: parts.assemble("nothing", []),
        lambda: Route(0.1, Pose.identity()).roll(0.1),
    ],
)
def test_impossible_parts_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(InvalidGeometryError):
        make()


def test_the_papers_objects_have_the_papers_sizes(spool: Mesh) -> None:
    assert np.abs(np.sort(np.ptp(spool.vertices, axis=0)) - [0.5, 2.0, 3.0]).max() < 0.15
    assert np.ptp(box_frame().vertices, axis=0) == pytest.approx(FRAME_SIZE_M)


@pytest.mark.parametrize("turn", [np.diag([-1.0, -1, 1]), np.diag([-1.0, 1, -1]), np.diag([1.0, -1, -1])])
def test_the_frame_is_nearly_but_not_quite_symmetric(turn: Floats) -> None:
    frame = box_frame()
    middle = np.array(FRAME_SIZE_M) / 2
    points = surface_points(frame, np.random.default_rng(0), per_m2=40)
    off = distances_to((points - middle) @ turn.T + middle, frame.triangles())
    assert 0.7 < np.mean(off < 1e-3) < 0.93


@pytest.mark.parametrize("seed", range(5))
def test_decoys_differ_clearly(spool: Mesh, seed: int) -> None:
    decoy = other_spool(np.random.default_rng(seed))
    sizes = np.ptp(spool.vertices, axis=0), np.ptp(decoy.vertices, axis=0)
    assert np.abs(sizes[0] - sizes[1]).max() > CLEARLY_DIFFERENT_M - 0.01


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_rays_meet_what_every_triangle_in_turn_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    soup = [Mesh.of("soup", rng.normal(size=(9, 3)), np.arange(9).reshape(3, 3)) for _ in range(2)]
    placed = [(mesh, Pose(random_rotation(rng), rng.normal(size=3))) for mesh in soup]
    triangles = np.concatenate([pose.move(mesh.vertices)[mesh.faces] for mesh, pose in placed])
    origin = rng.normal(size=3) * 3
    directions = triangles.mean(axis=1) - origin + rng.normal(size=(6, 3)) * 0.2
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = RayCaster(placed).shoot(origin, directions)
    for direction, distance, owner in zip(directions, hits.distance, hits.owner, strict=True):
        expected, face = first_hit(origin, direction, triangles)
        if not np.isclose(distance, expected, rtol=1e-4):
            # float32 may take a ray past an edge it all but touches; a nudge in double does the same.
            nudged = [first_hit(origin, direction + d, triangles)[0] for d in rng.normal(size=(40, 3)) * 1e-5]
            assert any(np.isclose(distance, other, rtol=1e-3) for other in nudged)
        else:
            assert owner == (face // 3 if face >= 0 else -1)


def test_an_exact_scan_lies_on_the_placed_model(spool_shop: Scene, spool: Mesh) -> None:
    (target,), (pose,) = spool_shop.target_ids(), spool_shop.truth()["pipe_spool"]
    exact = scan(spool_shop, scanner=EXACT, points=40_000)
    seen = pose.inverse().move(exact.points_on(target))
    assert len(seen) > 100
    assert distances_to(seen[::6], spool.triangles()).max() < 1e-5
    assert not any(station.attributes["mixed"].any() for station in exact.stations)


def test_noise_is_what_the_scanner_has_along_the_beam(spool_shop: Scene) -> None:
    exact = scan(spool_shop, scanner=replace(EXACT, step=0.025), seed=1)
    noisy = scan(spool_shop, scanner=replace(EXACT, step=0.025, noise=0.002), seed=1)
    for a, b in zip(exact.stations, noisy.stations, strict=True):
        assert a.origin is not None
        beam = (a.xyz - a.origin) / np.linalg.norm(a.xyz - a.origin, axis=1, keepdims=True)
        moved = b.xyz - a.xyz
        along = np.einsum("ij,ij->i", moved, beam)
        assert np.linalg.norm(moved - along[:, None] * beam, axis=1).max() < 1e-9
        assert along.std() == pytest.approx(0.002, rel=0.03)
        assert abs(along.mean()) < 5 * 0.002 / np.sqrt(len(along))


def test_every_point_lies_on_the_beam_of_its_row_and_column(spool_scan: SimulatedScan) -> None:
    for station in spool_scan.stations:
        assert station.origin is not None
        beam = spool_scan.scanner.directions(station.attributes["row"], station.attributes["column"])
        away = station.xyz - station.origin
        assert np.linalg.norm(np.cross(away, beam), axis=1).max() < 1e-9
        assert np.einsum("ij,ij->i", away, beam).min() >= spool_scan.scanner.nearest - 0.02
        cell = station.attributes["row"].astype(np.int64) * spool_scan.scanner.columns() + station.attributes["column"]
        assert len(np.unique(cell)) == len(cell)


def test_scans_have_their_attributes_and_about_the_points_asked(spool_scan: SimulatedScan) -> None:
    assert len(spool_scan) == pytest.approx(100_000, rel=0.02)
    for station in spool_scan.stations:
        kinds = {name: values.dtype.name for name, values in station.attributes.items()}
        assert kinds == {
            "intensity": "float32",
            "row": "int32",
            "column": "int32",
            "object_id": "int32",
            "mixed": "uint8",
        }
        assert 0.0 <= station.attributes["intensity"].min() <= station.attributes["intensity"].max() <= 1.0


def test_same_seed_same_scan_on_any_number_of_threads(spool_shop: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scanfind.simulate.scanner.BLOCK_RAYS", 3000)
    one, three, other = (
        scan(spool_shop, scanner=Scanner(step=0.05), seed=seed, threads=threads)
        for seed, threads in ((7, 1), (7, 3), (8, 1))
    )
    for a, b, c in zip(one.stations, three.stations, other.stations, strict=True):
        assert np.array_equal(a.xyz, b.xyz)
        assert all(np.array_equal(a.attributes[name], b.attributes[name]) for name in a.attributes)
        assert a.xyz.shape != c.xyz.shape or not np.array_equal(a.xyz, c.xyz)


def test_mixed_pixels_float_between_the_board_and_the_wall() -> None:
    board, wall = parts.box(0.02, 1.0, 1.0), parts.box(0.1, 8.0, 8.0)
    scene = Scene(
        (
            SceneObject("wall", wall, Pose(np.eye(3), np.array([4.0, -4.0, -4.0]))),
            SceneObject("board", board, Pose(np.eye(3), np.array([3.5, -0.5, -0.5]))),
        ),
        np.zeros((1, 3)),
    )
    (cloud,) = scan(scene, scanner=Scanner(step=0.003, noise=0.0)).stations
    mixed, x = cloud.attributes["mixed"] == 1, cloud.xyz[:, 0]
    assert mixed.sum() > 30
    assert (cloud.attributes["object_id"][mixed] == BACKGROUND).all()
    assert (x[mixed] > 3.5).all()
    assert (x[mixed] < 4.0).all()
    assert np.mean((x[mixed] > 3.55) & (x[mixed] < 3.95)) > 0.5
    on_board = ~mixed & (cloud.attributes["object_id"] == 1)
    assert np.abs(x[on_board] - 3.5).max() < 0.021
    # They come from beams by the board's rim, as seen from the station: no farther than half a footprint.
    rim = 3.5 * np.abs(cloud.xyz[mixed, 1:] / x[mixed, None]).max(axis=1)
    assert np.abs(rim - 0.5).max() < 0.006


def test_dark_and_grazing_surfaces_are_missed() -> None:
    floor = SceneObject("floor", parts.plate(60.0, 2.0, 0.1), Pose(np.eye(3), np.array([0.0, -1.0, -1.6])), 0.5)
    scene = Scene((floor,), np.zeros((1, 3)))
    bright = scan(scene, scanner=Scanner(step=0.006)).stations[0]
    dark = scan(replace(scene, objects=(replace(floor, reflectance=0.01),)), scanner=Scanner(step=0.006)).stations[0]
    far = [int((cloud.xyz[:, 0] > 8.0).sum()) for cloud in (dark, bright)]
    assert 0 < 3 * far[0] < far[1]


@pytest.mark.parametrize("which", ["pipe_spool", "box_frame"])
def test_a_shop_shows_its_target_in_the_clutter_asked_for(which: str, spool_shop: Scene) -> None:
    scene = spool_shop if which == "pipe_spool" else shop(11, box_frame())
    (target,) = scene.target_ids()
    assert list(scene.truth()) == [which]
    found = scan(scene, points=200_000)
    on = len(found.points_on(target))
    # With some thousand points on the target, one in twenty is luck.
    assert CLUTTER[0] * 0.95 < (len(found) - on) / on < CLUTTER[1] * 1.05
    assert scene.visible_share(target) >= 0.3
    assert sum(name == "other_spool" for name in found.object_names) >= 4
    for thing in scene.objects[1:]:
        corners = thing.pose.move(thing.mesh.vertices)
        assert corners.min() > -1e-6
        assert (corners < np.array(SHOP_M) + 1e-6).all()


def test_same_seed_same_shop(spool: Mesh, spool_shop: Scene) -> None:
    again = shop(3, spool)
    assert np.array_equal(again.stations, spool_shop.stations)
    assert [thing.name for thing in again.objects] == [thing.name for thing in spool_shop.objects]
    for a, b in zip(again.objects, spool_shop.objects, strict=True):
        assert a.pose.difference(b.pose)[0] == 0.0
        assert a.reflectance == b.reflectance


@pytest.mark.slow
def test_every_copy_of_every_target_is_in_the_truth(spool: Mesh) -> None:
    several = shop(0, [spool, box_frame()], copies=2)
    assert {name: len(poses) for name, poses in several.truth().items()} == {"pipe_spool": 2, "box_frame": 2}
    assert len(several.target_ids()) == 4


def test_wrong_calls_say_so(spool_shop: Scene, spool: Mesh) -> None:
    with pytest.raises(UsageError, match="step"):
        Scanner(step=0.0)
    with pytest.raises(UsageError, match="at least 1"):
        scan(spool_shop, points=0)
    with pytest.raises(UsageError, match="at least one station"):
        scan(spool_shop, np.zeros((0, 3)))
    with pytest.raises(InvalidGeometryError, match="stations"):
        scan(spool_shop, [1.0, 2.0])
    with pytest.raises(UsageError, match="no beam"):
        scan(replace(spool_shop, objects=spool_shop.objects[1:2]), [[1e4, 0, 0]], points=1000)
    with pytest.raises(UsageError, match="copies"):
        shop(0, spool, copies=0)


@pytest.mark.slow
@pytest.mark.parametrize("make", [pipe_spool, box_frame])
def test_ten_million_points(make: Callable[[], Mesh]) -> None:
    scene = shop(0, make())
    found = scan(scene, points=10_000_000)
    assert len(found) == pytest.approx(10_000_000, rel=0.01)
    on = len(found.points_on(scene.target_ids()[0]))
    assert CLUTTER[0] < (len(found) - on) / on < CLUTTER[1]
