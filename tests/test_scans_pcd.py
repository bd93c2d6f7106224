from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import lzf
import numpy as np
import pypcd4
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from damage import assert_reads_or_refuses, assert_same, damaged, read_all
from scanfind.errors import UnreadableFileError
from scanfind.scans import open_writer, read_scan, scan_info

XYZ = np.array([[0.5, -1.25, 2.0], [1024.125, 2048.0, 3e3], [7.0, 8.0, -9.5], [1.0, 2.0, 3.0]])
RECORD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "<u1", (4,)), ("h", "<i2", (2,)), ("t", "<u8")])
FIELDS = "FIELDS x y z _ h t\nSIZE 4 4 4 1 2 8\nTYPE F F F U I U\nCOUNT 1 1 1 4 2 1\n"


def header(data: str, fields: str = FIELDS, size: str = "WIDTH 4\nHEIGHT 1\nPOINTS 4\n", view: str = "") -> bytes:
    return f"# .PCD v0.7\nVERSION 0.7\n{fields}{size}{view}DATA {data}\n".encode()


def records() -> np.ndarray[Any, Any]:
    table = np.zeros(4, RECORD)
    table["x"], table["y"], table["z"] = XYZ.T
    table["h"], table["t"] = [[1, -2], [3, -4], [5, -6], [7, -8]], [0, 1, 2, 2**64 - 1]
    return table


def compressed(*columns: bytes) -> bytes:
    raw = b"".join(columns)
    packed: bytes = lzf.compress(raw, 2 * len(raw))
    return struct.pack("<II", len(packed), len(raw)) + packed


def text() -> bytes:
    rows = [[r["x"], r["y"], r["z"], *r["_"], *r["h"], r["t"]] for r in records()]
    return b"".join(" ".join(str(v) for v in row).encode() + b"\n" for row in rows)


def columns(*, with_padding: bool) -> list[bytes]:
    table = records()
    padding = [table["_"][:, k].tobytes() for k in range(4)] if with_padding else []
    h = [table["h"][:, k].tobytes() for k in range(2)]
    return [*(table[axis].tobytes() for axis in "xyz"), *padding, *h, table["t"].tobytes()]


ENCODED = {
    "ascii": header("ascii") + text(),
    "tabs": header("ascii") + text().replace(b" ", b"\t"),
    "binary": header("binary") + records().tobytes(),
    "compressed": header("binary_compressed") + compressed(*columns(with_padding=True)),
    # PCL leaves padding out when it compresses.
    "compressed by PCL": header("binary_compressed") + compressed(*columns(with_padding=False)),
}


def write(folder: Path, content: bytes) -> Path:
    path = folder / "scan.pcd"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("encoding", ENCODED)
def test_every_encoding_holds_the_same_points(encoding: str, tmp_path: Path) -> None:
    path = write(tmp_path, ENCODED[encoding])
    cloud = read_all(path)
    np.testing.assert_array_equal(cloud.xyz, XYZ)
    assert list(cloud.attributes) == ["h_0", "h_1", "t"]
    np.testing.assert_array_equal(cloud.attributes["h_1"], np.array([-2, -4, -6, -8], np.int16), strict=True)
    np.testing.assert_array_equal(cloud.attributes["t"], np.array([0, 1, 2, 2**64 - 1], np.uint64), strict=True)
    assert cloud.origin is None
    info = scan_info(path)
    assert (info.points, info.attributes) == (4, {"h_0": "int16", "h_1": "int16", "t": "uint64"})
    assert_same(cloud, read_all(path, chunk_points=3))


