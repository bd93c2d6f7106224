"""Scans of unknown scale: it is found by the models, and what is found is what a scan in metres gives."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.again import isolate_again
from scanfind.cloud import PointCloud
from scanfind.detection import Findings
from scanfind.errors import UsageError
from scanfind.find import find
from scanfind.fit.similarity import Similarity, agreed, similarity
from scanfind.grid.scene import GridParameters
from scanfind.inspect import inspect
from scanfind.library import ModelLibrary
from scanfind.library.model import ModelParameters
from scanfind.library.near_surface import near_triangles
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh
from scanfind.parameters import PRESETS, Parameters
from scanfind.pose import Pose, rotation_from_vector
from scanfind.priors import Priors
from scanfind.results import read_results, write_results
from scanfind.results.document import findings_of
from scanfind.scale.steps import STEP, sized, sizes_tried
from scanfind.scans import open_writer
from scanfind.simulate.furniture import hall
from scanfind.simulate.parts import blocks, box, cylinder, pipe
from scanfind.simulate.placement import surface_points
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.tiles import find_in_tiles

Floats = NDArray[np.float64]

QUICK = Parameters(
    grid=GridParameters(cell_m=0.02),
    surface=SurfaceParameters(samples=1000),
    search=replace(PRESETS["default"].search, time_limit_s=20.0, pairs_a_round=20_000, hypotheses_a_round=60_000),
)
FREE = replace(QUICK, priors=Priors(scale_free=0.1))
BRACKET = blocks(
    "bracket",
    [
        ((0, 0, 0), (1.0, 0.6, 0.15)),
        ((0, 0, 0.15), (0.15, 0.15, 0.9)),
        ((0.6, 0.3, 0.15), (0.9, 0.6, 0.4)),
        ((0, 0.15, 0.75), (0.15, 0.5, 0.9)),
    ],
)
# Metres a unit, of clouds that are as much too large as is asked for, and somewhat too small.
SMALLER, LARGER = 1.0 / 1.1, 1.0 / 0.953
PLACES = (
    Pose.from_rotation_vector([0.0, 0.0, 0.7], [2.9, 1.3, 0.0]),
    Pose.from_rotation_vector([0.5 * np.pi, 0.0, 0.0], [0.5, 3.4, 0.0]),
)


@cache
def library() -> ModelLibrary:
    brackets = ModelLibrary.in_memory()
    brackets.add(BRACKET, ModelParameters(QUICK.surface))
    return brackets


@cache
def room(scale: float = 1.0, *, empty: bool = False) -> tuple[PointCloud, ...]:
    """A hall of 4 × 4 × 2.5 m with two brackets, seen from two corners, in units of `scale` metres."""
    objects = [
        SceneObject("hall", hall(4.0, 4.0, 2.5), Pose.identity()),
        SceneObject("drum", cylinder(0.25, 0.8), Pose(np.eye(3), np.array([0.5, 0.5, 0.0]))),
        SceneObject("locker", box(0.5, 0.5, 1.0), Pose(np.eye(3), np.array([3.5, 0.4, 0.5]))),
        *(SceneObject("bracket", BRACKET, place, target=True) for place in PLACES if not empty),
    ]
    seen = Scene(tuple(objects), np.array([[1.2, 1.2, 1.6], [3.3, 3.3, 1.5]]))
    clouds = scan(seen, seed=3, scanner=Scanner(step=0.008)).stations
    return tuple(PointCloud(c.xyz / scale, {}, c.origin / scale) for c in clouds if c.origin is not None)


@cache
def found_at(scale: float) -> Findings:
    return find(list(room(scale)), library(), parameters=FREE)


# ── found ──


@pytest.mark.parametrize("scale", [SMALLER, LARGER])
def test_in_a_scan_of_another_scale_are_that_scale_and_the_same_poses(scale: float) -> None:
    found, rigid = found_at(scale), find(list(room()), library(), parameters=QUICK)
    assert found.scan_scale is not None
    off = found.scan_scale.metres / scale - 1.0
    assert abs(off) < 4.0 * found.scan_scale.sigma
    assert abs(off) < 2e-4
    assert found.scan_scale.words() in found.notes
    assert len(found) == len(rigid) == len(PLACES)
    for one in found:
        nearest = min((one.scene_from_model.difference(other.scene_from_model) for other in rigid), key=sum)
        assert nearest[0] < 1e-3  # 4 m away a scale that is off by 2e-4 moves by 0.8 mm
        assert nearest[1] < 1e-3


def test_all_that_is_told_is_in_metres() -> None:
    """Points are the scans' own times the scale, and so is where scanners stood."""
    found, clouds = found_at(LARGER), room(LARGER)
    assert found.scan_scale is not None
    metres = found.scan_scale.metres
    for one in found:
        assert one.isolated is not None
        for k, cloud in enumerate(clouds):
            mine = one.isolated.scan_id == k
            assert np.array_equal(one.isolated.xyz[mine], metres * cloud.xyz[one.isolated.source_index[mine]])
    stood = np.array([cloud.origin for cloud in clouds])
    assert np.array_equal(found.stations(), metres * stood)


