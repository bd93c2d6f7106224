"""Kernels that lay a model onto itself equal their plain twins."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from naive import self_overlap, shift_table
from scanfind.kernels import overlap
from scanfind.library.self_similar import peaks_of
from scanfind.pose import Pose, random_rotation

Floats = NDArray[np.float64]


def samples(rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """Points in a box of 1 × 0.5 × 0.2 m, some of them alike, and normals along the axes."""
    normals = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], count)[:, None]
    return rng.integers(0, 6, (count, 3)) * np.array([0.2, 0.1, 0.04]), normals


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 40), signed=st.booleans())
@settings(max_examples=50, deadline=None)
def test_overlap_equals_all_against_all(seed: int, count: int, signed: bool) -> None:
    rng = np.random.default_rng(seed)
    points, normals = samples(rng, count)
    pose = Pose(random_rotation(rng), rng.normal(0, 0.1, 3)) if seed % 2 else Pose(np.eye(3), rng.normal(0, 0.1, 3))
    some = int(rng.integers(1, count + 1))
    axis = int(rng.integers(3))
    order = np.argsort(points[:, axis])
    found = overlap.self_overlap(
        points, normals, some, points[order], normals[order], points[order, axis], axis, signed, pose.rotation,
        pose.translation, 0.15,
    )  # fmt: skip
    assert found == pytest.approx(self_overlap(points, normals, signed, some, pose, 0.15))


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 40), signed=st.booleans())
@settings(max_examples=50, deadline=None)
def test_shifts_equal_all_against_all_and_of_no_turn_lead_there_and_back(seed: int, count: int, signed: bool) -> None:
    rng = np.random.default_rng(seed)
    onto, facing = samples(rng, count)
    cell = 0.07
    for turn in (np.eye(3), random_rotation(rng)):
        points, normals = onto @ turn.T, facing @ turn.T
        farthest = np.maximum(onto.max(axis=0) - points.min(axis=0), points.max(axis=0) - onto.min(axis=0))
        reach = np.ceil(farthest / cell).astype(np.int64) + 1
        table = np.zeros(2 * reach + 1, np.int64)
        overlap.count_shifts(points, normals, onto, facing, signed, 1.0 / cell, reach, table)
        np.testing.assert_array_equal(table, shift_table((points, normals), (onto, facing), signed, 1.0 / cell, reach))
        assert turn[0, 0] != 1.0 or (table == table[::-1, ::-1, ::-1]).all()


@given(seed=st.integers(0, 2**32 - 1), least=st.floats(0.0, 1.0))
@settings(max_examples=20, deadline=None)
def test_a_peak_is_what_none_of_26_neighbours_exceeds(seed: int, least: float) -> None:
    rng = np.random.default_rng(seed)
    table = np.pad(rng.integers(0, 9, rng.integers(1, 7, 3), np.int32), 1)
    highest = np.lib.stride_tricks.sliding_window_view(np.pad(table, 1), (3, 3, 3)).max(axis=(3, 4, 5))
    naive = np.argwhere((table == highest) & (table >= least * table.max()) & (table > 0))
    found = peaks_of(table, least)
    assert sorted(map(tuple, found)) == sorted(map(tuple, naive))
    assert (np.diff(table[tuple(found.T)]) <= 0).all()
