"""Scanning a scene: a raster of beams from each station, with range noise, mixed pixels and dropouts."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.cloud import PointCloud, as_points
from scanfind.errors import UsageError
from scanfind.evidence.rays import RayCaster
from scanfind.pose import Pose
from scanfind.simulate.instruments import Instrument, Scanner
from scanfind.simulate.scene import BACKGROUND, Scene

__all__ = ["Block", "Scanner", "SimulatedScan", "Survey", "scan", "shares"]

Floats = NDArray[np.float64]

# A block of columns is the unit of work and of chance: fixed, so that threads and memory do not change the scan.
BLOCK_RAYS = 500_000
PILOT_RAYS = 40_000
ATTRIBUTES: Mapping[str, np.dtype[np.generic]] = {
    "intensity": np.dtype(np.float32),
    "row": np.dtype(np.int32),
    "column": np.dtype(np.int32),
    "object_id": np.dtype(np.int32),
    "mixed": np.dtype(np.uint8),
}


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """What the scanner brought home, a cloud per station, and the truth it came from.

    stations : clouds in the scene's frame with intensity (float32, 0 … 1), row, column (int32), object_id (int32, index
        into the scene's objects; 0 = background or no surface at all) and mixed (uint8, 1 = blended at an edge)
    scanner : the instrument at the resolution used
    truth : model name → scene_from_model of each copy
    object_names : by object_id
    """

    stations: list[PointCloud]
    scanner: Instrument
    truth: Mapping[str, list[Pose]]
    object_names: tuple[str, ...]

    def __len__(self) -> int:
        return sum(len(station) for station in self.stations)

    def points_on(self, object_id: int) -> Floats:
        """(N, 3): every scanned point of one object, from all stations."""
        return np.concatenate([s.xyz[s.attributes["object_id"] == object_id] for s in self.stations])


class Block(NamedTuple):
    """Some points of one station, and how many beams were sent out for them."""

    station: int
    beams: int
    cloud: PointCloud


@dataclass(frozen=True, eq=False)
class Survey:
    """A scan about to be made: an instrument, where it will stand, and the scene made ready for its rays.

    poses : scene_from_instrument at each station
    """

    scene: Scene
    caster: RayCaster
    scanner: Instrument
    poses: tuple[Pose, ...]
    seed: int

    @staticmethod
    def of(
        scene: Scene,
        stations: ArrayLike | None = None,
        scanner: Instrument | None = None,
        seed: int = 0,
        points: int | None = None,
    ) -> Survey:
        """Arguments and errors as for `scan`."""
        where = as_points(scene.stations if stations is None else stations, "stations")
        if not len(where):
            msg = "a scan needs at least one station"
            raise UsageError(msg)
        device = scanner or Scanner()
        poses = tuple(device.placed(at, to) for at, to in zip(where, scene.looked_at(where), strict=True))
        survey = Survey(scene, scene.caster(), device, poses, seed)
        return survey if points is None else survey.with_step(_step_for(points, survey))

    def with_step(self, step: float) -> Survey:
        """The same survey at another resolution."""
        return Survey(self.scene, self.caster, self.scanner.with_step(step), self.poses, self.seed)

    def beams(self) -> int:
        """How many beams all stations send out."""
        return self.scanner.rows() * self.scanner.columns() * len(self.poses)

    def blocks(self, threads: int) -> Iterator[Block]:
        """All points, station by station, columns in order; the same for any number of threads.

        Only a few blocks wait to be taken, however slow the taker is.
        """
        columns = max(1, BLOCK_RAYS // self.scanner.rows())
        work = [(k, first) for k in range(len(self.poses)) for first in range(0, self.scanner.columns(), columns)]
        pool, waiting = ThreadPoolExecutor(max(1, threads)), deque[Future[Block]]()
        try:
            for station, first in work:
                waiting.append(pool.submit(self._block, station, columns, first))
                if len(waiting) > 2 * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

    def _block(self, station: int, columns: int, first: int) -> Block:
        """Scan `columns` columns from `first` on: at most columns x rows points."""
        rng = np.random.default_rng([self.seed, station, first])
        scanner, pose = self.scanner, self.poses[station]
        rows = scanner.rows()
        column = np.arange(first, min(first + columns, scanner.columns()))
        row = np.tile(np.arange(rows), len(column))
        column = np.repeat(column, rows)
        directions = pose.turn(scanner.aim(row, column, rng))
        hits = self.caster.shoot(pose.translation, directions)
        distance, owner = hits.distance.copy(), hits.owner

        at_edge = np.flatnonzero(_edges(distance.reshape(-1, rows), scanner.edge).reshape(-1))
        mixed = np.zeros(len(distance), dtype=np.uint8)
        blended, where = self._blend(pose.translation, directions[at_edge], distance[at_edge], rng)
        distance[at_edge[where]], mixed[at_edge[where]] = blended, 1

        with np.errstate(invalid="ignore"):
            echo = np.where(owner >= 0, self.scene.reflectances()[owner], 0.0) * hits.cosine
            seen = scanner.reaches(distance)
            seen &= rng.random(len(distance)) < scanner.brightness(distance, echo)
        kept = np.flatnonzero(seen)
        surface = pose.translation + directions[kept] * distance[kept, None]
        kept = kept[scanner.keeps(self.caster, pose, surface, rng, self.seed)]
        distance, echo, mixed = distance[kept], echo[kept], mixed[kept]
        measured = distance + scanner.sigma(distance, hits.cosine[kept]) * rng.standard_normal(len(kept))
        intensity = np.clip(echo + 0.02 * rng.standard_normal(len(kept)), 0.0, 1.0)
        attributes = {
            "intensity": intensity,
            "row": row[kept],
            "column": column[kept],
            "object_id": np.where(mixed > 0, BACKGROUND, owner[kept]),
            "mixed": mixed,
        }
        cloud = PointCloud(
            pose.translation + directions[kept] * measured[:, None],
            {name: attributes[name].astype(dtype) for name, dtype in self.fields().items()},
            pose.translation if scanner.has_stations else None,
        )
        return Block(station, len(row), cloud)

    def fields(self) -> dict[str, np.dtype[np.generic]]:
        """The attributes its points have; what has no stations has no raster either."""
        left_out = () if self.scanner.has_stations else ("row", "column")
        return {name: dtype for name, dtype in ATTRIBUTES.items() if name not in left_out}

    def _blend(
        self, origin: Floats, directions: Floats, distance: Floats, rng: np.random.Generator
    ) -> tuple[Floats, NDArray[np.int64]]:
        """Mixed pixels among K beams at edges: the blended ranges and which beams have them.

        A second ray somewhere in the beam's footprint; where it meets another surface not too far from the first, the
        return is a weighted mean of both ranges, as the phase of the summed light is.
        """
        scanner = self.scanner
        if not len(directions):
            return np.zeros(0), np.zeros(0, dtype=np.int64)
        reach = np.where(np.isfinite(distance), distance, scanner.farthest)
        half = (scanner.beam_diameter + scanner.beam_divergence * reach) / 2
        across = np.cross(directions, rng.standard_normal(directions.shape))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        offset = across * (half * np.sqrt(rng.random(len(half))))[:, None]
        aside = directions * reach[:, None] + offset
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
        second = self.caster.shoot(origin, aside).distance
        weight = rng.random(len(half))
        with np.errstate(invalid="ignore"):
            gap = np.abs(second - distance)
            where = np.flatnonzero((gap > scanner.edge) & (gap < scanner.mixing))
        return distance[where] + weight[where] * (second[where] - distance[where]), where


def scan(
    scene: Scene,
    stations: ArrayLike | None = None,
    scanner: Instrument | None = None,
    seed: int = 0,
    points: int | None = None,
    threads: int = 2,
) -> SimulatedScan:
    """Scan a scene from each station in turn.

    stations : (S, 3) where the scanner stands, metres; None for the scene's own
    points : about how many valid points in all; sets the scanner's step. None keeps it
    Same seed, same points, on any number of threads. Raises UsageError, InvalidGeometryError.
    """
    survey = Survey.of(scene, stations, scanner, seed, points)
    blocks: list[list[PointCloud]] = [[] for _ in survey.poses]
    for block in survey.blocks(threads):
        blocks[block.station].append(block.cloud)
    clouds = [_joined(parts) for parts in blocks]
    return SimulatedScan(clouds, survey.scanner, scene.truth(), tuple(thing.name for thing in scene.objects))


def shares(caster: RayCaster, stations: Floats, scanner: Scanner) -> Floats:
    """Which share of the beams that meet something each mesh gets, (meshes,), over all stations (S, 3)."""
    row, column = np.divmod(np.arange(scanner.rows() * scanner.columns()), scanner.columns())
    directions = scanner.directions(row, column)
    counts = np.zeros(caster.meshes)
    for station in stations:
        owner = caster.shoot(station, directions).owner
        counts += np.bincount(owner[owner >= 0], minlength=caster.meshes)
    share: Floats = counts / max(1.0, counts.sum())
    return share


def _joined(parts: Sequence[PointCloud]) -> PointCloud:
    attributes = {name: np.concatenate([part.attributes[name] for part in parts]) for name in parts[0].attributes}
    origin = parts[0].origin
    return PointCloud(
        np.concatenate([part.xyz for part in parts]), attributes, None if origin is None else origin.copy()
    )


def _step_for(points: int, survey: Survey) -> float:
    """The step that gives about `points` valid ones: a coarse pilot scan tells what share of beams comes back."""
    if points < 1:
        msg = f"the number of points must be at least 1, got {points}"
        raise UsageError(msg)
    area = survey.scanner.area()
    pilot = survey.with_step(min(0.5, max(survey.scanner.finest, float(np.sqrt(area / PILOT_RAYS)))))
    shots = map(partial(pilot._block, columns=pilot.scanner.columns(), first=0), range(len(pilot.poses)))
    share = sum(len(block.cloud) for block in shots) / pilot.beams()
    if share == 0.0:
        msg = "no beam comes back: the stations see nothing of the scene within the scanner's range"
        raise UsageError(msg)
    return min(0.5, float(np.sqrt(area * len(survey.poses) * share / points)))


def _edges(distance: Floats, step: float) -> NDArray[np.bool_]:
    """Where the raster (C, R) of ranges jumps: beams next to one whose range bends away by more than `step`.

    The second difference, not the first: a floor seen far off steps evenly and has no edge.
    """
    r = np.minimum(distance, 1e6)
    edge = np.zeros(r.shape, dtype=bool)
    for axis in (0, 1):
        if r.shape[axis] < 3:
            continue
        bend = np.abs(np.diff(r, n=2, axis=axis)) > step
        middle = np.moveaxis(edge, axis, 0)
        middle[1:-1] |= np.moveaxis(bend, axis, 0)
    return edge
