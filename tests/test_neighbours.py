"""What beams met of one element of a design says nothing of another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.evidence.free_space import (
    BESIDE,
    FLUSH_M,
    HIDDEN,
    NOTHING,
    ON,
    TELLS_APART,
    Limits,
    caster_of,
    of_neighbours,
    spoken_by_each,
)
from scanfind.evidence.neighbours import Design, Placed
from scanfind.grid.depth import Beams
from scanfind.library.model import build_model
from scanfind.library.near_surface import near_triangles, signed_distances
from scanfind.pose import Pose, random_rotation
from scanfind.recognition.stands import as_designed
from scanfind.simulate.parts import blocks, box
from seen import seen_of

Floats = NDArray[np.float64]

LIMITS = Limits(0.009, 0.03, 0.25)
FLANGE = blocks("flange", [((0.0, 0.0, 0.0), (2.0, 0.01, 0.3))])
PLATE = blocks("plate", [((0.5, -0.008, 0.05), (1.1, 0.0, 0.25))])  # of 8 mm, on the side that scanners see


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_the_nearest_other_element_is_that_of_a_naive_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    meshes = [replace(box(*rng.uniform(0.05, 0.5, 3)), name=f"box{k % 3}") for k in range(5)]
    meshes[3], meshes[4] = meshes[0], meshes[1]
    placed = [Placed(each.name, each, Pose(random_rotation(rng), 0.3 * rng.normal(size=3))) for each in meshes]
    points = 0.4 * rng.normal(size=(200, 3))
    for without in (frozenset[str](), frozenset(["box0"]), frozenset(["box0", "box1", "box2"])):
        naive = np.full(len(points), np.inf)
        for name, mesh, pose in placed:
            if name not in without:
                off = np.abs(signed_distances(near_triangles(mesh.triangles(), 0.05), pose.inverse().move(points))[0])
                naive = np.fmin(naive, off)
        np.testing.assert_allclose(Design(placed).off(without, points, 0.05), naive, atol=1e-6)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_beam_says_on_only_where_the_surface_is_nearer_than_its_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    off = np.where(rng.random(300) < 0.3, np.inf, rng.uniform(0.0, LIMITS.inlier, 300))
    behind, cosine = rng.uniform(-0.02, 0.02, 300), rng.uniform(0.3, 1.0, 300)
    says = np.where(np.abs(behind) * cosine <= LIMITS.inlier, ON, BESIDE).astype(np.uint8)
    told = of_neighbours(off, behind, cosine, says, LIMITS.inlier)
    assert (told[np.isinf(off)] == says[np.isinf(off)]).all()
    still = told == ON
    assert (off[still] > (np.abs(behind) * cosine)[still] + TELLS_APART * LIMITS.inlier).all()
    assert set(told[(says == ON) & ~still]) <= {NOTHING, HIDDEN}
    hidden = (says == BESIDE) & np.isfinite(off) & (behind < -FLUSH_M)
    np.testing.assert_array_equal(told == HIDDEN, hidden | ((says == ON) & (told == HIDDEN)))


def said_of_plate(beams: list[Beams], *, neighbours: bool) -> Floats:
    flange, plate = build_model(FLANGE), build_model(PLATE)
    design = as_designed([flange, plate]) if neighbours else None
    return np.asarray(spoken_by_each(plate, caster_of(plate), Pose.identity(), beams, LIMITS, design).sum(axis=0))


@pytest.mark.parametrize("there", [True, False])
def test_a_plate_that_is_missing_is_not_seen_on_the_flange_it_was_to_lie_on(there: bool) -> None:
    beams = seen_of([(each, Pose.identity()) for each in ((FLANGE, PLATE) if there else (FLANGE,))])
    alone, among = (said_of_plate(beams, neighbours=each) for each in (False, True))
    assert alone[0] > 0.7 * alone.sum()  # 8 mm: within what counts as on it
    if there:
        assert among[0] > 0.9 * alone[0]
    else:
        assert among[0] < 0.05 * alone[0]
