"""Pictures without a screen: the nearest point is seen, all of a thing is in the picture, the PNG is one."""

from __future__ import annotations

import io

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from scanfind.picture import SCALE, Dots, deviation_colours, draw, png, surface_dots, view_at
from scanfind.simulate.parts import box

RED, BLUE = np.array([[200, 0, 0]], np.uint8), np.array([[0, 0, 200]], np.uint8)


@given(st.integers(0, 2**32 - 1))
def test_all_of_a_thing_is_in_its_picture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * rng.uniform(0.1, 10.0, 3) + 1e6 * rng.normal(size=3)
    view = view_at(points, rng.normal(size=3), aspect=1.5)
    for point in points:
        picture = draw(view, [Dots(point[None], RED, 3)], 90, 60)
        assert (picture[..., 1] == 0).any()


def test_the_nearest_is_seen_whatever_is_drawn_last() -> None:
    near, far = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    view = view_at(np.vstack([near, far]), (0.0, 1.0, 0.0))
    for layers in ([Dots(near, RED, 2), Dots(far, BLUE, 2)], [Dots(far, BLUE, 2), Dots(near, RED, 2)]):
        picture = draw(view, layers, 64, 64)
        shown = picture[(picture != 255).any(axis=2)]
        assert len(shown)
        assert (shown[:, 2] == 0).all()


def test_a_surface_is_closed_and_lies_where_it_is() -> None:
    triangles = box(1.0, 1.0, 1.0).triangles()
    dots = surface_dots(triangles, (90, 120, 150), seed=0)
    assert (dots.points >= triangles.min(axis=(0, 1)) - 1e-9).all()
    assert (dots.points <= triangles.max(axis=(0, 1)) + 1e-9).all()
    picture = draw(view_at(dots.points, (0.0, 1.0, 0.0)), [dots], 60, 40)
    assert (picture[15:25, 25:35] != 255).all()


def test_nothing_and_no_surface_make_an_empty_picture() -> None:
    nothing = surface_dots(np.zeros((1, 3, 3)), (0, 0, 0), seed=0)
    assert (draw(view_at(np.empty((0, 3))), [nothing], 8, 8) == 255).all()


def test_deviations_have_the_colours_of_the_scale() -> None:
    colours = deviation_colours([-1.0, -0.01, 0.0, 0.01, 9.0, np.nan], 0.01)
    low, none, high = SCALE[0][1], SCALE[2][1], SCALE[-1][1]
    assert colours.tolist() == [list(low), list(low), list(none), list(high), list(high), list(none)]


def test_a_png_is_read_by_others_as_it_was() -> None:
    from PIL import Image

    picture = np.random.default_rng(0).integers(0, 256, (7, 11, 3), dtype=np.uint8)
    with Image.open(io.BytesIO(png(picture))) as read:
        np.testing.assert_array_equal(np.asarray(read), picture)
