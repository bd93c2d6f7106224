"""PTX out: a block a station, ten lines that say how large its grid is and where it stood, then a line for every beam.

A beam without a point is a line of zeros. PTX has no place for other fields than the intensity.
"""

from __future__ import annotations

from typing import TextIO

import numpy as np

from scanfind.cloud import Floats
from scanfind.errors import InvalidGeometryError, UnsupportedFormatError
from scanfind.pose import Pose
from scanfind.scans.output import CloudFile, Columns

FIELDS = ("intensity", "row", "column")
# Lines formatted in one go: 12 MB of text.
LINES_AT_ONCE = 300_000


class StationsWriter(CloudFile):
    """A PTX file being written; see `StationsFile`. Points come column by column, as the lines do."""

    def _begin(self) -> None:
        if foreign := [name for name in self.fields if name not in FIELDS]:
            msg = f"{self.path.name}: PTX has no place for {foreign[0]!r}; choose e57, laz or ply, or leave it out"
            raise UnsupportedFormatError(msg)
        self._file: TextIO = self.part.open("w", encoding="ascii", newline="\n")
        self._rows = self._lines = self._due = 0

    def station(self, name: str, pose: Pose, raster: tuple[int, int]) -> None:
        """Begin a station's block; PTX has no names."""
        with self._failures():
            self._empty_lines(self._due)
            rows, columns = raster
            self._rows, self._lines, self._due = rows, 0, rows * columns
            self._station_from_scene = pose.inverse()
            # Row vectors: its axes are the rows of the turn, its position the last row.
            turned = np.vstack([pose.matrix().T[:3], [*pose.translation, 1.0]])
            axes = [" ".join(map(repr, row)) for row in [pose.translation.tolist(), *pose.rotation.T.tolist()]]
            matrix = [" ".join(map(repr, row)) for row in turned.tolist()]
            self._file.write("\n".join([str(columns), str(rows), *axes, *matrix]) + "\n")

    def _append(self, xyz: Floats, columns: Columns) -> None:
        line = columns["column"].astype(np.int64) * self._rows + columns["row"]
        if line[0] < self._lines or line[-1] >= self._due or (np.diff(line) <= 0).any():
            msg = f"{self.path.name}: points of a PTX file come column by column, each of its own row and column"
            raise InvalidGeometryError(msg)
        table = np.column_stack([self._station_from_scene.move(xyz), columns["intensity"]])
        for first in range(0, len(table), LINES_AT_ONCE):
            some = slice(first, first + LINES_AT_ONCE)
            self._empty_lines(line[some][0])
            full = np.zeros((line[some][-1] + 1 - self._lines, 4))
            full[line[some] - self._lines] = table[some]
            self._file.write("%.5f %.5f %.5f %.4f\n" * len(full) % tuple(full.ravel().tolist()))
            self._lines += len(full)

    def _empty_lines(self, until: int) -> None:
        self._file.write("0 0 0 0\n" * (until - self._lines))
        self._lines = until

    def _finish(self) -> None:
        self._empty_lines(self._due)
        self._file.close()

    def _discard(self) -> None:
        self._file.close()
