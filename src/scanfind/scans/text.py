"""Text in: PTX and PTS of Leica's Cyclone, and tables of numbers (XYZ, TXT, CSV, ASC) with or without a header.

What a file is, its content tells, not its name: a first line of one whole number announces that many points (PTS); two
such lines, a grid (PTX); anything else is a table.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import BinaryIO, NamedTuple

from scanfind.cloud import PointChunk, ScanInfo, Station
from scanfind.errors import UnreadableFileError
from scanfind.scans.fields import axes
from scanfind.scans.ptx import PtxScan, placed, read_scan_header
from scanfind.scans.records import Block, cut_short, declared_block, valid_chunks, whole_number
from scanfind.scans.rows import LONGEST_LINE, Lines, Rows, excerpt, layout_of, parse
from scanfind.scans.text_columns import TextColumns, columns_of, header_names

# Enough rows to tell what a column holds, as far as a block goes.
SAMPLE_ROWS = 100_000
BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class Kind(Enum):
    """What is in front of the rows."""

    PTX = "PTX"
    PTS = "PTS"
    TABLE = "text"


class Section(NamedTuple):
    """One scan of a file: how many rows (-1: to the end), its columns (None: no rows), its PTX header if it has one."""

    points: int
    columns: TextColumns | None
    ptx: PtxScan | None = None


def info(path: Path) -> ScanInfo:
    """What the file says of itself; points is -1 for tables. PTX and PTS are passed over from header to header.

    Raises UnreadableFileError.
    """
    with path.open("rb") as file:
        source = _TextFile(file, path)
        stations: list[Station] = []
        attributes: dict[str, str] = {}
        for k, section in enumerate(source.sections()):
            if section.points > 0 and (there := source.lines.skip(section.points)) < section.points:
                raise cut_short(path.name, section.points, there)
            name = path.stem if source.kind is Kind.TABLE else f"{path.stem} {k + 1}"
            origin = section.ptx.origin() if section.ptx else None
            stations.append(Station(name, section.points, origin))
            for attribute, (_, dtype) in (section.columns.attributes if section.columns else {}).items():
                attributes.setdefault(attribute, str(dtype))
            if section.ptx:
                attributes |= {"row": "int32", "column": "int32"}
    points = -1 if source.kind is Kind.TABLE else sum(station.points for station in stations)
    return ScanInfo(str(path), source.kind.value, points, tuple(stations), attributes)


def read(path: Path, chunk_points: int) -> Iterator[PointChunk]:
    """Stream the points: a PTX scan moved by its transform, its origin the scanner's place; raises UnreadableFileError.

    Columns are float64, except colours, classification and return numbers that are whole in the first rows.
    """
    with path.open("rb") as file:
        source = _TextFile(file, path)
        first = 0
        for k, section in enumerate(source.sections()):
            origin = section.ptx.translation if section.ptx else None
            blocks = source.blocks(section)
            yield from valid_chunks(blocks, chunk_points, scan=k, origin=origin, first=first)
            first += section.points


class _TextFile:
    """An open text file: its kind, told from the first rows, and its scans one after the other."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self.name = path.name
        names = _comment_names(file)
        self.lines = Lines(file, path.name)
        first = self.lines.peek(2)
        if not first.count:
            msg = f"{path.name} is empty: no rows of numbers in it"
            raise UnreadableFileError(msg)
        words = [line.split() for line in first.text.splitlines() if line.strip()]
        counts = [len(line) == 1 and line[0].isdigit() for line in words]
        if path.suffix.lower() == ".ptx" or counts == [True, True]:
            self.kind = Kind.PTX
        else:
            self.kind = Kind.PTS if counts[0] else Kind.TABLE
        self._header = self._names_of_columns(first, names) if self.kind is Kind.TABLE else None

    def sections(self) -> Iterator[Section]:
        """Each scan of the file; its rows have to be read or skipped before the next is asked for."""
        if self.kind is Kind.TABLE:
            yield self._section(-1)
            return
        while self.lines.peek(1).count:
            if self.kind is Kind.PTX:
                scan = read_scan_header(self.lines, self.name)
                yield self._section(scan.points)._replace(ptx=scan)
            else:
                yield self._section(self._count())

    def blocks(self, section: Section) -> Iterator[Block]:
        """The rows of a section; raises UnreadableFileError where there are fewer than it promises."""
        done = 0
        while section.columns and done != section.points:
            rows = self.lines.take(SAMPLE_ROWS if section.points < 0 else min(SAMPLE_ROWS, section.points - done))
            if not rows.count:
                break
            table = parse(rows, section.columns.layout, self.name)
            block = declared_block(table, section.columns.xyz, section.columns.attributes, self.name)
            yield block if section.ptx is None else placed(block, section.ptx, done)
            done += rows.count
        if done < section.points:
            raise cut_short(self.name, section.points, done)

    def _section(self, points: int) -> Section:
        sample = self.lines.peek(SAMPLE_ROWS if points < 0 else min(points, SAMPLE_ROWS)) if points else None
        if sample is None or not sample.count:
            return Section(points, None)
        is_cyclone = self.kind is not Kind.TABLE
        return Section(points, columns_of(sample, self.name, self._header, is_cyclone=is_cyclone))

    def _count(self) -> int:
        row = self.lines.take(1)
        words = row.text.decode("utf-8", "replace").split()
        if len(words) != 1:
            found = excerpt(" ".join(words))
            msg = (
                f"{self.name}: line {row.line} should be the number of points that follow, but is {found}; "
                "correct the count above it, or delete it to have all rows read"
            )
            raise UnreadableFileError(msg)
        return whole_number(words[0], f"{self.name}: line {row.line}")

    def _names_of_columns(self, first: Rows, comment: list[str] | None) -> list[str] | None:
        """The names in the header line, or in the comment above the rows; None where neither gives any."""
        line = first.text.split(b"\n", 1)[0].decode("utf-8", "replace")
        names = header_names(line)
        if names is None:
            # A comment may say anything: it is a header if it names as many columns as there are.
            return comment if comment and len(comment) == layout_of(first.text).columns else None
        if axes(names) is None:
            msg = f"{self.name}: line {first.line} is neither numbers nor a header naming x, y and z: {excerpt(line)}"
            raise UnreadableFileError(msg)
        self.lines.take(1)
        return names


def _comment_names(file: BinaryIO) -> list[str] | None:
    """The names of columns in a comment at the file's beginning, as CloudCompare writes `//X Y Z`; None without."""
    start = len(BYTE_ORDER_MARK) if file.read(len(BYTE_ORDER_MARK)) == BYTE_ORDER_MARK else 0
    file.seek(start)
    names = None
    while (line := file.readline(LONGEST_LINE)).startswith((b"#", b"//")):
        found = header_names(line.decode("utf-8", "replace"))
        names = found if found and axes(found) else names
    file.seek(start)
    return names
