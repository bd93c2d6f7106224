"""Rows of numbers in a text file: read in blocks of whole lines, parsed fast, and slowly where something is wrong."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UnreadableFileError

BLOCK_BYTES = 1 << 22
# A row of a hundred columns has 2 KB. Nothing longer is split into columns, so no line can eat memory.
LONGEST_LINE = 1 << 16
MISSING = ("", "nan", "NaN", "NAN", "-nan", "-NaN", "nan(ind)", "-nan(ind)", "1.#QNAN", "-1.#IND", "NA", "N/A", "null")

_NO_ROW = re.compile(rb"^[ \t\v\f]*(?:(?:#|//).*)?$", re.MULTILINE)
_BLANK_OR_COMMENT = np.frombuffer(b" \t\v\f#/", np.uint8)
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?inf(?:inity)?", re.ASCII | re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Rows:
    """Some whole lines: `count` of them are rows of numbers, the others blank; `line` is the first row's number."""

    text: bytes
    count: int
    line: int


class Layout(NamedTuple):
    """How a row is divided: `columns` numbers; separator "" is white space; integers of 64 bits by column."""

    columns: int
    separator: str = ""
    decimal: str = "."
    wide: tuple[tuple[int, str], ...] = ()


class Lines:
    """The rows of an open file from where it stands; blank lines and comments (# and //) are passed over.

    line : the number the next line of the file has
    Reading raises UnreadableFileError for binary content and for lines longer than LONGEST_LINE.
    """

    def __init__(self, file: BinaryIO, name: str, line: int = 1) -> None:
        self._file = file
        self._name = name
        self._line = line
        self._rest = b""
        self._text = b""
        self._next = 0
        self._starts = self._ends = self._numbers = np.empty(0, np.int64)

    def peek(self, most: int) -> Rows:
        """The next rows, at least one and up to `most`, as far as a block goes; none at the end of the file."""
        while self._next == len(self._ends):
            if not self._fill():
                return Rows(b"", 0, self._line)
        count = min(most, len(self._ends) - self._next)
        start, end = self._starts[self._next], self._ends[self._next + count - 1]
        return Rows(self._text[start:end], count, int(self._numbers[self._next]))

    def take(self, most: int) -> Rows:
        """As `peek`, and go on behind them."""
        rows = self.peek(most)
        self._next += rows.count
        return rows

    def skip(self, count: int) -> int:
        """Pass over `count` rows; returns how many there were."""
        left = count
        while left and (rows := self.take(left)).count:
            left -= rows.count
        return count - left

    def _fill(self) -> bool:
        """Read the next block; False at the end of the file."""
        raw = self._file.read(BLOCK_BYTES)
        text = self._rest + raw
        if not text:
            return False
        # The rest of the last block begins a line, and the file's last line may lack its end.
        end = text.rfind(b"\n") + 1 if raw else len(text)
        self._rest = text[end:]
        if len(self._rest) > LONGEST_LINE:
            self._refuse_long_line(self._line + text.count(b"\n"))
        if not end:
            return True
        text = text[:end]
        if b"\0" in text or b"\0" in self._rest:
            msg = f"{self._name} is not plain text (binary content, or UTF-16): save it as ASCII or UTF-8"
            raise UnreadableFileError(msg)
        if not text.endswith(b"\n"):
            text += b"\n"
        if b"\r" in text:
            text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        starts, ends = _line_bounds(text)
        if np.isin(np.frombuffer(text, np.uint8)[starts], _BLANK_OR_COMMENT).any():
            text = _NO_ROW.sub(b"", text)
            starts, ends = _line_bounds(text)
        if (ends - starts).max() > LONGEST_LINE:
            self._refuse_long_line(self._line + int((ends - starts).argmax()))
        rows = np.flatnonzero(ends - starts > 1)
        self._text, self._next = text, 0
        self._starts, self._ends, self._numbers = starts[rows], ends[rows], rows + self._line
        self._line += len(ends)
        return True

    def _refuse_long_line(self, line: int) -> NoReturn:
        msg = f"{self._name}: line {line} is longer than {LONGEST_LINE:,} bytes, so these are not rows of numbers"
        raise UnreadableFileError(msg)


