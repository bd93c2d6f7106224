"""What each scanner saw in each direction: the nearest range, as a cube map."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.threads import once

Floats = NDArray[np.float64]
NO_BEAMS, NO_BITS, NO_PATCHES = np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.float32)

DEPTH_PIXELS = 360  # along an edge of the cube map: 0.25° a pixel, 35 mm at 8 m
# Pixels are joined until the maps speak of this share of what they look at: of the samples they are silent about, those
# they speak of tell (verify.spread). Joined further, a part missing from the scan is taken for one seen through.
LEAST_SPOKEN, LEAST_DEPTH_PIXELS = 0.08, 45
ENOUGH_AROUND = 3  # of a pixel and the four beside it must be filled for a sample to be seen through or hidden
# Of directions towards a surface so many must bring something back for silence to tell; a scanner sees as far as so
# many of its beams went; an azimuth is known to a degree; the middle of a pixel (kernels.grid.pack_beam).
LEAST_FILLED, SEES, AZIMUTHS, PIXELS_MIDDLE = 0.3, 0.99, 360, (128 << 8) | 128
LOOKED_AT = 45  # patches along an edge, of 2°: one with any range in it was looked at


class Silence(NamedTuple):
    """Where a scanner looked and nothing came back: beams that went as far as it sees.

    origin, edge : see Beams; where : (6 · edge² / 8,) uint8, a bit a pixel; reach : how far it sees, metres
    """

    origin: Floats
    where: NDArray[np.uint8]
    reach: float
    edge: int
    filled: float = 1.0  # each is one of its own

    def towards(self, points: Floats, reach: float, short: float = np.inf) -> NDArray[np.int64]:
        """The pixels within `reach` metres of points (N, 3) from which nothing came back: none is too short."""
        return pixels_in(points, self.origin, reach, self.edge, silent=self.where)

    def beams_in(self, pixels: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
        """Unit directions (B, 3), ranges and solid angles (B,) of the beams in some pixels (B,)."""
        from scanfind.kernels.grid import RANGE_UNITS

        went = (np.int64(self.reach * RANGE_UNITS) << 16) | PIXELS_MIDDLE
        return unpacked_beams(pixels, np.full(len(pixels), went), self.edge)


@dataclass(frozen=True, eq=False)
class Beams:
    """The nearest beam that came back from each direction, exactly: beside which pixel it went tells what it missed.

    origin : (3,) where the scanner stood, relative to the grid's offset
    nearest : (6 · edge²,) int64, range and aim (kernels.grid.pack_beam), NO_BEAM where none came back
    """

    origin: Floats
    nearest: NDArray[np.int64]
    edge: int

    def silent(self) -> NDArray[np.bool_]:
        """Where the scanner looked and nothing came back, (6 · edge²,); nowhere if too seldom something does.

        A scanner sweeps all directions of one elevation alike, and all elevations at each azimuth: it looked wherever
        one came back as steeply somewhere, and one at all that way. z is up.
        """
        from scanfind.kernels.grid import NO_BEAM

        filled = self.nearest < NO_BEAM
        if self.filled < LEAST_FILLED:
            return np.zeros_like(filled)
        elevation, azimuth = angles_of(self.edge)
        low, high = elevation[filled].min(), elevation[filled].max()
        turned = np.zeros(AZIMUTHS, np.bool_)
        turned[azimuth[filled]] = True
        turned |= np.roll(turned, 1) | np.roll(turned, -1)
        return np.asarray(~filled & turned[azimuth] & (elevation >= low) & (elevation <= high))

    @once
    def silence(self) -> Silence:
        """What the scanner did not see though it looked."""
        from scanfind.kernels.grid import NO_BEAM, RANGE_UNITS

        ranges = (self.nearest[self.nearest < NO_BEAM] >> 16) / RANGE_UNITS
        reach = float(np.quantile(ranges, SEES)) if len(ranges) else 0.0
        return Silence(self.origin, np.packbits(self.silent()), reach, self.edge)

    def towards(self, points: Floats, reach: float, short: float = np.inf) -> NDArray[np.int64]:
        """The pixels within `reach` metres of points (N, 3) in which a beam came back and ended no more than `short`
        metres before the point.
        """
        return pixels_in(
            points, self.origin, reach, self.edge, nearest=self.nearest, short=short, farthest=self._farthest
        )

    def beams_in(self, pixels: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
        """Unit directions (B, 3), ranges and solid angles (B,) of the beams in some pixels (B,)."""
        return unpacked_beams(pixels, self.nearest[pixels], self.edge)

    @once
    def _farthest(self) -> NDArray[np.float32]:
        """How far any beam of each patch went, (6 · LOOKED_AT²,), metres; 0 where none came back."""
        from scanfind.kernels.grid import NO_BEAM, RANGE_UNITS

        few = self.edge // LOOKED_AT
        ranges = np.where(self.nearest < NO_BEAM, (self.nearest >> 16) / RANGE_UNITS, 0.0).astype(np.float32)
        patches = ranges.reshape(6, LOOKED_AT, few, LOOKED_AT, few).max(axis=(2, 4)).reshape(-1)
        return np.asarray(np.nextafter(patches, np.float32(np.inf)))  # rounding shortens none

    @once
    def filled(self) -> float:
        """The share of directions towards a surface that brought a beam back: of patches, that of the upper quarter."""
        from scanfind.kernels.grid import NO_BEAM

        few = self.edge // LOOKED_AT
        patches = (self.nearest < NO_BEAM).reshape(6, LOOKED_AT, few, LOOKED_AT, few).mean(axis=(2, 4))
        looked = patches[patches > 0.0]
        return float(np.quantile(looked, 0.75)) if len(looked) else 0.0

    def ranges(self) -> DepthMap:
        """How far they went, and no more."""
        from scanfind.kernels.grid import NO_BEAM, RANGE_UNITS

        ranges = np.where(self.nearest < NO_BEAM, (self.nearest >> 16) / RANGE_UNITS, np.inf)
        return DepthMap(self.origin, ranges.astype(np.float32), self.edge)


class DepthMap(NamedTuple):
    """The nearest surface seen from one scanner position in each direction.

    origin : (3,) relative to the grid's offset
    ranges : (6 · edge²,) float32, metres, cube map (see kernels.grid.cube_pixel); inf where no beam came back
    """

    origin: Floats
    ranges: NDArray[np.float32]
    edge: int

    def coarser(self) -> DepthMap:
        """Pixels of twice the edge, each the nearest of its four."""
        half = self.edge // 2
        pixels = self.ranges.reshape(6, half, 2, half, 2)
        rows = np.minimum(pixels[:, :, 0], pixels[:, :, 1])
        return DepthMap(self.origin, np.minimum(rows[..., 0], rows[..., 1]).reshape(-1), half)

    def spoken(self) -> float:
        """The share of what was looked at where a sample gets an answer: its pixel and those beside it mostly full."""
        filled = np.isfinite(self.ranges).reshape(6, self.edge, self.edge)
        around = filled.astype(np.int8)
        for axis in (1, 2):
            around[(slice(None),) * axis + (slice(1, None),)] += filled[(slice(None),) * axis + (slice(None, -1),)]
            around[(slice(None),) * axis + (slice(None, -1),)] += filled[(slice(None),) * axis + (slice(1, None),)]
        few = self.edge // LOOKED_AT
        looked = filled.reshape(6, LOOKED_AT, few, LOOKED_AT, few).any(axis=(2, 4))
        looked = looked.repeat(few, axis=1).repeat(few, axis=2)
        return float((around >= ENOUGH_AROUND)[looked].mean()) if looked.any() else 1.0


@lru_cache(maxsize=2)
def angles_of(edge: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """The elevation of each pixel's middle, radians, and its azimuth in AZIMUTHS steps, (6 · edge²,)."""
    every = np.arange(6 * edge**2)
    ways, _, _ = unpacked_beams(every, np.full(len(every), PIXELS_MIDDLE), edge)
    turn = np.arctan2(ways[:, 1], ways[:, 0]) / (2.0 * np.pi) % 1.0
    azimuth = np.minimum((turn * AZIMUTHS).astype(np.intp), AZIMUTHS - 1)
    return np.arcsin(np.clip(ways[:, 2], -1.0, 1.0)).astype(np.float32), azimuth


