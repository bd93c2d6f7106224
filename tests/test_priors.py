"""What is known beforehand: it narrows the search, and changes nothing of what is found within."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from scanfind.cloud import PointCloud
from scanfind.detection import Findings
from scanfind.errors import UsageError
from scanfind.find import find
from scanfind.grid.scene import GridParameters
from scanfind.inspect import inspect
from scanfind.library import ModelLibrary
from scanfind.library.model import Model, ModelParameters
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh, Placement
from scanfind.parameters import PRESETS, Parameters
from scanfind.pose import Pose, random_rotation
from scanfind.priors import Priors
from scanfind.priors.allowed import middle_of
from scanfind.simulate.furniture import hall
from scanfind.simulate.parts import blocks, box, cylinder
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.tiles import find_in_tiles

Floats = NDArray[np.float64]

# As in test_find: cells of 20 mm, small rounds; a search takes a second.
QUICK = Parameters(
    grid=GridParameters(cell_m=0.02),
    surface=SurfaceParameters(samples=1000),
    search=replace(
        PRESETS["default"].search, time_limit_s=20.0, pairs_a_round=8000, hypotheses_a_round=60_000, kept=24
    ),
)
BRACKET = blocks(
    "bracket",
    [
        ((0, 0, 0), (1.0, 0.6, 0.15)),
        ((0, 0, 0.15), (0.15, 0.15, 0.9)),
        ((0.6, 0.3, 0.15), (0.9, 0.6, 0.4)),
        ((0, 0.15, 0.75), (0.15, 0.5, 0.9)),
    ],
)
# One stands upright; one lies on its side.
STANDING = Pose.from_rotation_vector([0.0, 0.0, 0.7], [2.9, 1.3, 0.0])
LYING = Pose.from_rotation_vector([0.5 * np.pi, 0.0, 0.0], [0.5, 3.4, 0.0])
PLACES = {"standing": STANDING, "lying": LYING}


@cache
def library() -> ModelLibrary:
    brackets = ModelLibrary.in_memory()
    brackets.add(BRACKET, ModelParameters(QUICK.surface))
    return brackets


def bracket() -> Model:
    return library().models()[0]


def middle(place: Pose) -> Floats:
    return np.asarray(place.move(middle_of(bracket())[None])[0])


@cache
def room() -> tuple[PointCloud, ...]:
    """A hall of 4 × 4 × 2.5 m with two brackets, seen from two corners."""
    objects = [
        SceneObject("hall", hall(4.0, 4.0, 2.5), Pose.identity()),
        SceneObject("drum", cylinder(0.25, 0.8), Pose(np.eye(3), np.array([0.5, 0.5, 0.0]))),
        SceneObject("locker", box(0.5, 0.5, 1.0), Pose(np.eye(3), np.array([3.5, 0.4, 0.5]))),
        *(SceneObject("bracket", BRACKET, place, target=True) for place in PLACES.values()),
    ]
    seen = Scene(tuple(objects), np.array([[1.2, 1.2, 1.6], [3.3, 3.3, 1.5]]))
    return tuple(scan(seen, seed=3, scanner=Scanner(step=0.008)).stations)


def seek(priors: Priors, parameters: Parameters = QUICK, move: Pose | None = None, models: Any = None) -> Findings:
    pose = move or Pose.identity()
    clouds = [PointCloud(pose.move(c.xyz), {}, pose.move(c.origin)) for c in room() if c.origin is not None]
    return find(clouds, models or library(), parameters=replace(parameters, priors=priors), isolate=False)


def named(found: Findings, move: Pose | None = None) -> list[str]:
    """Which of the brackets was found, by name; "?" where there is none."""
    back, names = (move or Pose.identity()).inverse(), []
    for one in found:
        errors = {name: (back @ one.scene_from_model).difference(place) for name, place in PLACES.items()}
        names += [next((name for name, (m, r) in errors.items() if m < 0.01 and r < 0.01), "?")]
    return sorted(names)


def around(point: Floats, half: float) -> tuple[float, float, float, float, float, float]:
    a, b, c, d, e, f = np.concatenate([point - half, point + half]).tolist()
    return a, b, c, d, e, f


# ── region ──


@pytest.mark.parametrize("name", PLACES)
def test_what_lies_in_a_region_is_found_as_in_the_whole(name: str) -> None:
    """However far it sticks out: the box is a tenth of the bracket."""
    whole = {tuple(named(Findings([one]))): one for one in seek(Priors())}
    assert set(whole) == {("standing",), ("lying",)}
    (one,) = seek(Priors(region=around(middle(PLACES[name]), 0.05)))
    metres, radians = one.scene_from_model.difference(whole[name,].scene_from_model)
    assert metres < 5e-4
    assert radians < 5e-4
    assert one.visible_support == pytest.approx(whole[name,].visible_support, abs=0.02)
    assert one.penalty == pytest.approx(whole[name,].penalty, abs=0.01)


def test_a_middle_just_outside_is_not_in_the_region_and_it_is_said_why() -> None:
    x, y, z = middle(STANDING).tolist()
    found = seek(Priors(region=(x + 0.02, -np.inf, -np.inf, np.inf, y + 1.0, z + 1.0)))
    assert list(found) == []
    assert any("outside of the region" in refused.reason for refused in found.refused)


def test_an_outline_is_a_region_in_plan() -> None:
    (x, y), _ = middle(STANDING)[:2], None
    assert named(seek(Priors(outline=((x - 1, y - 1), (x + 1, y - 1), (x, y + 1))))) == ["standing"]
    notched = Priors(outline=((x - 1, y - 1), (x + 1, y - 1), (x + 1, y + 1), (x, y - 0.5)))
    assert notched.holds(np.array([x + 0.5, y - 0.4, 3.0]))
    assert not notched.holds(np.array([x, y, 0.0]))


def test_tiles_keep_to_the_region_as_well() -> None:
    priors = Priors(region=around(middle(LYING), 0.05), expect=1)
    found = find_in_tiles(list(room()), library(), parameters=replace(QUICK, priors=priors))
    assert named(found) == ["lying"]
    assert "bracket: 1 of 1 expected found" in found.notes


def test_a_region_where_the_scan_is_not_is_an_error() -> None:
    for search in (find, find_in_tiles):
        with pytest.raises(UsageError, match=r"no point lies .* to 102.* the scan begins about"):
            search(list(room()), library(), parameters=replace(QUICK, priors=Priors(region=(100, 100, 0, 101, 101, 9))))


# ── up ──


@pytest.mark.parametrize("seed", range(2))
def test_upright_is_found_and_lying_is_refused_whichever_way_is_up(seed: int) -> None:
    rng = np.random.default_rng(seed)
    move = Pose(random_rotation(rng), rng.uniform(-5.0, 5.0, 3))
    x, y, z = (move.rotation @ [0.0, 0.0, 1.0]).tolist()
    assert named(seek(Priors(up=(x, y, z), tilt_deg=1.0), move=move), move) == ["standing"]


def test_a_model_drawn_on_its_side_stands_as_it_was_drawn() -> None:
    """The lying bracket's y is up: that is how a file with y up would have drawn it."""
    assert named(seek(Priors(up="z", model_up="y"))) == ["lying"]


