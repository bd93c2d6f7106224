"""LAS, LAZ and COPC: against laspy where laspy can, against hostile headers where it cannot."""

from __future__ import annotations

import re
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanfind.errors import OutputError, ScanfindError, UnreadableFileError, UnsupportedFormatError
from scanfind.scans import open_writer, read_scan, scan_info

LASPY = "formats/laspy/tests/data/"
PDAL = "formats/pdal/test/data/"


def points_or_line(path: Path) -> int | str:
    """The number of points, header and chunks agreeing, or the error."""
    line = ""
    try:
        count = sum(len(chunk) + chunk.dropped for chunk in read_scan(path))
        assert count == scan_info(path).points
    except ScanfindError as error:
        line = str(error)
    assert "\n" not in line
    return line or count


def test_every_file_gives_its_points_or_one_line(shared_data: Path) -> None:
    formats = shared_data / "formats"
    listed = re.findall(r"^(\S+) .*? (\d+) \2 OK$", (formats / "las_check.txt").read_text(), re.MULTILINE)
    expected: dict[str, int | str] = {name: int(points) for name, points in listed if (formats / name).exists()}
    # laspy crashes on this one: version 1 of LASzip, without chunks. Its points are those of simple.las.
    expected["pdal/test/data/laz/simple-laszip-compressor-version-1.2r0.laz"] = 1065
    damaged = {
        "pdal/test/data/las/1.2-with-color-clipped.las": "promises 1,065 points, 1,064 are there",
        "pdal/test/data/las/permutations/1.2-no-points.las": "promises 1,065 points, 0 are there",
        "pdal/test/data/las/garbage_nVariableLength.las": "1,069,128,089 variable length records do not fit",
        "pdal/test/data/ept/lone-star-invalid-tile/ept-data/2-2-2-2.laz": "version 126.203 does not exist",
    }
    found = {str(p.relative_to(formats)): points_or_line(p) for p in formats.rglob("*.la[sz]")}
    lines = {name: str(found.pop(name)) for name in damaged}
    assert found == expected
    assert len(found) > 80
    assert all(said in lines[name] for name, said in damaged.items())


@pytest.mark.parametrize(
    "name",
    [
        LASPY + "simple1_1.las",
        LASPY + "simple1_3.las",
        LASPY + "extrabytes.las",
        LASPY + "extra.laz",
        LASPY + "unregistered_extra_bytes.las",
        LASPY + "1_4_w_evlr.laz",
        LASPY + "simple.copc.laz",
        PDAL + "las/permutations/1.2_2.las",
    ],
)
def test_every_dimension_is_as_laspy_reads_it(name: str, shared_data: Path) -> None:
    import laspy

    truth = laspy.read(shared_data / name)
    (chunk,) = read_scan(shared_data / name)
    np.testing.assert_allclose(chunk.xyz, truth.xyz, rtol=1e-15)
    seen = 0
    for dimension in truth.point_format.dimensions:
        if dimension.name in ("X", "Y", "Z"):
            continue
        values = np.asarray(truth[dimension.name]).reshape(len(chunk), -1)
        for part in range(values.shape[1]):
            stem = dimension.name.replace("ExtraBytes", "extra_bytes")
            own = stem if values.shape[1] == 1 else f"{stem}_{part}"
            np.testing.assert_array_equal(chunk.attributes[own], values[:, part], err_msg=own)
            seen += 1
    assert seen == len(chunk.attributes)


def test_a_second_record_of_extra_bytes_counts_too(shared_data: Path) -> None:
    # laspy stops at the first record and calls the rest of each point "ExtraBytes".
    (chunk,) = read_scan(shared_data / LASPY / "append-bug.laz")
    assert list(chunk.attributes)[-2:] == ["Deviation", "confidence"]
    assert chunk.attributes["Deviation"].dtype == np.uint16


def test_a_file_before_laszip_had_chunks_reads_as_its_uncompressed_twin(shared_data: Path) -> None:
    (old,) = read_scan(shared_data / PDAL / "laz/simple-laszip-compressor-version-1.2r0.laz")
    (plain,) = read_scan(shared_data / PDAL / "las/simple.las")
    np.testing.assert_array_equal(old.xyz, plain.xyz)
    for name, values in plain.attributes.items():
        np.testing.assert_array_equal(old.attributes[name], values)


