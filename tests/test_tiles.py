"""A site in tiles: the same as in one piece, whoever does the work and whatever dies on the way."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import scanfind.scans.sources
from scanfind.cloud import CHUNK_POINTS, PointChunk, PointCloud
from scanfind.detection import Findings
from scanfind.errors import UnreadableFileError, UsageError
from scanfind.find import find
from scanfind.grid.moments import ROW, MomentGrid
from scanfind.scans import open_writer, read_scan, scan_info
from scanfind.scans.sources import scans_of
from scanfind.search.served import RIGHT_PAIR_FINDS, Tally
from scanfind.tiles import find_in_tiles
from scanfind.tiles import plan as planned
from scanfind.tiles.plan import BASE_BYTES, ROW_BYTES, STATION_BYTES, Held, estimate, size_of, tiles_of
from scanfind.tiles.sweep import enough, learnt_from
from test_find import BRACKET, QUICK, Floats, clouds, library

# A corridor of rooms, of which no tile may hold more than about one and a half.
ROOMS = 3
APART = np.array([6.0, 0.4, 0.0])
ROWS_A_TILE = 230_000


@cache
def corridor(rooms: int = ROOMS) -> list[PointCloud]:
    """Rooms with a bracket each, every third point of each station."""
    return [
        replace(
            cloud, xyz=cloud.xyz[::3] + k * APART, origin=None if cloud.origin is None else cloud.origin + k * APART,
            attributes={name: values[::3] for name, values in cloud.attributes.items()},
        )
        for k in range(rooms)
        for cloud in clouds()
    ]  # fmt: skip


def memory_for(rows: int) -> int:
    return BASE_BYTES + 2 * ROOMS * STATION_BYTES + ROW_BYTES * rows


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> int:
    """A memory in which the corridor is no single tile; the rooms have less surface than the estimate expects."""
    monkeypatch.setattr(planned, "ROWS_A_SQUARE_CELL", 1.0)
    return memory_for(ROWS_A_TILE)


def in_tiles(memory: int, executor: Executor | Callable[[], Executor] | None = None, **rest: object) -> Findings:
    return find_in_tiles(corridor(), library(), parameters=QUICK, memory=memory, executor=executor, **rest)  # type: ignore[arg-type]


SAID: list[str] = []
TILES: list[str] = []


@cache
def serial() -> Findings:
    """In this process; SAID and TILES hold what was said, and the names of the tiles."""
    with pytest.MonkeyPatch.context() as patch, TemporaryDirectory() as work:
        patch.setattr(planned, "ROWS_A_SQUARE_CELL", 1.0)
        found = in_tiles(memory_for(ROWS_A_TILE), work=work, say=SAID.append)
        TILES.extend(path.name for path in Path(work).glob("search-*"))
        return found


def places(found: Findings) -> Floats:
    return np.array(sorted((one.pivot or (np.nan,) * 3 for one in found), key=lambda at: at[0]))


def assert_same(one: Findings, other: Findings) -> None:
    """To the last bit."""
    assert [found.model for found in one] == [found.model for found in other]
    for mine, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine.scene_from_model.matrix(), theirs.scene_from_model.matrix())
        assert (mine.id, mine.score, mine.support, mine.deviation) == (
            theirs.id, theirs.score, theirs.support, theirs.deviation,
        )  # fmt: skip
        assert mine.isolated is not None
        assert theirs.isolated is not None
        np.testing.assert_array_equal(mine.isolated.xyz, theirs.isolated.xyz)
        np.testing.assert_array_equal(mine.isolated.scan_id, theirs.isolated.scan_id)
        np.testing.assert_array_equal(mine.isolated.source_index, theirs.isolated.source_index)
        np.testing.assert_array_equal(mine.isolated.deviation, theirs.isolated.deviation)
        assert mine.isolated.attributes.keys() == theirs.isolated.attributes.keys()
        for name, values in mine.isolated.attributes.items():
            np.testing.assert_array_equal(values, theirs.isolated.attributes[name])
    assert (one.scans, one.tolerance_m, one.shift, one.crs) == (
        other.scans, other.tolerance_m, other.shift, other.crs,
    )  # fmt: skip


@cache
def whole() -> Findings:
    return find(corridor(), library(), parameters=QUICK)


NUMBERS: dict[str, np.dtype[Any]] = {"scan_id": np.dtype(np.int32), "source_index": np.dtype(np.int64)}


def test_one_tile_is_find(tmp_path: Path) -> None:
    scans = [replace(cloud, attributes={}) for cloud in clouds()]
    with open_writer(tmp_path / "tile.ply", NUMBERS) as tile, open_writer(tmp_path / "find.ply", NUMBERS) as rest:
        assert_same(
            find_in_tiles(scans, library(), parameters=QUICK, remainder=tile),
            find(scans, library(), parameters=QUICK, remainder=rest),
        )
    assert (tmp_path / "tile.ply").read_bytes() == (tmp_path / "find.ply").read_bytes()


def test_tiles_are_the_whole() -> None:
    assert len(whole()) == len(serial()) == ROOMS
    assert len(TILES) > 1
    # Each tile searched on its own; the last fit, on the raw points, leaves a hundredth of a millimetre.
    np.testing.assert_allclose(places(serial()), places(whole()), atol=5e-5)
    points = [sorted(len(one.isolated or ()) for one in found) for found in (serial(), whole())]
    np.testing.assert_allclose(points[0], points[1], rtol=0.01)


def test_threads_do_the_same(narrow: int) -> None:
    with ThreadPoolExecutor(3) as pool:
        assert_same(in_tiles(narrow, pool), serial())


def test_a_memory_that_cannot_be_kept_is_refused_before_a_point_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scanfind.scans.sources.chunks_of", lambda cloud: pytest.fail("it was read"))
    with pytest.raises(UsageError, match=r"--memory 500 MB cannot be kept: the smallest tile .* needs about"):
        in_tiles(500_000_000)


def test_what_a_run_takes_is_told_before_it_and_each_scan_as_it_comes() -> None:
    serial()
    points = sum(len(cloud) for cloud in corridor())
    assert SAID[0].startswith(f"{points:,} points; memory: ")
    assert sum("M points/s" in line for line in SAID) == len(corridor())


def test_of_many_scans_one_that_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    cut_short, files = tmp_path / "b.ply", []
    for name, cloud in zip("abc", [*clouds(), clouds()[0]], strict=True):
        files.append(tmp_path / f"{name}.ply")
        with open_writer(files[-1], {}) as writer:
            writer.write(cloud.xyz, {})
    cut_short.write_bytes(cut_short.read_bytes()[:-1000])
    origin = clouds()[0].origin
    found = find_in_tiles(tmp_path, library(), parameters=QUICK, origin=origin)
    assert len(found) == 1
    assert len(found.missing) == 1
    assert str(cut_short) in found.missing[0]
    assert found.missing[0] in found.notes
    assert [scan.points for scan in found.scans] == [len(clouds()[0]), 0, len(clouds()[0])]
    alone = find_in_tiles([files[0], files[2]], library(), parameters=QUICK, origin=origin)
    np.testing.assert_array_equal(alone[0].scene_from_model.matrix(), found[0].scene_from_model.matrix())


def test_a_folder_or_a_pattern_stands_for_its_scans(tmp_path: Path) -> None:
    for name in ("b.ply", "a.E57", "notes.txt", "c.laz"):
        (tmp_path / name).touch()
    assert [Path(str(one)).name for one in scans_of(tmp_path)] == ["a.E57", "b.ply", "c.laz"]
    assert [Path(str(one)).name for one in scans_of([tmp_path / "*.ply", "d.e57"])] == ["b.ply", "d.e57"]
    for nothing in (tmp_path / "*.las", tmp_path / "empty"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(UsageError, match="no "):
            scans_of(nothing)


def test_where_no_scan_can_be_read_the_first_error_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    with pytest.raises(UnreadableFileError, match=r"a\.ply"):
        find_in_tiles(tmp_path, BRACKET, parameters=QUICK)


@given(st.integers(0, 2**32), st.integers(0, 2), st.integers(60, 400))
def test_every_bin_has_one_tile_and_no_tile_too_much(seed: int, margin: int, most: int) -> None:
    bins = np.unique(np.random.default_rng(seed).integers(-6, 7, (40, 3)), axis=0)
    rows, memory = np.arange(1, len(bins) + 1), BASE_BYTES + ROW_BYTES * most
    held = Held(bins, rows, np.empty((0, 2, 3)))
    try:
        tiles = tiles_of(held, margin, memory)
    except UsageError:
        assert max(rows[(abs(bins - one) <= margin).all(axis=1)].sum() for one in bins) > most
        return
    np.testing.assert_array_equal(np.sum([tile.holds(bins) for tile in tiles], axis=0), 1)
    assert all(rows[tile.grown(margin).holds(bins)].sum() <= most for tile in tiles)
    assert tiles == tiles_of(Held(bins[::-1], rows[::-1], held.reached), margin, memory)


def tally(tested: float, hits: float = 0.0, shown: float = 0.0) -> Tally:
    return Tally(np.array([tested]), np.array([hits]), np.array([shown]))


@given(st.lists(st.tuples(st.floats(1, 1e4), st.floats(1, 1e4)), min_size=1), st.floats(0, 1e5))
def test_what_tiles_find_tells_how_long_others_are_searched(found: list[tuple[float, float]], tested: float) -> None:
    tallies = [tally(0.0, hits, shown) for hits, shown in found]
    (share,) = learnt = learnt_from([*tallies, tally(tested)])
    shares = [0.5 * hits / shown for hits, shown in found]
    assert share == pytest.approx(np.clip(share, min(shares), max(shares))) or share == RIGHT_PAIR_FINDS
    assert share >= RIGHT_PAIR_FINDS
    assert all(enough(one, learnt, 0.01) for one in tallies)
    assert enough(tally(tested), learnt, 0.01) == (np.exp(-share * tested) < 0.01)
    assert enough(tally(np.inf), learnt, 0.01)
    assert learnt_from([tally(tested)]) == (0.0,)
    assert not enough(tally(np.inf), (0.0,), 0.01)


def test_a_tile_searched_again_tells_the_same(narrow: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("scanfind.tiles.sweep.HOPED", 1e6)  # each but one round
    monkeypatch.setattr("scanfind.tiles.sweep.enough", lambda *_: False)
    assert_same(in_tiles(narrow, work=tmp_path), serial())
    assert {path.name.replace("again-", "search-") for path in tmp_path.glob("again-*")} == set(TILES)


def test_setups_whose_beams_come_into_a_tile_count() -> None:
    held = Held(np.array([[0, 0, 0], [9, 0, 0]]), np.array([1000, 1000]), np.array([[[-1.0, -1, -1], [2, 2, 2]]] * 9))
    fits = BASE_BYTES + ROW_BYTES * 1000 + STATION_BYTES * 9
    assert len(tiles_of(held, 1, fits)) == 2
    with pytest.raises(UsageError, match="--memory is too small"):
        tiles_of(held, 1, fits - 1)


FIRST_BEYOND = 2**32 + 7


def test_points_beyond_the_32nd_bit_keep_their_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    read = scanfind.scans.sources.chunks_of

    def far_on(cloud: PointCloud) -> Iterator[PointChunk]:
        return (replace(chunk, source_index=chunk.source_index + FIRST_BEYOND) for chunk in read(cloud))

    monkeypatch.setattr("scanfind.scans.sources.chunks_of", far_on)
    (found,) = find_in_tiles(clouds(), library(), parameters=QUICK)
    assert found.isolated is not None
    cloud, where = clouds()[0], found.isolated.scan_id == 0
    numbers = found.isolated.source_index[where] - FIRST_BEYOND
    np.testing.assert_array_equal(cloud.xyz[numbers], found.isolated.xyz[where])


def test_headers_beyond_the_32nd_bit_are_believed_only_where_the_file_is_as_long(tmp_path: Path) -> None:
    path, points = tmp_path / "long.las", FIRST_BEYOND
    with open_writer(path, {}) as writer:
        writer.write(np.zeros((1, 3)), {})
    header = bytearray(path.read_bytes())
    start, record = struct.unpack_from("<I", header, 96)[0], struct.unpack_from("<H", header, 105)[0]
    header[107:111] = bytes(4)  # the count of old, of 32 bits
    header[247:255] = struct.pack("<Q", points)
    path.write_bytes(header)
    with pytest.raises(UnreadableFileError, match=f"promises {points:,} points"):
        for _ in read_scan(path):
            pass
    with path.open("r+b") as file:
        file.truncate(start + record * points)  # as long as it says, and sparse
    assert scan_info(path).points == points
    assert f"{points:,} points" in estimate([scan_info(path)], [(0.02, 2.0)], 0.02, 2.56).words()
    assert len(next(read_scan(path))) == CHUNK_POINTS


def summed_grid(points: Sequence[Floats], jobs: int) -> MomentGrid:
    grid = MomentGrid(0.05, np.zeros(3), jobs)
    for k, xyz in enumerate(points):
        grid.add(PointChunk(xyz, {}, np.arange(len(xyz)), origin=np.array([5.0 * k, 1.0, 2.0])))
    return grid


def all_rows(grid: MomentGrid) -> Floats:
    rows = np.concatenate([np.empty(0, ROW), *grid.rows()])
    return np.sort(rows, order=["key", "place", "view"])


@pytest.mark.parametrize("jobs", [1, 2])
def test_moments_that_left_two_grids_make_the_grid_of_both(jobs: int) -> None:
    rng = np.random.default_rng(3)
    halves = [rng.uniform(-2, 2, (30_000, 3)), rng.uniform(-1, 3, (30_000, 3))]
    both = summed_grid(halves, jobs)
    joined = MomentGrid(0.05, np.zeros(3), jobs)
    for half in (summed_grid([halves[0]], 2), summed_grid([halves[0][:0], halves[1]], 1)):
        for rows in half.rows():
            joined.add_rows(rows)
        joined.look(half.beams())
    assert joined.points == both.points
    np.testing.assert_array_equal(all_rows(joined), all_rows(both))
    np.testing.assert_array_equal(all_rows(joined.coarser()), all_rows(both.coarser()))
    for mine, theirs in zip(joined.beams(), both.beams(), strict=True):
        np.testing.assert_array_equal(mine.origin, theirs.origin)
        np.testing.assert_array_equal(mine.nearest, theirs.nearest)


@pytest.mark.parametrize(("text", "size"), [("3GB", 3e9), ("800 MB", 8e8), ("1.5g", 1.5e9), ("2GiB", 2**31), ("7", 7)])
def test_sizes(text: str, size: float) -> None:
    assert size_of(text) == size


@pytest.mark.parametrize("text", ["", "GB", "-3GB", "3 apples", "0"])
def test_what_is_no_size(text: str) -> None:
    with pytest.raises(UsageError, match="--memory is a size"):
        size_of(text)