def layout_of(text: bytes) -> Layout:
    """How the first row of `text` is divided: by semicolons, commas or white space, with a decimal point or comma."""
    line = text.split(b"\n", 1)[0].decode("utf-8", "replace").strip()
    words = line.split()
    if ";" in line:
        return Layout(line.count(";") + 1, ";", "," if "," in line else ".")
    if "," in line and len(words) >= 3 and all(_DECIMAL_COMMA.fullmatch(word) for word in words):
        return Layout(len(words), "", ",")
    if "," in line:
        return Layout(line.count(",") + 1, ",")
    return Layout(len(words))


def split(line: str, separator: str) -> list[str]:
    """The cells of a line without their quotes and the spaces around them."""
    cells = line.split(separator) if separator else line.split()
    return [cell.strip().strip('"').strip() for cell in cells]


def is_number(cell: str) -> bool:
    """Whether a cell is a number, or stands for a missing one."""
    return bool(_NUMBER.fullmatch(cell)) or cell in MISSING


def parse(rows: Rows, layout: Layout, name: str) -> list[NDArray[Any]]:
    """The columns of some rows, each (rows.count,) float64, or the integer that `layout.wide` asks for.

    Missing numbers are NaN. Raises UnreadableFileError with the line that is not a row of `layout`.
    """
    # pandas fails without saying where, and fills short rows with NaN. So: fast if all is well, else line by line.
    # Integers of 64 bits, rare in text, always go line by line: pandas takes them by way of doubles if it has to.
    fast = None if layout.wide else _parse_fast(rows, layout)
    return fast or parse_slowly(rows, layout, name)


def parse_slowly(rows: Rows, layout: Layout, name: str) -> list[NDArray[Any]]:
    """As `parse`, one line at a time."""
    table: list[list[float | int]] = []
    wide = dict(layout.wide)
    for number, line in enumerate(rows.text.decode("utf-8", "replace").split("\n"), rows.line):
        if not line:
            continue
        cells = split(line, layout.separator)
        if len(cells) != layout.columns:
            msg = f"{name}: line {number} has {len(cells)} columns instead of {layout.columns}: {excerpt(line)}"
            raise UnreadableFileError(msg)
        if layout.decimal != ".":
            cells = [cell.replace(layout.decimal, ".") for cell in cells]
        values: list[float | int] = []
        for k, cell in enumerate(cells):
            if k in wide and re.fullmatch(r"[+-]?[0-9]{1,20}", cell) and _within(int(cell), wide[k]):
                values.append(int(cell))
            elif k not in wide and is_number(cell):
                values.append(np.nan if cell in MISSING else float(cell))
            else:
                msg = f"{name}: line {number} holds {cell[:40]!r} where a number should be: {excerpt(line)}"
                raise UnreadableFileError(msg)
        table.append(values)
    return [np.array([row[k] for row in table], wide.get(k, np.float64)) for k in range(layout.columns)]


def excerpt(line: str) -> str:
    """The beginning of a line of a file, quoted, for an error message."""
    return repr(line.strip()[:80])


def _parse_fast(rows: Rows, layout: Layout) -> list[NDArray[Any]] | None:
    """As `parse`, by pandas; None where a row may be wrong."""
    import pandas as pd

    text = rows.text.replace(b'"', b"") if b'"' in rows.text else rows.text
    try:
        frame = pd.read_csv(
            io.BytesIO(text),
            sep=layout.separator or r"\s+",
            decimal=layout.decimal,
            header=None,
            dtype=np.float64,
            na_values=list(MISSING),
            keep_default_na=False,
            quoting=3,  # csv.QUOTE_NONE: an open quote must not swallow lines
            engine="c",
            low_memory=False,
        )
    except (ValueError, OverflowError):
        return None
    if frame.shape != (rows.count, layout.columns):
        return None
    columns = [frame[k].to_numpy() for k in range(layout.columns)]
    # No row is longer than the first, so all are complete if there are enough cells in total.
    if np.isnan(columns[-1]).any():
        cells = text.count(layout.separator.encode()) + rows.count if layout.separator else len(text.split())
        if cells != rows.count * layout.columns:
            return None
    return columns


def _line_bounds(text: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where each line begins, and where the next one does."""
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n")).astype(np.int64) + 1
    return np.concatenate([np.zeros(1, np.int64), ends[:-1]]), ends


def _within(value: int, dtype: str) -> bool:
    limits = np.iinfo(dtype)
    return int(limits.min) <= value <= int(limits.max)