def pixels_in(
    points: Floats, origin: Floats, reach: float, edge: int, *, nearest: NDArray[np.int64] = NO_BEAMS,
    silent: NDArray[np.uint8] = NO_BITS, short: float = np.inf, farthest: NDArray[np.float32] = NO_PATCHES,
) -> NDArray[np.int64]:  # fmt: skip
    """The pixels about a scanner within `reach` metres of points (N, 3) that have a beam, or a bit: see the kernel."""
    from scanfind.kernels.beams import BLOCK, NOT_ASKED, pixels_towards

    met, found = np.zeros(6 * edge**2, np.bool_), np.empty(6 * edge**2, np.int64)
    across = max(1, edge // LOOKED_AT)
    asked = np.full(6 * (-(-edge // BLOCK)) ** 2, NOT_ASKED, np.int32)
    count = pixels_towards(points, origin, reach, edge, nearest, silent, short, farthest, across, asked, met, found)
    return found[:count]


def unpacked_beams(pixels: NDArray[np.int64], beams: NDArray[np.int64], edge: int) -> tuple[Floats, Floats, Floats]:
    """Unit directions (B, 3), ranges and solid angles (B,) of packed beams (B,) in pixels (B,)."""
    from scanfind.kernels.beams import beams_of

    directions, ranges, angles = np.empty((len(pixels), 3)), np.empty(len(pixels)), np.empty(len(pixels))
    beams_of(pixels, beams, edge, directions, ranges, angles)
    return directions, ranges, angles


def joined_until_spoken(maps: list[DepthMap]) -> list[DepthMap]:
    """Depth maps of one resolution, made coarser together until they speak of enough of what they look at."""
    while maps and maps[0].edge > LEAST_DEPTH_PIXELS and spoken(maps) < LEAST_SPOKEN:
        maps = [depth.coarser() for depth in maps]
    return maps


def spoken(maps: list[DepthMap]) -> float:
    """The share of samples in sight of a scanner that some depth maps speak of."""
    return float(np.mean([depth.spoken() for depth in maps])) if maps else 1.0
