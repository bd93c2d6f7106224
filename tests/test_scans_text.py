from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from damage import assert_reads_or_refuses, assert_same, damaged, read_all
from scanfind.errors import UnreadableFileError
from scanfind.scans import read_scan, rows, scan_info
from scanfind.scans.rows import Layout, Lines, Rows

FUZZ = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


def write(folder: Path, content: str | bytes, suffix: str = ".xyz") -> Path:
    path = folder / f"scan{suffix}"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize(
    "content",
    [
        "1 2.5 -3 40\n4 5 6 70\n",
        "1 2.5 -3 40\n4 5 6 70",
        "  1\t2.5   -3 40  \r\n4 5 6 70\r\n",
        "1 2.5 -3 40\r4 5 6 70\r",
        "1,2.5,-3,40\n4,5,6,70\n",
        "1 , 2.5 , -3 , 40\n4, 5, 6, 70\n",
        "1;2.5;-3;40\n4;5;6;70\n",
        "1;2,5;-3;40\n4;5;6;70\n",
        "1,0 2,5 -3,0 40,0\n4 5 6 70\n",
        '"1","2.5","-3","40"\n4,5,6,70\n',
        "# made by\n\n// hand\n1 2.5 -3 40\n\n   \n # between\n4 5 6 70\n\n",
        "\ufeff1 2.5 -3 40\n4 5 6 70\n",
        "X Y Z Intensity\n1 2.5 -3 40\n4 5 6 70\n",
        "\ufeffX;Y;Z;I\n1;2,5;-3;40\n4;5;6;70\n",
        '"x","y","z","intensity"\n1 2.5 -3 40\n4 5 6 70\n',
        "Intensity,Z [m],Y [m],X [m]\n40,-3,2.5,1\n70,6,5,4\n",
        "//X Y Z Intensity\n1 2.5 -3 40\n4 5 6 70\n",
        "# x y z i\n1 2.5 -3 40\n4 5 6 70\n",
        "2\n1 2.5 -3 40\n4 5 6 70\n",
        "//X Y Z Intensity\n2\n1 2.5 -3 40\n4 5 6 70\n",
    ],
)
def test_one_cloud_in_all_its_spellings(content: str, tmp_path: Path) -> None:
    path = write(tmp_path, content)
    cloud = read_all(path)
    assert cloud.xyz.tolist() == [[1, 2.5, -3], [4, 5, 6]]
    assert {name: values.tolist() for name, values in cloud.attributes.items()} == {"intensity": [40, 70]}
    assert cloud.origin is None
    assert scan_info(path).attributes == {"intensity": "float64"}
    assert_same(cloud, read_all(path, chunk_points=1))


@pytest.mark.parametrize(
    ("row", "names"),
    [
        ("1 2 3", []),
        ("1 2 3 0.5", ["intensity"]),
        ("1 2 3 10 20 30", ["red", "green", "blue"]),
        ("1 2 3 0.5 10 20 30", ["intensity", "red", "green", "blue"]),
        ("1 2 3 200 10 20 30", ["intensity", "red", "green", "blue"]),
        ("1 2 3 10 20 30 255", ["red", "green", "blue", "field_7"]),
        ("1 2 3 10 20 30 0.5", ["red", "green", "blue", "intensity"]),
        ("1 2 3 0.6 0 -0.8", ["normal_x", "normal_y", "normal_z"]),
        ("1 2 3 0.6 0 -0.8 1", ["normal_x", "normal_y", "normal_z", "field_7"]),
        ("1 2 3 10 20 30 0.6 0 -0.8", ["red", "green", "blue", "normal_x", "normal_y", "normal_z"]),
        ("1 2 3 0.5 10 20 30 0.6 0 -0.8 9", ["intensity", "red", "green", "blue", "normal_x", "normal_y", "normal_z",
                                             "field_11"]),
        ("1 2 3 4.5 6.5", ["field_4", "field_5"]),
        ("1 2 3 0 0 0", ["field_4", "field_5", "field_6"]),
        ("1 2 3 300 10 20", ["field_4", "field_5", "field_6"]),
    ],
)  # fmt: skip
def test_columns_without_a_header_are_told_by_their_numbers(row: str, names: list[str], tmp_path: Path) -> None:
    attributes = scan_info(write(tmp_path, f"{row}\n" * 3)).attributes
    assert list(attributes) == names
    assert all(attributes[name] == "uint8" for name in ("red", "green", "blue") if name in attributes)


