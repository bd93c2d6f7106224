"""LAS 1.4 and LAZ out, streamed through laspy: point format 6, 7 with colour, 8 with near infrared as well."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import Floats, shift_for
from scanfind.errors import OutputError
from scanfind.scans.las_header import EXACT, GEO_KEYS, GEOGRAPHIC_CRS, PROJECTED_CRS, WKT
from scanfind.scans.output import CloudFile, Columns

# A tenth of a millimetre; 32 bits of it reach 214 km either side of the offset.
SCALE_M = 1e-4
NAME_BYTES = 32
# An extra bytes record describes a dimension in 192 bytes and holds 65,535.
MOST_EXTRA = 341
RGB = {"red", "green", "blue"}


class Writer(CloudFile):
    """A LAS or LAZ file being written, by its suffix.

    A field with a name of the point format goes there if its dtype fits. What does not fit, and every other field,
    is kept exactly in extra bytes; a misfit leaves a rounded copy in the format's own place, for viewers.
    """

    def _begin(self) -> None:
        self._file = self.part.open("wb")
        self._las: Any = None

    def _append(self, xyz: Floats, columns: Columns) -> None:
        from laspy import ScaleAwarePointRecord

        if self._las is None:
            self._open(self.shift if self.shift.any() else shift_for(xyz[0]))
        steps = np.rint((xyz - self._las.header.offsets) / SCALE_M)
        if not (np.abs(steps) < 2**31).all():
            msg = f"cannot write {self.path.name}: LAS keeps {SCALE_M} m within 214 km of {self._las.header.offsets}"
            raise OutputError(msg)
        record = ScaleAwarePointRecord.zeros(len(xyz), header=self._las.header)
        for axis, name in enumerate("XYZ"):
            record[name] = steps[:, axis].astype(np.int32)
        for name, values in columns.items():
            if name in self._standard:
                record[name] = _fitted(values, self._standard[name])
            if name in self._extra:
                record[self._extra[name]] = values.astype(_stored(values.dtype), copy=False)
        with _failing_as_os_error():
            self._las.write_points(record)

    def _finish(self) -> None:
        if self._las is None:
            self._open(self.shift)
        with _failing_as_os_error():
            self._las.close()

    def _discard(self) -> None:
        self._file.close()

    def _open(self, offset: Floats) -> None:
        """Write the header: only now is the offset known."""
        import laspy
        from laspy.vlrs.vlr import VLR

        names = set(self.fields)
        header = laspy.LasHeader(version="1.4", point_format=8 if "nir" in names else 7 if RGB & names else 6)
        header.scales = np.full(3, SCALE_M)
        header.offsets = offset
        header.generating_software = "scanfind"
        dimensions = {d.name: d for d in header.point_format.standard_dimensions if d.name not in "XYZ"}
        self._standard = {name: d for name, d in dimensions.items() if name in names}
        self._extra: dict[str, str] = {}
        for name, dtype in self.fields.items():
            if name not in dimensions:
                self._extra[name] = _free_name(name, {*dimensions, *"XYZ", *self._extra.values()})
            elif not np.can_cast(dtype, np.uint8 if dimensions[name].num_bits < 8 else dimensions[name].dtype, "safe"):
                self._extra[name] = name + EXACT
        if len(self._extra) > MOST_EXTRA:
            msg = f"cannot write {self.path.name}: LAS has room for {MOST_EXTRA} extra fields, not {len(self._extra)}"
            raise OutputError(msg)
        header.add_extra_dims(
            [laspy.ExtraBytesParams(stored, _stored(self.fields[name])) for name, stored in self._extra.items()]
        )
        if self.crs:
            number, data = _crs_record(self.crs)
            header.vlrs.append(VLR("LASF_Projection", number, "coordinate system", data))
            header.global_encoding.wkt = number == WKT
        with _failing_as_os_error():
            self._las = laspy.LasWriter(self._file, header, do_compress=self.path.suffix.lower() == ".laz")


def _stored(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The extra bytes type that holds a dtype: LAS knows neither truth values nor half floats."""
    return np.dtype({"?": np.uint8, "e": np.float32}.get(dtype.char, dtype))


def _fitted(values: NDArray[Any], dimension: Any) -> NDArray[Any]:
    """The values as near as a dimension of the point format can have them."""
    if dimension.dtype is not None and dimension.dtype.kind == "f":
        return values.astype(dimension.dtype, copy=False)
    if values.dtype.kind == "f":
        values = np.nan_to_num(values)
        # A share, as E57 has intensities: rounded to 0 and 1 it would show black in every viewer.
        shares = len(values) > 0 and values.min() >= 0.0 and values.max() <= 1.0
        values = np.rint(values * dimension.max if shares and dimension.max > 255 else values)
    whole = values
    fitted: NDArray[Any] = np.clip(whole, dimension.min, dimension.max).astype(dimension.dtype or np.uint8)
    return fitted


def _free_name(name: str, taken: set[str]) -> str:
    """`name` cut to what LAS allows, numbered where the cut made two alike."""
    # NumPy hands out no buffer of records with a colon in a field's name.
    allowed = name.replace(":", "_").replace("\0", "_") or "unnamed"
    number = 1
    while True:
        end = "" if number == 1 else f"_{number}"
        short = allowed.encode()[: NAME_BYTES - len(end)].decode(errors="ignore") + end
        if short not in taken:
            return short
        number += 1


def _crs_record(crs: str) -> tuple[int, bytes]:
    """Record number and data of a CRS: WKT as it is, or the two GeoTIFF keys that say EPSG:nnnn."""
    if not crs.startswith("EPSG:"):
        return WKT, crs.encode() + b"\0"
    code = int(crs.removeprefix("EPSG:"))
    # EPSG gives the numbers from 4000 to 4999 to geographic systems.
    geographic = 4000 <= code < 5000
    kind, key = (2, GEOGRAPHIC_CRS) if geographic else (1, PROJECTED_CRS)
    return GEO_KEYS, struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, kind, key, 0, 1, code)


@contextmanager
def _failing_as_os_error() -> Iterator[None]:
    """Have a full disk reported as such: lazrs knows only its own kind of error."""
    import lazrs

    try:
        yield
    except lazrs.LazrsError as error:
        raise OSError(str(error)) from error
