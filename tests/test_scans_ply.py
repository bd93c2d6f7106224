from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from damage import assert_reads_or_refuses, assert_same, damaged, read_all
from scanfind.errors import InvalidGeometryError, OutputError, UnreadableFileError, UnsupportedFormatError
from scanfind.scans import open_writer, read_scan, scan_info

XYZ = np.array([[0.5, -1.25, 2.0], [1e6 + 0.125, 2e6, 3e3], [7.0, 8.0, -9.5]])
HEADER = (
    "element vertex 3\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\nproperty short s\n"
)
RECORD = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1"), ("s", "i2")]
TRIANGLE = "property list uchar int vertex_indices\n"


def records(order: Literal["<", ">"]) -> bytes:
    table = np.empty(3, np.dtype(RECORD).newbyteorder(order))
    table["x"], table["y"], table["z"] = XYZ.T
    table["red"], table["s"] = [1, 2, 255], [-5, 0, 300]
    return table.tobytes()


def ply(encoding: str, body: bytes, header: str = HEADER) -> bytes:
    return f"ply\nformat {encoding} 1.0\ncomment any\nobj_info any\n{header}end_header\n".encode() + body


TEXT = b"".join(
    b"%r %r %r %d %d\n" % (*map(float, p), r, s) for p, r, s in zip(XYZ, (1, 2, 255), (-5, 0, 300), strict=True)
)
ENCODED = {
    "ascii": ply("ascii", TEXT),
    "little": ply("binary_little_endian", records("<")),
    "big": ply("binary_big_endian", records(">")),
    "dos": ply("ascii", TEXT).replace(b"\n", b"\r\n"),
    "faces behind": ply("ascii", TEXT + b"3 0 1 2\n3 0 1 2\n", HEADER + "element face 2\n" + TRIANGLE),
    "faces before": ply("ascii", b"3 0 1 2\n4 0 1 2 2\n" + TEXT, "element face 2\n" + TRIANGLE + HEADER),
    "lists before": ply(
        "binary_little_endian",
        b"\x03" + bytes(12) + b"\x01" + bytes(4) + records("<"),
        "element face 2\n" + TRIANGLE + HEADER,
    ),
    "records before": ply(
        "binary_big_endian", bytes(12) + records(">"), "element camera 2\nproperty short a\nproperty int b\n" + HEADER
    ),
}


def write(folder: Path, content: bytes) -> Path:
    path = folder / "scan.ply"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("encoding", ENCODED)
def test_every_encoding_holds_the_same_points(encoding: str, tmp_path: Path) -> None:
    path = write(tmp_path, ENCODED[encoding])
    cloud = read_all(path)
    np.testing.assert_array_equal(cloud.xyz, XYZ)
    np.testing.assert_array_equal(cloud.attributes["red"], np.array([1, 2, 255], np.uint8), strict=True)
    np.testing.assert_array_equal(cloud.attributes["s"], np.array([-5, 0, 300], np.int16), strict=True)
    assert cloud.source_index.tolist() == [0, 1, 2]
    assert cloud.origin is None
    info = scan_info(path)
    assert info.points == 3
    assert info.attributes == {"red": "uint8", "s": "int16"}
    assert_same(cloud, read_all(path, chunk_points=2))


@pytest.mark.parametrize(
    ("header", "why"),
    [
        ("element vertex 9223372036854775808\nproperty float x\nproperty float y\nproperty float z\n", "cut short"),
        ("element vertex 40\nproperty float x\nproperty float y\nproperty float z\n", "cut short"),
        ("element vertex -3\nproperty float x\nproperty float y\nproperty float z\n", "number of records"),
        ("element vertex 1e3\n", "number of records"),
        ("element vertex " + "9" * 5000 + "\n", "number of records"),
        ("element vertex 1\nproperty float x\nproperty float y\n", "no x, y and z"),
        ("element vertex 1\n", "no x, y and z"),
        ("element vertex 1\nproperty real x\n", "header line"),
        ("property float x\n", "header line"),
        ("element points 1\nproperty float x\n", "no points"),
        (f"element face 1\n{TRIANGLE}{HEADER}", "longer than the file"),
        (f"element face 9223372036854775808\nproperty double a\n{HEADER}", "longer than the file"),
        ("element face 1\nproperty list float int a\n", "header line"),
    ],
    ids=lambda text: text[:30],
)
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_headers_that_cannot_be_true_are_refused(encoding: str, header: str, why: str, tmp_path: Path) -> None:
    path = write(tmp_path, ply(encoding, b"\xff" * 200 if encoding != "ascii" else b"1 2 3\n" * 3, header))
    if encoding == "ascii" and why == "longer than the file":
        why = "cut short"
    with pytest.raises(UnreadableFileError, match=why):
        list(read_scan(path))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "not 'ply'"),
        (b"OFF\n3 1 0\n", "not 'ply'"),
        (b"ply\nelement vertex 3\n", "begin with 'format"),
        (b"ply\nformat ascii 2.0\n", "begin with 'format"),
        (b"ply\nformat ascii 1.0\n", "does not end"),
        (b"ply\nformat ascii 1.0\n" + b"comment long\n" * 100_000, "does not end"),
        (b"ply\nformat ascii 1.0\ncomment " + b"x" * 2_000_000, "does not end"),
    ],
)
def test_what_is_no_ply_is_refused(content: bytes, why: str, tmp_path: Path) -> None:
    path = write(tmp_path, content)
    for ask in (scan_info, lambda p: list(read_scan(p))):
        with pytest.raises(UnreadableFileError, match=why):
            ask(path)