def test_whole_numbers_get_whole_types(tmp_path: Path) -> None:
    path = write(tmp_path, "x,y,z,Red,G,B,Classification,GpsTime,My Field\n1,2,3,65535,0,0,5,1e9,1\n", ".csv")
    assert scan_info(path).attributes == {
        "red": "uint16", "green": "uint8", "blue": "uint8", "classification": "uint8", "gps_time": "float64",
        "My Field": "float64",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("", "is empty"),
        ("\n\n# nothing\n", "is empty"),
        ("This is a file that tells a story.\n", "line 1 is neither numbers nor a header"),
        ("X,Y,X\n1,2,3\n", "line 1 is neither numbers nor a header"),
        (b"\x0b\n\x0c\n", "is empty"),
        ("1 2 3\n\x1c\n", "line 2 has 0 columns"),
        ("1 2\n3 4\n", "line 1 has 2 columns"),
        ("1 2 3\n4 5\n6 7 8\n", "line 2 has 2 columns instead of 3: '4 5'"),
        ("1 2 3\n4 5 6 7\n", "line 2 has 4 columns instead of 3: '4 5 6 7'"),
        ("x y z\n1 2 3 4\n", "line 2 has 4 columns instead of 3"),
        ("x y z i\n1 2 3\n", "line 2 has 3 columns instead of 4"),
        ("1 2 3\n\n# c\n4 5 six\n", "line 4 holds 'six' where a number should be"),
        ("1,2,3\n4,5,6,\n", "line 2 has 4 columns"),
        ("1 2 3\n4 5 1_000\n", "'1_000'"),
        ("1 2 3\n4 5 0x10\n", "'0x10'"),
        (b"1 2 3\n4 5 \xff\n", "line 2"),
        (b"1 2 3\n4 5 \x00\n", "not plain text"),
        (b"\x7fELF\x02\x01\x01\x00" + bytes(100), "not plain text"),
        ("1 2 3\n".encode("utf-16"), "not plain text"),
        ("1 2 3\n" + "9" * 100_000 + " 1 2\n", "line 2 is longer"),
        ("1 2 3\n" + "9 " * 5_000_000, "line 2 is longer"),
        ("2\n1 2 3\n", "promises 2 points, 1 are there"),
        ("2\n1 2 3\n4 5 6\n7 8 9\n", "line 4 should be the number of points"),
        ("99999999999999999999\n1 2 3\n", "cut short"),
        ("999999999999999999999\n1 2 3\n", "not a number of records"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_what_is_no_cloud_is_refused(content: str | bytes, why: str, tmp_path: Path) -> None:
    with pytest.raises(UnreadableFileError, match=why):
        list(read_scan(write(tmp_path, content)))


def test_a_type_told_by_the_first_rows_holds_for_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "BLOCK_BYTES", 64)
    with pytest.raises(UnreadableFileError, match="red is uint8 by the file's header or first rows, but holds 256"):
        list(read_scan(write(tmp_path, "x y z r\n" + "1 2 3 4\n" * 20 + "1 2 3 256\n")))


def test_missing_numbers_are_nan_and_missing_points_are_dropped(tmp_path: Path) -> None:
    path = write(tmp_path, "x,y,z,i\n1,2,3,\n,5,6,7\nnan,1,2,3\n7,8,9,NaN\ninf,0,0,1\n", ".csv")
    cloud = read_all(path)
    assert cloud.source_index.tolist() == [0, 3]
    assert cloud.dropped == 3
    assert np.isnan(cloud.attributes["intensity"]).all()


@pytest.mark.parametrize("block", [1, 5, 16, 1000])
def test_blocks_of_any_size_give_the_same_lines(block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = "# c\nx y z i\n" + "".join(f"{k} {k}.5 -{k} {k}\r\n\n" for k in range(50)) + "1 2 3 4"
    whole = read_all(write(tmp_path, content))
    monkeypatch.setattr(rows, "BLOCK_BYTES", block)
    assert_same(whole, read_all(write(tmp_path, content)))
    with pytest.raises(UnreadableFileError, match="line 103 has 3 columns"):
        list(read_scan(write(tmp_path, content[:-2])))


NUMBERS = st.one_of(
    st.floats(allow_subnormal=False).map(repr),
    st.integers(-(10**6), 10**6).map(str),
    st.sampled_from(["nan", "NA", "inf", "-inf", "+1.", ".5", "1E+05"]),
)


@given(
    data=st.data(),
    separator=st.sampled_from(["", ",", ";"]),
    width=st.integers(3, 6),
    missing=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_the_fast_parser_is_the_slow_one(data: st.DataObject, separator: str, width: int, *, missing: bool) -> None:
    numbers = st.one_of(NUMBERS, st.just("")) if missing and separator else NUMBERS
    table = data.draw(st.lists(st.lists(numbers, min_size=width, max_size=width), min_size=1, max_size=20))
    text = "".join((separator or " ").join(row) + "\n" for row in table).encode()
    taken = Rows(text, len(table), 1)
    fast = rows.parse(taken, Layout(width, separator), "twin")
    slow = rows.parse_slowly(taken, Layout(width, separator), "twin")
    for a, b in zip(fast, slow, strict=True):
        # pandas rounds the last bit of some doubles otherwise than Python does: 2e-16 of 5,000 km is a nanometre.
        np.testing.assert_allclose(a, b, rtol=1e-15)


def test_lines_are_skipped_as_they_are_taken() -> None:
    text = b"".join(b"%d\n# c\n\n" % k for k in range(10))
    lines = Lines(io.BytesIO(text), "lines")
    assert lines.skip(4) == 4
    assert lines.take(1) == Rows(b"4\n", 1, 13)
    assert lines.take(2).text.split() == [b"5", b"6"]
    assert lines.skip(99) == 3
    assert lines.take(1).count == 0


PTX = """2
3
10 20 30
1 0 0
0 1 0
0 0 1
0 1 0 0
-1 0 0 0
0 0 1 0
10 20 30 1
1 2 3 0.5 10 20 30
0 0 0 0.5 0 0 0
1 0 0 0.25 1 2 3
0 0 0 0 0 0 0
0 1 0 1 4 5 255
nan 1 0 1 4 5 255
"""
SECOND = "1\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n7 8 9 0.125\n"


def test_ptx_scans_are_moved_by_their_transforms(tmp_path: Path) -> None:
    path = write(tmp_path, PTX + SECOND, ".ptx")
    first, second = read_scan(path)
    # Row vectors: [1 2 3 1] @ M.
    assert first.xyz.tolist() == [[8, 21, 33], [10, 21, 30], [9, 20, 30]]
    assert first.origin is not None
    assert first.origin.tolist() == [10, 20, 30]
    assert (first.attributes["column"].tolist(), first.attributes["row"].tolist()) == ([0, 0, 1], [0, 2, 1])
    assert first.source_index.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(first.attributes["blue"], np.array([30, 3, 255], np.uint8), strict=True)
    assert (second.scan, second.source_index.tolist(), second.xyz.tolist()) == (1, [6], [[7, 8, 9]])
    assert list(second.attributes) == ["intensity", "row", "column"]
    info = scan_info(path)
    assert info.points == 7
    assert [(s.points, s.origin) for s in info.stations] == [(6, (10, 20, 30)), (1, (0, 0, 0))]


def test_dropped_points_are_counted_once_however_the_scan_is_cut(tmp_path: Path) -> None:
    path = write(tmp_path, PTX + SECOND, ".ptx")
    for chunk_points in (1, 2, 3, 100):
        chunks = list(read_scan(path, chunk_points=chunk_points))
        assert [sum(c.dropped for c in chunks if c.scan == k) for k in (0, 1)] == [3, 0]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (PTX.replace("2\n3\n", "2\n4\n", 1), "promises 8 points, 6 are there"),
        (PTX.replace("2\n3\n", "2\n2\n", 1), r"line 15 should be the number of columns \(1 numbers\), but is '0 1 0 1"),
        (
            PTX[: PTX.index("10 20 30 1")],
            r"line 10 should be a row of the transform \(4 numbers\), but is the end of the file",
        ),
        (PTX.replace("10 20 30 1\n", "10 20 30 2\n"), "last column of a transform"),
        (PTX.replace("10 20 30 1\n", "10 20 nan 1\n"), "last column of a transform"),
        (PTX.replace("10 20 30\n", "10 20\n", 1), "line 3 should be the scanner's position"),
        (PTX.replace("2\n3\n", "-2\n3\n", 1), "not a number of records"),
        (PTX.replace("2\n3\n", f"{2**63}\n{2**63}\n", 1), "no scanner has such a grid"),
        (PTX.replace("2\n3\n", f"{2**31 - 1}\n{2**31 - 1}\n", 1), "cut short"),
        (PTX.replace(" 255\n", " 255 1\n", 1), "line 15 has 8 columns instead of 7"),
        ("1 2 3\n", "line 1 should be the number of columns"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_damaged_ptx_is_refused(content: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(UnreadableFileError, match=why):
        list(read_scan(write(tmp_path, content, ".ptx")))


def test_a_ptx_without_points_is_empty(tmp_path: Path) -> None:
    path = write(tmp_path, PTX.split("1 2 3 0.5", maxsplit=1)[0].replace("2\n3\n", "0\n0\n", 1), ".ptx")
    assert list(read_scan(path)) == []
    assert scan_info(path).points == 0


def test_pts_has_blocks_and_cyclones_intensities(tmp_path: Path) -> None:
    path = write(tmp_path, "1\n1 2 3 -2048 1 2 3\n2\n4 5 6 2047 4 5 6\n7 8 9 0 7 8 9\n0\n", ".pts")
    chunks = list(read_scan(path))
    assert [chunk.scan for chunk in chunks] == [0, 1]
    assert [chunk.source_index.tolist() for chunk in chunks] == [[0], [1, 2]]
    assert [chunk.attributes["intensity"].tolist() for chunk in chunks] == [[-2048], [2047, 0]]
    assert scan_info(path).points == 3
    assert [station.points for station in scan_info(path).stations] == [1, 2, 0]


SOUND = {
    ".ptx": PTX + SECOND,
    ".pts": "2\n1 2 3 -2048 1 2 3\n4 5 6 2047 4 5 6\n1\n7 8 9 0 7 8 9\n",
    ".csv": "x;y;z;red;my field\n1,5;2;3;4;5\n1e3;-2;3;255;-5\n;1;2;3;4\n",
    ".xyz": "# comment\n//X Y Z nx ny nz\n1 2 3 0.6 0 0.8\n4 5 6 1 0 0\n7 8 9 0 0 -1\n",
}


@pytest.mark.parametrize("suffix", SOUND)
@given(data=st.data())
@FUZZ
def test_damage_is_survived(suffix: str, data: st.DataObject, tmp_path: Path) -> None:
    assert_reads_or_refuses(write(tmp_path, data.draw(damaged(SOUND[suffix].encode())), suffix))


@pytest.mark.parametrize("suffix", SOUND)
@given(content=st.binary(max_size=200))
@FUZZ
def test_anything_is_survived(suffix: str, content: bytes, tmp_path: Path) -> None:
    assert_reads_or_refuses(write(tmp_path, content, suffix))


# File → points, or the words of the refusal.
PDAL = "formats/pdal/test/data"
FILES: dict[str, Any] = {
    f"{PDAL}/ptx/1.2-with-color.ptx": 1065,
    f"{PDAL}/ptx/complex-transform.ptx": 4,
    f"{PDAL}/ptx/multiple-and-transform.ptx": 8,
    f"{PDAL}/ptx/no-color.ptx": 15,
    f"{PDAL}/pts/autzen.pts": 10,
    # Nine rows where eight are announced.
    f"{PDAL}/pts/bunny_8.pts": "line 10 should be the number of points",
    f"{PDAL}/pts/test.pts": 19,
    f"{PDAL}/pts/site_56_8.pts": 8,
    f"{PDAL}/text/badheader.txt": "neither numbers nor a header",
    f"{PDAL}/text/utm17_1.txt": 10,
    f"{PDAL}/text/utm17_2.txt": 10,
    f"{PDAL}/text/utm17_3.txt": "line 5 has 4 columns instead of 3",
    f"{PDAL}/text/file1.txt": 9,
    f"{PDAL}/text/file2.txt": 9,
    f"{PDAL}/text/file3.txt": 9,
    f"{PDAL}/text/quoted.txt": 9,
    f"{PDAL}/text/quoted2.txt": 9,
    f"{PDAL}/text/numeric_dim.txt": 5,
    f"{PDAL}/text/missingheader.txt": 5,
    f"{PDAL}/text/text.txt": "neither numbers nor a header",
    f"{PDAL}/text/duplicates-sorted.txt": 7,
    f"{PDAL}/text/duplicates-unsorted.txt": 7,
    f"{PDAL}/text/largescan.txt": 6,
    f"{PDAL}/text/crlf_test.txt": 10,
    f"{PDAL}/text/crlf_test2.txt": 10,
    f"{PDAL}/text/with_edgeofflightline.txt": 10_000,
    f"{PDAL}/text/decimate_file_grid.txt": 81,
    f"{PDAL}/autzen/autzen-point-format-3.txt": 106,
    f"{PDAL}/autzen/autzen-bmx-cores.txt": 3,
    f"{PDAL}/autzen/autzen-bmx-m3c2.txt": 103,
    f"{PDAL}/autzen/autzen-bmx-largersample.txt": 103,
    f"{PDAL}/autzen/autzen-bmx-cc.txt": 103,
    "formats/trimesh/models/points_agisoft.xyz": 100,
    "formats/trimesh/models/points_cloudcompare.xyz": 101,
    "steel_joint/data/test_points.txt": 3907,
    "steel_joint/data/profiles.csv": "neither numbers nor a header",
    "formats/las_check.txt": "neither numbers nor a header",
    "formats/pcl/pcl/LICENSE.txt": "neither numbers nor a header",
}


@pytest.mark.parametrize("file", FILES)
def test_files_of_others(file: str, shared_data: Path) -> None:
    path, expected = shared_data / file, FILES[file]
    if isinstance(expected, str):
        with pytest.raises(UnreadableFileError, match=expected):
            list(read_scan(path))
    else:
        assert sum(len(chunk) for chunk in read_scan(path)) == expected


def test_the_steel_joint_has_normals_and_labels(shared_data: Path) -> None:
    cloud = read_all(shared_data / "steel_joint" / "data" / "test_points.txt")
    assert list(cloud.attributes) == ["normal_x", "normal_y", "normal_z", "field_7"]
    assert int(cloud.attributes["field_7"].sum()) == 2940


def test_one_cloud_in_two_formats_of_pdal(shared_data: Path) -> None:
    ptx = read_all(shared_data / PDAL / "ptx" / "1.2-with-color.ptx")
    las = read_all(shared_data / "formats" / "laspy" / "tests" / "data" / "simple.las")
    np.testing.assert_allclose(ptx.xyz, las.xyz, atol=1e-6)