@pytest.mark.parametrize(
    ("name", "crs"),
    [
        (LASPY + "simple.copc.laz", "COMPD_CS["),
        (PDAL + "copc/lone-star.copc.laz", "GEOCCS["),
        (PDAL + "las/utm17.las", "EPSG:"),
        (PDAL + "las/permutations/1.0_0.las", "PROJCS["),
        (LASPY + "simple.las", None),
    ],
)
def test_the_coordinate_system_is_kept(name: str, crs: str | None, shared_data: Path, tmp_path: Path) -> None:
    info = scan_info(shared_data / name)
    assert info.crs is None if crs is None else (info.crs or "").startswith(crs)
    for suffix in ("las", "laz"):
        with open_writer(tmp_path / f"copy.{suffix}", {}, crs=info.crs) as writer:
            writer.write(np.zeros((1, 3)), {})
        assert scan_info(tmp_path / f"copy.{suffix}").crs == info.crs


def test_memory_is_bounded_by_the_chunk(shared_data: Path) -> None:
    path = shared_data / PDAL / "copc/lone-star.copc.laz"
    assert sum(len(chunk) for chunk in read_scan(path, chunk_points=1_000)) == 518_862
    tracemalloc.start()
    try:
        for _ in read_scan(path, chunk_points=1_000):
            pass
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # The largest of its 15 octree nodes has 61 thousand points of 30 bytes; all points and attributes take 40 MB.
    assert peak < 5e6


Edit = Callable[[bytearray], None]


def put(at: int, layout: str, *values: Any) -> Edit:
    """An edit that packs values at a byte of the file."""

    def edit(data: bytearray) -> None:
        struct.pack_into("<" + layout, data, at, *values)

    return edit


def both(*edits: Edit) -> Edit:
    def edit(data: bytearray) -> None:
        for each in edits:
            each(data)

    return edit


@pytest.mark.parametrize(
    ("name", "edit", "said"),
    [
        ("las/simple.las", put(0, "4s", b"PK\3\4"), "does not begin with LASF"),
        ("las/simple.las", put(24, "BB", 2, 0), "version 2.0 does not exist"),
        ("las/simple.las", put(94, "H", 65535), "header of 65535 bytes"),
        ("las/simple.las", put(94, "H", 3), "header of 3 bytes"),
        ("las/simple.las", put(96, "I", 2**32 - 1), "points from byte 4294967295"),
        ("las/simple.las", put(96, "I", 0), "points from byte 0"),
        ("las/simple.las", put(100, "I", 2**32 - 1), "4,294,967,295 variable length records"),
        ("las/simple.las", put(104, "B", 11), "point format 11"),
        ("las/simple.las", put(105, "H", 33), "point format 3 with records of 33 bytes"),
        ("las/simple.las", put(105, "H", 0), "records of 0 bytes"),
        ("las/simple.las", put(107, "I", 2**32 - 1), "promises 4,294,967,295 points, 1,065 are there"),
        ("las/simple.las", put(107, "I", 1066), "promises 1,066 points, 1,065 are there"),
        ("las/test1_4.las", put(247, "Q", 2**63), "promises 9,223,372,036,854,775,808 points, 1,000 are there"),
        ("las/simple.las", put(131, "d", 0.0), "scale"),
        ("las/simple.las", put(139, "d", np.nan), "scale"),
        ("las/simple.las", put(155, "d", np.inf), "offset"),
        ("las/simple.las", put(104, "B", 0x83), "the LASzip record that says how is missing"),
        ("laz/simple.laz", put(107, "I", 1066), "do not decode"),
        ("laz/simple.laz", put(107, "I", 60_000), "its chunks hold 50,000"),
        ("laz/simple.laz", put(107, "I", 2**32 - 1), "its chunks hold 50,000"),
        ("laz/simple.laz", put(333, "q", 2**62), "chunk table should be at byte 4,611,686,018,427,387,904"),
        ("laz/simple.laz", put(281, "H", 7), "compressor 7 is not read"),
        ("laz/simple.laz", put(281 + 12, "I", 0), "chunks of no points"),
        ("laz/simple.laz", both(put(107, "I", 2**31), put(281 + 12, "I", 2**31)), "2,147,483,648 points does not fit"),
        ("laz/simple.laz", put(281 + 32, "H", 65535), "does not fit point format 3"),
        ("laz/simple.laz", put(281 + 34, "H", 99), "does not fit point format 3"),
        ("copc/1.2-with-color.copc.laz", put(247, "Q", 2**63), "its chunks hold 1,065"),
        # The size of the first layer of the first chunk, after one point and the chunk's count.
        ("copc/1.2-with-color.copc.laz", put(1709 + 8 + 36 + 4, "I", 2**32 - 1), "is larger than"),
    ],
)
def test_a_hostile_header_is_one_line(name: str, edit: Edit, said: str, shared_data: Path, tmp_path: Path) -> None:
    data = bytearray((shared_data / PDAL / name).read_bytes())
    edit(data)
    path = tmp_path / Path(name).name
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises((UnreadableFileError, UnsupportedFormatError), match=said) as caught:
            list(read_scan(path))
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value)


