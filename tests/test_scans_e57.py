"""E57: against pye57 where pye57 can, and files built here where no writer would."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.errors import ScanfindError, UnreadableFileError
from scanfind.pose import Pose
from scanfind.scans import open_writer, read_scan, scan_info

CRY = "formats/e57_cry-inc/testdata/"
PUMP = "pump_e57/pumpAVisualReferenceImage.e57"


def points_or_line(path: Path) -> int | str:
    """The number of valid points, header and chunks agreeing on all, or the error."""
    line = ""
    try:
        chunks = list(read_scan(path, chunk_points=100_000))
        assert sum(len(chunk) + chunk.dropped for chunk in chunks) == scan_info(path).points
    except ScanfindError as error:
        line = str(error)
    assert "\n" not in line
    return line or sum(len(chunk) for chunk in chunks)


def test_every_file_gives_its_points_or_one_line(shared_data: Path) -> None:
    formats = shared_data / "formats"
    expected: dict[str, int | str] = {}
    for line in (formats / "e57_check.txt").read_text().splitlines():
        name, said = re.fullmatch(r"(.*?\.e57) (.*)", line).groups()  # type: ignore[union-attr]
        # Where pye57 fails to read no records at all, no points is what is true.
        expected[name] = -1 if "OPEN-ERR" in said else sum(int(n) for n in re.findall(r"'(\d+)pt'", said))
    expected["../" + PUMP] = expected.pop("e57_pye57/pumpAVisualReferenceImage.e57")
    found: dict[str, int | str] = {}
    for name in expected:
        result = points_or_line(formats / name)
        found[name] = -1 if isinstance(result, str) and "checksum mismatch" in result else result
    assert found == expected
    assert {p.name for p in formats.rglob("*.e57")} <= {Path(name).name for name in expected}


def test_the_pump_room_is_as_pye57_reads_it(shared_data: Path) -> None:
    import pye57

    with pye57.E57(str(shared_data / PUMP)) as file:
        truth = file.read_scan(0, colors=True, intensity=True, row_column=True, ignore_missing_fields=True)
    (chunk,) = read_scan(shared_data / PUMP)
    np.testing.assert_array_equal(chunk.xyz, np.column_stack([truth[f"cartesian{axis}"] for axis in "XYZ"]))
    names = {"colorRed": "red", "colorGreen": "green", "colorBlue": "blue", "rowIndex": "row", "columnIndex": "column"}
    for theirs, ours in names.items():
        np.testing.assert_array_equal(chunk.attributes[ours], truth[theirs])
    np.testing.assert_allclose(chunk.attributes["intensity"], truth["intensity"], rtol=1e-6)
    # One sweep without a pose: its own frame is the scanner's.
    np.testing.assert_array_equal(chunk.origin, [0, 0, 0])


def test_spherical_coordinates_and_invalid_points(shared_data: Path) -> None:
    (chunk,) = read_scan(shared_data / CRY / "tiny_spherical.e57")
    assert (len(chunk), chunk.dropped) == (180, 180)
    # Its writer put the points one metre away on a circle.
    np.testing.assert_allclose(np.linalg.norm(chunk.xyz, axis=1), 1.0, atol=1e-6)
    assert "sphericalRange" not in chunk.attributes
    assert chunk.origin is not None
    (single,) = read_scan(shared_data / CRY / "cartesian_invalid_state_single.e57")
    assert (len(single), single.dropped) == (1, 2)
    assert single.origin is None


def test_a_pose_may_lack_its_rotation(shared_data: Path) -> None:
    (chunk,) = read_scan(shared_data / "formats/e57_pye57/translationWithoutRotation.e57")
    np.testing.assert_array_equal(chunk.origin, [4, 5, 6])


# ── files built here: a small real one, its XML edited, its checksums made right again ──

PAGE, PAYLOAD = 1024, 1020
CRC32C = [0] * 256
for _k in range(256):
    _c = _k
    for _ in range(8):
        _c = (_c >> 1) ^ (0x82F63B78 if _c & 1 else 0)
    CRC32C[_k] = _c


def checksum(page: bytes) -> bytes:
    value = 0xFFFFFFFF
    for byte in page:
        value = CRC32C[(value ^ byte) & 255] ^ (value >> 8)
    return (value ^ 0xFFFFFFFF).to_bytes(4, "big")


def with_checksums(file: bytes) -> bytes:
    """The same file with the checksum of each page made right."""
    pages = (file[at : at + PAYLOAD] for at in range(0, len(file) // PAGE * PAGE, PAGE))
    return b"".join(page + checksum(page) for page in pages)


class Template:
    """A small real file taken apart: what lies before its XML, and its XML."""

    def __init__(self, path: Path) -> None:
        file = path.read_bytes()
        self.logical = b"".join(file[at : at + PAYLOAD] for at in range(0, len(file), PAGE))
        physical, length = struct.unpack_from("<2Q", file, 24)
        self.start = physical // PAGE * PAYLOAD + physical % PAGE
        self.xml = self.logical[self.start :][:length]

    def file(self, xml: bytes) -> bytes:
        """The file with another XML."""
        logical = bytearray(self.logical[: self.start] + xml)
        logical += bytes(-len(logical) % PAYLOAD)
        start = self.start // PAYLOAD * PAGE + self.start % PAYLOAD
        struct.pack_into("<3Q", logical, 16, len(logical) // PAYLOAD * PAGE, start, len(xml))
        pages = (bytes(logical[at : at + PAYLOAD]) for at in range(0, len(logical), PAYLOAD))
        return b"".join(page + checksum(page) for page in pages)


@pytest.fixture(scope="module")
def template(shared_data: Path) -> Template:
    return Template(shared_data / CRY / "scaled_integer_intensity.e57")


POSE = b"""<pose type="Structure"><rotation type="Structure"><w type="Float">%f</w><x type="Float">%f</x>
<y type="Float">%f</y><z type="Float">%f</z></rotation><translation type="Structure"><x type="Float">%f</x>
<y type="Float">%f</y><z type="Float">%f</z></translation></pose>"""


def test_the_template_survives_being_taken_apart(template: Template, tmp_path: Path) -> None:
    path = tmp_path / "same.e57"
    path.write_bytes(template.file(template.xml))
    assert points_or_line(path) == 2


def test_a_pose_moves_points_and_turns_normals(shared_data: Path, tmp_path: Path) -> None:
    template = Template(shared_data / "formats/e57_pye57/testWithNormals.e57")
    path = tmp_path / "posed.e57"
    path.write_bytes(template.file(template.xml))
    (local,) = read_scan(path)
    assert local.origin is None
    pose = Pose.from_rotation_vector([0.3, -0.8, 1.9], [100.0, -20.0, 3.0])
    q = pose.quaternion()
    # Not of length one: writers round.
    numbers = (*(2 * q[part] for part in "wxyz"), *pose.translation)
    path.write_bytes(template.file(template.xml.replace(b"<points ", POSE % numbers + b"<points ", 1)))
    (posed,) = read_scan(path)
    np.testing.assert_allclose(posed.xyz, pose.move(local.xyz), atol=1e-4)
    normals, turned = (
        np.column_stack([chunk.attributes[f"normal_{axis}"] for axis in "xyz"]) for chunk in (local, posed)
    )
    np.testing.assert_allclose(turned, pose.turn(normals), atol=1e-5)
    assert posed.origin is not None
    np.testing.assert_allclose(posed.origin, pose.translation, atol=1e-6)


COUNT = b'recordCount="2"'
CONSTANT = re.compile(rb"<(cartesian.|intensity|cartesianInvalidState) type=[^>]*/>")


def nested(xml: bytes) -> bytes:
    return xml.replace(b"<data3D", b'<a type="Structure">' * 200_000 + b"</a>" * 200_000 + b"<data3D")


def broad(xml: bytes) -> bytes:
    children = b"".join(b'<a%d type="Integer"/>' % k for k in range(50_000))
    return xml.replace(b"<data3D", children + b"<data3D")


def equal(xml: bytes) -> bytes:
    constant = CONSTANT.sub(rb'<\1 type="Integer" minimum="5" maximum="5">5</\1>', xml)
    return constant.replace(COUNT, b'recordCount="4000000000000000000"')


def entities(xml: bytes) -> bytes:
    steps = b"".join(b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (97 + k) * 10) for k in range(9))
    bomb = b'<!DOCTYPE e57Root [<!ENTITY a "aaaaaaaaaa">' + steps + b"]><e57Root"
    return xml.replace(b"<e57Root", bomb, 1).replace(b"<data3D", b'<x type="String">&i;</x><data3D')


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda xml: xml.replace(COUNT, b'recordCount="9223372036854775807"'), "promises 9,223,372,036,854,775,807"),
        (lambda xml: xml.replace(COUNT, b'recordCount="-1"'), "promises -1 points"),
        (lambda xml: xml.replace(COUNT, b'recordCount="1000"'), "promises 1,000 points, the file has room for 79"),
        (lambda xml: xml.replace(COUNT, b'recordCount="3"'), "of the 3 points"),
        (equal, "promises 4,000,000,000,000,000,000 points"),
        (nested, "nested 64 deep"),
        (broad, "1000 children"),
        (entities, "damaged"),
        (lambda xml: xml.replace(b"cartesianZ", b"cartesianW"), "neither cartesian nor spherical"),
        (lambda xml: xml.replace(b"data3D", b"data4D"), "not defined"),
        (lambda xml: xml.replace(b"</e57Root>", b""), "not well formed"),
        (lambda xml: xml.replace(b'fileOffset="48"', b'fileOffset="4611686018427387904"'), "damaged"),
        (lambda xml: xml.replace(b"<points ", POSE % (0, 0, 0, 0, 1, 2, 3) + b"<points "), "impossible pose"),
    ],
)
def test_a_hostile_header_is_one_line(
    edit: Callable[[bytes], bytes], said: str, template: Template, tmp_path: Path
) -> None:
    path = tmp_path / "hostile.e57"
    path.write_bytes(template.file(edit(template.xml)))
    with pytest.raises(UnreadableFileError, match=said) as caught:
        list(read_scan(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("at", [16, 24, 32, 40])
@pytest.mark.parametrize("number", [0, 2**31, 2**63, 2**64 - 1])
def test_a_hostile_file_header_is_one_line(at: int, number: int, template: Template, tmp_path: Path) -> None:
    content = bytearray(template.file(template.xml))
    struct.pack_into("<Q", content, at, number)
    path = tmp_path / "hostile.e57"
    path.write_bytes(with_checksums(bytes(content)))
    assert isinstance(points_or_line(path), str)


def test_a_scan_of_one_sweep_far_from_its_own_origin_was_moved(shared_data: Path, tmp_path: Path) -> None:
    template = Template(shared_data / PUMP)
    path = tmp_path / "moved.e57"
    far = re.sub(rb"(<x(Min|Max)imum[^>]*>)[^<]*", rb"\g<1>500000.0", template.xml)
    path.write_bytes(template.file(far))
    assert scan_info(path).stations[0].origin is None


SEEDS = ["tiny_pc_with_extension.e57", "scaled_integer_intensity.e57", "original_guids.e57", "integer_intensity.e57"]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), name=st.sampled_from(SEEDS), honest=st.booleans())
def test_random_damage_is_points_or_one_line(
    data: st.DataObject, name: str, honest: bool, shared_data: Path, tmp_path: Path
) -> None:
    """Half of it with right checksums: then libE57 has to believe what it reads."""
    content = bytearray((shared_data / CRY / name).read_bytes())
    for at, value in data.draw(
        st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)), min_size=1, max_size=5)
    ):
        content[at] = value
    path = tmp_path / name
    path.write_bytes(with_checksums(bytes(content)) if honest else bytes(content))
    points_or_line(path)


def test_wide_integers_survive(tmp_path: Path) -> None:
    """pye57 takes numpy's int64 for 32 bits where it is a C long; ours must not."""
    edges: dict[str, NDArray[Any]] = {
        "a": np.array([-(2**63), 0, 2**63 - 1], np.int64),
        "b": np.array([-(2**31), 1, 2**31 - 1], np.int32),
        "c": np.array([0, 2**31, 2**32 - 1], np.uint32),
        "d": np.array([-128, 0, 127], np.int8),
        "e": np.array([0, 40_000, 65_535], np.uint16),
    }
    path = tmp_path / "wide.e57"
    with open_writer(path, {name: values.dtype for name, values in edges.items()}) as writer:
        writer.write(np.eye(3), edges)
    for chunk_points in (3, 1):
        chunks = list(read_scan(path, chunk_points=chunk_points))
        for name, values in edges.items():
            read = np.concatenate([chunk.attributes[name] for chunk in chunks])
            assert read.dtype == values.dtype
            np.testing.assert_array_equal(read, values)


