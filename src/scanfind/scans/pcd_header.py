"""The header of a PCD file (PCL's Point Cloud Data, versions .5 to .7)."""

from __future__ import annotations

import math
import os
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from scanfind.errors import UnreadableFileError
from scanfind.scans.fields import attribute_columns, axes
from scanfind.scans.records import cut_short, header_lines, whole_number

KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
TYPES = {(kind, str(size)): f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {
    ("F", "4"): "<f4",
    ("F", "8"): "<f8",
}
ENCODINGS = ("ascii", "binary", "binary_compressed")
NO_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
# A histogram of features has 308 numbers a point; a header that promises millions is hostile.
MOST_COLUMNS = 10_000


class Column(NamedTuple):
    """One number of a point; a field of several numbers is several columns."""

    name: str
    dtype: np.dtype[Any]
    is_padding: bool


class PcdHeader(NamedTuple):
    """What the header says, proven possible.

    encoding : one of ENCODINGS
    xyz : the columns that are the coordinates
    packed : the column that holds colours of 8 bits in one number, if there is one
    attributes : column → attribute name, for the others
    origin : where the sensor stood, metres; None where the file does not say
    lines : how many lines the header has
    """

    encoding: str
    points: int
    columns: tuple[Column, ...]
    xyz: tuple[int, int, int]
    packed: int | None
    attributes: dict[int, str]
    origin: tuple[float, float, float] | None
    lines: int

    @property
    def has_alpha(self) -> bool:
        """Whether the packed colours have an opacity."""
        return self.packed is not None and self.columns[self.packed].name == "rgba"

    def record(self) -> np.dtype[Any]:
        """One point as the file stores it; the fields are numbered, because names may repeat."""
        return np.dtype([(str(k), column.dtype) for k, column in enumerate(self.columns)])


def read_header(file: BinaryIO, name: str) -> PcdHeader:
    """Read and check the header, and leave `file` at the data; raises UnreadableFileError."""
    entries: dict[str, list[str]] = {}
    lines = 0
    for words in header_lines(file, name, "DATA"):
        lines += 1
        if not words or words[0].startswith("#"):
            continue
        key = "FIELDS" if words[0] == "COLUMNS" else words[0]
        if key not in KEYS:
            msg = f"{name} is damaged or not a PCD file: header line {lines} is {' '.join(words)[:80]!r}"
            raise UnreadableFileError(msg)
        entries[key] = words[1:]
    if missing := [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH") if not entries.get(key)]:
        msg = f"{name} is damaged: its header has no {missing[0]}"
        raise UnreadableFileError(msg)
    encoding = " ".join(entries["DATA"])
    if encoding not in ENCODINGS:
        msg = f"{name}: DATA {encoding[:40]!r} is none of {', '.join(ENCODINGS)}"
        raise UnreadableFileError(msg)
    points, is_image = _points(entries, name)
    columns = _columns(entries, name)
    names = [column.name for column in columns]
    xyz = axes(names)
    if xyz is None:
        msg = f"{name}: its points have no x, y and z, only {', '.join(entries['FIELDS'])[:80]}"
        raise UnreadableFileError(msg)
    packed, attributes = _attributes(columns)
    _check_size(file, encoding, points, columns, name)
    return PcdHeader(encoding, points, columns, xyz, packed, attributes, _origin(entries, is_image, name), lines)


def _points(entries: dict[str, list[str]], name: str) -> tuple[int, bool]:
    """How many points, and whether they are the pixels of an image."""
    width, height = (whole_number(" ".join(entries.get(key) or ["1"]), f"{name}: {key}") for key in ("WIDTH", "HEIGHT"))
    points = whole_number(" ".join(entries.get("POINTS") or [str(width * height)]), f"{name}: POINTS")
    if width * height != points:
        msg = f"{name} is damaged: {width:,} × {height:,} is not the {points:,} points its header promises"
        raise UnreadableFileError(msg)
    return points, width > 1 and height > 1


def _columns(entries: dict[str, list[str]], name: str) -> tuple[Column, ...]:
    fields = entries["FIELDS"]
    counts = entries.get("COUNT") or ["1"] * len(fields)
    if {len(entries["SIZE"]), len(entries["TYPE"]), len(counts)} != {len(fields)}:
        msg = f"{name} is damaged: FIELDS, SIZE, TYPE and COUNT have different lengths"
        raise UnreadableFileError(msg)
    columns: list[Column] = []
    for field, size, kind, word in zip(fields, entries["SIZE"], entries["TYPE"], counts, strict=True):
        count = whole_number(word, f"{name}: COUNT of {field}")
        if (kind, size) not in TYPES:
            msg = f"{name}: field {field} has TYPE {kind[:8]} and SIZE {size[:8]}, which do not exist"
            raise UnreadableFileError(msg)
        if not 1 <= count <= MOST_COLUMNS - len(columns):
            msg = f"{name}: field {field} has COUNT {count:,}"
            raise UnreadableFileError(msg)
        own = [field] if count == 1 else [f"{field}_{k}" for k in range(count)]
        columns += [Column(each, np.dtype(TYPES[kind, size]), field == "_") for each in own]
    return tuple(columns)


def _attributes(columns: tuple[Column, ...]) -> tuple[int | None, dict[int, str]]:
    """The column of packed colours, and the names of the others."""
    named = attribute_columns([column.name for column in columns])
    wanted = {k: name for k, name in named.items() if not columns[k].is_padding}
    packs = [k for k, name in wanted.items() if name in ("rgb", "rgba") and columns[k].dtype.itemsize >= 4]
    if packs and not {"red", "green", "blue"} & set(wanted.values()):
        del wanted[packs[0]]
        return packs[0], wanted
    # Beside red, green and blue the packed colours are but a preview of them.
    return None, {k: name for k, name in wanted.items() if k not in packs[:1]}


def _origin(entries: dict[str, list[str]], is_image: bool, name: str) -> tuple[float, float, float] | None:
    """Where the sensor stood.

    PCL's VIEWPOINT is "an acquisition viewpoint for the points", and its NormalEstimation turns normals towards its
    translation in the points' own frame: so that is the origin, and the points are not moved. Every writer that
    knows no viewpoint writes NO_VIEWPOINT. It means something for an image only: depth cameras measure from their own
    centre, so the pixels' frame begins there.
    """
    words = entries.get("VIEWPOINT") or [str(number) for number in NO_VIEWPOINT]
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError:
        numbers = ()
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)):
        msg = f"{name} is damaged: VIEWPOINT is {' '.join(words)[:80]!r}, not seven numbers"
        raise UnreadableFileError(msg)
    return None if numbers == NO_VIEWPOINT and not is_image else (numbers[0], numbers[1], numbers[2])


def _check_size(file: BinaryIO, encoding: str, points: int, columns: tuple[Column, ...], name: str) -> None:
    """Refuse more points than the bytes behind the header can be, before anything is reserved for them."""
    data_bytes = os.fstat(file.fileno()).st_size - file.tell()
    if encoding == "ascii":
        # A number takes a digit and a blank, the file's last one only the digit.
        least = 2 * len(columns)
        data_bytes += 1
    elif encoding == "binary":
        least = sum(column.dtype.itemsize for column in columns)
    else:
        return
    if points * least > data_bytes:
        raise cut_short(name, points, data_bytes // least)
