"""Tolerance profiles: nothing passes by default, what is uncertain is not judged, a TOML file means what it says."""

from __future__ import annotations

from math import radians
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from by_hand import absent, at, detection, element, motion, part, results
from scanfind.design.elements import INSTALLED, NO_DATA, NOT_ENOUGH_DATA, NOT_FOUND, OCCLUDED, UNCERTAIN
from scanfind.errors import UsageError
from scanfind.pose import random_rotation
from scanfind.results.schema import AxisEntry, DetectionEntry, ElementEntry, ModelEntry, SymmetryEntry
from scanfind.simulate.parts import cylinder
from scanfind.tolerances import (
    IN,
    NOT_JUDGED,
    OUT,
    PRESETS,
    Judgement,
    Limit,
    Profile,
    Rule,
    allowed_off,
    judge_detection,
    judge_element,
    load_profile,
)
from scanfind.tolerances.discs import Disc, disc_of

SHIFT = Profile("", (Rule({}, {"shift_mm": Limit(0.01)}),))
OFF = allowed_off(0.01)
SURFACE = Profile("", (Rule({}, {"surface_p95_mm": Limit(0.003)}),))
PIPE = SymmetryEntry(words="", centre_m=(0.0, 0.0, 0.0), axes=[AxisEntry(direction=(0.0, 0.0, 1.0), order=None)])


def judged(profile: Profile, each: ElementEntry, found: DetectionEntry | None = None) -> Judgement:
    return judge_element(profile, results(each, found or detection()), each)


def written(folder: Path, text: str) -> Path:
    path = folder / "profile.toml"
    path.write_text(text, encoding="utf-8")
    return path


# ── judging ───────────────────────────────────────────────────────────────────────────────────────────────────────


@given(st.floats(0.0, 0.05), st.floats(0.0, 0.02))
def test_the_decision_rule_leaves_out_what_is_too_close_to_call(shift: float, sigma: float) -> None:
    verdict = judged(SHIFT, element(shift_m=(shift, 0.0, 0.0), off_m=shift), detection(sigma_m=sigma)).verdict
    assert (verdict == IN) == (shift + 2 * sigma <= 0.01)
    assert (verdict == OUT) == (shift - 2 * sigma > 0.01)


@pytest.mark.parametrize("status", [UNCERTAIN, OCCLUDED, NOT_FOUND, NOT_ENOUGH_DATA, NO_DATA])
def test_what_was_not_found_is_not_judged(status: str) -> None:
    verdict = judged(SHIFT, absent(status, 0.0, 0.0, 0.0, 1.0))
    assert verdict.verdict == NOT_JUDGED
    assert "its status is" in verdict.why


def test_an_element_that_no_rule_is_about_is_not_judged() -> None:
    columns = Profile("", (Rule({"class": ("IfcColumn*",)}, {"shift_mm": Limit(0.01)}),))
    assert judged(columns, element()).verdict == NOT_JUDGED
    assert judged(columns, element(ifc_class="IfcColumn")).verdict == IN


def test_a_free_slide_is_not_judged_but_what_is_seen_to_be_off_is_out() -> None:
    free = detection(unobservable=[motion("slide", (1.0, 0.0, 0.0))])
    assert judged(SHIFT, element(), free).verdict == NOT_JUDGED
    assert "slide" in judged(SHIFT, element(), free).why
    assert judged(SHIFT, element(shift_m=(0.0, 0.02, 0.0), off_m=0.02), free).verdict == OUT


def test_a_roll_is_excused_where_the_model_looks_the_same_after_it() -> None:
    free, each = detection(unobservable=[motion("roll", (0.0, 0.0, -1.0))]), element()
    assert judged(OFF, each, free).verdict == NOT_JUDGED
    pipe = ModelEntry(name="beam", sha256="", diameter_m=2.0, pairs=1, symmetry=PIPE)
    assert judge_element(OFF, results(each, free, models=[pipe]), each).verdict == IN


def test_what_an_inspection_held_at_the_designs_is_not_in_tolerance() -> None:
    each, model = element(), ModelEntry(name="beam", sha256="", diameter_m=2.0, pairs=1, symmetry=PIPE)
    slid = detection(scene_from_model=at(0.03))
    verdict = judge_element(SHIFT, results(each, slid, models=[model]), each)
    assert verdict.verdict == NOT_JUDGED
    assert "30 mm" in verdict.why
    near = detection(scene_from_model=at(0.004))
    assert judge_element(SHIFT, results(each, near, models=[model]), each).verdict == IN


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"points": 40}, "only 40 points"),
        ({"deviation": None, "points": 0}, "no points of its own"),
        ({"visible_support": 0.7}, "only 70%"),
        ({"visible_support": 0.0}, "without a scanner's position"),
    ],
)
def test_too_little_data_is_not_judged(said: dict[str, object], why: str) -> None:
    found = detection(**said)
    verdict = judge_detection(SURFACE, results(found), found)
    assert verdict.verdict == NOT_JUDGED
    assert why in verdict.why


def test_a_surface_is_judged_only_as_far_out_as_points_were_cut() -> None:
    found = detection()
    assert judge_detection(SURFACE, results(found), found).verdict == IN
    assert "--tolerance" in judge_detection(SURFACE, results(found, tolerance_m=0.0021), found).why