# ── the design ──


def test_only_what_stands_near_the_design_is_found() -> None:
    for name, place in PLACES.items():
        design = Pose(place.rotation, place.translation + np.array([0.3, 0.0, 0.0]))
        placed = ModelLibrary.in_memory()
        placed.put(replace(bracket(), placements=(Placement("1", "", "", design),)))
        assert named(seek(Priors(near_design_m=0.4, turned_deg=5.0), models=placed)) == [name]
    short = replace(QUICK, search=replace(QUICK.search, time_limit_s=1.0))
    found = seek(Priors(near_design_m=0.2), short, models=placed)
    assert list(found) == []
    assert any("from where the design puts it" in refused.reason for refused in found.refused)


def test_a_model_without_places_is_where_it_was_drawn() -> None:
    drawn = Mesh.of("bracket", STANDING.move(BRACKET.vertices), BRACKET.faces)
    (one,) = seek(Priors(near_design_m=0.05), models=drawn)
    metres, radians = one.scene_from_model.difference(Pose.identity())
    assert metres < 0.01
    assert radians < 0.01


def test_of_a_design_the_elements_in_the_region_are_inspected() -> None:
    places = tuple(Placement(name, "", name, place) for name, place in PLACES.items())
    design = Mesh("bracket", BRACKET.vertices, BRACKET.faces, "", places)
    known = replace(QUICK, priors=Priors(region=around(middle(STANDING), 0.1), near_design_m=0.3))
    found = inspect(list(room()), design, parameters=known)
    assert [(each.placement.name, each.status) for each in found.elements] == [("standing", "installed")]
    with pytest.raises(UsageError, match="in one frame"):
        inspect(list(room()), design, parameters=known, align="always")
    elsewhere = replace(QUICK, priors=Priors(region=around(np.full(3, 50.0), 1.0)))
    with pytest.raises(UsageError, match="no element of the design"):
        inspect(list(room()), design, parameters=elsewhere)


