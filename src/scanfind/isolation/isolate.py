"""Isolate: a second pass over the raw points gives each detection its own, with all their attributes (paper, 3.5).

The paper names this its slow part. Here nearly all points are dismissed by one look-up in the cells near placed
surfaces (`Vicinity`); the exact distance is left to the few that remain. Points may arrive in any chunks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.cloud import PointChunk
from scanfind.detection import IsolatedPoints
from scanfind.errors import InvalidGeometryError, UsageError
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface, Vicinity
    from scanfind.pose import Pose

Floats = NDArray[np.float64]

# The table of blocks stays below 16 MB: where the boxes of all placed models need more, cells grow instead.
MAX_BLOCKS = 4_000_000
# Blocks looked at in one go while the vicinity is built: 4 MB of bits, of which most are dropped at once.
BLOCKS_AT_ONCE = 65_536


@dataclass(frozen=True)
class IsolateParameters:
    """What isolation may decide.

    tolerance : a raw point within this distance of a placed surface belongs to it, metres; there is no default here,
        for it follows from the scan: about three times its range noise, or half the resolution where that is more
    cell : edge of the cells of the first look-up, metres. Only speed depends on it: smaller cells let fewer points
        through to the exact distance, but no longer fit the processor's cache (4 cm: 120 kB for a model of 3 m)
    """

    tolerance: float
    cell: float = 0.04

    def __post_init__(self) -> None:
        for name, value in (("tolerance", self.tolerance), ("cell", self.cell)):
            if not (np.isfinite(value) and value > 0):
                msg = f"the {name} of isolation must be a positive length in metres, got {value}"
                raise UsageError(msg)


@dataclass(frozen=True, eq=False)
class Placed:
    """A model's surface where a detection has it.

    id : the detection's, from 1
    near : built once a model and shared by its instances, with a reach not below the tolerance
    scene_from_model : in the shifted scene, that is for xyz - shift
    """

    id: int
    near: NearSurface
    scene_from_model: Pose


class Isolator:
    """Says of each raw point whose it is: the nearest placed surface within tolerance has it, and no other.

    shift : (3,) what is taken off the file's coordinates before a pose of `placed` holds, metres
    jobs : threads, on which the result does not depend

    Raises UsageError for ids that are below 1 or used twice, or a reach below the tolerance.
    """

    def __init__(
        self, placed: Sequence[Placed], parameters: IsolateParameters, shift: ArrayLike = (0, 0, 0), jobs: int = 1
    ) -> None:
        ids = [p.id for p in placed]
        if len(set(ids)) < len(ids) or min(ids, default=1) < 1:
            msg = f"placed models need different ids from 1 on, got {sorted(ids)}"
            raise UsageError(msg)
        if short := [p.id for p in placed if p.near.reach < parameters.tolerance]:
            msg = f"the surface of detection {short[0]} must be built with a reach of at least {parameters.tolerance} m"
            raise UsageError(msg)
        # Lowest id first: the first of two equal distances is kept.
        self.placed = sorted(placed, key=lambda p: p.id)
        self.tolerance, self.jobs = np.float32(parameters.tolerance), jobs
        self.shift = np.array(shift, dtype=np.float64)
        if self.shift.shape != (3,):
            msg = f"the shift of a scene must have shape (3,), got {self.shift.shape}"
            raise InvalidGeometryError(msg)
        self._vicinity, self._start, self._which = vicinity_of(self.placed, parameters)

    def cut(self, chunk: PointChunk) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Whose each of N points is, (N,), 0 for nobody, and its distance to that surface, (N,), NaN for nobody.

        Distances are in metres, + outside.
        """
        from scanfind.kernels.distance import blocks_of

        owner = np.zeros(len(chunk), dtype=np.int32)
        deviation = np.full(len(chunk), np.nan, dtype=np.float32)
        xyz = np.ascontiguousarray(chunk.xyz, dtype=np.float64)
        if not len(xyz):
            return owner, deviation
        parts = in_threads(self.jobs, len(xyz), lambda i, j: blocks_of(self._vicinity, self.shift, xyz[i:j]))
        block = np.concatenate(parts)
        rows = np.flatnonzero(block >= 0)
        for placed, mine in self._candidates(rows, block[rows]):
            if not len(mine):
                continue
            distance = np.concatenate(in_threads(self.jobs, len(mine), partial(self._measure, placed, xyz, mine)))
            so_far = np.where(owner[mine] > 0, np.abs(deviation[mine]), np.float32(np.inf))
            nearer = (np.abs(distance) <= self.tolerance) & (np.abs(distance) < so_far)
            owner[mine[nearer]] = placed.id
            deviation[mine[nearer]] = distance[nearer]
        return owner, deviation

    def pieces(self, chunk: PointChunk) -> Iterator[tuple[int, IsolatedPoints]]:
        """The points of a chunk that belong to somebody: (id, points), by id, in the chunk's order.

        For a writer that follows the stream; `isolate` gathers the same pieces.
        """
        return pieces_of(chunk, *self.cut(chunk))

    def _measure(self, placed: Placed, xyz: Floats, mine: NDArray[np.int64], i: int, j: int) -> NDArray[np.float32]:
        """How far the points xyz[mine[i:j]] are from a placed surface, NaN beyond its reach."""
        from scanfind.kernels.distance import distances

        pose = placed.scene_from_model
        distance, _ = distances(placed.near, pose.rotation, pose.translation, self.shift, xyz, mine[i:j])
        return np.asarray(distance)

    def _candidates(
        self, rows: NDArray[np.int64], block: NDArray[np.int32]
    ) -> Iterator[tuple[Placed, NDArray[np.int64]]]:
        """Each placed model with the rows (K,) of the points whose block it is near, lowest id first."""
        if len(self.placed) == 1:
            yield self.placed[0], rows
            return
        count = self._start[block + 1] - self._start[block]
        first = np.repeat(self._start[block] - (np.cumsum(count) - count), count)
        which = self._which[first + np.arange(len(first))]
        rows = np.repeat(rows, count)[np.argsort(which, kind="stable")]
        ends = np.cumsum(np.bincount(which, minlength=len(self.placed)))
        for k in np.unique(which):
            yield self.placed[k], rows[ends[k - 1] if k else 0 : ends[k]]


