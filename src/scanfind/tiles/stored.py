"""Moments and beams on disk, by bin: what one scan left, for any tile to take what is its own.

Not the points: moments add, so a grid that is full is written out and begun again, and a tile sums what it finds. The
disk then grows with the surface seen from each setup, and nothing is read from the scans twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanfind.grid.blocks import unpacked
from scanfind.grid.depth import DEPTH_PIXELS, Beams
from scanfind.grid.moments import ROW, MomentGrid
from scanfind.tiles.plan import Tile

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Where the rows of a bin lie in a file.
PIECE = np.dtype([("bin", "i8", (3,)), ("start", "i8"), ("count", "i8")])
# Odd: no two blocks of a bin become one where the product wraps round.
SPREAD = np.int64(0x1E3779B97F4A7C15)
ROWS, PIECES, BEAMS, ORIGINS, BOXES = "rows", "pieces.npy", "beams.npy", "origins.npy", "boxes.npy"


class Store:
    """Grids written to the folder of one scan, as often as they are full. blocks : see `plan.bin_blocks`"""

    def __init__(self, folder: Path, blocks: int) -> None:
        self._folder, self._blocks, self._parts = folder, blocks, 0

    def write(self, grid: MomentGrid) -> None:
        """Keep what is in a grid."""
        folder = self._folder / f"{self._parts:05d}"
        folder.mkdir(parents=True)
        pieces, start = [np.empty(0, PIECE)], 0
        with (folder / ROWS).open("wb") as file:
            for some in grid.rows():
                bins = bins_of(some["key"], self._blocks)
                order = np.lexsort(bins.T)
                rows, bins = some[order], bins[order]
                first = np.flatnonzero(np.concatenate([[True], (bins[1:] != bins[:-1]).any(axis=1)]))
                piece = np.empty(len(first), PIECE)
                piece["bin"], piece["start"] = bins[first], start + first
                piece["count"] = np.diff(np.append(first, len(rows)))
                pieces.append(piece)
                file.write(rows.view(np.uint8).data)
                start += len(rows)
        np.save(folder / PIECES, np.concatenate(pieces))
        if beams := grid.beams():
            np.save(folder / BEAMS, np.array([of.nearest for of in beams]))
            np.save(folder / ORIGINS, np.array([of.origin for of in beams]))
            np.save(folder / BOXES, np.array([reached(of) for of in beams]))
        self._parts += 1


def bins_of(keys: Ints, blocks: int) -> Ints:
    """The bins (R, 3) in which blocks lie, from their packed coordinates (R,)."""
    return np.asarray(unpacked(keys) >> blocks)


def reached(beams: Beams) -> Floats:
    """Low and high corner, (2, 3), of the box around a scanner and all that its nearest beams met."""
    from scanfind.kernels.grid import NO_BEAM

    directions, ranges, _ = beams.beams_in(np.flatnonzero(beams.nearest < NO_BEAM))
    ends = np.concatenate([np.zeros((1, 3)), directions * ranges[:, None]])
    return np.array([ends.min(axis=0), ends.max(axis=0)]) + beams.origin


def parts_of(folders: Iterable[Path]) -> list[Path]:
    """What was written to the folders of some scans, in order."""
    return [part for folder in folders for part in sorted(folder.iterdir()) if (part / PIECES).is_file()]


def stored_bins(parts: Sequence[Path]) -> tuple[Ints, Ints, NDArray[np.bool_]]:
    """The bins (K, 3) with anything in them, how many rows are stored for each, (K,), and whether by several parts.

    These may have seen the same cells: fifty setups in one hall would count its floor fifty times. See `summed_rows`.
    """
    pieces = [np.load(part / PIECES) for part in parts]
    every = np.concatenate([np.empty(0, PIECE), *pieces])
    seen_by = np.repeat(np.arange(len(parts)), [len(some) for some in pieces])
    bins, which = np.unique(every["bin"], axis=0, return_inverse=True)
    which = which.reshape(-1)
    rows = np.bincount(which, every["count"], len(bins)).astype(np.int64)
    by_several = np.bincount(np.unique(np.stack([which, seen_by]), axis=1)[0], minlength=len(bins)) > 1
    return bins, rows, by_several


def summed_rows(parts: Sequence[Path], bins: Ints) -> Ints:
    """How many rows some bins (K, 3) have when all parts are summed, (K,)."""
    numbers, order = packed(bins), np.argsort(packed(bins))
    found: list[list[NDArray[np.int64]]] = [[np.empty(0, np.int64)] for _ in bins]
    for part in parts:
        pieces = np.load(part / PIECES)
        pieces = pieces[np.isin(packed(pieces["bin"]), numbers)]
        at = order[np.searchsorted(numbers[order], packed(pieces["bin"]))]
        with (part / ROWS).open("rb") as file:
            for k, start, count in zip(at.tolist(), pieces["start"].tolist(), pieces["count"].tolist(), strict=True):
                file.seek(start * ROW.itemsize)
                some = np.fromfile(file, ROW, count)
                found[k].append(some["key"] * SPREAD + some["place"] * 64 + some["view"])
    return np.array([len(np.unique(np.concatenate(cells))) for cells in found], np.int64)


def packed(bins: Ints) -> Ints:
    """Bins (K, 3) as one number each, (K,)."""
    return np.asarray(bins @ np.array([1 << 40, 1 << 20, 1]))


def reached_from(parts: Sequence[Path]) -> Floats:
    """Low and high corner, (S, 2, 3), of what the beams of each scanner position went through, from the offset."""
    boxes = [np.load(part / BOXES) for part in parts if (part / BOXES).is_file()]
    return np.concatenate([np.empty((0, 2, 3)), *boxes])


def rows_in(parts: Sequence[Path], box: Tile) -> Iterator[NDArray[Any]]:
    """The rows (R,) of ROW of the bins in a box, some at a time."""
    for part in parts:
        pieces = np.load(part / PIECES)
        pieces = pieces[box.holds(pieces["bin"])]
        with (part / ROWS).open("rb") as file:
            for start, count in zip(pieces["start"].tolist(), pieces["count"].tolist(), strict=True):
                file.seek(start * ROW.itemsize)
                yield np.fromfile(file, ROW, count)


def count_in(parts: Sequence[Path], box: Tile) -> int:
    """How many rows are stored for the bins in a box: there may be fewer when they are summed."""
    pieces = [np.load(part / PIECES) for part in parts]
    return sum(int(some["count"][box.holds(some["bin"])].sum()) for some in pieces)


def beams_into(parts: Sequence[Path], box: Floats) -> list[Beams]:
    """What scanners saw whose beams may have come into a box: low and high corner (2, 3), from the grid's offset.

    Mapped from disk, since hundreds of setups have 6 MB each.
    """
    found = []
    for part in parts:
        if not (part / BEAMS).is_file():
            continue
        origins, boxes = np.load(part / ORIGINS), np.load(part / BOXES)
        near = np.flatnonzero((boxes[:, 0] <= box[1]).all(axis=1) & (boxes[:, 1] >= box[0]).all(axis=1))
        if len(near):
            # Copied where it is written to, which never happens: kernels are compiled for arrays that could be.
            every = np.load(part / BEAMS, mmap_mode="c")
            found += [Beams(origins[k], np.asarray(every[k]), DEPTH_PIXELS) for k in near]
    return found
