"""Rivals without any of their libraries: what they share, and the process they run in."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import rivals
from benchmarks.rivals.answer import TIME_LIMIT, Answer, read_answer, write_answer
from benchmarks.rivals.inside.finish import apart, check, finish, icp
from benchmarks.rivals.inside.prepare import Prepared, prepare_scene, thin
from benchmarks.rivals.inside.windows import windows
from benchmarks.rivals.runner import ask, viewpoints
from benchmarks.rivals.table import ENVIRONMENTS
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.errors import InvalidGeometryError, UsageError
from scanfind.pose import Pose, random_rotation
from scanfind.simulate.objects import pipe_spool

Floats = NDArray[np.float64]

VOXEL = 0.08


class Plain:
    """Every distance worked out: what scipy's tree answers, in three lines."""

    def __init__(self, points: Floats) -> None:
        self.points = points

    def query(
        self, x: Floats, k: int = 1, *, distance_upper_bound: float = np.inf
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        squared = (x**2).sum(axis=1)[:, None] + (self.points**2).sum(axis=1) - 2.0 * x @ self.points.T
        at = np.argpartition(squared, k - 1, axis=1)[:, :k]
        far = np.sqrt(np.maximum(np.take_along_axis(squared, at, axis=1), 0.0))
        far = np.where(far < distance_upper_bound, far, np.inf)
        return (far[:, 0], at[:, 0]) if k == 1 else (far, at)


def grid(u: Floats, v: Floats, origin: tuple[float, float, float], count: int) -> Floats:
    """count² points over a parallelogram."""
    a, b = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    return np.array(origin) + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v


def bracket() -> OrientedCloud:
    """Samples of three unequal plates at right angles, meeting in a corner: no symmetry."""
    x, y, z = 0.9 * np.eye(3)[0], 0.6 * np.eye(3)[1], 0.4 * np.eye(3)[2]
    plates = [grid(x, y, (0, 0, 0), 16), grid(y, z, (0, 0, 0), 16), grid(z, x, (0, 0, 0), 16)]
    normals = np.repeat(np.eye(3)[[2, 0, 1]], 256, axis=0)
    order = np.random.default_rng(0).permutation(768)
    return OrientedCloud(np.concatenate(plates)[order], normals[order])


def scene_of(cloud: OrientedCloud) -> Prepared:
    return Prepared(cloud, Plain(cloud.points), cloud)


def test_planes_go_and_the_object_stays() -> None:
    thing = Pose.from_rotation_vector([0.3, 0.2, 0.5], [2.0, 1.5, 0.8]).move(bracket().points)
    floor = grid(np.array([4.0, 0, 0]), np.array([0, 4.0, 0]), (0, 0, 0), 55)
    wall = grid(np.array([4.0, 0, 0]), np.array([0, 0, 2.5]), (0, 0, 0), 45)
    noise = np.random.default_rng(1).normal(0, 0.002, (len(floor) + len(wall) + len(thing), 3))
    points = np.concatenate([floor, wall, thing]) + noise
    seen_from = np.broadcast_to([2.0, 3.0, 2.0], points.shape)

    left = prepare_scene(points, seen_from, True, VOXEL, 0, Plain).fine

    on_plane = np.abs(left.points[:, 1:]).min(axis=1) < 0.03
    assert on_plane.mean() < 0.1
    assert Plain(left.points).query(thing)[0].max() < 0.1
    assert (((seen_from[0] - left.points) * left.normals).sum(axis=1) >= 0).all()


def test_thinning_keeps_the_mean_of_every_cell() -> None:
    points = np.random.default_rng(2).uniform(-3, 3, (500, 3))
    means, same = thin(100.0, points, points)
    np.testing.assert_allclose(means, points.mean(axis=0)[None])
    np.testing.assert_array_equal(means, same)
    np.testing.assert_allclose(np.sort(thin(1e-6, points)[0], axis=0), np.sort(points, axis=0))


@pytest.mark.parametrize("seed", range(4))
def test_icp_goes_home_through_outliers(seed: int) -> None:
    rng, model = np.random.default_rng(seed), bracket()
    truth = Pose(random_rotation(rng), rng.normal(0, 1, 3))
    clutter = rng.uniform(-2, 2, (400, 3)) + truth.translation
    scene = scene_of(
        OrientedCloud(
            np.concatenate([truth.move(model.points), clutter]),
            np.concatenate([truth.turn(model.normals), rng.permutation(clutter) / 3.0]),
        )
    )
    start = Pose.from_rotation_vector(rng.normal(0, 0.03, 3), rng.normal(0, 0.03, 3)) @ truth
    assert apart(icp(start, model, scene, VOXEL), truth, model.points) < 1e-3


def test_the_check_ranks_the_truth_first_and_no_pose_twice() -> None:
    rng, model = np.random.default_rng(5), bracket()
    truth = Pose(random_rotation(rng), rng.normal(0, 1, 3))
    scene = scene_of(OrientedCloud(truth.move(model.points), truth.turn(model.normals)))
    wrong = [Pose(random_rotation(rng), truth.translation + rng.normal(0, 0.3, 3)) for _ in range(8)]
    near = Pose.from_rotation_vector([0, 0, 0.02], [0.01, 0, 0]) @ truth

    best = finish([*wrong, near, truth], model, scene, VOXEL)

    # Where plates meet, the nearest point may be the other plate's.
    assert check(truth, model, scene, VOXEL) == pytest.approx(best[0][0], abs=0.01)
    assert best[0][0] > 0.9
    assert apart(best[0][1], truth, model.points) < 1e-3
    assert [score for score, _ in best] == sorted((score for score, _ in best), reverse=True)
    assert all(apart(pose, truth, model.points) > VOXEL for _, pose in best[1:])
    assert finish([], model, scene, VOXEL) == []


def test_windows_are_no_wider_than_a_model_needs_and_leave_no_point_out() -> None:
    points = np.random.default_rng(6).uniform(-2, 2, (20_000, 3))
    seen = np.zeros(len(points), dtype=bool)
    for rows in windows(points, 1.0):
        seen[rows] = True
        assert np.ptp(points[rows], axis=0).max() <= 1.5
    assert seen.all()


def test_an_answer_comes_back_as_it_went(tmp_path: Path) -> None:
    pose = Pose(random_rotation(np.random.default_rng(3)), np.array([1.0, -2.0, 5e5]))
    for sent in (Answer([pose], [0.5], {"total": 1.5}), Answer(error="x")):
        write_answer(sent, tmp_path / "answer.json")
        got = read_answer(tmp_path / "answer.json")
        assert (got.scores, got.seconds, got.error) == (sent.scores, sent.seconds, sent.error)
        for one, other in zip(got.poses, sent.poses, strict=True):
            np.testing.assert_allclose(one.matrix(), other.matrix(), rtol=1e-12, atol=1e-12)


def fake(code: str, folder: Path, limit: float = 10.0) -> Answer:
    """A rival of one line."""
    return ask([sys.executable, "-c", code], folder, limit, {})


def test_an_answer_is_read_from_the_child(tmp_path: Path) -> None:
    write_answer(Answer([Pose.identity()], [1.0], {"total": 0.1}), tmp_path / "sent")
    answer = fake("print('ready', flush=True); import os; os.rename('sent', 'answer.json')", tmp_path)
    assert (answer.error, answer.scores) == ("", [1.0])


def test_the_limit_ends_the_whole_process_group(tmp_path: Path) -> None:
    code = (
        "import subprocess, sys, time; print('ready', flush=True);"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']);"
        "open('pid', 'w').write(str(child.pid)); time.sleep(60)"
    )
    begin = time.perf_counter()
    assert fake(code, tmp_path, 1.5) == Answer(error=TIME_LIMIT)
    assert time.perf_counter() - begin < 30
    status = Path(f"/proc/{(tmp_path / 'pid').read_text()}/status")
    # Its parent is gone too: until init has buried it, it is a zombie.
    time.sleep(0.2)
    assert not status.exists() or "Z (zombie)" in status.read_text()


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("raise RuntimeError('no luck')", "exit code 1: RuntimeError: no luck"),
        ("print('ready', flush=True); import os; os.abort()", "exit code -6"),
        ("print('ready')", "exit code 0: no word"),
    ],
)
def test_a_crash_is_an_answer(tmp_path: Path, code: str, says: str) -> None:
    answer = fake(code, tmp_path)
    assert answer.error.startswith(says)
    assert answer.poses == []


def test_who_is_unknown_or_not_installed_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    points = np.zeros((3, 3))
    with pytest.raises(UsageError, match="no rival is called 'x'"):
        rivals.run("x", points, None, None, pipe_spool())
    monkeypatch.setattr("benchmarks.rivals.table.HOME", tmp_path)
    assert rivals.available() == []
    for name, rival in rivals.RIVALS.items():
        assert rival.environment in ENVIRONMENTS
        with pytest.raises(UsageError, match=rf"install {name}"):
            rivals.run(name, points, None, None, pipe_spool())


def test_every_point_has_a_viewpoint() -> None:
    points, origins = np.zeros((3, 3)), np.array([[1.0, 0, 0], [0, 1.0, 0]])
    np.testing.assert_array_equal(viewpoints(points, origins, np.array([0, 1, 1])), origins[[0, 1, 1]])
    np.testing.assert_array_equal(viewpoints(points, origins, None), origins[[0, 0, 0]])
    with pytest.raises(InvalidGeometryError, match="one of 2 origins"):
        viewpoints(points, origins, np.array([0, 1, 2]))