def isolate(
    chunks: Iterable[PointChunk],
    placed: Sequence[Placed],
    parameters: IsolateParameters,
    shift: ArrayLike = (0, 0, 0),
    jobs: int = 1,
) -> dict[int, IsolatedPoints]:
    """The raw points of every placed model, by detection id, in the order of the stream; empty where there is none.

    chunks : all scans of the scene, file frame; `scan` must count on over files, for it becomes scan_id
    shift : (3,) taken off the file's coordinates before the poses hold, metres
    jobs : threads, on which the result does not depend

    Every detection has every attribute of the scene; where a chunk lacks one, it is NaN (floats) or 0.
    Raises as `Isolator` does.
    """
    isolator = Isolator(placed, parameters, shift, jobs)
    pieces: dict[int, list[IsolatedPoints]] = {p.id: [] for p in isolator.placed}
    fields: dict[str, np.dtype[Any]] = {}
    for chunk in chunks:
        for name, values in chunk.attributes.items():
            fields[name] = np.promote_types(fields.get(name, values.dtype), values.dtype)
        owner, deviation = isolator.cut(chunk)
        for key, piece in pieces_of(chunk, owner, deviation):
            pieces[key].append(piece)
    return {key: joined(mine, fields) for key, mine in pieces.items()}


def pieces_of(
    chunk: PointChunk, owner: NDArray[np.int32], deviation: NDArray[np.float32]
) -> Iterator[tuple[int, IsolatedPoints]]:
    """The owned points of a chunk, (id, points), by id, in the chunk's order."""
    rows = np.flatnonzero(owner)
    rows = rows[np.argsort(owner[rows], kind="stable")]
    mine = subset(chunk, rows)
    ids, first, count = np.unique(owner[rows], return_index=True, return_counts=True)
    for key, start, n in zip(ids.tolist(), first, count, strict=True):
        part = slice(start, start + n)
        yield (
            key,
            IsolatedPoints(
                xyz=mine.xyz[part],
                attributes={name: values[part] for name, values in mine.attributes.items()},
                scan_id=np.full(n, chunk.scan, dtype=np.int32),
                source_index=mine.source_index[part],
                deviation=deviation[rows[part]],
            ),
        )


def nearer(points: IsolatedPoints, distance: float) -> IsolatedPoints:
    """Those of isolated points that are no farther from the surface than a distance, metres."""
    near = np.abs(points.deviation) <= np.float32(distance)
    attributes = {name: values[near] for name, values in points.attributes.items()}
    return IsolatedPoints(
        points.xyz[near], attributes, points.scan_id[near], points.source_index[near], points.deviation[near]
    )


def left_over(chunks: Iterable[PointChunk], isolated: Iterable[IsolatedPoints]) -> Iterator[PointChunk]:
    """What is left of each chunk, one for one and possibly empty: the scene without the points that somebody has."""
    records: dict[int, list[NDArray[np.int64]]] = {}
    for points in isolated:
        for scan in np.unique(points.scan_id).tolist():
            records.setdefault(scan, []).append(points.source_index[points.scan_id == scan])
    taken = {scan: np.sort(np.concatenate(some)) for scan, some in records.items()}
    for chunk in chunks:
        yield subset(chunk, ~np.isin(chunk.source_index, taken.get(chunk.scan, ())))