def test_names_that_xml_does_not_allow_are_spelled_otherwise(tmp_path: Path) -> None:
    fields = {name: np.array([k], np.uint8) for k, name in enumerate(["größe", "1st", "a b", "a-b", "row"])}
    path = tmp_path / "names.e57"
    with open_writer(path, {name: np.dtype("u1") for name in fields}) as writer:
        writer.write(np.zeros((1, 3)), fields)
    (chunk,) = read_scan(path)
    assert {name: int(values[0]) for name, values in chunk.attributes.items()} == {
        "gr__e": 0,
        "_1st": 1,
        "a_b": 2,
        "a_b_2": 3,
        "row": 4,
    }


def test_the_shift_is_in_the_pose_and_is_no_station(tmp_path: Path) -> None:
    import pye57

    shift = np.array([5_000_000.0, 400_000.0, 0.0])
    path = tmp_path / "shifted.e57"
    with open_writer(path, {"intensity": np.dtype("f4")}, shift=shift, crs="LOCAL_CS[]") as writer:
        writer.write([shift + np.array([1.5, 2.5, 3.5])], {"intensity": np.array([0.5], "f4")})
    with pye57.E57(str(path)) as file:
        np.testing.assert_array_equal(file.get_header(0).translation, shift)
        raw = file.read_scan(0, transform=False, intensity=True, ignore_missing_fields=True)
    assert (raw["cartesianX"][0], raw["cartesianZ"][0], raw["intensity"][0]) == (1.5, 3.5, 0.5)
    info = scan_info(path)
    assert (info.stations[0].origin, info.crs) == (None, "LOCAL_CS[]")


@pytest.mark.parametrize(
    ("values", "limits"),
    [
        (np.array([7, 300, 20], np.uint16), [7, 300]),
        (np.array([np.nan, -np.inf, 0.5], np.float32), [0.5, 0.5]),
        (np.full(3, np.nan, np.float64), None),
    ],
)
def test_intensity_limits_are_those_of_the_finite_values(
    values: NDArray[Any], limits: list[float] | None, tmp_path: Path
) -> None:
    import pye57

    path = tmp_path / "bright.e57"
    with open_writer(path, {"intensity": values.dtype}) as writer:
        for k in range(3):
            writer.write(np.zeros((1, 3)), {"intensity": values[k : k + 1]})
    (chunk,) = read_scan(path)
    np.testing.assert_array_equal(chunk.attributes["intensity"], values)
    with pye57.E57(str(path)) as file:
        header = file.get_header(0)
        if limits is None:
            assert "intensityLimits" not in header.scan_fields
        else:
            assert [header.intensityMinimum, header.intensityMaximum] == limits
