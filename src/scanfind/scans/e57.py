"""E57 in (ASTM E2807): several scans a file, each with its pose or none, read in chunks through libE57.

libE57 checks every page against its checksum and every read against its own bounds: 30,000 files with random bytes
changed and the checksums made right again gave errors, no crash and no hang. So it runs in this process. What it does
believe is the number of records, checked here, and the shape of the XML, checked in `e57_xml`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import Floats, PointChunk, ScanInfo, Station
from scanfind.errors import ScanfindError, UnreadableFileError
from scanfind.pose import Pose
from scanfind.scans.e57_xml import check_xml

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
NAMES: Mapping[str, str] = {
    "colorRed": "red",
    "colorGreen": "green",
    "colorBlue": "blue",
    "rowIndex": "row",
    "columnIndex": "column",
    "returnIndex": "return_number",
    "returnCount": "number_of_returns",
    "timeStamp": "gps_time",
    "normalX": "normal_x",
    "normalY": "normal_y",
    "normalZ": "normal_z",
}
NORMALS = ("normal_x", "normal_y", "normal_z")
# pye57 0.4.19 refuses numpy's int32 and fills only every other half of its int64 where that is a C long (Linux, macOS):
# all wide integers pass through C's long long, the same 64 bits by a name it understands.
WIDE = np.dtype(np.longlong)
# Our own extension: the fields E57 has no name for, and the mark of a cloud whose pose is a shift, not a station.
EXTENSION, EXTENSION_URI = "scanfind", "https://scanfind.org/e57/1.0"
MERGED = f"{EXTENSION}:merged"
# The buffers of a chunk take no more than this, however many fields a hostile prototype lists.
BLOCK_BYTES = 1 << 28
# Fields whose minimum is their maximum take no bytes: without a limit, an empty file could hold 2^63 equal points.
MOST_EQUAL_POINTS = 1_000_000
# No scanner reaches farther. A scan without a pose that lies wholly beyond was moved by its writer.
FARTHEST_M = 5_000.0


class Field(NamedTuple):
    """One field of a scan: name in the file, our name, dtype, bits in the file, what to add to the file's value."""

    element: str
    name: str
    dtype: np.dtype[Any]
    bits: int
    plus: int = 0

    @property
    def memory(self) -> np.dtype[Any]:
        """The dtype pye57 fills."""
        direct = self.dtype.kind == "f" or (self.dtype.itemsize <= 2 and not self.plus)
        return self.dtype if direct else WIDE


class Scan(NamedTuple):
    """One scan of a file. pose : scene_from_scan, None where the file has none; `points` is libE57's node."""

    name: str
    points: Any
    records: int
    fields: tuple[Field, ...]
    coordinates: tuple[str, str, str]
    pose: Pose | None
    origin: Floats | None
    bounds: Floats | None


def info(path: Path) -> ScanInfo:
    """What the file says of its scans; raises UnreadableFileError."""
    with _opened(path) as image:
        scans = _scans(image, path)
        crs = _text(image.root(), "coordinateMetadata")
    dtypes: dict[str, np.dtype[Any]] = {}
    for scan in scans:
        for field in _kept(scan):
            dtypes[field.name] = np.result_type(field.dtype, dtypes.get(field.name, field.dtype))
    return ScanInfo(
        path=str(path),
        format="E57",
        points=sum(scan.records for scan in scans),
        stations=tuple(Station(s.name, s.records, _triple(s.origin)) for s in scans),
        attributes={name: str(dtype) for name, dtype in dtypes.items()},
        bounds=_joint_bounds(scans),
        crs=crs or None,
    )


def read(path: Path, chunk_points: int) -> Iterator[PointChunk]:
    """Stream the valid points of all scans, poses applied, normals turned."""
    with _opened(path) as image:
        first = 0
        for number, scan in enumerate(_scans(image, path)):
            for done, columns in _columns(image, scan, chunk_points, path):
                chunk = _chunk(scan, number, first + done, columns)
                if len(chunk) or chunk.dropped:
                    yield chunk
            first += scan.records