def test_with_the_scale_found_a_scan_in_metres_gives_the_same_to_the_last_bit() -> None:
    found = found_at(LARGER)
    assert found.scan_scale is not None
    metres = found.scan_scale.metres
    clouds = [PointCloud(metres * c.xyz, {}, metres * np.asarray(c.origin)) for c in room(LARGER)]
    rigid = find(clouds, library(), parameters=QUICK)
    assert [one.scene_from_model.matrix().tolist() for one in rigid] == [
        one.scene_from_model.matrix().tolist() for one in found
    ]


def test_a_region_is_in_the_scans_own_unit() -> None:
    middle = PLACES[0].move(BRACKET.vertices.mean(axis=0)[None])[0] / SMALLER
    low, high = (middle - 0.3).tolist(), (middle + 0.3).tolist()
    priors = Priors(region=(*low, *high), scale_free=0.1, up="z")
    (one,) = find(list(room(SMALLER)), library(), parameters=replace(QUICK, priors=priors), isolate=False)
    assert one.scene_from_model.difference(PLACES[0])[0] < 0.002


def test_a_model_may_be_drawn_far_from_its_origin() -> None:
    """As a building's parts are: what is scaled is the distance from the scan's origin, not from the model's."""
    drawn = Mesh.of("bracket", BRACKET.vertices + np.array([400.0, -300.0, 20.0]), BRACKET.faces)
    found = find(list(room(SMALLER)), drawn, parameters=FREE, isolate=False)
    assert found.scan_scale is not None
    assert found.scan_scale.metres == pytest.approx(SMALLER, rel=2e-4)
    assert len(found) == len(PLACES)


def test_where_nothing_tells_the_scale_nothing_is_found_and_it_is_said() -> None:
    short = replace(FREE, search=replace(FREE.search, time_limit_s=1.0))
    found = find(list(room(empty=True)), library(), parameters=short)
    assert list(found) == []
    assert found.scan_scale is not None
    assert found.scan_scale.metres == 1.0
    assert np.isnan(found.scan_scale.sigma)
    assert any("nothing tells the scale" in note for note in found.notes)


# ── results ──


def test_a_result_keeps_the_scale_and_isolates_again_by_it(tmp_path: Path) -> None:
    files, found = [tmp_path / "0.ply", tmp_path / "1.ply"], found_at(LARGER)
    for file, cloud in zip(files, room(LARGER), strict=True):
        with open_writer(file, {}) as writer:
            writer.write(cloud.xyz, {})
    write_results(found, tmp_path / "found", models=library(), parameters=FREE)
    before = read_results(tmp_path / "found")
    assert findings_of(before).scan_scale == found.scan_scale
    after = isolate_again(tmp_path / "found", files, out=tmp_path / "again")
    assert after.scan_scale == before.scan_scale
    # The search cut them before its last fit moved the pose by tenths of a millimetre.
    for one, other in zip(after.detections, before.detections, strict=True):
        assert one.points == pytest.approx(other.points, rel=0.01)


# ── the fit of seven unknowns ──


def naive(triangles: Floats, xyz: Floats, at: Similarity, steps: int = 8) -> Similarity:
    """Gauss-Newton by differences: distances from the nearest face's plane, all points alike, one by one."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def moved(x: Floats) -> Similarity:
        pose = Pose(at.pose.rotation @ rotation_from_vector(x[:3]), at.pose.translation + x[3:6])
        return Similarity(at.scale * (1.0 + x[6]), nan, pose)

    def off(this: Similarity, face: NDArray[np.intp]) -> Floats:
        local = this.pose.inverse().move(this.scale * xyz)
        return np.asarray(((local - triangles[face, 0]) * normals[face]).sum(axis=1))

    for _ in range(steps):
        local = at.pose.inverse().move(at.scale * xyz)
        planes = np.abs(((local[:, None] - triangles[None, :, 0]) * normals).sum(axis=2))
        face = planes.argmin(axis=1)
        here, little = off(at, face), 1e-6
        slopes = np.array([(off(moved(little * one), face) - here) / little for one in np.eye(7)]).T
        at = moved(np.linalg.lstsq(slopes, -here, rcond=None)[0])
    return at


def on_faces(mesh: Mesh, seed: int) -> Floats:
    """Points of the mesh well within its faces, and nearer to their own face's plane than to any other."""
    points = surface_points(mesh, np.random.default_rng(seed), 400.0)
    triangles = mesh.triangles()
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = np.sort(np.abs(((points[:, None] - triangles[None, :, 0]) * normals).sum(axis=2)).round(9), axis=1)
    other = np.array([row[row > 1e-6][0] for row in planes])
    return np.asarray(points[other > 0.05])


BELOW = PRESETS["default"].refine.unobservable_below


