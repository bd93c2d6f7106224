"""E57 out, streamed through libE57, in double precision, every field kept: one merged scan, or one a station.

Of a merged scan, coordinates are written less the shift, and the scan's pose brings them back: readers that hold local
coordinates in single precision keep their digits. So that nobody takes that pose for a scanner's position, the scan
says `merged` in our extension, and row and column are written there too: a cloud of several scans is no grid.
"""

from __future__ import annotations

import re
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import Floats
from scanfind.pose import Pose
from scanfind.scans.e57 import CARTESIAN, EXTENSION, EXTENSION_URI, MERGED, WIDE
from scanfind.scans.output import CloudFile, Columns

NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
ELEMENTS = {
    "intensity": "intensity",
    "red": "colorRed",
    "green": "colorGreen",
    "blue": "colorBlue",
    "return_number": "returnIndex",
    "number_of_returns": "returnCount",
    "gps_time": "timeStamp",
    "normal_x": "nor:normalX",
    "normal_y": "nor:normalY",
    "normal_z": "nor:normalZ",
}
# Only a scan of one station is a grid that E57's own names may count.
RASTER = {"row": "rowIndex", "column": "columnIndex"}
BUFFER_POINTS = 65_536


class Writer(CloudFile):
    """An E57 file being written: one scan, its pose the shift."""

    named: ClassVar[Mapping[str, str]] = ELEMENTS

    def _begin(self) -> None:
        from pye57 import libe57

        self.part.open("wb").close()
        self._in_scan = False
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._darkest, self._brightest = np.inf, -np.inf
        with _failing_as_os_error():
            self._image = libe57.ImageFile(str(self.part), "w")
            self._scans = self._headers()
            self._elements = _elements(self.fields, self.named)
            self._buffers: dict[str, NDArray[Any]] = {
                name: np.empty(BUFFER_POINTS, np.float64) for name in CARTESIAN
            } | {name: np.empty(BUFFER_POINTS, _memory(dtype)) for name, dtype in self.fields.items()}
            self._first_scan()

    def _first_scan(self) -> None:
        self._open_scan(self.path.stem, Pose(np.eye(3), self.shift), merged=True)

    def _append(self, xyz: Floats, columns: Columns) -> None:
        local = self._scan_from_scene.move(xyz)
        self._low, self._high = np.minimum(self._low, local.min(axis=0)), np.maximum(self._high, local.max(axis=0))
        intensity = columns.get("intensity", np.empty(0))
        if (known := intensity[np.isfinite(intensity)]).size:
            self._darkest = min(self._darkest, float(known.min()))
            self._brightest = max(self._brightest, float(known.max()))
        # Returns are counted from 0 in E57.
        if "return_number" in columns:
            columns = columns | {"return_number": columns["return_number"].astype(np.int64) - 1}
        for first in range(0, len(xyz), BUFFER_POINTS):
            part = slice(first, first + BUFFER_POINTS)
            count = len(xyz[part])
            for axis, element in enumerate(CARTESIAN):
                self._buffers[element][:count] = local[part, axis]
            for name, values in columns.items():
                self._buffers[name][:count] = values[part]
            with _failing_as_os_error():
                self._points.write(count)

    def _finish(self) -> None:
        with _failing_as_os_error():
            self._close_scan()
            self._image.close()

    def _discard(self) -> None:
        self._image.cancel()

    def _headers(self) -> Any:
        """The file's root, and the list its scans go to."""
        from pye57 import libe57

        image, root = self._image, self._image.root()
        image.extensionsAdd("", libe57.E57_V1_0_URI)
        image.extensionsAdd("nor", NORMALS_URI)
        image.extensionsAdd(EXTENSION, EXTENSION_URI)
        root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
        root.set("guid", libe57.StringNode(image, f"{{{uuid.uuid4()}}}"))
        root.set("versionMajor", libe57.IntegerNode(image, libe57.E57_FORMAT_MAJOR))
        root.set("versionMinor", libe57.IntegerNode(image, libe57.E57_FORMAT_MINOR))
        root.set("e57LibraryVersion", libe57.StringNode(image, libe57.E57_LIBRARY_ID))
        root.set("coordinateMetadata", libe57.StringNode(image, self.crs or ""))
        scans = libe57.VectorNode(image, True)
        root.set("data3D", scans)
        root.set("images2D", libe57.VectorNode(image, True))
        return scans

    def _open_scan(self, name: str, scene_from_scan: Pose, *, merged: bool) -> None:
        """Begin a scan; a merged one without a shift has no pose."""
        from pye57 import libe57

        image = self._image
        scan = libe57.StructureNode(image)
        self._scans.append(scan)
        scan.set("guid", libe57.StringNode(image, f"{{{uuid.uuid4()}}}"))
        scan.set("name", libe57.StringNode(image, name))
        if merged:
            scan.set(MERGED, libe57.IntegerNode(image, 1, 0, 1))
        if not merged or scene_from_scan.translation.any():
            pose = libe57.StructureNode(image)
            pose.set("rotation", self._structure(scene_from_scan.quaternion()))
            translation = dict(zip("xyz", scene_from_scan.translation.tolist(), strict=True))
            pose.set("translation", self._structure(translation))
            scan.set("pose", pose)
        if "red" in self.fields:
            top = float(np.iinfo(self.fields["red"]).max) if self.fields["red"].kind in "ui" else 1.0
            colours = ("Red", "Green", "Blue")
            limits = {f"color{c}{end}": value for c in colours for end, value in (("Minimum", 0.0), ("Maximum", top))}
            scan.set("colorLimits", self._structure(limits))
        self._scan, self._scan_from_scene = scan, scene_from_scan.inverse()
        # libE57 crashes where an open writer of points dies before its file: nothing may touch this name earlier.
        self._points, self._in_scan = self._open_points(), True
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._darkest, self._brightest = np.inf, -np.inf

    def _close_scan(self) -> None:
        """Complete the scan that is being written, if there is one, with what its points told."""
        if not self._in_scan:
            return
        self._points.close()
        self._in_scan = False
        if (self._low <= self._high).all():
            low, high = zip("xyz", self._low, strict=True), zip("xyz", self._high, strict=True)
            ends = {f"{axis}Minimum": value for axis, value in low}
            ends |= {f"{axis}Maximum": value for axis, value in high}
            self._scan.set("cartesianBounds", self._structure(ends))
        if self._darkest <= self._brightest:
            limits = {"intensityMinimum": self._darkest, "intensityMaximum": self._brightest}
            self._scan.set("intensityLimits", self._structure(limits))

    def _open_points(self) -> Any:
        """Attach the points and open them for writing; libE57 does not need their number."""
        from pye57 import libe57

        image = self._image
        prototype = libe57.StructureNode(image)
        buffers = libe57.VectorSourceDestBuffer()
        elements = dict(zip(CARTESIAN, CARTESIAN, strict=True)) | self._elements
        for name, buffer in self._buffers.items():
            prototype.set(elements[name], self._prototype(name))
            buffers.append(libe57.SourceDestBuffer(image, elements[name], buffer, BUFFER_POINTS, True, True))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        self._scan.set("points", points)
        return points.writer(buffers)

    def _prototype(self, name: str) -> Any:
        """The node that says how a field is stored: as its dtype, with the dtype's bounds."""
        from pye57 import libe57

        dtype = _memory(self.fields.get(name, np.dtype(np.float64)))
        if dtype.kind == "f":
            single = dtype.itemsize == 4
            precision = libe57.FloatPrecision.E57_SINGLE if single else libe57.FloatPrecision.E57_DOUBLE
            return libe57.FloatNode(self._image, 0.0, precision)
        bounds = np.iinfo(self.fields[name]) if self.fields[name].kind in "ui" else np.iinfo(np.uint8)
        low, high = int(bounds.min), min(int(bounds.max), 2**63 - 1)
        less = int(name == "return_number")
        return libe57.IntegerNode(self._image, 0, max(low - less, -(2**63)), high - less)

    def _structure(self, numbers: dict[str, float]) -> Any:
        from pye57 import libe57

        node = libe57.StructureNode(self._image)
        for name, value in numbers.items():
            node.set(name, libe57.FloatNode(self._image, float(value)))
        return node


