"""Where a site is cut, and what that costs: tiles of whole bins, each small enough for the memory it may take.

Bins are cubes of 2ᵏ blocks of cells, at the same place for every tile: a cell's moments are the same whichever tile
they are in.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, log2
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError

if TYPE_CHECKING:
    from scanfind.cloud import ScanInfo
    from scanfind.library.model import Model

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BLOCK_CELLS = 8  # along the edge of a block
# A tile also tells what it found so far beyond its border, in diameters: at the border itself two tiles may each think
# that the middle of an instance lies with the other.
RIM = 1.0 / 30.0
LEAST_BIN_M = 1.0  # smaller bins are cut no better, and a site has a million of them

# What a process takes before it has read a point: Python, its libraries, compiled kernels, one chunk of points.
BASE_BYTES = 450_000_000
# Of a tile's memory, all levels and everything the search derives from them, for each row of its finest cells.
ROW_BYTES = 280
# The nearest beams of one scanner position, and the depth map made of them.
STATION_BYTES = 6 * 360**2 * (8 + 4 + 4)
# Rows on a square metre of a tile's floor, times the square of a cell: surfaces over and on it, views of each.
ROWS_A_SQUARE_CELL = 6.0
# On disk, a row of moments as it leaves a grid.
STORED_BYTES = 120


class Tile(NamedTuple):
    """A box of bins, half-open: low (3,) to high (3,), counted from the grid's offset. Its own is what lies in it."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]

    def grown(self, margin: int) -> Tile:
        """With so many more bins on every side."""
        x, y, z = self.low
        a, b, c = self.high
        return Tile((x - margin, y - margin, z - margin), (a + margin, b + margin, c + margin))

    def halves(self) -> tuple[Tile, Tile]:
        """Cut across its longest side."""
        axis = int(np.subtract(self.high, self.low).argmax())

        def cut(corner: tuple[int, int, int]) -> tuple[int, int, int]:
            x, y, z = ((self.low[k] + self.high[k]) // 2 if k == axis else at for k, at in enumerate(corner))
            return x, y, z

        return Tile(self.low, cut(self.high)), Tile(cut(self.low), self.high)

    def holds(self, bins: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Which of some bins (K, 3) are in it."""
        return np.asarray(((bins >= self.low) & (bins < self.high)).all(axis=1))

    def has(self, point: Floats, bin_m: float, rim: float = 0.0) -> bool:
        """Is a point (3,), metres from the grid's offset, in it or in a rim of so many metres around it?"""
        low, high = self.metres(bin_m)
        return bool(((point >= low - rim) & (point < high + rim)).all())

    def metres(self, bin_m: float) -> Floats:
        """Its low and high corner, (2, 3), from the grid's offset."""
        return np.array([self.low, self.high]) * bin_m

    def name(self) -> str:
        """Its own among all tiles of a site, as part of a file's name."""
        return "_".join(f"{a}.{b}" for a, b in zip(self.low, self.high, strict=True))


def bin_blocks(cell: float, diameter: float) -> int:
    """log2 of the blocks along the edge of a bin: a quarter of the smallest model, but no less than LEAST_BIN_M.

    Margins are whole bins: with bins of half a model, tiles of 15 m had 4.7 m of it on each side instead of 3.5.
    """
    return max(0, ceil(log2(max(0.25 * diameter, LEAST_BIN_M) / (BLOCK_CELLS * cell)) - 1e-9))


def bin_metres(cell: float, blocks: int) -> float:
    """The edge of a bin of 2**blocks blocks."""
    return float(cell * BLOCK_CELLS * 2**blocks)


def margin_of(models: Sequence[Model]) -> float:
    """How far around a tile, metres, every model reaches whose middle is in it or in its rim."""
    reaches = [np.linalg.norm(m.samples.points - m.samples.points.mean(axis=0), axis=1).max() for m in models]
    return max(float(reach) + RIM * model.diameter for reach, model in zip(reaches, models, strict=True))


class Held(NamedTuple):
    """What lies where in a site, by bins from the grid's offset.

    bins : (K, 3) with anything in them; rows : (K,) how many rows of the finest cells of a search each holds
    reached : (S, 2, 3) low and high corner of what the beams of each scanner position went through, in bins
    """

    bins: Ints
    rows: Ints
    reached: Floats

    def within(self, tile: Tile) -> Held:
        """What lies in a tile."""
        inside = tile.holds(self.bins)
        return Held(self.bins[inside], self.rows[inside], self.reached)

    def with_bins(self, bins: Ints) -> Held:
        """With some bins (K, 3) more, that nothing need lie in."""
        every, first = np.unique(np.concatenate([self.bins, bins]), axis=0, return_index=True)
        return Held(every, np.concatenate([self.rows, np.zeros(len(bins), np.int64)])[first], self.reached)

    def needed(self, tile: Tile) -> int:
        """Bytes it takes to search a tile that has its margin."""
        inside = (self.reached[:, 0] <= tile.high).all(axis=1) & (self.reached[:, 1] >= tile.low).all(axis=1)
        rows = int(self.rows[tile.holds(self.bins)].sum())
        return BASE_BYTES + STATION_BYTES * int(inside.sum()) + ROW_BYTES * rows


def tiles_of(held: Held, margin: int, memory: int) -> list[Tile]:
    """Cut a site until every tile, with a margin of so many bins, fits the memory; in the order of their places.

    Raises UsageError where a single bin with its margin does not.
    """
    bins = held.bins
    todo = [(Tile((*bins.min(axis=0).tolist(),), (*(bins.max(axis=0) + 1).tolist(),)), held)] if len(bins) else []
    tiles = []
    while todo:
        tile, around = todo.pop()
        mine = around.bins[tile.holds(around.bins)]
        if not len(mine):
            continue
        # To what it holds: halves of an L-shaped site would else keep the empty corner.
        tile = Tile((*mine.min(axis=0).tolist(),), (*(mine.max(axis=0) + 1).tolist(),))
        around = around.within(tile.grown(margin))
        needed = around.needed(tile.grown(margin))
        if needed <= memory:
            tiles.append(tile)
            continue
        if max(np.subtract(tile.high, tile.low)) == 1:
            msg = (
                f"--memory is too small: the smallest tile needs {words(needed)}: give more, "
                "or larger cells (grid.cell_m)"
            )
            raise UsageError(msg)
        todo += [(half, around) for half in tile.halves()]
    return sorted(tiles)


class Estimate(NamedTuple):
    """What a run will take, from headers alone; -1 where they do not say.

    points : records in all files
    least_memory : bytes without which its smallest tile cannot be searched
    most_memory : bytes with which the whole site would be one tile
    disk : bytes of the working folder, at most
    """

    points: int
    least_memory: int
    most_memory: int
    disk: int

    def words(self) -> str:
        """One line for a person."""
        points = f"{self.points:,} points" if self.points >= 0 else "an unknown number of points"
        whole = f", up to {words(self.most_memory)} to be one tile" if self.most_memory >= 0 else ""
        disk = f"; up to {words(self.disk)} of disk" if self.disk >= 0 else ""
        return f"{points}; memory: {words(self.least_memory)} at least{whole}{disk}"


def estimate(infos: Sequence[ScanInfo], sizes: Sequence[tuple[float, float]], finest: float, bin_m: float) -> Estimate:
    """What a search will take.

    infos : of the scans' headers
    sizes : the cell and the margin of the models searched together, metres, of each such group
    finest : the cell in which points are summed; bin_m : the edge of a bin
    """
    counts = [info.points for info in infos]
    points = -1 if min(counts, default=-1) < 0 else sum(counts)
    stations = min(sum(len(info.stations) for info in infos), 8)
    most = points if points >= 0 else 1 << 62

    def memory(floor: float, cell: float) -> int:
        rows = min(most, ROWS_A_SQUARE_CELL * floor / cell**2)
        return int(BASE_BYTES + stations * STATION_BYTES + ROW_BYTES * rows)

    least = max(memory((bin_m * (1 + 2 * ceil(margin / bin_m))) ** 2, cell) for cell, margin in sizes)
    boxes = np.array([info.bounds for info in infos if info.bounds is not None])
    floor = -1.0
    if len(boxes) == len(infos) > 0:
        floor = float(np.prod((boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0))[:2]))
    known = floor >= 0.0 or points >= 0
    rows = min(most, ROWS_A_SQUARE_CELL * max(floor, 0.0) / finest**2 if floor >= 0.0 else most)
    whole = max(memory(floor, cell) for cell, _ in sizes) if floor >= 0.0 else memory(1e12, min(c for c, _ in sizes))
    return Estimate(points, min(least, whole) if known else least, whole if known else -1,
                    int(rows * STORED_BYTES) if known else -1)  # fmt: skip


def words(size: float) -> str:
    """Bytes for a person."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def size_of(text: str) -> int:
    """Bytes from `3GB`, `800 MB` or a plain number of bytes; raises UsageError."""
    units = {"": 1, "b": 1, "k": 10**3, "kb": 10**3, "m": 10**6, "mb": 10**6, "g": 10**9, "gb": 10**9, "t": 10**12,
             "tb": 10**12, "kib": 2**10, "mib": 2**20, "gib": 2**30, "tib": 2**40}  # fmt: skip
    plain = text.strip().lower()
    number = plain.rstrip("kmgtib ")
    try:
        size = int(float(number) * units[plain[len(number) :].strip()])
    except (ValueError, KeyError, OverflowError) as error:
        msg = f"--memory is a size such as 3GB or 800MB, got {text!r}"
        raise UsageError(msg) from error
    if size <= 0:
        msg = f"--memory is a size above 0, such as 3GB, got {text!r}"
        raise UsageError(msg)
    return size
