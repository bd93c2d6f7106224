"""Which poses are thought of: no hypothesis is given up that leads to a pose the priors allow for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.kernels.allowed import may_be
from scanfind.library.model import Model, ModelParameters, build_model
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Placement
from scanfind.pose import Pose, random_rotation
from scanfind.priors import Priors
from scanfind.priors.allowed import DRAWN_IN, LEANING_DEG, allowed_poses, lean_of, middle_of, why_not
from scanfind.simulate.parts import blocks
from scanfind.symmetry import FREE, Axis, Symmetry

Floats = NDArray[np.float64]


@cache
def bracket() -> Model:
    mesh = blocks("bracket", [((0, 0, 0), (1.0, 0.6, 0.15)), ((0, 0, 0.15), (0.15, 0.15, 0.9))])
    return build_model(mesh, ModelParameters(SurfaceParameters(samples=300)))


def symmetric(symmetry: Symmetry, placements: Sequence[Placement] = ()) -> Model:
    return replace(bracket(), symmetry=symmetry, placements=tuple(placements))


NONE, ABOUT_X = Symmetry(np.zeros(3)), Symmetry(np.zeros(3), (Axis((1.0, 0.0, 0.0), 2),))
PIPE = Symmetry(np.zeros(3), (Axis((1.0, 0.0, 0.0), FREE), Axis((0.0, 1.0, 0.0), 2)))
BALL = Symmetry(np.zeros(3), (Axis((1.0, 0.0, 0.0), FREE), Axis((0.0, 1.0, 0.0), FREE)))


@pytest.mark.parametrize("symmetry", [NONE, ABOUT_X, PIPE, BALL], ids=["none", "2-fold", "pipe", "ball"])
@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_lean_does_not_depend_on_which_of_its_likes_a_pose_is(symmetry: Symmetry, seed: int) -> None:
    rng = np.random.default_rng(seed)
    model, pose, up, drawn = symmetric(symmetry), Pose(random_rotation(rng), np.zeros(3)), *rng.normal(size=(2, 3))
    lean = lean_of(model, drawn, pose, up)
    for motion in symmetry.motions():
        assert lean_of(model, drawn, pose @ motion, up) == pytest.approx(lean, abs=1e-6)
    turned = pose.rotation @ drawn @ up / np.linalg.norm(drawn) / np.linalg.norm(up)
    assert lean <= np.arccos(np.clip(turned, -1.0, 1.0)) + 1e-6
    if symmetry is NONE:
        assert lean == pytest.approx(np.arccos(np.clip(turned, -1.0, 1.0)), abs=1e-6)


def test_an_element_is_upright_as_the_design_placed_it() -> None:
    """A beam's geometry is drawn along z, and the design lays it down."""
    lies = Pose.from_rotation_vector([0.0, 0.5 * np.pi, 0.0], [3.0, 2.0, 1.0])
    model = symmetric(NONE, [Placement("1", "IfcBeam", "beam", lies)])
    assert lean_of(model, np.array([0.0, 0.0, 1.0]), lies, np.array([0.0, 0.0, 1.0])) == pytest.approx(0.0, abs=1e-6)
    assert "leans by 90°" in why_not(model, Priors(up="z"), Pose.identity())


def test_turned_too_far_from_the_design_is_not_it() -> None:
    turned = Pose.from_rotation_vector([0.0, 0.0, 0.3]) @ bracket_about_its_middle()
    model = symmetric(NONE, [Placement("1", "", "", bracket_about_its_middle())])
    assert not why_not(model, Priors(near_design_m=0.1, turned_deg=18.0), turned)
    assert "turned by 17°" in why_not(model, Priors(near_design_m=0.1, turned_deg=10.0), turned)


def bracket_about_its_middle() -> Pose:
    return Pose(np.eye(3), -middle_of(bracket()))


# ── hypotheses ──


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), known=st.sets(st.sampled_from(["region", "up", "near"])))
def test_no_hypothesis_is_given_up_that_may_lead_to_a_pose_allowed(seed: int, known: set[str]) -> None:
    """One as far off as hypotheses are; and one that is given up is not allowed itself."""
    rng = np.random.default_rng(seed)
    priors = Priors(
        region=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0) if "region" in known else None,
        up="z" if "up" in known else None,
        tilt_deg=20.0,
        near_design_m=1.0 if "near" in known else None,
    )
    model = symmetric((NONE, ABOUT_X, PIPE, BALL)[seed % 4])
    offset = rng.uniform(-5.0, 5.0, 3)
    pose = Pose.from_rotation_vector(rng.normal(scale=0.3, size=3), rng.uniform(-1.5, 1.5, 3))
    turn = Pose.from_rotation_vector(0.99 * np.radians(LEANING_DEG) * unit(rng.normal(size=3)))
    off = 0.99 * DRAWN_IN * model.diameter * unit(rng.normal(size=3))
    about = pose.move(middle_of(model)[None])[0]
    drawn = Pose(turn.rotation @ pose.rotation, turn.rotation @ (pose.translation - about) + about + off)
    allowed = allowed_poses([model], priors, offset)
    met = may_be(allowed, 0, drawn.rotation, drawn.translation - offset)
    if not why_not(model, priors, pose):
        assert met
    if not may_be(allowed, 0, pose.rotation, pose.translation - offset):
        assert why_not(model, priors, pose)


def unit(vector: Any) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def test_with_nothing_known_every_pose_is_allowed() -> None:
    allowed = allowed_poses([bracket()], Priors(), np.zeros(3))
    assert not allowed.known
    assert may_be(allowed, 0, np.eye(3), np.full(3, 1e9))


def test_of_two_models_each_has_its_own_places() -> None:
    far = replace(bracket(), name="far", placements=(Placement("1", "", "", Pose(np.eye(3), np.full(3, 9.0))),))
    allowed = allowed_poses([bracket(), far], Priors(near_design_m=0.5), np.zeros(3))
    at = [Pose.identity(), Pose(np.eye(3), np.full(3, 9.0))]
    met = [[may_be(allowed, which, pose.rotation, pose.translation) for pose in at] for which in (0, 1)]
    assert met == [[True, False], [False, True]]