def _columns(image: Any, scan: Scan, chunk_points: int, path: Path) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
    """(records before, element → values (N,)) chunk by chunk; the arrays are reused, so keep copies."""
    from pye57 import libe57

    if not scan.records:
        return
    capacity = min(chunk_points, scan.records, max(1, BLOCK_BYTES // sum(f.memory.itemsize for f in scan.fields)))
    buffers = libe57.VectorSourceDestBuffer()
    columns = {field.element: np.empty(capacity, field.memory) for field in scan.fields}
    for element, column in columns.items():
        buffers.append(libe57.SourceDestBuffer(image, element, column, capacity, True, True))
    reader = scan.points.reader(buffers)
    done = 0
    while done < scan.records:
        try:
            count = reader.read()
        except libe57.E57Exception as error:
            what = f"only {done:,} of the {scan.records:,} points of {scan.name!r} can be read"
            msg = f"{path.name} is damaged: {what} ({_first_line(error)})"
            raise UnreadableFileError(msg) from error
        if not count:
            msg = f"{path.name} is cut short: {scan.name!r} promises {scan.records:,} points, {done:,} are there"
            raise UnreadableFileError(msg)
        yield done, {element: column[:count] for element, column in columns.items()}
        done += count
    reader.close()


def _chunk(scan: Scan, number: int, first: int, columns: Mapping[str, NDArray[Any]]) -> PointChunk:
    a, b, c = (columns[element] for element in scan.coordinates)
    with np.errstate(over="ignore", invalid="ignore"):
        if scan.coordinates == SPHERICAL:
            a, b, c = a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)
        xyz = _placed(a, b, c, scan.pose)
        # One pass over the sums: none is finite where a coordinate is not.
        valid = np.isfinite(xyz[:, 0] + xyz[:, 1] + xyz[:, 2])
    if (state := columns.get(_state(scan))) is not None:
        # 1: only the direction is meaningful; 2: nothing is.
        valid &= state == 0
    some = slice(None) if valid.all() else valid
    attributes = {}
    for field in _kept(scan):
        values = columns[field.element][some]
        attributes[field.name] = (values + field.plus if field.plus else values).astype(field.dtype)
    if scan.pose and all(name in attributes for name in NORMALS):
        turned = scan.pose.turn(np.column_stack([attributes[name] for name in NORMALS]))
        attributes |= {n: turned[:, k].astype(attributes[n].dtype) for k, n in enumerate(NORMALS)}
    index = first + np.flatnonzero(valid)
    return PointChunk(xyz[some], attributes, index, number, scan.origin, int((~valid).sum()))


def _placed(a: Floats, b: Floats, c: Floats, pose: Pose | None) -> Floats:
    """Coordinates (N,) of a scan's own frame as points (N, 3) of the file's.

    Column by column: a product of matrices so narrow took as long as libE57 takes to read them.
    """
    xyz = np.empty((len(a), 3))
    for k, column in enumerate((a, b, c)):
        if pose is None:
            xyz[:, k] = column
            continue
        row, at = pose.rotation[k], pose.translation[k]
        along = row[0] * a
        along += row[1] * b
        along += row[2] * c
        along += at
        xyz[:, k] = along
    return xyz


def _state(scan: Scan) -> str:
    return "cartesianInvalidState" if scan.coordinates == CARTESIAN else "sphericalInvalidState"


def _kept(scan: Scan) -> list[Field]:
    """The fields that become attributes."""
    return [f for f in scan.fields if f.element not in scan.coordinates and f.element != _state(scan)]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file as libE57 sees it. Its nodes are untyped until touched: one that is not what it should be fails here."""
    from pye57 import libe57

    check_xml(path)
    image = None
    try:
        image = libe57.ImageFile(str(path), "r")
        yield image
    except (ScanfindError, MemoryError):
        raise
    except (libe57.E57Exception, TypeError, ValueError, LookupError, AttributeError, RuntimeError) as error:
        msg = f"{path.name} is damaged or not an E57 file: {_first_line(error)}"
        raise UnreadableFileError(msg) from error
    finally:
        if image is not None:
            image.close()


def _scans(image: Any, path: Path) -> list[Scan]:
    size = path.stat().st_size
    root = image.root()
    ours = any(image.extensionsUri(k) == EXTENSION_URI for k in range(image.extensionsCount()))
    return [_scan(node, k, ours, size, path.name) for k, node in enumerate(root["data3D"])]


def _scan(node: Any, number: int, ours: bool, size: int, name: str) -> Scan:
    """Check one scan's header against the file's size."""
    points = node["points"]
    records = points.childCount()
    fields = _fields(points)
    there = {field.element for field in fields}
    title = _text(node, "name") or f"scan {number}"
    coordinates = next((c for c in (CARTESIAN, SPHERICAL) if there.issuperset(c)), None)
    if coordinates is None:
        msg = f"{name}: {title!r} has neither cartesian nor spherical coordinates, only {', '.join(sorted(there))}"
        raise UnreadableFileError(msg)
    bits = sum(field.bits for field in fields)
    room = size * 8 // bits if bits else MOST_EQUAL_POINTS
    if not 0 <= records <= room:
        msg = f"{name} is damaged: {title!r} promises {records:,} points, the file has room for {room:,}"
        raise UnreadableFileError(msg)
    fields = tuple(f._replace(dtype=np.dtype("f8")) if f.element in coordinates else f for f in fields)
    pose = _pose(node, f"{name}: {title!r}")
    bounds = _bounds(node)
    origin = pose.translation.copy() if pose else None
    if pose is None and (coordinates == SPHERICAL or {"rowIndex", "columnIndex"} <= there):
        # One sweep of a scanner, in the scanner's own frame; other clouds without a pose are merged from several.
        origin = np.zeros(3) if bounds is None or _distance(bounds) < FARTHEST_M else None
    if ours and node.isDefined(MERGED):
        origin = None
    return Scan(title, points, records, fields, coordinates, pose, origin, bounds)


def _fields(points: Any) -> tuple[Field, ...]:
    """The numeric fields of a scan's prototype; texts and nested structures have no place in an array."""
    from pye57 import libe57

    prototype = libe57.StructureNode(points.prototype())
    fields: list[Field] = []
    for k in range(prototype.childCount()):
        node = prototype.get(k)
        element = node.elementName()
        local = element.rpartition(":")[2]
        name = NAMES.get(local, local)
        if any(name == field.name for field in fields):
            name = element.replace(":", "_")
        kind = node.type()
        if kind == libe57.NodeType.E57_FLOAT:
            single = libe57.FloatNode(node).precision() == libe57.FloatPrecision.E57_SINGLE
            fields.append(Field(element, name, np.dtype("f4" if single else "f8"), 32 if single else 64))
        elif kind in (libe57.NodeType.E57_INTEGER, libe57.NodeType.E57_SCALED_INTEGER):
            scaled = kind == libe57.NodeType.E57_SCALED_INTEGER
            number = libe57.ScaledIntegerNode(node) if scaled else libe57.IntegerNode(node)
            low, high = number.minimum(), number.maximum()
            # E57 counts returns from 0, everyone else from 1.
            plus = int(element == "returnIndex" and not scaled)
            dtype = np.dtype("f8") if scaled else _integer(low + plus, high + plus)
            fields.append(Field(element, name, dtype, (high - low).bit_length(), plus))
    return tuple(fields)


def _integer(low: int, high: int) -> np.dtype[Any]:
    """The smallest integer dtype that holds both."""
    for dtype in (np.uint8, np.int8, np.uint16, np.int16, np.uint32, np.int32):
        if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max:
            return np.dtype(dtype)
    return np.dtype(np.int64)


def _pose(node: Any, what: str) -> Pose | None:
    """A scan's pose; one without a rotation only moves."""
    if not node.isDefined("pose"):
        return None
    w, x, y, z = (_number(node, f"pose/rotation/{part}", float(part == "w")) for part in "wxyz")
    translation = np.array([_number(node, f"pose/translation/{part}", 0.0) for part in "xyz"])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not np.isfinite(translation).all() or not math.isfinite(length) or length < 1e-6:
        msg = f"{what} has an impossible pose: rotation {w} {x} {y} {z}, translation {translation.tolist()}"
        raise UnreadableFileError(msg)
    w, x, y, z = w / length, x / length, y / length, z / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return Pose(rotation, translation)


def _bounds(node: Any) -> Floats | None:
    """((min x, y, z), (max x, y, z)) in the scan's own frame, (2, 3); None where absent or impossible."""
    ends = [[_number(node, f"cartesianBounds/{a}{end}", math.nan) for a in "xyz"] for end in ("Minimum", "Maximum")]
    bounds = np.array(ends)
    return bounds if np.isfinite(bounds).all() and (bounds[0] <= bounds[1]).all() else None


def _distance(bounds: Floats) -> float:
    """From the frame's origin to a box (2, 3), metres."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(bounds[0], -bounds[1]))))


def _joint_bounds(scans: list[Scan]) -> tuple[tuple[float, float, float], tuple[float, float, float]] | None:
    """The box around the boxes of all scans. None where one has no box, or has a pose: the standard wants boxes in the
    scan's own frame, pye57 writes them in the file's.
    """
    boxes = [scan.bounds for scan in scans if scan.bounds is not None and scan.pose is None]
    if not boxes or len(boxes) < len(scans):
        return None
    low, high = np.min(boxes, axis=0)[0].tolist(), np.max(boxes, axis=0)[1].tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def _number(node: Any, where: str, otherwise: float) -> float:
    if not node.isDefined(where):
        return otherwise
    found = node
    for part in where.split("/"):
        found = found[part]
    return float(found.scaledValue() if hasattr(found, "scaledValue") else found.value())


def _text(node: Any, where: str) -> str:
    return str(node[where].value()).strip() if node.isDefined(where) else ""


def _triple(point: Floats | None) -> tuple[float, float, float] | None:
    return None if point is None else (float(point[0]), float(point[1]), float(point[2]))


def _first_line(error: Exception) -> str:
    """libE57's messages go on with its own source lines."""
    return (str(error).splitlines() or [type(error).__name__])[0]