class StationsWriter(Writer):
    """An E57 file being written: a scan a station, each with its pose; see `StationsFile`."""

    named: ClassVar[Mapping[str, str]] = ELEMENTS | RASTER

    def _first_scan(self) -> None:
        """There is none before `station` is called."""

    def station(self, name: str, pose: Pose, raster: tuple[int, int]) -> None:
        """Begin a station's scan."""
        with self._failures(), _failing_as_os_error():
            self._close_scan()
            self._open_scan(name, pose, merged=False)


def _memory(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The dtype in which libE57 is given a field."""
    if dtype.kind == "f":
        return np.dtype(np.float64 if dtype.itemsize == 8 else np.float32)
    return WIDE


def _elements(names: Iterable[str], named: Mapping[str, str]) -> dict[str, str]:
    """Attribute name → element name: as `named` has it, else in our extension, spelled as XML allows."""
    elements: dict[str, str] = {}
    for name in names:
        spelled = re.sub(r"[^A-Za-z0-9_]", "_", name)
        spelled = spelled if re.match(r"[A-Za-z_]", spelled) else f"_{spelled}"
        element, number = named.get(name, f"{EXTENSION}:{spelled}"), 1
        while element in elements.values():
            number += 1
            element = f"{EXTENSION}:{spelled}_{number}"
        elements[name] = element
    return elements


@contextmanager
def _failing_as_os_error() -> Iterator[None]:
    """Have a full disk reported as such: libE57 knows only its own kind of error."""
    from pye57 import libe57

    try:
        yield
    except libe57.E57Exception as error:
        raise OSError((str(error).splitlines() or ["libE57 failed"])[0]) from error