@pytest.mark.parametrize(
    ("size", "view", "origin"),
    [
        ("WIDTH 4\nHEIGHT 1\n", "", None),
        ("WIDTH 4\nHEIGHT 1\n", "VIEWPOINT 0 0 0 1 0 0 0\n", None),
        ("WIDTH 1\nHEIGHT 4\n", "VIEWPOINT 0 0 0 1 0 0 0\n", None),
        ("WIDTH 4\nHEIGHT 1\n", "VIEWPOINT 0 0 0 0 1 0 0\n", (0, 0, 0)),
        ("WIDTH 4\n", "VIEWPOINT 1 2.5 -3 1 0 0 0\n", (1, 2.5, -3)),
        ("WIDTH 2\nHEIGHT 2\n", "VIEWPOINT 0 0 0 1 0 0 0\n", (0, 0, 0)),
        ("WIDTH 2\nHEIGHT 2\nPOINTS 4\n", "", (0, 0, 0)),
    ],
)
def test_the_viewpoint_is_where_the_sensor_stood(
    size: str, view: str, origin: tuple[float, ...] | None, tmp_path: Path
) -> None:
    path = write(tmp_path, header("binary", size=size, view=view) + records().tobytes())
    cloud = read_all(path)
    assert (None if cloud.origin is None else tuple(cloud.origin)) == origin == scan_info(path).stations[0].origin
    np.testing.assert_array_equal(cloud.xyz, XYZ)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
@pytest.mark.parametrize("kind", ["F", "U"])
@pytest.mark.parametrize("name", ["rgb", "rgba"])
def test_packed_colours_are_unpacked(encoding: str, kind: str, name: str, tmp_path: Path) -> None:
    number = np.array([0x00FF8001, 0x40302010], np.uint32)
    values = number if kind == "U" else number.view(np.float32)
    table = np.empty(2, [("xyz", "<f4", (3,)), ("c", values.dtype)])
    table["xyz"], table["c"] = 1.0, values
    fields = f"FIELDS x y z {name}\nSIZE 4 4 4 4\nTYPE F F F {kind}\n"
    body = table.tobytes() if encoding == "binary" else b"".join(b"1 1 1 %s\n" % str(v).encode() for v in values)
    found = read_all(write(tmp_path, header(encoding, fields, "WIDTH 2\n") + body)).attributes
    expected = {"red": [255, 48], "green": [128, 32], "blue": [1, 16], **({"alpha": [0, 64]} if name == "rgba" else {})}
    assert {k: v.tolist() for k, v in found.items()} == expected
    assert {v.dtype for v in found.values()} == {np.dtype("u1")}


def test_points_without_depth_are_dropped_and_counted(tmp_path: Path) -> None:
    fields = "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\n"
    body = b"nan nan nan nan\n1 2 3 255\nnan nan nan nan\nnan nan nan nan\n"
    path = write(tmp_path, header("ascii", fields, "WIDTH 2\nHEIGHT 2\n") + body)
    cloud = read_all(path)
    assert (cloud.source_index.tolist(), cloud.dropped, cloud.attributes["blue"].tolist()) == ([1], 3, [255])
    assert_same(cloud, read_all(path, chunk_points=1))
    # A point that is there must have what the header declares.
    path.write_bytes(path.read_bytes().replace(b"3 255", b"3 nan"))
    with pytest.raises(UnreadableFileError, match="rgb is uint32"):
        list(read_scan(path))


XYZ_ONLY = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"


@pytest.mark.parametrize(
    ("head", "why"),
    [
        (header("binary", size="WIDTH 4\nHEIGHT 1\nPOINTS 5\n"), "is not the 5 points"),
        (header("binary", size="WIDTH 9223372036854775808\nHEIGHT 1\n"), "cut short"),
        (header("ascii", size="WIDTH 9223372036854775808\nHEIGHT 1\n"), "cut short"),
        (header("binary_compressed", size="WIDTH 9223372036854775808\nHEIGHT 1\n"), "damaged or cut short"),
        (header("binary", size="WIDTH -4\nHEIGHT 1\n"), "number of records"),
        (header("binary", size="WIDTH 4\nHEIGHT x\n"), "number of records"),
        (header("binary", size="POINTS 4\n"), "no WIDTH"),
        (header("binary_lzma"), "none of ascii"),
        (header("binary", "FIELDS x y z\nSIZE 4 4\nTYPE F F F\n"), "different lengths"),
        (header("binary", "FIELDS x y z\nSIZE 2 4 4\nTYPE F F F\n"), "do not exist"),
        (header("binary", "FIELDS x y i\nSIZE 4 4 4\nTYPE F F F\n"), "no x, y and z"),
        (header("binary", XYZ_ONLY + "COUNT 1 1 999999999\n"), "COUNT 999,999,999"),
        (header("binary", XYZ_ONLY + "COUNT 1 1 0\n"), "COUNT 0"),
        (header("binary", view="VIEWPOINT 0 0 0\n"), "VIEWPOINT"),
        (header("binary", view="VIEWPOINT 0 0 nan 1 0 0 0\n"), "VIEWPOINT"),
        (b"289814.15 4320978.61 170.76\n", "not a PCD file"),
        (b"", "does not end"),
        (b"VERSION 0.7\n" * 100_000, "does not end"),
        (b"VERSION " + b"7" * 2_000_000, "does not end"),
    ],
    ids=lambda value: str(value)[-30:],
)
def test_headers_that_cannot_be_true_are_refused(head: bytes, why: str, tmp_path: Path) -> None:
    path = write(tmp_path, head + bytes(200) if head else head)
    with pytest.raises(UnreadableFileError, match=why):
        list(read_scan(path))


