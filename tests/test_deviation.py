"""Laws of deviations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanfind.errors import InvalidGeometryError, UsageError
from scanfind.isolation.deviation import deviation_of, within

distances = st.lists(st.floats(-1.0, 1.0, width=32), min_size=1, max_size=40)


@given(distances)
def test_statistics_keep_their_order(values: list[float]) -> None:
    d = deviation_of(np.array(values, dtype=np.float32))
    slack = 1e-12
    assert abs(d.mean_m) <= d.rms_m + slack
    assert d.rms_m <= abs(d.worst_m) + slack
    assert d.p95_m <= abs(d.worst_m)
    assert d.worst_m in values


@given(distances)
def test_turning_the_side_turns_the_signs(values: list[float]) -> None:
    there, back = deviation_of(values), deviation_of([-v for v in values])
    assert back.mean_m == -there.mean_m
    assert (back.rms_m, back.p95_m, abs(back.worst_m)) == (there.rms_m, there.p95_m, abs(there.worst_m))


def test_known_numbers() -> None:
    d = deviation_of([0.003, -0.004, np.nan])
    assert (d.mean_m, d.rms_m) == pytest.approx((-0.0005, np.sqrt(12.5e-6)))
    assert (d.p95_m, d.worst_m) == pytest.approx((0.00395, -0.004))
    assert deviation_of([0.002, -0.002]).worst_m == 0.002


def test_one_stray_point_does_not_put_a_part_out_of_tolerance() -> None:
    good = np.full(1000, 0.001)
    good[0] = 0.5
    assert within(deviation_of(good), 0.002)
    assert not within(deviation_of(np.linspace(0, 0.01, 100)), 0.009)


def test_the_door() -> None:
    for nothing in ([], [np.nan]):
        with pytest.raises(InvalidGeometryError, match="at least one"):
            deviation_of(nothing)
    with pytest.raises(InvalidGeometryError, match=r"\(N,\)"):
        deviation_of(np.zeros((2, 2)))
    for tolerance in (0.0, -1.0, np.nan):
        with pytest.raises(UsageError, match="positive"):
            within(deviation_of([0.0]), tolerance)
