"""Leica's PTX: in front of each scan's rows, ten lines say how large its grid is and where it stood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanfind.cloud import Floats
from scanfind.errors import UnreadableFileError
from scanfind.scans.records import Block, whole_number
from scanfind.scans.rows import Lines, excerpt, is_number, split

# Numbers on each of the ten lines, and what they are.
HEADER = (
    (1, "the number of columns"),
    (1, "the number of rows"),
    (3, "the scanner's position"),
    *[(3, "an axis of the scanner")] * 3,
    *[(4, "a row of the transform")] * 4,
)


class PtxScan(NamedTuple):
    """The header of one scan. Points lie column by column, `rows` in each.

    turn, translation : (3, 3), (3,) metres; file = scan @ turn + translation, row vectors as the file has them
    """

    points: int
    rows: int
    turn: Floats
    translation: Floats

    def origin(self) -> tuple[float, float, float]:
        """Where the scanner stood: its own frame begins there."""
        x, y, z = self.translation.tolist()
        return x, y, z


def read_scan_header(lines: Lines, name: str) -> PtxScan:
    """The ten lines before a scan's rows; raises UnreadableFileError."""
    entries = [_entry(lines, count, what, name) for count, what in HEADER]
    columns, rows = (whole_number(entries[k][0], f"{name}: {HEADER[k][1]}") for k in (0, 1))
    if max(columns, rows) > np.iinfo(np.int32).max:
        msg = f"{name} is damaged: {columns:,} columns of {rows:,} points, no scanner has such a grid"
        raise UnreadableFileError(msg)
    matrix = np.array(entries[6:], dtype=np.float64)
    if not np.isfinite(matrix).all() or (matrix[:, 3] != [0, 0, 0, 1]).any():
        msg = f"{name} is damaged: the last column of a transform is 0 0 0 1, got {matrix[:, 3].tolist()}"
        raise UnreadableFileError(msg)
    return PtxScan(columns * rows, rows, matrix[:3, :3], matrix[3, :3])


def placed(block: Block, scan: PtxScan, first: int) -> Block:
    """Rows from the `first` on, moved to the file's frame, with their row and column; 0 0 0 is no point, so NaN."""
    with np.errstate(all="ignore"):
        xyz = block.xyz @ scan.turn + scan.translation
    xyz[(block.xyz == 0).all(axis=1)] = np.nan
    column, row = np.divmod(first + np.arange(len(xyz)), scan.rows)
    return Block(xyz, {**block.attributes, "row": row.astype(np.int32), "column": column.astype(np.int32)})


def _entry(lines: Lines, count: int, what: str, name: str) -> list[str]:
    row = lines.take(1)
    line = row.text.decode("utf-8", "replace")
    cells = split(line, "")
    if len(cells) != count or not all(cell and is_number(cell) for cell in cells):
        found = excerpt(line) if row.count else "the end of the file"
        msg = f"{name}: line {row.line} should be {what} ({count} numbers), but is {found}"
        raise UnreadableFileError(msg)
    return cells