# ── how many ──


def test_a_search_ends_with_as_many_as_expected_and_says_so() -> None:
    found = seek(Priors(expect=2))
    assert named(found) == ["lying", "standing"]
    assert found.notes == ["bracket: 2 of 2 expected found"]


def test_with_fewer_it_goes_on_until_its_time_is_over() -> None:
    parameters = replace(QUICK, search=replace(QUICK.search, time_limit_s=1.5))
    found = seek(Priors(expect={"bracket": 3}), parameters)
    assert named(found) == ["lying", "standing"]
    assert found.notes[0] == "bracket: 2 of 3 expected found"
    assert sum(found.timings_s[stage] for stage in ("search", "refine", "verify")) >= 1.5


@pytest.mark.slow
def test_with_no_limit_a_search_for_more_than_there_are_ends() -> None:
    parameters = replace(QUICK, search=replace(QUICK.search, time_limit_s=None))
    assert seek(Priors(expect=3), parameters).notes == ["bracket: 2 of 3 expected found"]


# ── at the door ──


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"region": (0, 0, 0, 1, 1, 0)}, "the low corner"),
        ({"region": (0, 0, 1, 1)}, "the low corner"),
        ({"region": (0, 0, 0, 1, 1, np.nan)}, "the low corner"),
        ({"outline": ((0, 0), (1, 1))}, "three corners"),
        ({"up": (0, 0, 0)}, "a direction"),
        ({"up": (0, np.inf, 0)}, "a direction"),
        ({"tilt_deg": 0}, "at most 180"),
        ({"near_design_m": -1}, "above 0"),
        ({"turned_deg": 5}, "together with near_design_m"),
        ({"expect": 0}, "1 or more"),
        ({"expect": {"bracket": 0}}, "1 or more"),
    ],
)
def test_nonsense_is_refused(given: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        Priors(**given)


def test_counts_that_cannot_be_are_refused_before_anything_is_read() -> None:
    unread = np.full((5, 3), np.nan)
    with pytest.raises(UsageError, match="no model is called 'brackt': did you mean 'bracket'"):
        find(unread, library(), parameters=replace(QUICK, priors=Priors(expect={"brackt": 1})))
    few = replace(QUICK, search=replace(QUICK.search, max_instances=1), priors=Priors(expect=2))
    with pytest.raises(UsageError, match="2 instances are expected, and max_instances allows 1"):
        find(unread, library(), parameters=few)


def test_settings_files_know_them(tmp_path: Path) -> None:
    from scanfind.config import load_settings

    (tmp_path / "site.toml").write_text(
        '[priors]\nregion = [0, 0, 0, 8, 5, 3]\nup = "z"\noutline = [[0, 0], [8, 0], [8, 5.5]]\n'
        "expect = { spool = 2 }\nscale_free = 0.05\n"
    )
    _, read = load_settings(PRESETS, {"priors.model_up": "0,1,0"}, tmp_path / "site.toml", {"SCANFIND_PRIORS_UP": "-x"})
    assert read.priors == Priors(
        (0, 0, 0, 8, 5, 3), ((0, 0), (8, 0), (8, 5.5)), "-x", (0, 1, 0), expect={"spool": 2}, scale_free=0.05
    )
