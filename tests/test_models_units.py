"""Units, hints, joining parts, and which shapes are one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanfind.errors import InvalidGeometryError, UsageError
from scanfind.models.distinct import rigid_and_rest, same_shapes
from scanfind.models.parts import MOST_PARTS, Part, as_one, join, moved
from scanfind.models.polygons import fans
from scanfind.models.units import UNITS, metres_per, size_hint
from scanfind.pose import random_rotation

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
OUTWARDS = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
    [1, 5, 7], [1, 7, 3],
])  # fmt: skip


def box(x: float = 1.0, y: float = 1.0, z: float = 1.0, name: str = "box") -> Part:
    return Part(name, CORNERS * (x, y, z), OUTWARDS)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def placement(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = random_rotation(rng), rng.uniform(-100, 100, 3)
    return matrix


@pytest.mark.parametrize(("metres", "units", "hint"), [
    (3500.0, None, "the model is 3,500 m across: are its units mm? (--units mm)"),
    (0.0035, "mm", "the model is 3.5 mm across: are its units m? (--units m)"),
    (5e6, None, "the model is 5,000,000 m across: what are its units? (--units mm|cm|m|in|ft)"),
    (3.5, None, None), (0.1, "mm", None), (30.0, "m", None),
])  # fmt: skip
def test_an_implausible_size_asks_for_its_units(metres: float, units: str | None, hint: str | None) -> None:
    assert size_hint(metres, metres_per(units), stated=False) == hint


def test_a_file_that_states_its_units_is_not_asked_for_them() -> None:
    assert "--units" not in (size_hint(3500.0, 1.0, stated=True) or "--units")


@given(st.floats(1e-6, 1e9), st.sampled_from(list(UNITS)))
def test_a_proposed_unit_makes_the_size_plausible(raw: float, unit: str) -> None:
    hint = size_hint(raw * UNITS[unit], UNITS[unit], stated=False)
    proposed = hint.split("--units ")[1].removesuffix(")") if hint else "no hint"
    if proposed in UNITS:
        assert size_hint(raw * UNITS[proposed], UNITS[proposed], stated=False) is None


def test_an_unknown_unit_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="mm, cm, m, in, ft, got 'yard'"):
        metres_per("yard")


@given(st.lists(st.integers(0, 7), max_size=12))
def test_a_polygon_of_n_corners_is_n_minus_two_triangles(counts: list[int]) -> None:
    corners = np.arange(sum(counts))
    starts = np.cumsum([0, *counts])
    naive = [
        [first, first + k, first + k + 1]
        for first, count in zip(starts, counts, strict=False)
        for k in range(1, count - 1)
    ]
    assert fans(corners, np.array(counts, dtype=np.int64)).tolist() == naive


@pytest.mark.parametrize("turned", [False, True])
def test_a_closed_part_faces_outwards(turned: bool) -> None:
    part = box()
    mesh = join("a", [part._replace(faces=part.faces[:, ::-1]) if turned else part], "")
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(1.0)
    assert mesh.notes == {"parts": (("box", 0, 12),), "watertight": True, "turned": int(turned)}


@given(st.lists(st.booleans(), min_size=12, max_size=12))
def test_a_closed_part_of_mixed_winding_is_made_consistent(turn: list[bool]) -> None:
    part = box(1, 2, 3)
    faces = np.where(np.array(turn)[:, None], part.faces[:, ::-1], part.faces)
    mesh = join("a", [part._replace(faces=faces)], "")
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(6.0)


def test_an_open_surface_stays_as_it_is() -> None:
    part = box()
    mesh = join("a", [part._replace(faces=part.faces[2:, ::-1])], "")
    assert not mesh.notes["watertight"]
    assert (mesh.vertices[mesh.faces] == part.vertices[part.faces[2:, ::-1]]).all()


def test_parts_keep_their_names_and_faces() -> None:
    parts = [box(name="a"), moved(box(name="b"), placement(1)), box(1, 1, 0, name="b")]
    mesh = join("all", parts, "", 1e-3)
    assert mesh.notes["parts"] == (("a", 0, 12), ("b", 12, 24), ("b", 24, 28))
    assert mesh.area() == pytest.approx((6 + 6 + 2) * 1e-6)


def test_a_triangle_soup_is_welded() -> None:
    part = box()
    soup = Part("soup", part.vertices[part.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    mesh = join("soup", [soup], "")
    assert len(mesh.vertices) == 8
    assert mesh.notes["watertight"]


def test_very_many_parts_are_one() -> None:
    triangle = Part("t", CORNERS[:3], np.array([[0, 1, 2]]))
    mesh = join("all", [moved(triangle, placement(k)) for k in range(MOST_PARTS + 1)], "")
    assert mesh.notes["parts"] == (("all", 0, MOST_PARTS + 1),)


def test_a_mirrored_part_faces_outwards_still() -> None:
    mirrored = moved(box(), np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert volume(mirrored.vertices, mirrored.faces) == pytest.approx(1.0)


@pytest.mark.parametrize("vertices", [np.full((8, 3), np.nan), np.full((8, 3), np.inf), CORNERS[:3]])
def test_a_damaged_part_is_refused(vertices: np.ndarray) -> None:
    with pytest.raises(InvalidGeometryError):
        join("a", [box(), Part("bad", vertices, OUTWARDS)], "")


def test_no_triangle_is_refused() -> None:
    with pytest.raises(InvalidGeometryError, match="no triangle"):
        join("a", [box(1, 0, 0)], "")


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2**32 - 1)), min_size=1, max_size=8))
def test_copies_are_found_wherever_they_lie(which: list[tuple[int, int]]) -> None:
    shapes = [box(1, 2, 3), box(1, 2, 3.00003), box(0.003175, 1, 1), moved(box(1, 2, 3.1), np.diag([-1.0, 1, 1, 1]))]
    parts = [moved(shapes[kind], placement(seed)) for kind, seed in which]
    groups = same_shapes(parts)
    assert [sorted({which[copy.part][0] for copy in group}) for group in groups] == [
        [kind] for kind in dict.fromkeys(kind for kind, _ in which)
    ]
    assert sorted(copy.part for group in groups for copy in group) == list(range(len(parts)))
    for group in groups:
        first = parts[group[0].part]
        for copy in group:
            np.testing.assert_allclose(
                moved(first, copy.copy_from_first).vertices, parts[copy.part].vertices, atol=2e-5
            )


def test_copies_in_one_place_are_not_moved() -> None:
    [group] = same_shapes([box(), box()._replace(vertices=box().vertices + 1e-6)])
    assert [copy.copy_from_first.tolist() for copy in group] == [np.eye(4).tolist()] * 2


@given(st.integers(0, 2**32 - 1), st.tuples(*[st.floats(0.2, 5.0)] * 3), st.booleans())
def test_a_placement_is_a_motion_and_the_rest(seed: int, scales: tuple[float, float, float], mirrored: bool) -> None:
    turn = placement(seed + 1)[:3, :3]
    matrix = placement(seed)
    matrix[:3, :3] = matrix[:3, :3] @ turn @ np.diag(scales) @ turn.T @ np.diag([1, -1.0 if mirrored else 1.0, 1])
    rigid, rest = rigid_and_rest(matrix)
    np.testing.assert_allclose(rigid @ (np.eye(4) if rest is None else rest), matrix, atol=1e-12)
    np.testing.assert_allclose(rigid[:3, :3] @ rigid[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rigid[:3, :3]) == pytest.approx(1.0)


def test_all_mirror_images_are_one_geometry() -> None:
    shape = Part("l", CORNERS * (1, 2, 3) + (0.1, 0.2, 0.3), OUTWARDS)
    rests = []
    for seed in range(5):
        matrix = placement(seed) @ np.diag([1.0, -1.0, 1.0, 1.0])
        rigid, rest = rigid_and_rest(matrix)
        assert rest is not None
        rests.append(moved(shape, rest))
        np.testing.assert_allclose(moved(rests[-1], rigid).vertices, moved(shape, matrix).vertices, atol=1e-12)
    assert len(same_shapes(rests)) == 1


def test_as_one_is_all_triangles() -> None:
    parts = [box(name="a"), moved(box(), placement(3))]
    whole = as_one(parts)
    np.testing.assert_array_equal(
        whole.vertices[whole.faces], np.concatenate([part.vertices[part.faces] for part in parts])
    )
