"""Words for people: each status says what decided it, and no number is rounded into a lie."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from by_hand import absent, detection, element, motion, part, results
from scanfind.design.elements import INSTALLED, NO_DATA, NOT_ENOUGH_DATA, NOT_FOUND, OCCLUDED, UNCERTAIN
from scanfind.results.explain import (
    detection_sentences,
    element_sentences,
    headline,
    length,
    share,
    shift_in_words,
    stations_in_words,
)
from scanfind.results.schema import ElementEntry, ScanEntry


def told(each: ElementEntry) -> str:
    return " ".join(element_sentences(results(each, detection()), each))


@pytest.mark.parametrize(
    ("each", "words"),
    [
        (absent(NOT_FOUND, 0.0, 0.1, 0.15, 0.75), "60 % of the surface that the 3 stations should see is empty space."),
        (absent(NOT_FOUND, 0.0, 0.8, 0.2, 0.0), "Something else stands in its place: 80 %"),
        (absent(OCCLUDED, 0.01, 0.0, 0.0, 0.99), "Other things stand before 99 % of what the 3 stations would see"),
        (absent(UNCERTAIN, 0.9, 0.1, 0.0, 0.0), "90 % of the surface looked at is there, which does not settle"),
        (absent(UNCERTAIN, 0.4, 0.1, 0.5, 0.0), "The scan does not settle"),
        (absent(NOT_ENOUGH_DATA, 0.0, 0.0, 0.5, 0.5), "Too little of its surface was looked at"),
        (absent(NO_DATA, 0.0, 0.0, 0.0, 0.0), "No beam of any station came near its place"),
        (element(status=UNCERTAIN, off_m=1.5, through=0.9, on=0.0), "One of its shape stands 1.50 m off"),
        (element(), "It stands where the design puts it"),
        (element(shift_m=(0.004, 0.0, -0.012), off_m=0.014), "stands 12 mm too low, 4.0 mm towards +x; the point"),
        (element(shift_m=(0.0, 0.0, 0.03), off_m=0.03, on=0.3, through=0.6), "In its designed place, 60 % of the"),
    ],
)
def test_each_status_says_what_decided_it(each: ElementEntry, words: str) -> None:
    assert words in told(each)


@pytest.mark.parametrize("status", [INSTALLED, UNCERTAIN, OCCLUDED, NOT_FOUND, NOT_ENOUGH_DATA, NO_DATA])
def test_where_no_scanner_position_is_known_it_says_so_and_breaks_nowhere(status: str) -> None:
    nothing = {"on": None, "beside": None, "through": None, "hidden": None}
    assert "not known" in told(element(status=status, detection=None, shift_m=None, off_m=None, **nothing)) or (
        status == INSTALLED
    )


@given(st.floats(0.0, 1.0))
def test_a_share_is_all_or_nothing_only_where_it_is(part: float) -> None:
    words = share(part)
    assert (words == "100 %") == (part > 1.0 - 1e-9)
    assert (words == "0 %") == (part == 0.0)


def test_lengths_have_as_many_digits_as_they_deserve() -> None:
    assert [length(x) for x in (0.0, -0.0031, 0.00994, 0.00996, 0.12, 0.9994, 2.0)] == [
        "0.0 mm", "3.1 mm", "9.9 mm", "10 mm", "120 mm", "999 mm", "2.00 m",
    ]  # fmt: skip


def test_a_displacement_says_the_largest_part_first_and_leaves_out_what_is_none() -> None:
    assert shift_in_words((0.003, -0.02, 0.0004)) == "20 mm towards -y, 3.0 mm towards +x"
    assert shift_in_words((0.0, 0.0, 0.0)) == ""


def test_a_turn_within_what_is_uncertain_is_not_told() -> None:
    each = element(turn_rad=0.005, off_m=0.004)
    sure, unsure = (results(each, detection(sigma_rad=sigma)) for sigma in (0.0001, 0.004))
    assert "turned by 0.29°" in element_sentences(sure, each)[0]
    assert "turned" not in element_sentences(unsure, each)[0]


def test_what_the_scan_leaves_open_is_said_in_the_scans_axes() -> None:
    turned = ((0.0, 0.0, 1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    open_ = [motion("slide", (0.0, 1.0, 0.0)), motion("roll", (0.0, 0.0, 1.0), 0.002)]
    found = detection(unobservable=open_, scene_from_model=turned)
    words = " ".join(detection_sentences(results(found), found))
    assert "Nothing in the scan tells whether it has moved up or down." in words
    assert "hardly tells whether it is turned about an axis along x: only to ± 0.11°." in words


def test_parts_that_are_off_missing_or_unseen_are_named_and_no_others() -> None:
    gone = part(name="clip", status="missing", off_m=None, shift_m=None, turn_rad=None, penalty=0.8)
    parts = [part(name="good"), part(name="bent", off_m=0.02, turn_rad=(0.0, 0.05, 0.0)), gone]
    found = detection(parts=[*parts, part(name="dark", status="not_seen", off_m=None)])
    words = " ".join(detection_sentences(results(found), found))
    assert "good" not in words
    assert "Its part bent is 20 mm off, turned by 2.86°." in words
    assert "Its part clip is missing: beams passed through 80 % of it." in words
    assert "Its part dark cannot be judged" in words
    assert words.startswith("Its part bent")


def test_a_headline_is_one_line() -> None:
    assert headline(element()) == "installed, in place"
    assert headline(element(shift_m=(0.0, 0.0, -0.012), off_m=0.012)) == "installed, 12 mm too low"
    assert headline(absent(OCCLUDED, 0.0, 0.0, 0.0, 1.0)) == "hidden"


def test_stations_are_counted_over_all_scans() -> None:
    scan = ScanEntry(path="a.ply", points=1, dropped=0, stations_m=[None])
    assert stations_in_words(results()) == "the 3 stations"
    assert stations_in_words(results(scans=[scan])) == "a scanner"
    assert (
        stations_in_words(results(scans=[scan.model_copy(update={"stations_m": [(0.0, 0.0, 0.0)]})])) == "the station"
    )
