"""The streaming pass: raw points in, moments of every cell out, at every level of the octree.

Each cell keeps moments: n, Σx, Σxxᵀ, Σ direction to the scanner. Their means are the paper's weighted octree (3.1),
their pooled covariance its normals by PCA (3.2); moments add, so levels, chunks, files and workers merge.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterable, Iterator
from functools import partial, reduce
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import PointChunk
from scanfind.grid.depth import DEPTH_PIXELS, Beams
from scanfind.threads import side_by_side

if TYPE_CHECKING:
    from scanfind.kernels.blocks import BlockRows

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
# Of one shard, as the kernels of the pass take them: its hash table, the arrays all share, its counts.
Arrays: TypeAlias = "tuple[NDArray[Any] | BlockRows, ...]"

# Room to begin with: 2, 134 and 470 MB of addresses, of which only what is written becomes memory. From 2^14 blocks and
# 2^20 rows on, doubling took 0.9 s of a pass over 10 M points that needs 0.8 s.
EMPTY_BLOCKS, EMPTY_OCTANTS, EMPTY_ROWS = 1 << 16, 1 << 19, 1 << 22
MOST_SHARDS = 8  # each reads all points, and a thread that adds a tenth of them gains nothing any more
WORTH_A_THREAD = 1000  # points or blocks: fewer are added sooner than a thread is started
POINTS_TO_SETTLE = 1000  # of which the median says where the scan lies
BLOCKS_AT_ONCE = 1024  # that leave a grid together: some 20 MB of rows

# What leaves a grid, for a file or another grid with the same cells: the moments of one cell and view. Aligned, since
# kernels read them.
ROW = np.dtype([("key", "i8"), ("place", "i2"), ("view", "i2"), ("moments", "i8", (13,))], align=True)


class MomentGrid:
    """Raw points in, moments out. `add` every chunk, in any order; the result does not depend on it.

    cell : edge of a cell, metres; offset : (3,) float64, the grid's origin in the points' frame (`None`: the median of
    the first points, rounded to whole metres, so that coordinates keep their digits however far from zero the scan is).
    jobs : threads; expected_rows : where more are known to come, arrays need not be doubled, for a moment holding twice
    as much
    box : (2, 3) low and high corner, the points' frame, metres: of points outside only the beams are noted

    points : added so far
    signed : every chunk said where its scanner stood
    units : offset units a cell
    block_keys : (blocks,) packed, -1 where none lies
    block_rows : a row of each cell's moments
    moments : (rows, 13) for each cell and view; links : (rows, 2) the row's view, and the cell's next row or -1
    counts : (shards, 4) blocks, octants and rows in use, and points left out; see kernels.grid.place_of for where they
        lie
    """

    def __init__(
        self, cell: float, offset: Floats | None = None, jobs: int = 1, expected_rows: int = EMPTY_ROWS,
        box: Floats | None = None,
    ) -> None:  # fmt: skip
        from scanfind.kernels.blocks import BlockRows
        from scanfind.kernels.grid import MOMENTS, OFFSET_UNITS

        self.cell = cell
        self.offset = offset
        self.box = box
        self.points = 0
        self.signed = True
        self.units = OFFSET_UNITS
        self.block_keys = np.full(EMPTY_BLOCKS, -1, np.int64)
        int32 = np.dtype(np.int32)
        self.block_rows = BlockRows(room((EMPTY_BLOCKS, 8), int32), room((EMPTY_OCTANTS, 64), int32))
        rows = max(EMPTY_ROWS, expected_rows)
        self.moments = room((rows, MOMENTS), np.dtype(np.int64))
        self.links = room((rows, 2), int32)
        self._jobs, self._shards = jobs, min(jobs, MOST_SHARDS)
        self.counts = np.zeros((self._shards, 4), np.int64)
        self._tables = [empty_hash(EMPTY_BLOCKS // self._shards) for _ in range(self._shards)]
        self._held: list[PointChunk] = []
        self._beams: dict[tuple[float, ...], Ints] = {}
        self._coarser: MomentGrid | None = None
        self._looking: tuple[tuple[float, ...], Ints] | None = None

    @property
    def unaddressable(self) -> int:
        """Points too far from the rest to be in a cell."""
        from scanfind.kernels.grid import LEFT_OUT

        return int(self.counts[0, LEFT_OUT])

    def add(self, chunk: PointChunk) -> None:
        """Sum a chunk's points into the grid and into the depth map of its scanner."""
        if not len(chunk):
            return
        if self.offset is None:
            self._settle(chunk)
            return
        from scanfind.kernels.grid import accumulate

        has_origin = chunk.origin is not None
        self.signed &= has_origin
        origin = np.zeros(3) if chunk.origin is None else np.asarray(chunk.origin, np.float64)
        seen = self._beams_from(origin - self.offset) if has_origin else np.empty((self._shards, 0), np.int64)
        xyz, offset = chunk.xyz, self.offset
        if self.box is not None:
            inside = ((xyz >= self.box[0]) & (xyz <= self.box[1])).all(axis=1)
            if has_origin:
                self._note_beams(xyz[~inside], origin, seen)
            xyz = xyz[inside]
        self._in_shards(
            len(xyz),
            lambda at, shard, arrays: accumulate(
                xyz, at, origin, has_origin, offset, self.cell, shard, self._shards, *arrays, seen[shard], DEPTH_PIXELS
            ),
        )
        self.points += len(xyz)

    def _note_beams(self, xyz: Floats, origin: Floats, seen: Ints) -> None:
        """Note what beams to points (N, 3) saw, in the maps of the shards: each takes some of them."""
        from scanfind.kernels.grid import note_beams

        cuts = np.linspace(0, len(xyz), self._shards + 1).astype(np.int64)
        note = [
            partial(note_beams, xyz[start:stop], origin, seen[shard], DEPTH_PIXELS)
            for shard, (start, stop) in enumerate(pairwise(cuts.tolist()))
        ]
        side_by_side(self._jobs if len(xyz) >= WORTH_A_THREAD else 1, *note)

    def rows(self) -> Iterator[NDArray[Any]]:
        """All moments, as rows (R,) of ROW, some blocks at a time in the order of their keys."""
        blocks = self.blocks()
        for start in range(0, len(blocks), BLOCKS_AT_ONCE):
            some = blocks[start : start + BLOCKS_AT_ONCE]
            first = self.block_rows.of(some).reshape(-1)
            cells = np.flatnonzero(first >= 0)
            rows = first[cells]
            while len(rows):  # the first view of every cell, then the second of those that have one …
                out = np.empty(len(rows), ROW)
                out["key"], out["place"] = self.block_keys[some[cells // 512]], cells % 512
                out["view"], out["moments"] = self.links[rows, 0], self.moments[rows]
                yield out
                following = self.links[rows, 1]
                cells, rows = cells[following >= 0], following[following >= 0]

    def add_rows(self, rows: NDArray[Any]) -> None:
        """Sum rows (R,) of ROW into the grid, which must have the cells, offset and units of the one they left."""
        from scanfind.kernels.grid import add_rows

        keys, places, views, sums = (np.ascontiguousarray(rows[name]) for name in ROW.names or ())
        self._in_shards(
            len(rows),
            lambda at, shard, arrays: add_rows(at, keys, places, views, sums, shard, self._shards, *arrays),
        )
        self.points += int(sums[:, 0].sum())

    def look(self, beams: Iterable[Beams]) -> None:
        """Take what scanners saw for what points of their own told: the nearest in each direction is kept."""
        for of in beams:
            key = (*of.origin.tolist(),)
            self._beams[key] = np.minimum(self._beams[key], of.nearest) if key in self._beams else of.nearest

    def memory_bytes(self) -> int:
        """What the rows and blocks in use take."""
        blocks, octants, rows, _ = self.counts.sum(axis=0)
        of_a_block = self.block_keys[0].nbytes + self.block_rows.octants[0].nbytes
        of_a_row = self.moments[0].nbytes + self.links[0].nbytes
        return int(blocks * of_a_block + octants * self.block_rows.cells[0].nbytes + rows * of_a_row)

    def _in_shards(self, count: int, work: Callable[[int, int, Arrays], int]) -> None:
        """Call work(at, shard, the shard's arrays) until each shard is at `count`, with more room where it stopped."""
        reached = [0] * self._shards

        def run(shard: int) -> None:
            arrays = (
                *self._tables[shard], self.block_keys, self.block_rows, self.moments, self.links, self.counts[shard],
            )  # fmt: skip
            reached[shard] = work(reached[shard], shard, arrays)

        while True:
            jobs = self._jobs if count >= WORTH_A_THREAD else 1
            side_by_side(jobs, *[partial(run, shard) for shard in range(self._shards) if reached[shard] < count])
            if min(reached) == count:
                return
            self._make_room()

    def _beams_from(self, origin: Floats) -> Ints:
        """The nearest beam in each direction from a scanner that each shard notes, (shards, pixels)."""
        from scanfind.kernels.grid import NO_BEAM

        key = tuple(origin.tolist())
        if self._looking is None or self._looking[0] != key:
            self._look_away()
            self._looking = key, np.full((self._shards, 6 * DEPTH_PIXELS**2), NO_BEAM)
        return self._looking[1]

    def _look_away(self) -> None:
        """Join what the shards noted from the scanner of the last chunk: a map for each of 50 stations is enough."""
        if self._looking is not None:
            key, seen = self._looking
            nearest = reduce(np.minimum, seen)
            self._beams[key] = np.minimum(self._beams[key], nearest) if key in self._beams else nearest
            self._looking = None

    def _settle(self, chunk: PointChunk) -> None:
        """Hold chunks back until there are enough points to say where the scan lies; then add what was held.

        The median of the first points, not the first: one stray record would put the whole scan out of reach.
        """
        self._held.append(chunk)
        if sum(len(held) for held in self._held) >= POINTS_TO_SETTLE:
            self.release()

    def release(self) -> None:
        """Add the chunks held back, of a scan too small to settle by itself; needed before the sums are read."""
        held, self._held = self._held, []
        if self.offset is None and held:
            first = np.concatenate([chunk.xyz[:POINTS_TO_SETTLE] for chunk in held])[:POINTS_TO_SETTLE]
            self.offset = np.round(np.median(first, axis=0))
        for chunk in held:
            self.add(chunk)
        self._look_away()

    def _make_room(self) -> None:
        """Double whichever array some shard has filled."""
        from scanfind.kernels.blocks import fill_hash
        from scanfind.kernels.grid import BATCH, BLOCKS, LOTS, OCTANTS, ROWS, ROWS_OF_OCTANT, is_full

        most, shards = self.counts.max(axis=0), self._shards
        octants, cells = self.block_rows
        if is_full(most, OCTANTS, BATCH, len(cells), shards):
            self.block_rows = self.block_rows._replace(cells=doubled(cells))
        if is_full(most, BLOCKS, BATCH, len(self.block_keys), shards):
            self.block_rows = self.block_rows._replace(octants=doubled(octants))
            self.block_keys = np.concatenate([self.block_keys, np.full(len(self.block_keys), -1)])
            used = np.flatnonzero(self.block_keys >= 0)
            for shard in range(shards):
                self._tables[shard] = empty_hash(len(self.block_keys) // shards)
                theirs = used[used // LOTS[BLOCKS] % shards == shard]
                fill_hash(self.block_keys, theirs, *self._tables[shard])
        if is_full(most, ROWS, ROWS_OF_OCTANT, len(self.moments), shards):
            self.moments, self.links = doubled(self.moments), doubled(self.links)

    def blocks(self) -> NDArray[np.intp]:
        """Where the blocks in use lie, in the order of their keys."""
        self.release()
        used = np.flatnonzero(self.block_keys >= 0)
        return np.asarray(used[np.argsort(self.block_keys[used])])

    def rows_end(self) -> int:
        """All rows in use lie before this one."""
        from scanfind.kernels.grid import LOTS, ROWS

        self.release()
        lots = -(-int(self.counts[:, ROWS].max()) // LOTS[ROWS])
        return lots * self._shards * LOTS[ROWS]

    def points_per_row(self) -> float:
        """Raw points a cell, on average, counting a cell once for each view."""
        from scanfind.kernels.grid import ROWS

        self.release()
        return self.points / max(int(self.counts[:, ROWS].sum()), 1)

    def coarser(self) -> MomentGrid:
        """The next level of the octree: cells of twice the edge, each the sum of its eight children; summed once."""
        self.release()
        if self._coarser is None or self._coarser.points != self.points:
            self._coarser = self._summed()
        return self._coarser

    def _summed(self) -> MomentGrid:
        from scanfind.kernels.grid import LEFT_OUT, sum_children

        parent = MomentGrid(2.0 * self.cell, self.offset, self._jobs)
        parent.points, parent.signed = self.points, self.signed
        parent.counts[0, LEFT_OUT] = self.unaddressable
        parent.units = 2.0 * self.units
        parent._beams = self._beams
        blocks, half = self.blocks(), np.int64(self.units / 2)
        keys, cells = self.block_keys, self.block_rows
        parent._in_shards(
            len(blocks),
            lambda at, shard, arrays: sum_children(
                at, blocks, keys, cells, self.moments, self.links, half, shard, self._shards, *arrays
            ),
        )
        return parent

    def beams(self) -> list[Beams]:
        """The nearest in each direction from each scanner position, in the order of their coordinates."""
        self.release()
        return [Beams(np.array(key), self._beams[key], DEPTH_PIXELS) for key in sorted(self._beams)]


def room(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """An array of zeros that costs memory only where it is written, from its beginning on.

    Not in huge pages: they take a tenth of a second off a pass of 10 M points where the system has them at hand, and
    add three to five where it must first make them from what another program left behind.
    """
    size = int(np.prod(shape)) * dtype.itemsize
    private = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}
    return np.frombuffer(mmap.mmap(-1, size, **private), dtype).reshape(shape)


def doubled(array: NDArray[Any]) -> NDArray[Any]:
    """Twice the room along the first axis."""
    larger = room((2 * len(array), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def empty_hash(entries: int) -> tuple[Ints, NDArray[np.int32]]:
    """Keys and values of an empty hash table with room for so many entries at a load of at most a half."""
    size = 1 << max(4, int(2 * max(entries, 1) - 1).bit_length())
    return np.full(size, -1, np.int64), np.zeros(size, np.int32)
