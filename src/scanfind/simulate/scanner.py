"""A virtual terrestrial laser scanner: a panoramic raster of beams with range noise, mixed pixels and dropouts."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.cloud import PointCloud, as_points
from scanfind.errors import UsageError
from scanfind.pose import Pose
from scanfind.simulate.rays import RayCaster
from scanfind.simulate.scene import BACKGROUND, Scene

Floats = NDArray[np.float64]

# A block of columns is the unit of work and of chance: fixed, so that threads and memory do not change the scan.
BLOCK_RAYS = 500_000
PILOT_RAYS = 40_000


@dataclass(frozen=True)
class Scanner:
    """What the instrument can do. Lengths in metres, angles in radians.

    step : angle between neighbouring beams, both ways (0.0016 is 10 mm at 6.3 m)
    lowest, highest : elevation of the raster's first and last row
    nearest, farthest : range limits
    noise : range noise sigma
    noise_per_metre : what it grows by with range
    noise_grazing : what it grows by at grazing incidence: sigma / cos**noise_grazing
    beam_diameter, beam_divergence : the beam's footprint is their sum at a range, full width
    mixing : two surfaces under one beam closer than this in range give one blended return; farther ones the first
    edge : a range step between neighbours beyond this, beyond what a slope makes, is looked at for mixed pixels
    dimmest : least return, as reflectance x cos(incidence) x (10 m / range)², that is surely seen
    """

    step: float = 0.0016
    lowest: float = float(np.radians(-60.0))
    highest: float = float(np.radians(90.0))
    nearest: float = 0.4
    farthest: float = 80.0
    noise: float = 0.002
    noise_per_metre: float = 0.0
    noise_grazing: float = 0.0
    beam_diameter: float = 0.005
    beam_divergence: float = 0.0006
    mixing: float = 1.0
    edge: float = 0.03
    dimmest: float = 0.02

    def __post_init__(self) -> None:
        if not (0.0 < self.step <= 0.5 and -np.pi / 2 <= self.lowest < self.highest <= np.pi / 2):
            msg = (
                "a scanner needs 0 < step <= 0.5 and -90 <= lowest < highest <= 90 degrees, got "
                f"step {self.step}, {np.degrees(self.lowest):.1f} to {np.degrees(self.highest):.1f}"
            )
            raise UsageError(msg)

    def rows(self) -> int:
        """How many beams a column has."""
        return max(2, round((self.highest - self.lowest) / self.step) + 1)

    def columns(self) -> int:
        """How many columns a full turn has."""
        return max(4, round(2 * np.pi / self.step))

    def directions(self, row: ArrayLike, column: ArrayLike) -> Floats:
        """Unit directions (N, 3) of the beams at row, column (N,): row 0 lowest, column 0 towards +x, turning to +y."""
        elevation = self.lowest + (self.highest - self.lowest) * np.asarray(row) / (self.rows() - 1)
        azimuth = 2 * np.pi * np.asarray(column) / self.columns()
        level = np.cos(elevation)
        return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)

    def with_step(self, step: float) -> Scanner:
        """The same instrument set to another resolution."""
        return replace(self, step=step)


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
    scanner: Scanner
    truth: Mapping[str, list[Pose]]
    object_names: tuple[str, ...]

    def __len__(self) -> int:
        return sum(len(station) for station in self.stations)

    def points_on(self, object_id: int) -> Floats:
        """(N, 3): every scanned point of one object, from all stations."""
        return np.concatenate([s.xyz[s.attributes["object_id"] == object_id] for s in self.stations])


def scan(
    scene: Scene,
    stations: ArrayLike | None = None,
    scanner: Scanner | None = None,
    seed: int = 0,
    points: int | None = None,
    threads: int = 2,
) -> SimulatedScan:
    """Scan a scene from each station in turn.

    stations : (S, 3) where the scanner stands, metres; None for the scene's own
    points : about how many valid points in all; sets the scanner's step. None keeps it
    Same seed, same points, on any number of threads. Raises UsageError, InvalidGeometryError.
    """
    where = as_points(scene.stations if stations is None else stations, "stations")
    if not len(where):
        msg = "a scan needs at least one station"
        raise UsageError(msg)
    caster = scene.caster()
    reflectance = np.array([thing.reflectance for thing in scene.objects])
    device = scanner or Scanner()
    if points is not None:
        device = device.with_step(_step_for(points, caster, reflectance, where, device, seed))
    columns = max(1, BLOCK_RAYS // device.rows())
    clouds = []
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for station, origin in enumerate(where):
            shoot = partial(_block, caster, reflectance, origin, device, (seed, station), columns)
            blocks = list(pool.map(shoot, range(0, device.columns(), columns)))
            attributes = {name: np.concatenate([a[name] for _, a in blocks]) for name in blocks[0][1]}
            clouds.append(PointCloud(np.concatenate([xyz for xyz, _ in blocks]), attributes, origin.copy()))
    return SimulatedScan(clouds, device, scene.truth(), tuple(thing.name for thing in scene.objects))


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


def _step_for(
    points: int, caster: RayCaster, reflectance: Floats, stations: Floats, scanner: Scanner, seed: int
) -> float:
    """The step that gives about `points` valid ones: a coarse pilot scan tells what share of beams comes back."""
    if points < 1:
        msg = f"the number of points must be at least 1, got {points}"
        raise UsageError(msg)
    turn = 2 * np.pi * (scanner.highest - scanner.lowest)
    pilot = scanner.with_step(min(0.5, float(np.sqrt(turn / PILOT_RAYS))))
    back = sum(
        len(_block(caster, reflectance, origin, pilot, (seed, station), pilot.columns(), 0)[0])
        for station, origin in enumerate(stations)
    )
    share = back / (pilot.rows() * pilot.columns() * len(stations))
    if share == 0.0:
        msg = "no beam comes back: the stations see nothing of the scene within the scanner's range"
        raise UsageError(msg)
    return min(0.5, float(np.sqrt(turn * len(stations) * share / points)))


def _block(
    caster: RayCaster,
    reflectance: Floats,
    origin: Floats,
    scanner: Scanner,
    seed: tuple[int, int],
    columns: int,
    first: int,
) -> tuple[Floats, dict[str, NDArray[Any]]]:
    """Scan `columns` columns from `first` on: points (N, 3) and their attributes, N at most columns x rows."""
    rng = np.random.default_rng([*seed, first])
    rows = scanner.rows()
    column = np.arange(first, min(first + columns, scanner.columns()))
    row = np.tile(np.arange(rows), len(column))
    column = np.repeat(column, rows)
    directions = scanner.directions(row, column)
    hits = caster.shoot(origin, directions)
    distance, owner = hits.distance, hits.owner

    at_edge = np.flatnonzero(_edges(distance.reshape(-1, rows), scanner.edge).reshape(-1))
    distance = distance.copy()
    mixed = np.zeros(len(distance), dtype=np.uint8)
    blended, where = _blend(caster, scanner, origin, directions[at_edge], distance[at_edge], rng)
    distance[at_edge[where]], mixed[at_edge[where]] = blended, 1

    with np.errstate(invalid="ignore"):
        echo = np.where(owner >= 0, reflectance[owner], 0.0) * hits.cosine
        back = echo * (10.0 / np.maximum(distance, 1.0)) ** 2
        seen = (distance >= scanner.nearest) & (distance <= scanner.farthest)
        seen &= rng.random(len(distance)) < back / scanner.dimmest
    distance, echo = distance[seen], echo[seen]
    sigma = (scanner.noise + scanner.noise_per_metre * distance) / np.maximum(
        hits.cosine[seen], 0.05
    ) ** scanner.noise_grazing
    measured = distance + sigma * rng.standard_normal(len(distance))
    intensity = np.clip(echo + 0.02 * rng.standard_normal(len(echo)), 0.0, 1.0)
    return origin + directions[seen] * measured[:, None], {
        "intensity": intensity.astype(np.float32),
        "row": row[seen].astype(np.int32),
        "column": column[seen].astype(np.int32),
        "object_id": np.where(mixed[seen] > 0, np.int32(BACKGROUND), owner[seen]).astype(np.int32),
        "mixed": mixed[seen],
    }


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


def _blend(
    caster: RayCaster,
    scanner: Scanner,
    origin: Floats,
    directions: Floats,
    distance: Floats,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.int64]]:
    """Mixed pixels among K beams at edges: the blended ranges and which beams have them.

    A second ray somewhere in the beam's footprint; where it meets another surface not too far from the first, the
    return is a weighted mean of both ranges, as the phase of the summed light is.
    """
    if not len(directions):
        return np.zeros(0), np.zeros(0, dtype=np.int64)
    reach = np.where(np.isfinite(distance), distance, scanner.farthest)
    half = (scanner.beam_diameter + scanner.beam_divergence * reach) / 2
    across = np.cross(directions, rng.standard_normal(directions.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    offset = across * (half * np.sqrt(rng.random(len(half))))[:, None]
    aside = directions * reach[:, None] + offset
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    second = caster.shoot(origin, aside).distance
    weight = rng.random(len(half))
    with np.errstate(invalid="ignore"):
        gap = np.abs(second - distance)
        where = np.flatnonzero((gap > scanner.edge) & (gap < scanner.mixing))
    return distance[where] + weight[where] * (second[where] - distance[where]), where
