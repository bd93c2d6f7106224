"""Kernels that lay a model onto itself equal their plain twins."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from naive import self_overlap, shift_table
from scanfind.kernels import overlap
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
    found = overlap.self_overlap(points, normals, signed, some, pose.rotation, pose.translation, 0.15)
    assert found == pytest.approx(self_overlap(points, normals, signed, some, pose, 0.15))


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 40), signed=st.booleans())
@settings(max_examples=50, deadline=None)
def test_shifts_are_counted_there_and_back(seed: int, count: int, signed: bool) -> None:
    points, normals = samples(np.random.default_rng(seed), count)
    cell = 0.07
    reach = np.ceil(np.ptp(points, axis=0) / cell).astype(np.int64) + 1
    table = np.zeros(2 * reach + 1, np.int64)
    overlap.count_shifts(points, normals, signed, 1.0 / cell, reach, table)
    np.testing.assert_array_equal(table, shift_table(points, normals, signed, 1.0 / cell, reach))
    np.testing.assert_array_equal(table, table[::-1, ::-1, ::-1])
