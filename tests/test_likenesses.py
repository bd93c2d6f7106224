"""A twin that was drawn first gives way to the part that is there, and what is right stays."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from scanfind.clock import Clock
from scanfind.find import begin
from scanfind.grid.moments import MomentGrid
from scanfind.library.model import Model, build_model
from scanfind.mesh import Mesh
from scanfind.parameters import PRESETS
from scanfind.pose import Pose
from scanfind.recognition.likenesses import Likenesses
from scanfind.recognition.recognise import SURE, Recognition
from scanfind.recognition.sizes import Sizes
from scanfind.scans.sources import Sources
from scanfind.simulate.parts import blocks
from scanfind.simulate.scanner import scan
from scanfind.simulate.scene import Scene, SceneObject

FLOOR = SceneObject("floor", blocks("floor", [((-4, -4, -0.3), (4, 4, -0.2))]), Pose.identity())
STATIONS = np.array([[-1.5, -3.0, 1.5], [2.5, -2.5, 1.8], [0.5, 3.0, 1.6]])
PLACE = Pose.from_rotation_vector([0.0, 0.0, 0.4], [0.3, -0.2, 0.0])


def stand(name: str, boss: float, *, mirrored: bool = False) -> Mesh:
    """A plate with a post at one end and a boss on it `boss` from there, metres."""
    bossed = ((boss, 0.3, 0.1), (boss + 0.2, 0.5, 0.3))
    made = blocks(name, [((0, 0, 0), (1.2, 0.5, 0.1)), ((0, 0, 0.1), (0.15, 0.15, 0.8)), bossed])
    if not mirrored:
        return made
    return Mesh.of(name, made.vertices * np.array([1.0, -1.0, 1.0]), made.faces[:, ::-1])


@cache
def models() -> tuple[Model, ...]:
    bench = blocks("bench", [((0, 0, 0), (2.5, 0.4, 0.4))])
    return tuple(
        build_model(mesh)
        for mesh in (stand("near", 0.5), stand("far", 0.62), stand("mirrored", 0.5, mirrored=True), bench)
    )


@cache
def search(built: str) -> Recognition:
    """The search for all of them in a scan of one, before its first round."""
    mesh = next(model.mesh for model in models() if model.name == built)
    assert mesh is not None
    scanned = scan(Scene((FLOOR, SceneObject(built, mesh, PLACE)), STATIONS), seed=3, points=150_000)
    parameters = PRESETS["default"]
    sizes = Sizes(models(), parameters)
    grid = MomentGrid(sizes.finest_cell())
    for chunk in Sources(scanned.stations).chunks():
        grid.add(chunk)
    (size,) = sizes.groups()
    return begin(size, grid, (), parameters, 0, 1, Clock())


def test_only_what_is_of_like_size_is_a_likeness() -> None:
    likenesses = Likenesses(models(), 24)
    assert set(likenesses.of_others(0)) == {1, 2}
    assert set(likenesses.of_others(3)) == set()
    assert likenesses.of_itself(0) == [each.motion for each in models()[0].similar]
    none = Likenesses(models(), 0)
    assert not none.of_others(0)
    assert not none.of_itself(0)


@pytest.mark.parametrize(("built", "drawn"), [("near", "far"), ("far", "near"), ("near", "mirrored")])
def test_a_twin_drawn_first_gives_way(built: str, drawn: str) -> None:
    found, names = search(built), [model.name for model in models()]
    ground, theirs = found.ground, names.index(drawn)
    there = Pose(PLACE.rotation, PLACE.translation - ground.offset)
    ways = Likenesses(models(), 24).of_others(names.index(built))[theirs]
    refined = found.refine(ground.placements(theirs, [there @ motion for motion in ways]))
    wrong = max(found.weighing.candidates(refined), key=lambda candidate: candidate.area)
    assert wrong.model == theirs
    best = found._best_of_similar(wrong)
    assert names[best.model] == built
    assert np.linalg.norm(best.translation - there.translation) < 0.005
    assert PLACE.difference(best.pose())[1] < 0.005


def test_what_is_right_stays() -> None:
    found = search("near")
    there = Pose(PLACE.rotation, PLACE.translation - found.ground.offset)
    (right,) = found.weighing.candidates(found.refine(found.ground.placements(0, [there])))
    assert right.score > SURE
    assert found._best_of_similar(right).model == 0