@given(seed=st.integers(0, 1000), scale=st.floats(0.9, 1.1))
@settings(max_examples=10, deadline=None)
def test_the_fit_is_that_of_a_naive_twin(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    place = Pose.from_rotation_vector(rng.normal(size=3), rng.uniform(-3.0, 3.0, 3))
    xyz = place.move(on_faces(BRACKET, seed)) / scale
    nudge = Pose.from_rotation_vector(0.002 * rng.normal(size=3), 0.002 * rng.normal(size=3))
    start = Similarity(1.002 * scale, nan, place @ nudge)
    near = near_triangles(BRACKET.triangles(), 0.05)
    fit = similarity(near, start, xyz, np.zeros(len(xyz), np.int32), [0.05] * 6, BELOW)
    twin = naive(BRACKET.triangles(), xyz, start)
    assert fit is not None
    for told in (fit, twin):
        assert told.scale == pytest.approx(scale, rel=1e-6)
        assert told.pose.difference(place)[0] < 1e-5


def test_the_scale_is_as_far_off_as_it_is_told_to_be() -> None:
    near, errors = near_triangles(BRACKET.triangles(), 0.012), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        points = surface_points(BRACKET, rng, 800.0)
        xyz = (PLACES[0].move(points) + 0.002 * rng.normal(size=points.shape)) / 1.05
        fit = similarity(
            near, Similarity(1.05, nan, PLACES[0]), xyz, np.zeros(len(xyz), np.int32), [0.012] * 3, BELOW
        )  # fmt: skip
        assert fit is not None
        errors.append((fit.scale - 1.05) / fit.sigma)
    # The mean of 40 squares is 1 ± 0.22 by chance, three times which is allowed.
    assert 0.34 < np.mean(np.square(errors)) < 1.67


def test_what_looks_the_same_in_any_size_does_not_tell_it() -> None:
    plate = blocks("plate", [((0, 0, 0), (2.0, 1.0, 0.001))])
    points = surface_points(plate, np.random.default_rng(0), 500.0)
    top = points[points[:, 2] > 0.0009]
    near = near_triangles(plate.triangles(), 0.02)
    nobody = np.zeros(len(top), np.int32)
    assert similarity(near, Similarity(1.0, nan, Pose.identity()), top, nobody, [0.02] * 3, BELOW) is None


def test_a_pipe_tells_it_by_its_radius() -> None:
    spool = pipe(0.1, 2.0)
    points = surface_points(spool, np.random.default_rng(0), 2000.0)
    near = near_triangles(spool.triangles(), 0.02)
    fit = similarity(
        near, Similarity(1.0, nan, Pose.identity()), points / 1.02, np.zeros(len(points), np.int32), [0.02] * 6, BELOW
    )  # fmt: skip
    assert fit is not None
    assert fit.scale == pytest.approx(1.02, abs=1e-4)


def test_scales_of_several_are_weighted_by_how_well_they_are_known() -> None:
    here = Pose.identity()
    scale, sigma = agreed([Similarity(1.0, 0.001, here), Similarity(1.001, 0.002, here)])
    assert scale == pytest.approx(1.0002)
    assert sigma == pytest.approx(0.001 * np.sqrt(0.8))
    # Where they disagree, it is known as badly as that: 0.1 apart, weighted four to one.
    scale, sigma = agreed([Similarity(1.0, 0.001, here), Similarity(1.1, 0.002, here)])
    assert scale == pytest.approx(1.02)
    assert sigma == pytest.approx(0.04)


# ── sizes tried ──


@pytest.mark.parametrize("share", [0.01, 0.1, 0.15])
def test_sizes_span_the_share_in_steps_that_are_small_enough(share: float) -> None:
    tried = sizes_tried(share)
    assert tried[0] == pytest.approx(1.0 - share)
    assert tried[-1] == pytest.approx(1.0 + share)
    assert np.diff(np.log(tried)).max() <= STEP


def test_a_sized_model_is_the_model_of_the_sized_mesh() -> None:
    model = library().models()[0]
    larger, again = (
        sized(model, 1.07),
        ModelLibrary.in_memory().add(BRACKET.scaled(1.07), ModelParameters(QUICK.surface)),
    )
    assert larger.diameter == pytest.approx(again.diameter, rel=1e-3)
    assert larger.area == pytest.approx(again.area, rel=1e-9)
    assert larger.symmetry.axes == again.symmetry.axes


# ── at the door ──


def test_what_it_cannot_be_combined_with_is_refused() -> None:
    unread = np.full((5, 3), np.nan)
    for share in (-0.1, 0.16, nan):
        with pytest.raises(UsageError, match="scale_free must be a share from 0 to 0"):
            Priors(scale_free=share)
    with pytest.raises(UsageError, match="scale_free must be 0 where near_design_m"):
        Priors(scale_free=0.1, near_design_m=0.5)
    with pytest.raises(UsageError, match="not found in tiles: leave out"):
        find_in_tiles(unread, library(), parameters=FREE)
    with pytest.raises(UsageError, match="inspect: how far off things are needs scans in metres"):
        inspect(unread, library(), parameters=FREE)
    with pytest.raises(UsageError, match="scale_free must be 0 where models are tried in their places"):
        find(unread, library(), parameters=FREE, at_design=True)
