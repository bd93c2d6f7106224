"""What slides along itself is measured by its ends; what the design hides; which models could be swapped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from scanfind.evidence.ends import FIXED, Slid, comes_near, slid, with_faces
from scanfind.evidence.free_space import Limits, Towards, beams_to, caster_of, spoken_by_each
from scanfind.grid.depth import Beams
from scanfind.library.model import Cover, Model, ModelParameters, build_model
from scanfind.library.surface import SurfaceParameters
from scanfind.pose import Pose
from scanfind.recognition.stands import as_designed
from scanfind.recognition.swaps import onto, pairs_alike, sides_of
from scanfind.recognition.witnesses import known_along
from scanfind.simulate.parts import blocks, box
from seen import seen_of

Floats = NDArray[np.float64]

LIMITS = Limits(0.006, 0.03, 0.25)
ALONG = np.array([1.0, 0.0, 0.0])


def bar(length: float = 2.0, width: float = 0.2) -> Model:
    mesh = replace(box(length, width, width), name=f"bar {length:g}")
    return build_model(mesh, ModelParameters(SurfaceParameters(samples=400)))


def at(x: float) -> Pose:
    return Pose(np.eye(3), np.array([x, 0.0, 0.0]))


@cache
def bar_seen(x: float) -> list[Beams]:
    return seen(bar(), x)


def seen(model: Model, x: float) -> list[Beams]:
    """What two scanners keep of a bar before a wall."""
    assert model.mesh is not None
    return seen_of([(model.mesh, at(x))])


@pytest.mark.parametrize("moved", [-0.08, -0.02, 0.05])
@pytest.mark.parametrize("carried", [0.0, 0.03])
def test_a_slide_is_measured_wherever_icp_left_it(moved: float, carried: float) -> None:
    model = bar()
    told = slid(model, caster_of(model), at(carried), ALONG, -carried, bar_seen(moved), LIMITS)
    assert told is not None
    assert carried + told.by == pytest.approx(moved, abs=max(FIXED * told.sigma, 0.005))
    assert told.sigma < 0.01


@pytest.mark.parametrize("carried", [-0.03, 0.0, 0.05])
def test_what_stands_as_designed_is_not_slid(carried: float) -> None:
    model = bar()
    assert slid(model, caster_of(model), at(carried), ALONG, -carried, bar_seen(0.0), LIMITS) is None


@pytest.mark.parametrize("moved", [-0.02, 0.0, 0.002])
def test_of_what_was_moved_the_ends_are_believed_though_they_do_not_refute_the_design(moved: float) -> None:
    model = bar()
    told = slid(model, caster_of(model), at(0.03), ALONG, None, bar_seen(moved), LIMITS)
    assert told is not None
    assert 0.03 + told.by == pytest.approx(moved, abs=max(FIXED * told.sigma, 0.005))


def test_beams_that_end_before_it_say_nothing_and_are_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    model, screen = bar(), blocks("screen", [((0.5, -0.8, -1.0), (1.5, -0.75, 1.5))])
    assert model.mesh is not None
    beams = seen_of([(model.mesh, at(0.05)), (screen, Pose.identity())])
    asked: list[int] = []

    def told(allowed: float | None, near: Callable[..., NDArray[np.intp]]) -> Slid | None:
        def counted(covers: Sequence[Cover], scanners: Sequence[Beams], *, short: float) -> Towards:
            some = beams_to(covers, scanners, short=short if allowed is None else allowed)
            asked.append(len(some.ranges))
            return some

        monkeypatch.setattr("scanfind.evidence.ends.beams_to", counted)
        monkeypatch.setattr("scanfind.evidence.ends.comes_near", near)
        return slid(model, caster_of(model), at(0.0), ALONG, 0.0, beams, LIMITS)

    def all_of_them(_: object, __: object, origins: Floats, *___: object) -> NDArray[np.intp]:
        return np.arange(len(origins))

    every = told(np.inf, all_of_them)
    assert every is not None
    assert told(np.inf, comes_near) == told(None, all_of_them) == told(None, comes_near) == every
    assert 0 < asked[2] < 0.9 * asked[0]


def test_faces_and_ends_are_weighed_where_they_agree_and_the_ends_believed_where_not() -> None:
    told = with_faces(Slid(0.002, 0.002), 0.001**2)
    assert told.by == pytest.approx(0.0004)
    assert told.sigma**-2 == pytest.approx(0.002**-2 + 0.001**-2)
    assert with_faces(Slid(0.02, 0.002), 0.001**2) == Slid(0.02, 0.002)
    assert with_faces(Slid(0.002, 0.002), 0.0) == Slid(0.002, 0.002)


def test_what_the_design_has_in_front_hides_and_is_not_beside() -> None:
    plate, cover = bar(), build_model(blocks("cover", [((-0.01, -0.01, -0.01), (2.01, 0.21, 0.21))]))
    beams = seen(cover, 0.0)
    alone = spoken_by_each(plate, caster_of(plate), at(0.0), beams, LIMITS).sum(axis=0)
    assert alone[1] > 0.5 * alone.sum()
    design = as_designed([plate, cover])
    told = spoken_by_each(plate, caster_of(plate), at(0.0), beams, LIMITS, design).sum(axis=0)
    assert told[1] < 0.05 * told.sum()
    assert told[3] > 0.9 * alone[1]


def test_alike_are_those_of_one_section_whose_lengths_can_be_told_apart() -> None:
    models = [bar(2.0), bar(2.1), bar(2.0, 0.21), bar(2.0, 0.3), bar(3.0)]
    sides = np.array([sides_of(model) for model in models])
    assert pairs_alike(sides) == {(0, 1), (1, 2)}  # the first and the third are of one length


def test_a_model_is_put_onto_another_side_along_side_and_middle_to_middle() -> None:
    one, other = bar(2.0), build_model(replace(box(0.2, 2.5, 0.2), name="up"))
    low, high = other.samples.points.min(axis=0), other.samples.points.max(axis=0)
    for way in onto(one, other):
        points = way.move(one.samples.points)
        np.testing.assert_allclose(0.5 * (points.min(axis=0) + points.max(axis=0)), 0.5 * (low + high), atol=0.01)
        assert np.argmax(np.ptp(points, axis=0)) == 1


def test_sides_of_about_one_length_are_put_along_each_other_in_every_way() -> None:
    stub, beam = bar(0.21), bar(2.0, 0.21)
    assert len(onto(stub, stub)) == 24
    assert len(onto(beam, beam)) == 8
    assert all(np.isclose(np.linalg.det(way.rotation), 1.0) for way in onto(stub, stub))


@pytest.mark.parametrize("seed", range(3))
def test_a_covariance_has_the_variance_that_ends_and_faces_give_and_no_other_changes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, along = rng.normal(size=(6, 6)), rng.normal(size=3)
    along /= np.linalg.norm(along)
    covariance, six = root @ root.T, np.concatenate([np.zeros(3), along])
    others = np.linalg.svd(six[None])[2][1:]  # (5, 6) across it
    before = float(six @ covariance @ six)
    for known in (before, 0.0):
        found = known_along(covariance, along, known, 0.25)
        assert np.linalg.eigvalsh(found).min() > 0.0
        assert np.isclose(six @ found @ six, 0.25 if known else before + 0.25)
        np.testing.assert_allclose(others @ found @ others.T, others @ covariance @ others.T)