@pytest.mark.parametrize(
    "body",
    [
        b"",
        struct.pack("<II", 0, 0),
        struct.pack("<II", 3, 4 * 28) + b"\xff\xff\xff",
        struct.pack("<II", 2**32 - 1, 2**32 - 1) + bytes(64),
        struct.pack("<II", 64, 4 * 28) + b"\xff" * 64,
        struct.pack("<II", 64, 4 * 28) + bytes(64),
    ],
)
def test_compressed_points_that_do_not_decode_are_refused(body: bytes, tmp_path: Path) -> None:
    with pytest.raises(UnreadableFileError, match="damaged"):
        list(read_scan(write(tmp_path, header("binary_compressed") + body)))


def test_a_small_compressed_file_cannot_ask_for_gigabytes(tmp_path: Path) -> None:
    points = (2**32 - 1) // 12
    head = header("binary_compressed", XYZ_ONLY, f"WIDTH {points}\n")
    with pytest.raises(UnreadableFileError, match="damaged or cut short"):
        list(read_scan(write(tmp_path, head + struct.pack("<II", 1000, 12 * points) + bytes(1000))))


KINDS = [np.dtype(kind) for kind in ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8", "?")]


@given(data=st.data())
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_what_is_written_is_read_back(data: st.DataObject, tmp_path: Path) -> None:
    names = ["red", "green", "blue", "normal_x", "intensity", "gps_time", "an extra", "_"]
    fields = data.draw(st.dictionaries(st.sampled_from(names), st.sampled_from(KINDS)))
    # Single precision at first, then double: the file turns wide.
    single = data.draw(st.integers(0, 30))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    points = rng.normal(scale=1e6, size=(30, 3))
    points[:single] = points[:single].astype(np.float32)
    columns: dict[str, Any] = {name: rng.integers(0, 100, 30).astype(dtype) for name, dtype in fields.items()}
    path = tmp_path / "cloud.pcd"
    with open_writer(path, fields, shift=[5e5, 0, 0]) as writer:
        for part in (slice(0, single), slice(single, 30)):
            writer.write(points[part], {name: values[part] for name, values in columns.items()})
    cloud = read_all(path)
    np.testing.assert_array_equal(cloud.xyz, points)
    spelled = {"an extra": "an_extra", "_": "field"}
    assert {spelled.get(name, name) for name in columns} == set(cloud.attributes)
    for name, values in columns.items():
        back = cloud.attributes[spelled.get(name, name)]
        np.testing.assert_array_equal(back, values)
        assert back.dtype == (np.dtype("u1") if values.dtype == bool else values.dtype)
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.pcd"]


def test_single_precision_stays_single(tmp_path: Path) -> None:
    path = tmp_path / "cloud.pcd"
    with open_writer(path, {}) as writer:
        writer.write(XYZ, {})
    assert b"SIZE 4 4 4\n" in path.read_bytes()


@pytest.mark.parametrize("scale", [1, 257])
def test_colours_of_16_bits_are_exact_and_have_a_preview(scale: int, tmp_path: Path) -> None:
    colours = np.array([0, 128, 255, 7], np.uint16) * np.uint16(scale)
    path = tmp_path / "cloud.pcd"
    with open_writer(path, dict.fromkeys(("red", "green", "blue"), np.dtype("u2"))) as writer:
        writer.write(XYZ, {"red": colours, "green": colours, "blue": colours})
    np.testing.assert_array_equal(read_all(path).attributes["red"], colours, strict=True)
    path.write_bytes(path.read_bytes().replace(b"red green blue", b"one other more"))
    np.testing.assert_array_equal(read_all(path).attributes["red"], np.array([0, 128, 255, 7], np.uint8), strict=True)


@pytest.mark.parametrize("encoding", ENCODED)
@given(data=st.data())
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_damage_is_survived(encoding: str, data: st.DataObject, tmp_path: Path) -> None:
    assert_reads_or_refuses(write(tmp_path, data.draw(damaged(ENCODED[encoding]))))


# File → points and dropped points, or the words of the refusal.
FILES = {
    "formats/pdal/test/data/pcd/utm17_tab.pcd": (10, 0),
    "formats/pdal/test/data/pcd/autzen-utm.pcd": (1065, 0),
    "formats/pdal/test/data/pcd/utm17_comma.pcd": (10, 0),
    "formats/pdal/test/data/pcd/utm17_space.pcd": (10, 0),
    "formats/pdal/test/data/pcd/missingheader.pcd": "not a PCD file",
    "formats/pcl/tutorials/min_cut_segmentation_tutorial.pcd": (9311, 0),
    "formats/pcl/tutorials/correspondence_grouping/milk.pcd": (12575, 0),
    "formats/pcl/tutorials/lamppost.pcd": (1771, 0),
    "formats/pcl/tutorials/template_alignment/object_template_0.pcd": (1397, 0),
    "formats/pcl/pcl/test/milk_color.pcd": (13704, 0),
    "formats/pcl/pcl/test/colored_cloud.pcd": (1000, 0),
    "formats/pcl/pcl/test/car6.pcd": (10031, 0),
    "formats/pcl/pcl/test/milk.pcd": (13704, 0),
    "formats/pcl/pcl/test/bunny.pcd": (397, 0),
    "formats/pcl/pcl/test/bun0.pcd": (397, 0),
    "milk_kinect/milk_segment_in_scene.pcd": (13704, 0),
    "milk_kinect/milk_model.pcd": (12575, 0),
    "milk_kinect/scene.pcd": (241_407, 65_793),
}


@pytest.mark.parametrize("file", FILES)
def test_files_of_others(file: str, shared_data: Path) -> None:
    path, expected = shared_data / file, FILES[file]
    if isinstance(expected, str):
        with pytest.raises(UnreadableFileError, match=expected):
            list(read_scan(path))
        return
    cloud = read_all(path, chunk_points=100_000)
    assert (len(cloud), cloud.dropped) == expected
    assert scan_info(path).points == sum(expected)


def test_no_file_of_others_is_forgotten(shared_data: Path) -> None:
    assert {str(p.relative_to(shared_data)) for p in shared_data.rglob("*.pcd")} == set(FILES)


def test_the_kinect_scene_was_seen_from_its_origin(shared_data: Path) -> None:
    cloud = read_all(shared_data / "milk_kinect" / "scene.pcd")
    assert cloud.origin is not None
    assert cloud.origin.tolist() == [0, 0, 0]
    assert read_all(shared_data / "milk_kinect" / "milk_model.pcd").origin is None


@pytest.mark.parametrize("file", ["milk_kinect/scene.pcd", "formats/pdal/test/data/pcd/autzen-utm.pcd"])
def test_pypcd4_reads_the_same(file: str, shared_data: Path) -> None:
    cloud = read_all(shared_data / file)
    twin = pypcd4.PointCloud.from_path(shared_data / file)
    xyz = twin.numpy([name for name in twin.fields if name in "xyzXYZ"])
    np.testing.assert_array_equal(xyz[cloud.source_index], cloud.xyz.astype(xyz.dtype))


def test_pypcd4_reads_what_is_written(tmp_path: Path) -> None:
    path = tmp_path / "cloud.pcd"
    with open_writer(path, dict.fromkeys(("red", "green", "blue"), np.dtype("u1"))) as writer:
        writer.write(XYZ, {"red": np.full(4, 250, np.uint8)})
    twin = pypcd4.PointCloud.from_path(path)
    np.testing.assert_array_equal(twin.numpy(["x", "y", "z"]), XYZ)
    assert pypcd4.PointCloud.decode_rgb(twin.numpy(["rgb"])[:, 0].astype(np.float32)).tolist() == [[250, 0, 0]] * 4