def test_lists_in_a_point_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, ply("ascii", b"1 2 3 1 5\n", HEADER.replace("3", "1") + "property list uchar int links\n"))
    with pytest.raises(UnsupportedFormatError, match="links"):
        list(read_scan(path))


def test_a_bad_row_is_named_by_its_line(tmp_path: Path) -> None:
    path = write(tmp_path, ply("ascii", TEXT.replace(b"2000000.0", b"2_000_000")))
    with pytest.raises(UnreadableFileError, match="line 13 holds '2_000_000'"):
        list(read_scan(path))
    path = write(tmp_path, ply("ascii", TEXT.replace(b" 300\n", b"\n")))
    with pytest.raises(UnreadableFileError, match="line 14 has 4 columns instead of 5"):
        list(read_scan(path))
    path = write(tmp_path, ply("ascii", TEXT.replace(b" 255 ", b" 256 ")))
    with pytest.raises(UnreadableFileError, match=r"red is uint8 .* holds 256"):
        list(read_scan(path))


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    body = b"nan 0 0 0 0\n1 2 3 4 5\n0 inf 0 0 0\n"
    path = write(tmp_path, ply("ascii", body))
    cloud = read_all(path)
    assert (cloud.xyz.tolist(), cloud.source_index.tolist(), cloud.dropped) == ([[1, 2, 3]], [1], 2)
    assert_same(cloud, read_all(path, chunk_points=1))


def test_cloudcompare_names_are_ours_without_their_prefix(tmp_path: Path) -> None:
    names = ["nx", "ny", "nz", "scalar_Intensity", "scalar_GpsTime", "scalar_Dip", "Dip", "scalar_", "class"]
    header = HEADER.replace("3", "1") + "".join(f"property float {name}\n" for name in names)
    path = write(tmp_path, ply("ascii", b"1 2 3 4 5" + b" 0.5" * len(names), header))
    assert list(scan_info(path).attributes) == [
        "red", "s", "normal_x", "normal_y", "normal_z", "intensity", "gps_time", "Dip", "Dip_2", "scalar_",
        "classification",
    ]  # fmt: skip


KINDS = [np.dtype(kind) for kind in ("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8", "?")]


@given(data=st.data())
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_what_is_written_is_read_back(data: st.DataObject, tmp_path: Path) -> None:
    names = ["red", "green", "blue", "normal_x", "intensity", "gps_time", "an extra", "deviation"]
    fields = data.draw(st.dictionaries(st.sampled_from(names), st.sampled_from(KINDS)))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    path = tmp_path / "cloud.ply"
    points = rng.normal(scale=1e6, size=(30, 3))
    columns: dict[str, Any] = {name: rng.integers(0, 100, 30).astype(dtype) for name, dtype in fields.items()}
    with open_writer(path, fields, shift=[5e5, 0, 0], crs="PROJCS[]") as writer:
        for part in (slice(0, 11), slice(11, 11), slice(11, 30)):
            writer.write(points[part], {name: values[part] for name, values in columns.items()})
    cloud = read_all(path)
    np.testing.assert_array_equal(cloud.xyz, points)
    assert {name.replace(" ", "_") for name in columns} == set(cloud.attributes)
    for name, values in columns.items():
        back = cloud.attributes[name.replace(" ", "_")]
        np.testing.assert_array_equal(back, values)
        assert back.dtype == (np.dtype("u1") if values.dtype == bool else values.dtype)


