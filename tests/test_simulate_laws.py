"""What a simulated scan keeps to, whatever the instrument, the scene and the format: laws of measuring and of files."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from naive_simulate import distances_to
from scanfind.cli import main
from scanfind.errors import OutputError, UsageError
from scanfind.mesh import Mesh
from scanfind.models import read_models
from scanfind.pose import Pose
from scanfind.scans import read_scan, scan_info
from scanfind.simulate import (
    SCANNERS,
    FrameSensor,
    Photogrammetry,
    Scanner,
    Scene,
    SceneObject,
    frame,
    parts,
    plant,
    scan,
    shop,
    simulate,
)
from scanfind.simulate.objects import pipe_spool
from scanfind.simulate.placement import sample_oriented
from scanfind.simulate.run import IDS
from scanfind.simulate.scanner import Survey
from scanfind.simulate.stations import best_stations

Floats = NDArray[np.float64]

WALL_X = 3.0


def at(x: float, y: float, z: float) -> Pose:
    return Pose(np.eye(3), np.array([x, y, z]))


def small_scene(stations: int = 2) -> Scene:
    """A board before a wall, and a spool that is looked for."""
    objects = (
        SceneObject("wall", parts.box(0.2, 8.0, 6.0), at(WALL_X, -4.0, -3.0)),
        SceneObject("board", parts.box(0.02, 0.6, 0.6), at(2.2, 0.5, -0.3)),
        SceneObject("spool", pipe_spool(), at(-1.6, -3.0, -0.5), target=True),
    )
    return Scene(objects, np.array([[0.0, 0.1 * k, 0.2 * k] for k in range(stations)]), None)


@pytest.fixture(scope="module")
def small() -> Scene:
    return small_scene()


@pytest.fixture(scope="module", params=[plant, frame], ids=["plant", "frame"])
def generated(request: pytest.FixtureRequest) -> Scene:
    made: Scene = request.param(5)
    return made


@pytest.mark.parametrize("name", SCANNERS)
def test_same_seed_same_points_on_any_number_of_threads(
    name: str, small: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scanfind.simulate.scanner.BLOCK_RAYS", 4000)
    device = SCANNERS[name].with_step(max(0.02, SCANNERS[name].finest))
    one, two, four = (scan(small, scanner=device, seed=3, threads=threads) for threads in (1, 2, 4))
    other = scan(small, scanner=device, seed=4)
    assert len(one) > 500
    for a, *same, c in zip(one.stations, two.stations, four.stations, other.stations, strict=True):
        for b in same:
            assert np.array_equal(a.xyz, b.xyz)
            assert all(np.array_equal(a.attributes[key], b.attributes[key]) for key in a.attributes)
        assert not np.array_equal(a.xyz[:100], c.xyz[:100])


@pytest.mark.parametrize("device", [Scanner(step=0.02), FrameSensor(step=0.01)], ids=["turn", "frame"])
def test_without_noise_a_range_is_where_the_beam_meets_the_wall(device: Scanner | FrameSensor, small: Scene) -> None:
    exact = replace(device, noise=0.0, beam_diameter=0.0, beam_divergence=0.0)
    survey = Survey.of(replace(small, look_at=np.tile([WALL_X, 0.4, 0.3], (2, 1))), scanner=exact)
    for pose, cloud in zip(survey.poses, scan(survey.scene, scanner=exact).stations, strict=True):
        on_wall = cloud.attributes["object_id"] == 0
        front = on_wall & (np.abs(cloud.xyz[:, 0] - WALL_X) < 1e-3)
        assert front.sum() > 0.95 * on_wall.sum() > 300
        beam = pose.turn(exact.directions(cloud.attributes["row"][front], cloud.attributes["column"][front]))
        expected = pose.translation + beam * ((WALL_X - pose.translation[0]) / beam[:, 0])[:, None]
        assert np.abs(cloud.xyz[front] - expected).max() < 1e-5


@given(st.floats(0.0, 0.01), st.floats(0.0, 0.002), st.floats(0.0, 0.001), st.floats(0.0, 1.5), st.integers(0, 2**31))
@settings(max_examples=10, deadline=None)
def test_noise_is_what_was_asked(base: float, linear: float, square: float, grazing: float, seed: int) -> None:
    wall = Scene((small_scene().objects[0],), np.zeros((1, 3)))
    noisy = Scanner(
        step=0.02, noise=base + 1e-4, noise_per_metre=linear, noise_per_metre2=square, noise_grazing=grazing
    )
    (cloud,) = scan(wall, scanner=noisy, seed=seed).stations
    beam = noisy.directions(cloud.attributes["row"], cloud.attributes["column"])
    range_ = WALL_X / beam[:, 0]
    off = np.einsum("ij,ij->i", cloud.xyz, beam) - range_
    ours = (cloud.attributes["mixed"] == 0) & (np.abs(beam[:, 0]) > 0.3) & (np.abs(range_ * beam[:, 1]) < 3.9)
    sigma = (noisy.noise + linear * range_ + square * range_**2) / np.abs(beam[:, 0]) ** grazing
    scaled = off[ours] / sigma[ours]
    # Five standard errors of a mean and of a standard deviation.
    assert abs(scaled.mean()) < 5 / np.sqrt(len(scaled))
    assert abs(scaled.std() - 1.0) < 5 / np.sqrt(2 * len(scaled))


def test_mixed_pixels_are_at_edges_only(small: Scene) -> None:
    for cloud in scan(small, scanner=replace(SCANNERS["phase"], step=0.01, beam_divergence=0.005)).stations:
        mixed = cloud.attributes["mixed"] == 1
        assert 10 < mixed.sum() < 0.02 * len(mixed)
        assert (cloud.attributes["object_id"][mixed] == 0).all()
        # A beam or two from each of them, one ends on something else than the wall, or on nothing.
        there = {
            (int(r), int(c)): int(k)
            for r, c, k in zip(*(cloud.attributes[key] for key in ("row", "column", "object_id")), strict=True)
        }
        for row, column in zip(cloud.attributes["row"][mixed], cloud.attributes["column"][mixed], strict=True):
            around = {there.get((int(row) + i, int(column) + j), -1) for i in range(-2, 3) for j in range(-2, 3)}
            assert around - {0}


def test_points_lie_on_the_models_where_the_truth_has_them(generated: Scene) -> None:
    # A beam that grazes a pipe's rim leaves it by all of its error: so errors that grow there are for another test.
    found = scan(generated, scanner=replace(SCANNERS["faro-ls-840-he"], noise_grazing=0.0), points=100_000)
    rng = np.random.default_rng(0)
    for object_id in generated.target_ids():
        thing = generated.objects[object_id]
        for cloud in found.stations:
            mine = np.flatnonzero(cloud.attributes["object_id"] == object_id)
            mine = rng.permutation(mine)[:30]
            if not len(mine):
                continue
            assert cloud.origin is not None
            reach = np.linalg.norm(cloud.xyz[mine] - cloud.origin, axis=1)
            off = distances_to(thing.pose.inverse().move(cloud.xyz[mine]), thing.mesh.triangles())
            assert (off < 4 * found.scanner.sigma(reach, np.ones(len(reach))) + 1e-5).all()


def test_things_do_not_stand_in_each_other(generated: Scene) -> None:
    """2 cm below the surface of each there is nothing of another: what touches, or is welded on, may."""
    placed = [thing for thing in generated.objects[1:] if thing.name != "rack"]
    boxes = [np.array([v.min(axis=0), v.max(axis=0)]) for v in (t.pose.move(t.mesh.vertices) for t in placed)]
    for (a, box_a), (b, box_b) in permutations(zip(placed, boxes, strict=True), 2):
        if (box_a[0] > box_b[1] - 0.02).any() or (box_a[1] < box_b[0] + 0.02).any():
            continue
        points, normals = sample_oriented(a.mesh, np.random.default_rng(0), 120)
        below = a.pose.move(points - 0.02 * normals)
        below = below[((below > box_b[0]) & (below < box_b[1])).all(axis=1)]
        body = trimesh.Trimesh(b.pose.move(b.mesh.vertices), b.mesh.faces, process=False)
        assert not len(below) or not body.contains(below).any(), (a.name, b.name)


def test_a_generated_scene_has_what_it_is_named_for(generated: Scene) -> None:
    names = {thing.name for thing in generated.objects}
    wanted = {"pipe_run", "vessel", "pump", "column", "beam", "brace", "pipe_spool", "other_spool", "sleeper"}
    if "deck" in names:
        wanted = {"column", "beam", "joist", "brace", "deck", "handrail", "stairs", "box_frame", "stack"}
    assert wanted <= names
    assert len(generated.target_ids()) == (2 if "deck" in names else 3)
    done = simulate(generated, scanner=Scanner(step=0.03))
    assert min(sight.together for sight in done.targets()) > 0.25
    assert not done.remarks


@pytest.mark.parametrize("format", ["e57", "laz", "ply", "ptx"])
def test_every_format_keeps_points_ids_and_stations(format: str, small: Scene, tmp_path: Path) -> None:
    device = Scanner(step=0.02)
    done = simulate(small, tmp_path / "sim", scanner=device, seed=1, format=format, jobs=2)
    expected = scan(small, scanner=device, seed=1)
    chunks = list(read_scan(tmp_path / "sim" / f"scan.{format}"))
    assert sum(map(len, chunks)) == len(expected) == done.points()
    xyz = np.concatenate([cloud.xyz for cloud in expected.stations])
    assert np.abs(np.concatenate([chunk.xyz for chunk in chunks]) - xyz).max() < 1e-4
    if format == "ptx":
        kept = np.load(tmp_path / "sim" / IDS)
        assert len(kept) == 2 * device.rows() * device.columns() == scan_info(tmp_path / "sim/scan.ptx").points
        ids = [kept[chunk.source_index] for chunk in chunks]
        assert (kept >= 0).sum() == done.points()
    else:
        ids = [chunk.attributes["object_id"] for chunk in chunks]
    wanted = np.concatenate([cloud.attributes["object_id"] for cloud in expected.stations])
    assert np.array_equal(np.concatenate(ids), wanted)
    if format in ("e57", "ptx"):
        origins = {chunk.scan: chunk.origin for chunk in chunks}
        for number, at_ in enumerate(small.stations):
            assert origins[number] == pytest.approx(at_, abs=1e-12)
    else:
        station = np.concatenate([chunk.attributes["station"] for chunk in chunks])
        assert np.bincount(station).tolist() == [len(cloud) for cloud in expected.stations]


def test_a_frame_sensors_scans_come_back_in_the_scenes_frame(small: Scene, tmp_path: Path) -> None:
    device = replace(SCANNERS["structured-light"], step=0.01)
    turned = replace(small, look_at=np.tile([2.2, 0.8, 0.1], (2, 1)))
    for format in ("e57", "ptx"):
        done = simulate(turned, tmp_path / format, scanner=device, format=format)
        expected = np.concatenate([cloud.xyz for cloud in scan(turned, scanner=device).stations])
        found = np.concatenate([chunk.xyz for chunk in read_scan(tmp_path / format / f"scan.{format}")])
        assert np.abs(found - expected).max() < 2e-5
        for pose in done.survey.poses:
            assert pose.inverse().move([[2.2, 0.8, 0.1]])[0, 1:] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_frame_sensor_sees_its_frustum_and_not_the_projectors_shadow(small: Scene) -> None:
    device = replace(SCANNERS["structured-light"], noise=0.0, noise_per_metre2=0.0, beam_divergence=0.0)
    assert (device.rows(), device.columns()) == (465, 640)
    turned = replace(small, look_at=np.tile([2.2, 0.8, 0.0], (2, 1)))
    survey = Survey.of(turned, scanner=device)
    for pose, cloud in zip(survey.poses, scan(turned, scanner=device).stations, strict=True):
        local = pose.inverse().move(cloud.xyz)
        # Noise moves points along their beams only: all stay in view.
        assert device.in_view(local / np.linalg.norm(local, axis=1, keepdims=True)).mean() > 0.99
        assert survey.caster.sees(pose.move([[0.0, -0.075, 0.0]])[0], cloud.xyz).mean() > 0.999
        every = survey.scanner
        rays = np.divmod(np.arange(every.rows() * every.columns()), every.columns())
        hits = survey.caster.shoot(pose.translation, pose.turn(every.directions(*rays)))
        assert len(cloud) < np.isfinite(hits.distance).sum() - 100


def test_photogrammetry_knows_no_stations_and_has_holes(small: Scene, tmp_path: Path) -> None:
    preset = SCANNERS["photogrammetry"]
    assert isinstance(preset, Photogrammetry)
    device = replace(preset, step=0.01, holes=0.3)
    simulate(small, tmp_path / "sim", scanner=device)
    (chunk,) = read_scan(tmp_path / "sim" / "scan.e57")
    assert chunk.origin is None
    assert {"row", "column", "station"}.isdisjoint(chunk.attributes)
    everywhere = np.random.default_rng(0).uniform(-50, 50, (20_000, 3))
    texture = device.texture(everywhere, seed=0)
    assert np.quantile(texture, [0.1, 0.3, 0.5, 0.7, 0.9]) == pytest.approx([0.1, 0.3, 0.5, 0.7, 0.9], abs=0.03)
    # Nothing where the field is below the holes' level; noise moves points by a few millimetres of half a metre.
    assert device.texture(chunk.xyz, seed=0).min() > 0.25
    with pytest.raises(UsageError, match="PTX is a raster"):
        simulate(small, tmp_path / "other", scanner=device, format="ptx")
    assert not (tmp_path / "other").exists()


def test_the_visible_share_is_geometry() -> None:
    cube = SceneObject("cube", parts.box(1.0, 1.0, 1.0), at(3.0, -0.5, -0.5), target=True)
    screen = SceneObject("screen", parts.box(0.01, 1.0, 2.0), at(2.0, -1.0, -1.0))
    front, both = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0], [7.0, 0.0, 0.0]])
    for objects, stations, share in [((cube,), front, 1 / 6), ((cube,), both, 2 / 6), ((cube, screen), front, 1 / 12)]:
        done = simulate(Scene((replace(screen, name="far", pose=at(50.0, 0, 0)), *objects), stations), points=3000)
        (sight,) = done.targets()
        assert sight.together == pytest.approx(share, abs=0.03)
        assert len(sight.visible) == len(sight.points) == len(stations)
    assert sight.nearest_m == pytest.approx(3.0, abs=0.05)
    assert sight.incidence is not None
    assert 0.0 < sight.incidence < 0.3


def test_a_plan_tells_what_the_scan_then_has(small: Scene, tmp_path: Path) -> None:
    planned = simulate(small, scanner=Scanner(step=0.03), seed=2)
    done = simulate(small, tmp_path / "sim", scanner=Scanner(step=0.03), seed=2)
    assert planned.sights == done.sights
    truth = json.loads((tmp_path / "sim" / "truth.json").read_text())
    assert [thing["points"] for thing in truth["objects"]] == [list(sight.points) for sight in done.sights]
    (model,) = read_models(tmp_path / "sim" / truth["objects"][2]["model"])
    assert isinstance(model, Mesh)
    assert model.area() == pytest.approx(small.objects[2].mesh.area(), rel=1e-5)
    pose = Pose.from_matrix(truth["objects"][2]["scene_from_model"])
    assert pose.difference(small.objects[2].pose)[0] < 1e-12
    assert truth["models"]["spool"][0]["scene_from_model"] == truth["objects"][2]["scene_from_model"]


def test_remarks_say_where_not_to_stand(small: Scene) -> None:
    inside, near = [WALL_X + 0.1, 0.0, 0.0], [WALL_X - 0.1, 0.0, 0.0]
    said = simulate(small, scanner=Scanner(step=0.1), stations=[inside, near]).remarks
    assert "station 1 at 3.10 0.00 0.00 stands inside of something" in said[0]
    assert "station 2" in said[1]
    assert "0.10 m from a surface" in said[1]
    said = simulate(small, scanner=Scanner(step=0.1), stations=[inside]).remarks
    assert "spool (2): 0 % in sight, may be missed below a third" in said[-1]


def test_best_stations_see_more_than_any_pair_drawn(small: Scene) -> None:
    rng = np.random.default_rng(0)
    spots = rng.uniform([-2.0, -5.0, 0.5], [2.0, 3.0, 1.5], (30, 3))
    chosen, seen = best_stations(small, spots, 2)
    for pair in rng.choice(30, (5, 2)):
        other = simulate(small, scanner=Scanner(step=0.1), stations=spots[pair]).targets()[0].together
        assert seen[0] > other - 0.08
    assert all(any(np.array_equal(at, spot) for spot in spots) for at in chosen)
    with pytest.raises(UsageError, match="free room for 30 stations"):
        best_stations(small, spots, 31)


def test_nothing_half_written_is_left(small: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = Survey.blocks

    def interrupted(self: Survey, threads: int) -> Iterator[object]:
        yield next(iter(blocks(self, threads)))
        raise KeyboardInterrupt

    monkeypatch.setattr(Survey, "blocks", interrupted)
    for out in ("sim", "scan.ptx", "scan.e57", "scan.laz"):
        with pytest.raises(KeyboardInterrupt):
            simulate(small, tmp_path / out, scanner=Scanner(step=0.1))
        assert list(tmp_path.iterdir()) == []


def test_only_an_older_simulation_is_replaced(small: Scene, tmp_path: Path) -> None:
    coarse = Scanner(step=0.2)
    simulate(small, tmp_path / "sim", scanner=coarse)
    with pytest.raises(OutputError, match="--overwrite"):
        simulate(small, tmp_path / "sim", scanner=coarse)
    simulate(small, tmp_path / "sim", scanner=coarse, format="ply", overwrite=True)
    assert not (tmp_path / "sim" / "scan.e57").exists()
    (tmp_path / "sim" / "mine.txt").write_text("dear")
    with pytest.raises(OutputError, match=r"mine\.txt"):
        simulate(small, tmp_path / "sim", scanner=coarse, overwrite=True)
    simulate(small, tmp_path / "alone.laz", scanner=coarse)
    assert scan_info(tmp_path / "alone.laz").points == simulate(small, scanner=coarse).points()


def test_targets_of_one_name_are_one_model(small: Scene) -> None:
    other = SceneObject("spool", parts.box(1.0, 1.0, 1.0), Pose.identity(), target=True)
    with pytest.raises(UsageError, match="two different targets are called 'spool'"):
        simulate(replace(small, objects=(*small.objects, other)))


@pytest.mark.parametrize("make", [shop, plant, frame])
def test_a_target_larger_than_the_place_is_refused_at_once(make: Callable[..., Scene]) -> None:
    with pytest.raises(UsageError, match=r"slab is 30\.0 x 30\.0 x 1\.0 m"):
        make(0, replace(parts.box(30.0, 30.0, 1.0), name="slab"))
    with pytest.raises(UsageError, match="targets, copies and stations"):
        make(0, pipe_spool(), copies=0)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["plant"], "give --out DIR, or --plan"),
        (["plant", "--plan", "--out", "x"], "--plan writes nothing"),
        (["plnat", "--plan"], "did you mean 'plant'"),
        (["plant", "--plan", "--scanner", "fase"], "did you mean 'phase'"),
        (["plant", "--plan", "--step", "1", "--points", "5"], "exclude each other"),
        (["plant", "--plan", "--points", "many"], "--points must be a whole number"),
        (["plant", "--plan", "--station", "1,2"], "takes 3 numbers"),
        (["frame", "--plan", "--range", "5,1"], "nearest < farthest"),
        (["plant", "--plan", "--model", "none.stl"], "none.stl: no such file"),
        (["none.toml", "--plan"], "none.toml: cannot be read"),
        (["none.toml", "--plan", "--copies", "2"], "are for shop, plant and frame"),
    ],
)
def test_wrong_calls_are_one_line(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", *words]) in (1, 2)
    told = capsys.readouterr().err
    assert says in told
    assert told.count("\n") == 1


def test_the_command_prints_a_table_or_the_truth(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "shop", "--plan", "--points", "20000", "--stations", "2", "--seed", "3"]) == 0
    table = capsys.readouterr()
    assert table.out.splitlines()[0].split("  ")[0] in ("id", " id")
    assert "pipe_spool" in table.out
    assert "nothing written, as planned" in table.err
    assert main(["simulate", "shop", "--plan", "--json", "--points", "20000", "--stations", "2", "--seed", "3"]) == 0
    truth = json.loads(capsys.readouterr().out)
    assert len(truth["stations"]) == 2
    assert truth["seed"] == 3
