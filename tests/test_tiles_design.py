"""A design in tiles: what became of every element is what `find` tells of the site in one piece."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scanfind.assembly.parameters import AssemblyParameters
from scanfind.cli import main
from scanfind.cloud import PointCloud
from scanfind.design.elements import INSTALLED, NO_DATA, OCCLUDED, UNCERTAIN
from scanfind.detection import Findings
from scanfind.errors import UsageError
from scanfind.find import find
from scanfind.inspect import inspect
from scanfind.mesh import Mesh, Placement
from scanfind.pose import Pose
from scanfind.results import read_results
from scanfind.scans import open_stations
from scanfind.simulate.parts import blocks, cylinder
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.tiles import find_in_tiles
from scanfind.tiles import plan as planned
from scanfind.tiles.plan import BASE_BYTES, ROW_BYTES, STATION_BYTES
from test_find import BRACKET, QUICK

FLOOR = blocks("floor", [((-3, -5, -0.1), (24, 6, 0))])


def at(x: float, y: float, z: float = 0.0, turn: float = 0.0) -> Pose:
    return Pose.from_rotation_vector((0.0, 0.0, turn), (x, y, z))


# As designed, 30 mm off, not there (one stands far off, in another tile), behind a tank, as designed, in another hall.
PLACES = (at(0, 0), at(6, 0), at(12, 0, 0, 0.3), at(18, 0), at(3, 1.5, 0, 1.0), at(0, 60))
BUILT = (at(0, 0), at(6.02, 0.02, 0.01), at(14.9, 2.2, 0, 2.0), at(18, 0), at(3, 1.5, 0, 1.0))
STATUSES = [INSTALLED, INSTALLED, UNCERTAIN, OCCLUDED, INSTALLED, NO_DATA]
ROWS_A_TILE = 250_000
# What is not there is given up sooner; what is there is found in the first round.
SHORT = replace(QUICK, search=replace(QUICK.search, miss_probability=0.5))


def designed(*places: Pose) -> Mesh:
    every = tuple(Placement(f"gid{k}", "IfcPlate", f"bracket {k}", place) for k, place in enumerate(places))
    return replace(BRACKET, placements=every)


@cache
def site() -> list[PointCloud]:
    built = [SceneObject("floor", FLOOR, at(0, 0))]
    built += [SceneObject(f"bracket {k}", BRACKET, pose) for k, pose in enumerate(BUILT)]
    # Round: nothing of it could be taken for a bracket.
    built += [SceneObject("tank", cylinder(r, 2.4), at(x, y)) for r, x, y in ((1.5, 18.4, -1.7), (1.2, 16.6, 0.3))]
    stands = np.array([[3.0, -3.5, 1.5], [9.0, -3.5, 1.5], [15.0, -3.5, 1.5]])
    return list(scan(Scene(tuple(built), stands), scanner=Scanner(step=0.004), seed=3).stations)


@cache
def whole() -> Findings:
    return find(site(), designed(*PLACES), parameters=SHORT, at_design=True)


def in_tiles(rows: int, work: Path, *places: Pose) -> Findings:
    """In tiles of so many rows; of a bare floor the estimate, made for shops, expects more."""
    memory = BASE_BYTES + len(site()) * STATION_BYTES + ROW_BYTES * rows
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planned, "ROWS_A_SQUARE_CELL", 1.0)
        return find_in_tiles(site(), designed(*places), parameters=SHORT, memory=memory, at_design=True, work=work)


@pytest.mark.slow
def test_tiles_are_the_whole(tmp_path: Path) -> None:
    cut = in_tiles(ROWS_A_TILE, tmp_path, *PLACES)
    assert len(list(tmp_path.glob("*/search-*"))) > 2
    assert [element.status for element in cut.elements] == STATUSES
    assert len(cut) == len(whole())
    for mine, theirs in zip(cut.elements, whole().elements, strict=True):
        assert (mine.placement.global_id, mine.status) == (theirs.placement.global_id, theirs.status)
        np.testing.assert_allclose(np.array(mine.shift_m, float), np.array(theirs.shift_m, float), atol=5e-5)
        shares = [np.array([one.on, one.beside, one.through, one.hidden], float) for one in (mine, theirs)]
        np.testing.assert_allclose(shares[0], shares[1], atol=0.01)
        assert [each.station for each in mine.stations] == [each.station for each in theirs.stations]


@pytest.mark.slow
def test_one_tile_is_find(tmp_path: Path) -> None:
    found = in_tiles(50_000_000, tmp_path, *PLACES)
    assert [element.status for element in found.elements] == STATUSES
    for mine, theirs in zip(found, whole(), strict=True):
        np.testing.assert_array_equal(mine.scene_from_model.matrix(), theirs.scene_from_model.matrix())
        assert mine.stations == theirs.stations
    for one, other in zip(found.elements, whole().elements, strict=True):
        assert (one.why, one.shift_m, one.stations) == (other.why, other.shift_m, other.stations)


def test_where_all_stand_in_their_places_no_tile_is_searched(tmp_path: Path) -> None:
    places = (PLACES[0], PLACES[1], PLACES[4], BUILT[2])
    found = in_tiles(ROWS_A_TILE, tmp_path, *places)
    assert [element.status for element in found.elements] == [INSTALLED] * 4
    assert sorted(element.detection or 0 for element in found.elements) == [1, 2, 3, 4]
    assert len(list(tmp_path.glob("*/place-*"))) > 2
    assert not list(tmp_path.glob("*/search-*"))


@pytest.mark.slow
def test_processes_inspect_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCANFIND_GRID_CELL_M", "0.02")
    scans, designs, out = [], [], tmp_path / "out"
    for k, cloud in enumerate(site()):
        assert cloud.origin is not None
        scans.append(str(tmp_path / f"{k}.e57"))
        with open_stations(Path(scans[-1]), {}) as writer:
            writer.station(f"{k}", Pose(np.eye(3), cloud.origin), (1, 1))
            writer.write(cloud.xyz, {})
    for k in (0, 1, 4):
        designs.append(str(tmp_path / f"bracket{k}.ply"))
        trimesh.Trimesh(PLACES[k].move(BRACKET.vertices), BRACKET.faces, process=False).export(designs[-1])
    asked = ["inspect", *scans, "--design", *designs, "--memory", "1500MB", "--workers", "2", "--out", str(out)]
    assert main(asked) == 0
    told = read_results(out)
    assert [element.status for element in told.elements] == [INSTALLED] * 3
    off = [element.off_m for element in told.elements]
    np.testing.assert_allclose(np.array(off, float), [0.0, 0.03, 0.0], atol=0.001)
    assert not out.with_name("out.scanfind-work").exists()


def test_what_cannot_be_combined_is_refused() -> None:
    parts = replace(QUICK, assembly=AssemblyParameters(parts=True))
    with pytest.raises(UsageError, match="parts are not fitted in tiles"):
        inspect([np.zeros((9, 3))], BRACKET, parameters=parts, search=find_in_tiles)
