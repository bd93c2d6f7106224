"""What every scan format promises, whatever it is: files × formats."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from scanfind.cloud import Floats, PointChunk
from scanfind.errors import (
    InvalidGeometryError,
    OutputError,
    UnreadableFileError,
    UnsupportedFormatError,
    UsageError,
)
from scanfind.scans import CLOUD_WRITERS, SCAN_READERS, open_writer, read_scan, scan_info

# Several scans, invalid points, spherical, every LAS generation, three PCD encodings, ascii and binary PLY.
FILES = [
    "pump_e57/pumpAVisualReferenceImage.e57",
    "formats/pdal/test/data/e57/A_B.e57",
    "formats/pdal/test/data/e57/A_B_different_dims.e57",
    "formats/e57_cry-inc/testdata/tiny_spherical.e57",
    "formats/e57_cry-inc/testdata/cartesian_invalid_state_single.e57",
    "formats/e57_pye57/translationWithoutRotation.e57",
    "formats/laspy/tests/data/extrabytes.las",
    "formats/laspy/tests/data/unregistered_extra_bytes.las",
    "formats/laspy/tests/data/simple1_3.las",
    "formats/laspy/tests/data/extra.laz",
    "formats/laspy/tests/data/simple.copc.laz",
    "formats/pdal/test/data/laz/autzen_trim.laz",
    "formats/pdal/test/data/laz/simple-laszip-compressor-version-1.2r0.laz",
    "formats/pcl/pcl/test/car6.pcd",
    "formats/pcl/pcl/test/milk_color.pcd",
    "milk_kinect/milk_model.pcd",
    "pump_e57/pumpA_xyzrgb.ply",
    "formats/pdal/test/data/ptx/1.2-with-color.ptx",
    "formats/pdal/test/data/ptx/multiple-and-transform.ptx",
    "formats/pdal/test/data/pts/test.pts",
    "formats/pdal/test/data/text/utm17_1.txt",
    "formats/trimesh/models/points_cloudcompare.xyz",
]
# Formats whose header says how many points there are, so that a missing end is noticed.
COUNTED = {".e57", ".las", ".laz", ".ply", ".pcd", ".ptx", ".pts"}
FORMATS = sorted(CLOUD_WRITERS)
# How exactly each format keeps a coordinate 5,000 km from zero, given the shift.
KEEPS_M = {"e57": 1e-9, "las": 0.5001e-4, "laz": 0.5001e-4, "pcd": 1e-5, "ply": 1e-5}


class Whole(NamedTuple):
    """All chunks of a file put together; attributes by scan, because scans of one file need not have the same."""

    xyz: Floats
    source_index: NDArray[np.int64]
    scan: NDArray[np.int64]
    attributes: dict[tuple[int, str], NDArray[Any]]
    origins: dict[int, tuple[float, ...] | None]
    dropped: dict[int, int]


def whole(chunks: list[PointChunk]) -> Whole:
    attributes: dict[tuple[int, str], list[NDArray[Any]]] = {}
    dropped: dict[int, int] = {}
    for chunk in chunks:
        dropped[chunk.scan] = dropped.get(chunk.scan, 0) + chunk.dropped
        for name, values in chunk.attributes.items():
            attributes.setdefault((chunk.scan, name), []).append(values)
    return Whole(
        np.concatenate([np.empty((0, 3)), *(chunk.xyz for chunk in chunks)]),
        np.concatenate([np.empty(0, np.int64), *(chunk.source_index for chunk in chunks)]),
        np.concatenate([np.empty(0, np.int64), *(np.full(len(chunk), chunk.scan) for chunk in chunks)]),
        {key: np.concatenate(values) for key, values in attributes.items()},
        {chunk.scan: None if chunk.origin is None else tuple(chunk.origin) for chunk in chunks},
        dropped,
    )


def assert_same(a: Whole, b: Whole) -> None:
    np.testing.assert_array_equal(a.xyz, b.xyz)
    np.testing.assert_array_equal(a.source_index, b.source_index)
    np.testing.assert_array_equal(a.scan, b.scan)
    assert (a.origins, a.dropped) == (b.origins, b.dropped)
    assert a.attributes.keys() == b.attributes.keys()
    for key, values in a.attributes.items():
        assert values.dtype == b.attributes[key].dtype, key
        np.testing.assert_array_equal(values, b.attributes[key], err_msg=str(key))


@pytest.fixture(params=FILES, ids=lambda name: Path(name).name)
def file(request: pytest.FixtureRequest, shared_data: Path) -> Path:
    return shared_data / str(request.param)


def test_the_chunk_size_changes_nothing(file: Path) -> None:
    everything = whole(list(read_scan(file, chunk_points=10_000_000)))
    small = max(3, len(everything.xyz) // 50)
    for chunk_points in (small, 2 * small + 1):
        assert_same(everything, whole(list(read_scan(file, chunk_points=chunk_points))))


def test_a_chunk_is_well_formed(file: Path) -> None:
    for chunk in read_scan(file, chunk_points=5_000):
        assert len(chunk) <= 5_000
        assert len(chunk) or chunk.dropped
        assert chunk.xyz.shape == (len(chunk), 3)
        assert chunk.xyz.dtype == np.float64
        assert np.isfinite(chunk.xyz).all()
        assert chunk.source_index.dtype == np.int64
        assert chunk.source_index.shape == (len(chunk),)
        assert all(values.shape == (len(chunk),) for values in chunk.attributes.values())
        assert all(values.dtype.kind in "uif" for values in chunk.attributes.values())
        assert all(values.dtype.isnative for values in chunk.attributes.values())


def test_what_the_header_says_is_what_is_read(file: Path) -> None:
    info = scan_info(file)
    read = whole(list(read_scan(file)))
    if info.points >= 0:
        assert info.points == len(read.xyz) + sum(read.dropped.values())
        assert info.points == sum(station.points for station in info.stations)
    for number, origin in read.origins.items():
        assert info.stations[number].origin == origin
    promised = {name: np.dtype(dtype) for name, dtype in info.attributes.items()}
    found: dict[str, np.dtype[Any]] = {}
    for (_, name), values in read.attributes.items():
        found[name] = np.result_type(values.dtype, found.get(name, values.dtype))
    assert promised == found
    if info.bounds is not None and len(read.xyz):
        # Headers are rounded, by some writers to a hundredth.
        assert (read.xyz >= np.array(info.bounds[0]) - 0.02).all()
        assert (read.xyz <= np.array(info.bounds[1]) + 0.02).all()


def test_source_indices_count_the_records_of_the_file(file: Path) -> None:
    info = scan_info(file)
    index = whole(list(read_scan(file, chunk_points=1_000))).source_index
    assert (np.diff(index) > 0).all()
    assert index[0] >= 0
    if info.points >= 0:
        assert index[-1] < info.points


def test_a_given_origin_fills_in_where_the_file_has_none(file: Path) -> None:
    own = {chunk.scan: chunk.origin for chunk in read_scan(file)}
    for chunk in read_scan(file, origin=(1.0, 2.0, 3.0)):
        known = own[chunk.scan]
        np.testing.assert_array_equal(chunk.origin, [1.0, 2.0, 3.0] if known is None else known)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.9])
@pytest.mark.parametrize("name", [name for name in FILES if Path(name).suffix in COUNTED])
def test_a_file_cut_short_says_so_in_one_line(name: str, share: float, shared_data: Path, tmp_path: Path) -> None:
    file = shared_data / name
    data = file.read_bytes()
    cut = tmp_path / file.name
    cut.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(UnreadableFileError) as caught:
        list(read_scan(cut))
    assert "\n" not in str(caught.value)
    assert file.name in str(caught.value)


def test_every_format_is_tried() -> None:
    suffixes = {Path(name).suffix for name in FILES}
    assert {SCAN_READERS[suffix] for suffix in suffixes} == set(SCAN_READERS.values())


def test_wrong_names_get_a_helpful_line(tmp_path: Path) -> None:
    with pytest.raises(UnreadableFileError, match="no such file"):
        read_scan(tmp_path / "missing.e57")
    with pytest.raises(UnreadableFileError, match="missing: no such file or folder"):
        read_scan(tmp_path / "missing")
    with pytest.raises(UnreadableFileError, match="is a folder"):
        read_scan(tmp_path)
    (tmp_path / "scan.e75").touch()
    with pytest.raises(UnsupportedFormatError, match=r"did you mean \.e57"):
        scan_info(tmp_path / "scan.e75")
    (tmp_path / "scan").touch()
    with pytest.raises(UnsupportedFormatError, match=r"no suffix .* \.e57, \.las"):
        scan_info(tmp_path / "scan")
    with pytest.raises(UsageError, match="chunk_points"):
        read_scan(tmp_path / "missing.e57", chunk_points=0)
    (tmp_path / "scan.las").touch()
    with pytest.raises(UsageError, match="three finite numbers"):
        read_scan(tmp_path / "scan.las", origin=(0.0, 1.0))
    with pytest.raises(UnsupportedFormatError, match="choose ply"):
        open_writer(tmp_path / "out.obj", {})


@pytest.mark.parametrize("suffix", sorted(SCAN_READERS))
def test_an_empty_file_is_refused_or_empty(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"nothing{suffix}"
    path.touch()
    said = ""
    try:
        assert not list(read_scan(path))
    except UnreadableFileError as error:
        said = str(error)
    assert "\n" not in said


SHIFT = np.array([5_000_000.0, -400_000.0, 0.0])
FIELDS: dict[str, np.dtype[Any]] = {
    "intensity": np.dtype("f4"),
    "red": np.dtype("u1"),
    "green": np.dtype("u1"),
    "blue": np.dtype("u1"),
    "classification": np.dtype("u1"),
    "return_number": np.dtype("u1"),
    "number_of_returns": np.dtype("u1"),
    "gps_time": np.dtype("f8"),
    "normal_x": np.dtype("f4"),
    "normal_y": np.dtype("f4"),
    "normal_z": np.dtype("f4"),
    "row": np.dtype("u2"),
    "column": np.dtype("u2"),
    "instance": np.dtype("u2"),
    "scan_id": np.dtype("u2"),
    "source_index": np.dtype("i8"),
    "deviation": np.dtype("f4"),
    "temperature": np.dtype("i2"),
}


def sample(count: int) -> tuple[Floats, dict[str, NDArray[Any]]]:
    rng = np.random.default_rng(7)
    xyz = rng.uniform(-40, 40, (count, 3)) + SHIFT
    attributes = {
        name: (rng.integers(0, 8, count) if dtype.kind in "ui" else rng.normal(size=count)).astype(dtype)
        for name, dtype in FIELDS.items()
    }
    # A source index does not fit into single precision.
    attributes["source_index"] += 2**40
    attributes["deviation"][::10] = np.nan
    return xyz, attributes


def write_all(path: Path, pieces: int = 1, count: int = 1_000) -> tuple[Floats, dict[str, NDArray[Any]]]:
    xyz, attributes = sample(count)
    with open_writer(path, FIELDS, shift=SHIFT) as writer:
        for part in np.array_split(np.arange(count), pieces):
            writer.write(xyz[part], {name: values[part] for name, values in attributes.items()})
    return xyz, attributes


@pytest.mark.parametrize("kind", FORMATS)
def test_what_is_written_is_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"cloud.{kind}"
    xyz, attributes = write_all(path)
    read = whole(list(read_scan(path)))
    np.testing.assert_allclose(read.xyz, xyz, rtol=0, atol=KEEPS_M[kind])
    for name, values in attributes.items():
        np.testing.assert_array_equal(read.attributes[0, name], values, err_msg=name)
    # A cloud of several scans stands for no scanner.
    assert read.origins == {0: None}


@pytest.mark.parametrize("kind", FORMATS)
def test_writing_in_pieces_writes_the_same(kind: str, tmp_path: Path) -> None:
    write_all(tmp_path / f"one.{kind}", 1)
    write_all(tmp_path / f"many.{kind}", 17)
    one, many = (whole(list(read_scan(tmp_path / f"{name}.{kind}"))) for name in ("one", "many"))
    assert_same(one, many)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_field_a_piece_lacks_is_zero_or_nan(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"cloud.{kind}"
    with open_writer(path, {"row": np.dtype("u2"), "deviation": np.dtype("f4")}) as writer:
        writer.write(np.zeros((2, 3)), {"row": np.array([4, 5])[:2].astype("u2")})
        writer.write(np.ones((1, 3)), {"deviation": np.array([0.5], "f4")})
    read = whole(list(read_scan(path))).attributes
    np.testing.assert_array_equal(read[0, "row"], [4, 5, 0])
    np.testing.assert_array_equal(read[0, "deviation"], [np.nan, np.nan, 0.5])


@pytest.mark.parametrize("kind", FORMATS)
def test_no_points_make_a_file_of_no_points(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"cloud.{kind}"
    with open_writer(path, FIELDS, shift=SHIFT) as writer:
        writer.write(np.empty((0, 3)), {})
    assert scan_info(path).points == 0
    assert not list(read_scan(path))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_failure_leaves_what_was_there(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"cloud.{kind}"
    write_all(path)
    before = path.read_bytes()
    xyz, attributes = sample(10)
    writer = open_writer(path, FIELDS)
    writer.write(xyz - SHIFT, attributes)
    writer.abort()
    with pytest.raises(ZeroDivisionError), open_writer(path, FIELDS, shift=SHIFT) as writer:
        writer.write(xyz / (1 // 0), attributes)
    with pytest.raises(InvalidGeometryError, match="not announced"), open_writer(path, FIELDS, shift=SHIFT) as writer:
        writer.write(xyz, {"colour": np.zeros(10)})
    with pytest.raises(InvalidGeometryError, match="must have shape"), open_writer(path, FIELDS, shift=SHIFT) as writer:
        writer.write(xyz, {"red": np.zeros(9, np.uint8)})
    with pytest.raises(InvalidGeometryError, match="announced as uint8"), open_writer(path, FIELDS) as writer:
        writer.write(xyz, {"red": np.zeros(10)})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_full_disk_is_one_line_and_leaves_nothing(kind: str, tmp_path: Path) -> None:
    with pytest.raises(OutputError) as caught, file_size_limit(20_000):
        write_all(tmp_path / f"cloud.{kind}", pieces=5, count=20_000)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", FORMATS)
def test_a_folder_that_is_not_there_is_one_line(kind: str, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No such file"):
        write_all(tmp_path / "nowhere" / f"cloud.{kind}")