def test_a_chunk_count_of_thousands_of_millions_reserves_nothing(shared_data: Path, tmp_path: Path) -> None:
    data = bytearray((shared_data / PDAL / "laz/simple.laz").read_bytes())
    (table,) = struct.unpack_from("<q", data, 333)
    put(table + 4, "I", 2**32 - 1)(data)
    path = tmp_path / "many.laz"
    path.write_bytes(data)
    with pytest.raises(UnreadableFileError, match="4,294,967,295 chunks"):
        list(read_scan(path))


def test_points_beyond_all_numbers_are_dropped_and_counted(shared_data: Path, tmp_path: Path) -> None:
    data = bytearray((shared_data / PDAL / "las/simple.las").read_bytes())
    put(131, "d", 1e307)(data)
    path = tmp_path / "far.las"
    path.write_bytes(data)
    chunks = list(read_scan(path, chunk_points=100))
    assert sum(chunk.dropped for chunk in chunks) == 1065
    assert sum(len(chunk) for chunk in chunks) == 0


SEEDS = [
    "las/100-points.las",
    "las/bad-geotiff-keys.las",
    "las/test1_4.las",
    "laz/simple.laz",
    "copc/1.2-with-color.copc.laz",
    "laz/simple-laszip-compressor-version-1.2r0.laz",
]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), name=st.sampled_from(SEEDS))
def test_random_damage_is_points_or_one_line(data: st.DataObject, name: str, shared_data: Path, tmp_path: Path) -> None:
    content = bytearray((shared_data / PDAL / name).read_bytes())
    # Half of the damage to the headers, where it hurts.
    places = st.one_of(st.integers(0, 420), st.integers(0, len(content) - 1))
    for at, value in data.draw(st.lists(st.tuples(places, st.integers(0, 255)), max_size=6)):
        content[at] = value
    path = tmp_path / Path(name).name
    path.write_bytes(content[: data.draw(st.integers(0, len(content)) | st.just(len(content)))])
    points_or_line(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_what_the_point_format_cannot_hold_exactly_is_still_exact(suffix: str, tmp_path: Path) -> None:
    fields = {
        "intensity": np.array([0.25, 0.75, np.nan], "f4"),
        "classification": np.array([-1, 300, 2], "i4"),
        "nir": np.array([1, 2, 65535], "u2"),
        "X": np.array([1, 2, 3], "u1"),
        "a name of more than thirty two bytes, first": np.array([1, 2, 3], "u1"),
        "a name of more than thirty two bytes, second": np.array([4, 5, 6], "u8"),
        "surface:flag": np.array([True, False, True]),
    }
    path = tmp_path / f"cloud.{suffix}"
    with open_writer(path, {name: values.dtype for name, values in fields.items()}) as writer:
        writer.write(np.arange(9.0).reshape(3, 3), fields)
    (chunk,) = read_scan(path)
    stored = {
        "X": "X_2",
        "a name of more than thirty two bytes, first": "a name of more than thirty two b",
        "a name of more than thirty two bytes, second": "a name of more than thirty two_2",
        "surface:flag": "surface_flag",
    }
    for name, values in fields.items():
        np.testing.assert_array_equal(chunk.attributes[stored.get(name, name)], values, err_msg=name)
    import laspy

    # Viewers that know nothing of our extra bytes see the nearest values the format has.
    np.testing.assert_array_equal(laspy.read(path).classification, [0, 255, 2])


def test_points_too_far_apart_for_las_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "far.las"
    with pytest.raises(OutputError, match="within 214 km"), open_writer(path, {}) as writer:
        writer.write([[0.0, 0.0, 0.0], [300_000.0, 0.0, 0.0]], {})
    assert not list(tmp_path.iterdir())