def test_a_part_is_judged_by_rules_of_parts_and_a_missing_one_is_out() -> None:
    profile = Profile("", (Rule({"part": ("*flange*",)}, {"roll_mm": Limit(0.0015), "tilt_mm": Limit(0.00075)}),))
    discs = {("beam", "flange_2"): Disc((0.0, 0.0, 1.0), 0.1)}

    def verdict(**said: object) -> str:
        found = detection(parts=[part(**said)])
        return judge_detection(profile, results(found), found, discs).verdict

    assert verdict(turn_rad=(0.0, 0.0, 0.010)) == IN  # an arc of 1.0 mm at the rim
    assert verdict(turn_rad=(0.0, 0.0, 0.020)) == OUT
    assert verdict(turn_rad=(0.003, 0.0, 0.0)) == IN  # 0.6 mm across the diameter
    assert verdict(turn_rad=(0.006, 0.0, 0.0)) == OUT
    assert verdict(free=[motion("roll", (0.0, 0.0, 1.0))]) == NOT_JUDGED
    assert verdict(name="flange_3") == NOT_JUDGED  # nobody knows its axis
    assert verdict(name="pipe") == NOT_JUDGED
    assert verdict(status="missing", off_m=None, shift_m=None, turn_rad=None) == OUT
    assert verdict(status="not_seen", off_m=None, shift_m=None, turn_rad=None) == NOT_JUDGED


@given(st.integers(0, 2**32 - 1))
def test_the_axis_of_a_disc_is_found_however_it_is_turned(seed: int) -> None:
    turn = random_rotation(np.random.default_rng(seed))
    disc = disc_of(cylinder(0.2, 0.05).triangles() @ turn.T)
    assert disc is not None
    assert abs(np.dot(disc.axis, turn[:, 2])) == pytest.approx(1.0, abs=1e-6)
    assert disc.radius == pytest.approx(0.2, rel=0.02)


# ── files ─────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", PRESETS)
def test_presets_name_the_source_of_each_limit(name: str) -> None:
    profile = load_profile(name)
    assert profile.title
    assert all(limit.source for rule in profile.rules for limit in rule.limits.values())


def test_pipe_spools_have_the_limits_of_the_trade() -> None:
    profile = load_profile("pipe-spools")
    assert profile.limits(type="x", name="SP-1042")["shift_mm"].value == pytest.approx(0.003)
    flange = profile.limits(type="x", name="SP-1042", part="North_Flange")
    assert flange["roll_mm"].value == pytest.approx(0.0015)
    assert flange["tilt_mm"].value == pytest.approx(0.00075)


def test_of_two_rules_that_fit_the_later_one_holds(tmp_path: Path) -> None:
    profile = load_profile(
        written(
            tmp_path,
            'title = "ours"\n[[rule]]\nshift_mm = 10\nturn_deg = 1\n'
            '[[rule]]\nclass = ["IfcCol*", "IfcBeam"]\nname = "K*"\nshift_mm = { limit = 5, source = "client" }\n',
        )
    )
    assert profile.limits(**{"class": "IfcBeam", "name": "K1"}) == {
        "shift_mm": Limit(0.005, "client"),
        "turn_deg": Limit(radians(1.0)),
    }
    assert profile.limits(**{"class": "IfcBeam", "name": "L1"})["shift_mm"] == Limit(0.01)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "write [[rule]]"),
        ("rule = 3", "write [[rule]]"),
        ("[[rule]]\nshift_m = 3", "did you mean 'shift_mm'?"),
        ("[[rules]]\nshift_mm = 3", "did you mean 'rule'?"),
        ('[[rule]]\nclas = "x"\nshift_mm = 3', "did you mean 'class'?"),
        ("[[rule]]\nshift_mm = { limt = 3 }", "did you mean 'limit'?"),
        ("[[rule]]\nshift_mm = -3", "rule 1: shift_mm: must be a number above 0, got -3"),
        ("[[rule]]\nshift_mm = true", "must be a number above 0"),
        ("[[rule]]\nshift_mm = nan", "must be a number above 0"),
        ('[[rule]]\nclass = "IfcBeam"', "rule 1: has no limit"),
        ("[[rule]]\nclass = 3\nshift_mm = 3", "must be a pattern"),
        ("[[rule]]\nroll_mm = 3", "is a limit of parts"),
        ('[[rule]]\npart = "*"\nsurface_p95_mm = 3', "is a limit of whole elements"),
        ("title = 3\n[[rule]]\nshift_mm = 3", "title: must be text"),
        ("[[rule", "cannot be read as a TOML"),
    ],
)
def test_a_file_that_says_nothing_sensible_is_refused_in_one_line(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(UsageError) as raised:
        load_profile(written(tmp_path, text))
    assert why in str(raised.value)
    assert "\n" not in str(raised.value)


def test_an_unknown_preset_is_refused_with_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'pipe-spools'"):
        load_profile("pipe-spool")


def test_a_verdict_of_the_run_is_that_of_its_profile() -> None:
    each = element(status=INSTALLED, shift_m=(0.0, 0.0, 0.004), off_m=0.004)
    assert judged(allowed_off(0.005), each).verdict == IN
    assert judged(allowed_off(0.003), each).verdict == OUT
