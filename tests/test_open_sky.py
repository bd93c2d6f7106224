"""Where a scanner looked and nothing came back there is nothing: what stands before the open sky leaves no beams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import scanfind
from scanfind.design.elements import INSTALLED, NO_DATA, NOT_FOUND, OCCLUDED
from scanfind.grid.depth import LEAST_FILLED, PIXELS_MIDDLE, Beams, unpacked_beams
from scanfind.kernels.grid import NO_BEAM
from scanfind.mesh import Placement
from scanfind.parameters import PRESETS
from scanfind.pose import Pose
from scanfind.simulate.parts import blocks, box
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject
from seen import beams_about

Floats = NDArray[np.float64]

HIGHEST, WINDOW = 0.6, (1.0, 1.4)  # radians: above it nothing comes back, nor through a window
QUICK = replace(PRESETS["default"], search=replace(PRESETS["default"].search, time_limit_s=0.1))


def tower(turned: float, step: float = 0.004) -> Beams:
    """What a scanner keeps of a round wall 5 m off, with a window, whose top is HIGHEST above it; turned about z."""
    azimuth, elevation = np.meshgrid(np.arange(0.0, 2.0 * np.pi, step), np.arange(-0.3, HIGHEST, step))
    through = (azimuth > WINDOW[0]) & (azimuth < WINDOW[1]) & (np.abs(elevation) < 0.2)
    azimuth, elevation = azimuth[~through] + turned, elevation[~through]
    level = np.cos(elevation)
    ways = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    return beams_about(5.0 * ways, np.zeros(3))


def looks(beams: Beams, azimuth: float, elevation: float) -> tuple[bool, bool]:
    """Is a beam kept in a direction, and is the scanner silent there?"""
    way = 5.0 * np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    pixel = np.flatnonzero(beams_about(way[None], np.zeros(3)).nearest < NO_BEAM)[0]
    return bool(beams.nearest[pixel] < NO_BEAM), bool(beams.silent()[pixel])


@given(st.floats(0.0, 6.0))
@settings(max_examples=8, deadline=None)
def test_a_scanner_is_silent_through_a_window_and_not_where_it_may_not_have_looked(turned: float) -> None:
    beams = tower(turned)
    assert beams.filled > 0.9
    assert looks(beams, turned + 1.2, 0.0) == (False, True)
    assert looks(beams, turned + 2.0, 0.0) == (True, False)
    assert looks(beams, turned + 1.2, HIGHEST + 0.1) == (False, False)
    assert looks(beams, turned + 1.2, -0.5) == (False, False)
    assert not (beams.silent() & (beams.nearest < NO_BEAM)).any()


def test_silence_reaches_as_far_as_the_scanner_sees() -> None:
    beams = tower(0.5)
    silence = beams.silence
    assert silence.reach == pytest.approx(5.0, abs=0.01)
    every = np.arange(len(beams.nearest))
    everywhere = beams.origin + unpacked_beams(every, np.full(len(every), PIXELS_MIDDLE), beams.edge)[0]
    open_, filled = (np.sort(of.towards(everywhere, 1e-6)) for of in (silence, beams))
    np.testing.assert_array_equal(open_, np.flatnonzero(beams.silent()))
    np.testing.assert_array_equal(filled, np.flatnonzero(beams.nearest < NO_BEAM))
    directions, went, angles = silence.beams_in(open_)
    np.testing.assert_allclose(went, silence.reach, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    assert 0.5 < angles.mean() * len(beams.nearest) / (4.0 * np.pi) < 1.5


def test_a_sector_that_was_not_scanned_is_not_silent_and_a_thin_scan_says_nothing() -> None:
    beams = tower(0.0)
    aside = Beams(beams.origin, beams.nearest.copy(), beams.edge)
    faces = aside.nearest.reshape(6, -1)
    faces[1] = NO_BEAM  # towards -x nothing was kept at all
    assert not aside.silent().reshape(6, -1)[1].reshape(beams.edge, beams.edge)[beams.edge // 2].any()
    thin = Beams(beams.origin, np.where(np.arange(len(beams.nearest)) % 7, NO_BEAM, beams.nearest), beams.edge)
    assert thin.filled < LEAST_FILLED
    assert not thin.silent().any()


@pytest.mark.parametrize("looked_up", [True, False])
def test_what_is_missing_before_the_sky_is_not_found_where_scanners_looked(looked_up: bool) -> None:
    # Two beams on posts; of the upper one nothing is there. A mast far off tells that the scanners looked that steeply.
    low, high = (Pose(np.eye(3), np.array([0.0, 0.0, z])) for z in (0.4, 2.8))
    places = Placement("low", "IfcBeam", "B1", low), Placement("high", "IfcBeam", "B2", high)
    girder = replace(box(3.0, 0.2, 0.2), name="girder", placements=places)
    ground = blocks("ground", [((-6, -6, -0.3), (8, 6, -0.2))])
    there = [SceneObject("ground", ground, Pose.identity()), SceneObject("B1", girder, low)]
    if looked_up:
        there.append(SceneObject("mast", blocks("mast", [((1.3, 4.0, -0.2), (1.7, 4.4, 9.0))]), Pose.identity()))
    stations = np.array([[-1.0, -3.0, 1.5], [4.0, -2.5, 1.5]])
    cloud = scan(Scene(tuple(there), stations), scanner=Scanner(step=0.003), seed=5).stations
    elements = scanfind.find(cloud, girder, parameters=QUICK, at_design=True).elements
    told = {each.placement.global_id: each for each in elements}
    assert told["low"].status == INSTALLED
    if looked_up:
        assert told["high"].status == NOT_FOUND
        assert told["high"].through is not None
        assert told["high"].through > 0.7
    else:
        assert told["high"].status in (NO_DATA, OCCLUDED)