@pytest.mark.parametrize("scale", [1, 257])
def test_colours_of_16_bits_are_exact_and_have_a_preview(scale: int, tmp_path: Path) -> None:
    colours = np.array([0, 128, 255], np.uint16) * np.uint16(scale)
    path = tmp_path / "cloud.ply"
    with open_writer(path, dict.fromkeys(("red", "green", "blue"), np.dtype("u2"))) as writer:
        writer.write(XYZ, {"red": colours, "green": colours, "blue": colours})
    np.testing.assert_array_equal(read_all(path).attributes["red"], colours, strict=True)
    # A viewer that knows nothing of the exact ones sees the same picture.
    path.write_bytes(path.read_bytes().replace(b"_16bit", b"_other"))
    np.testing.assert_array_equal(read_all(path).attributes["red"], np.array([0, 128, 255], np.uint8), strict=True)


def test_integers_of_64_bits_and_missing_fields(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    with open_writer(path, {"source_index": np.dtype("i8"), "deviation": np.dtype("f4")}) as writer:
        writer.write(XYZ, {"source_index": np.array([1, 2, 2**53])})
    cloud = read_all(path)
    assert cloud.attributes["source_index"].tolist() == [1, 2, 2**53]
    assert np.isnan(cloud.attributes["deviation"]).all()


def test_a_failed_writing_leaves_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, b"an older file")

    def fail() -> None:
        with open_writer(path, {}) as writer:
            writer.write(XYZ, {})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    with pytest.raises(InvalidGeometryError), open_writer(path, {}) as writer:
        writer.write(XYZ, {"unknown": np.zeros(3)})
    with pytest.raises(OutputError):
        open_writer(tmp_path / "no folder" / "cloud.ply", {})
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"an older file"]


def test_no_points_are_a_cloud_too(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    with open_writer(path, {"intensity": np.dtype("f4")}):
        pass
    assert list(read_scan(path)) == []
    assert scan_info(path).points == 0


@pytest.mark.parametrize("encoding", ["ascii", "little", "big", "lists before"])
@given(data=st.data())
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_damage_is_survived(encoding: str, data: st.DataObject, tmp_path: Path) -> None:
    assert_reads_or_refuses(write(tmp_path, data.draw(damaged(ENCODED[encoding]))))


# File → points, or the words of the refusal.
FILES = {
    "pdal/test/data/ply/no_vertex.ply": "no 'element vertex'",
    "pdal/test/data/ply/text_extradim.ply": 1,
    "pdal/test/data/ply/simple_binary.ply": 3,
    "pdal/test/data/ply/unsized_dims.ply": "no x, y and z",
    "pdal/test/data/ply/mesh_fixed.ply": 4,
    "pdal/test/data/ply/issue_2421.ply": 1,
    "pdal/test/data/ply/simple_text.ply": 3,
    "pdal/test/data/ply/sized_dims.ply": "no x, y and z",
    "pdal/test/data/ply/mesh.ply": 4,
    "trimesh/models/featuretype.ply": 5096,
    "trimesh/models/fixed_top.ply": 2374,
    "trimesh/models/emptyIO/ply_empty_header.ply": "no 'element vertex'",
    "trimesh/models/emptyIO/ply_empty_bin.ply": 0,
    "trimesh/models/emptyIO/ply_points_bin.ply": 8,
    "trimesh/models/emptyIO/ply_points_ascii.ply": 8,
    "trimesh/models/emptyIO/ply_empty_ascii.ply": 0,
    "trimesh/models/plane.ply": 4,
    "trimesh/models/points_ascii_with_lists.ply": 5,
    "trimesh/models/points_emptyface.ply": 1024,
    "trimesh/models/empty.ply": 0,
    "trimesh/models/points_emptyascii.ply": 12,
    "trimesh/models/points_bin.ply": 5,
    "trimesh/models/points_ascii.ply": 5,
}


@pytest.mark.parametrize("file", FILES)
def test_files_of_others(file: str, shared_data: Path) -> None:
    path, expected = shared_data / "formats" / file, FILES[file]
    if isinstance(expected, str):
        with pytest.raises(UnreadableFileError, match=expected):
            list(read_scan(path))
    else:
        assert sum(len(chunk) for chunk in read_scan(path)) == expected == scan_info(path).points


def test_no_file_of_others_is_forgotten(shared_data: Path) -> None:
    assert {str(p.relative_to(shared_data / "formats")) for p in (shared_data / "formats").rglob("*.ply")} == set(FILES)


def test_the_pump_room(shared_data: Path) -> None:
    cloud = read_all(shared_data / "pump_e57" / "pumpA_xyzrgb.ply", chunk_points=50_000)
    assert len(cloud) == 155_201
    assert {name: values.dtype for name, values in cloud.attributes.items()} == dict.fromkeys(
        ("red", "green", "blue"), np.dtype("u1")
    )