def subset(chunk: PointChunk, rows: NDArray[Any]) -> PointChunk:
    """Some points of a chunk, by mask or row number, with all else it says."""
    attributes = {name: values[rows] for name, values in chunk.attributes.items()}
    return PointChunk(chunk.xyz[rows], attributes, chunk.source_index[rows], chunk.scan, chunk.origin, chunk.dropped)


def joined(pieces: Sequence[IsolatedPoints], fields: Mapping[str, np.dtype[Any]]) -> IsolatedPoints:
    """Pieces end to end, each attribute of `fields` in its dtype; NaN (floats) or 0 where a piece lacks it."""

    def column(name: str, dtype: np.dtype[Any]) -> NDArray[Any]:
        missing = np.array(np.nan if dtype.kind == "f" else 0).astype(dtype)
        parts = [piece.attributes.get(name, np.broadcast_to(missing, len(piece))) for piece in pieces]
        return np.concatenate([np.empty(0, dtype), *parts]).astype(dtype, copy=False)

    return IsolatedPoints(
        xyz=np.concatenate([np.empty((0, 3)), *(piece.xyz for piece in pieces)]),
        attributes={name: column(name, dtype) for name, dtype in fields.items()},
        scan_id=np.concatenate([np.empty(0, np.int32), *(piece.scan_id for piece in pieces)]),
        source_index=np.concatenate([np.empty(0, np.int64), *(piece.source_index for piece in pieces)]),
        deviation=np.concatenate([np.empty(0, np.float32), *(piece.deviation for piece in pieces)]),
    )


def vicinity_of(
    placed: Sequence[Placed], parameters: IsolateParameters
) -> tuple[Vicinity, NDArray[np.int64], NDArray[np.int64]]:
    """The cells within tolerance of any placed surface, and for each of B blocks the placed models it is near.

    Returns the vicinity, start (B + 1,) and which (K,): block b is near placed[which[start[b] : start[b + 1]]].
    """
    from scanfind.kernels.distance import Vicinity, cells_near

    boxes = np.array([scene_box(p, parameters.tolerance) for p in placed]).reshape(-1, 2, 3)
    low, high = (boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)) if len(placed) else (np.zeros(3), np.zeros(3))
    cell = parameters.cell
    while np.prod(np.floor((high - low) / (8 * cell)) + 1) > MAX_BLOCKS:
        cell *= 1.25
    shape = (np.floor((high - low) / (8 * cell)) + 1).astype(np.int64)
    found: list[tuple[NDArray[np.int64], NDArray[np.uint64]]] = []
    for p, box in zip(placed, boxes, strict=True):
        first, last = np.floor((box - low) / (8 * cell)).astype(np.int64)
        sides = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
        blocks = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
        pose = p.scene_from_model
        kept: list[tuple[NDArray[np.int64], NDArray[np.uint64]]] = []
        for k in range(0, len(blocks), BLOCKS_AT_ONCE):
            some = blocks[k : k + BLOCKS_AT_ONCE]
            bits = np.zeros((len(some), 8), np.uint64)
            cells_near(p.near, pose.rotation, pose.translation, low, cell, some, parameters.tolerance, bits)
            near = bits.any(axis=1)
            kept.append((np.ravel_multi_index(tuple(some[near].T), tuple(shape)), bits[near]))
        found.append((np.concatenate([a for a, _ in kept]), np.concatenate([b for _, b in kept])))
    address = np.concatenate([np.empty(0, np.int64), *(a for a, _ in found)])
    which = np.repeat(np.arange(len(found)), [len(a) for a, _ in found])
    occupied, block = np.unique(address, return_inverse=True)
    top = np.full(tuple(shape), -1, dtype=np.int32)
    top.ravel()[occupied] = np.arange(len(occupied), dtype=np.int32)
    cells = np.zeros((len(occupied), 8), dtype=np.uint64)
    for k, (_, bits) in enumerate(found):
        cells[block[which == k]] |= bits
    start = np.concatenate([[0], np.cumsum(np.bincount(block, minlength=len(occupied)))])
    return Vicinity(low, float(cell), top, cells), start, which[np.argsort(block, kind="stable")]


def scene_box(placed: Placed, tolerance: float) -> Floats:
    """Low and high corner, (2, 3), of the box in the shifted scene that holds all points a placed model may own."""
    corners = placed.near.boxes[1].reshape(2, 3)
    middle = placed.scene_from_model.move(corners.mean(axis=0))
    half = np.abs(placed.scene_from_model.rotation) @ (corners[1] - corners[0]) / 2.0
    half = half + 1.001 * (tolerance + placed.near.spacing) + 1e-9 * np.abs(middle).max()
    return np.array([middle - half, middle + half])
