"""What the instruments can do: how their rays go, how well they measure, and what they miss.

One dataclass a kind. The scan itself (`scanner`) knows none of them: it asks an `Instrument` for a raster of beams, the
noise of a range, the chance of a return, and which points a kind loses for reasons of its own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.errors import UsageError
from scanfind.evidence.rays import RayCaster
from scanfind.pose import Pose

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# cos of 87 degrees: beyond it, noise that grows with incidence grows no more.
LEAST_COSINE = 0.05


@dataclass(frozen=True)
class Instrument(ABC):
    """What every kind has. Lengths in metres, angles in radians; in its own frame it looks along +x, z is up.

    step : angle between neighbouring beams, both ways (0.0016 is 10 mm at 6.3 m)
    nearest, farthest : range limits
    noise : range noise sigma
    noise_per_metre, noise_per_metre2 : what it grows by with range, and with its square
    noise_grazing : what it grows by at grazing incidence: sigma / cos**noise_grazing
    beam_diameter, beam_divergence : the beam's footprint is their sum at a range, full width
    mixing : two surfaces under one beam closer than this in range give one blended return; farther ones the first
    edge : a range step between neighbours beyond this, beyond what a slope makes, is looked at for mixed pixels
    dimmest : least return, as reflectance x cos(incidence) x (10 m / range)², that is surely seen
    finest : the smallest step the instrument can be set to
    """

    step: float = 0.0016
    nearest: float = 0.4
    farthest: float = 80.0
    noise: float = 0.002
    noise_per_metre: float = 0.0
    noise_per_metre2: float = 0.0
    noise_grazing: float = 0.0
    beam_diameter: float = 0.005
    beam_divergence: float = 0.0006
    mixing: float = 1.0
    edge: float = 0.03
    dimmest: float = 0.02
    finest: float = 0.0

    # Whether what it brings home says where it stood, and in which row and column of a raster each point lies.
    has_stations: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 0.0 < self.step <= 0.5:
            msg = f"a scanner needs 0 < step <= 0.5 rad, got step {self.step}"
            raise UsageError(msg)
        if self.step < self.finest * (1 - 1e-9):
            least, asked = np.degrees(self.finest), np.degrees(self.step)
            msg = f"this scanner's finest step is {least:.4g} degrees, got {asked:.4g}: give more stations instead"
            raise UsageError(msg)
        if not 0.0 <= self.nearest < self.farthest < np.inf:
            msg = f"a scanner needs 0 <= nearest < farthest, got {self.nearest} and {self.farthest} m"
            raise UsageError(msg)
        for name, least in (("noise", 0.0), ("noise_per_metre", 0.0), ("noise_per_metre2", 0.0), ("noise_grazing", 0.0),
                            ("beam_diameter", 0.0), ("beam_divergence", 0.0), ("mixing", 0.0), ("edge", 1e-6),
                            ("dimmest", 1e-9)):  # fmt: skip
            if not (least <= (value := getattr(self, name)) < np.inf):
                msg = f"a scanner's {name} must be at least {least}, got {value}"
                raise UsageError(msg)

    @abstractmethod
    def rows(self) -> int:
        """How many beams a column has."""

    @abstractmethod
    def columns(self) -> int:
        """How many columns the raster has."""

    @abstractmethod
    def area(self) -> float:
        """Beams in the raster x step²: what a step must be for a number of beams follows from it."""

    @abstractmethod
    def directions(self, row: ArrayLike, column: ArrayLike) -> Floats:
        """Unit directions (N, 3) of the beams at row, column (N,), own frame; row 0 is the lowest."""

    @abstractmethod
    def in_view(self, directions: Floats) -> Mask:
        """Which of N unit directions (N, 3), own frame, the raster covers."""

    @abstractmethod
    def placed(self, position: Floats, look_at: Floats) -> Pose:
        """scene_from_instrument where it stands at `position` (3,) and is to see `look_at` (3,)."""

    def aim(self, row: ArrayLike, column: ArrayLike, rng: np.random.Generator) -> Floats:
        """The directions the beams really take, (N, 3)."""
        return self.directions(row, column)

    def sigma(self, distance: Floats, cosine: Floats) -> Floats:
        """Standard deviation (N,) of ranges (N,) at |cos(incidence)| (N,)."""
        straight = self.noise + self.noise_per_metre * distance + self.noise_per_metre2 * distance**2
        grown: Floats = straight / np.maximum(cosine, LEAST_COSINE) ** self.noise_grazing
        return grown

    def reaches(self, distance: Floats) -> Mask:
        """Which ranges (N,) are within the limits."""
        within: Mask = (distance >= self.nearest) & (distance <= self.farthest)
        return within

    def brightness(self, distance: Floats, echo: Floats) -> Floats:
        """The chance (N,) of a return, from ranges and reflectance x cos(incidence); 1 and above is surely seen."""
        back = echo * (10.0 / np.maximum(distance, 1.0)) ** 2
        return back / self.dimmest

    def keeps(self, caster: RayCaster, pose: Pose, points: Floats, rng: np.random.Generator, seed: int) -> Mask:
        """Which of N points (N, 3), scene frame, are not lost for reasons of this kind's own.

        rng is this block's; seed the whole scan's, for what must look the same from every station.
        """
        return np.ones(len(points), dtype=bool)

    def with_step(self, step: float) -> Instrument:
        """The same instrument set to another resolution."""
        return replace(self, step=step)


@dataclass(frozen=True)
class Scanner(Instrument):
    """A terrestrial laser scanner: a full turn about z, from elevation `lowest` to `highest`, radians."""

    lowest: float = float(np.radians(-60.0))
    highest: float = float(np.radians(90.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not -np.pi / 2 <= self.lowest < self.highest <= np.pi / 2:
            low, high = np.degrees([self.lowest, self.highest])
            msg = f"a scanner needs -90 <= lowest < highest <= 90 degrees, got {low:.1f} to {high:.1f}"
            raise UsageError(msg)

    def rows(self) -> int:
        """How many beams a column has."""
        return max(2, round((self.highest - self.lowest) / self.step) + 1)

    def columns(self) -> int:
        """How many columns a full turn has."""
        return max(4, round(2 * np.pi / self.step))

    def area(self) -> float:
        """2 pi times the elevations covered."""
        return 2 * np.pi * (self.highest - self.lowest)

    def directions(self, row: ArrayLike, column: ArrayLike) -> Floats:
        """Unit directions (N, 3): row 0 lowest, column 0 towards +x, turning to +y."""
        elevation = self.lowest + (self.highest - self.lowest) * np.asarray(row) / (self.rows() - 1)
        azimuth = 2 * np.pi * np.asarray(column) / self.columns()
        level = np.cos(elevation)
        return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)

    def in_view(self, directions: Floats) -> Mask:
        """Whether the elevation is covered."""
        sine = directions[:, 2]
        covered: Mask = (sine >= np.sin(self.lowest)) & (sine <= np.sin(self.highest))
        return covered

    def placed(self, position: Floats, look_at: Floats) -> Pose:
        """Level, column 0 towards the scene's +x: a full turn needs no aiming."""
        return Pose(np.eye(3), position.copy())


@dataclass(frozen=True)
class FrameSensor(Instrument):
    """A structured-light sensor: a camera, view_width x view_height radians, and a projector `baseline` m beside it.

    Pixels are even on the image plane. Where the projector's light does not fall, nothing is measured.
    """

    view_width: float = float(np.radians(57.0))
    view_height: float = float(np.radians(43.0))
    baseline: float = 0.075

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.0 < self.view_width < 3.0 and 0.0 < self.view_height < 3.0 and 0.0 <= self.baseline < 10.0):
            view = f"{np.degrees(self.view_width):.1f} x {np.degrees(self.view_height):.1f}"
            msg = f"a frame sensor needs a view of 0 to 170 degrees and a baseline, got {view} and {self.baseline} m"
            raise UsageError(msg)

    def rows(self) -> int:
        """How many pixels the image is high."""
        return max(2, round(float(2 * np.tan(self.view_height / 2)) / self.step) + 1)

    def columns(self) -> int:
        """How many pixels the image is wide."""
        return max(2, round(float(2 * np.tan(self.view_width / 2)) / self.step) + 1)

    def area(self) -> float:
        """That of the image plane at 1 m."""
        return float(4 * np.tan(self.view_width / 2) * np.tan(self.view_height / 2))

    def directions(self, row: ArrayLike, column: ArrayLike) -> Floats:
        """Unit directions (N, 3): row 0 lowest, column 0 leftmost (+y)."""
        left = np.tan(self.view_width / 2) * (1 - 2 * np.asarray(column) / (self.columns() - 1))
        up = np.tan(self.view_height / 2) * (2 * np.asarray(row) / (self.rows() - 1) - 1)
        rays = np.stack([np.ones_like(left), left, up], axis=-1)
        unit: Floats = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def in_view(self, directions: Floats) -> Mask:
        """Whether the image shows it."""
        ahead, left, up = directions.T
        shown: Mask = np.abs(left) <= np.tan(self.view_width / 2) * ahead
        shown &= np.abs(up) <= np.tan(self.view_height / 2) * ahead
        return shown

    def placed(self, position: Floats, look_at: Floats) -> Pose:
        """Looking at `look_at`, upright."""
        ahead = look_at - position
        yaw, pitch = np.arctan2(ahead[1], ahead[0]), np.arctan2(ahead[2], np.hypot(ahead[0], ahead[1]))
        turned = Pose.from_rotation_vector([0.0, 0.0, yaw]) @ Pose.from_rotation_vector([0.0, -pitch, 0.0])
        return Pose(turned.rotation, position.copy())

    def keeps(self, caster: RayCaster, pose: Pose, points: Floats, rng: np.random.Generator, seed: int) -> Mask:
        """Only what the projector lights."""
        return caster.sees(pose.move([[0.0, -self.baseline, 0.0]])[0], points)


@dataclass(frozen=True)
class Photogrammetry(Scanner):
    """A cloud matched from photographs, taken all around from each station: no origins, uneven density, holes.

    holes : share of the surface too plain to be matched, and so empty
    patch : size of plain and of textured places, metres
    Texture is a smooth random field in space, the same from every station: below the holes' level there is nothing,
    above it the density grows with the field. Points lie off the raster, by up to half a step.
    """

    holes: float = 0.2
    patch: float = 0.5

    has_stations: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.0 <= self.holes < 1.0 and 0.0 < self.patch < np.inf):
            msg = f"photogrammetry needs 0 <= holes < 1 and a patch above 0 m, got {self.holes} and {self.patch}"
            raise UsageError(msg)

    def aim(self, row: ArrayLike, column: ArrayLike, rng: np.random.Generator) -> Floats:
        """Anywhere about the raster's directions, (N, 3)."""
        r, c = np.asarray(row, dtype=np.float64), np.asarray(column, dtype=np.float64)
        away = rng.uniform(-0.5, 0.5, (2, *r.shape))
        return self.directions(np.clip(r + away[0], 0.0, self.rows() - 1), c + away[1])

    def keeps(self, caster: RayCaster, pose: Pose, points: Floats, rng: np.random.Generator, seed: int) -> Mask:
        """By chance, the likelier the more texture there is."""
        density = (self.texture(points, seed) - self.holes) / max(1.0 - self.holes, 1e-9)
        kept: Mask = rng.random(len(points)) < density
        return kept

    def texture(self, points: Floats, seed: int) -> Floats:
        """How much there is to match at points (N, 3), 0 … 1, each value as common as any other."""
        rng = np.random.default_rng([seed, 0])
        # Waves in all directions add up to a Gaussian field; with eight, its distribution is normal to 1 %.
        total = np.zeros(len(points))
        waves = 8
        for way in rng.standard_normal((waves, 3)):
            along = points @ (way / np.linalg.norm(way)) * (np.pi / self.patch * rng.uniform(0.6, 1.4))
            total += np.cos(along + rng.uniform(0.0, 2 * np.pi))
        normal = total * np.sqrt(2.0 / waves)
        # The logistic curve that follows the normal distribution to 1 %.
        even: Floats = 1.0 / (1.0 + np.exp(-1.702 * normal))
        return even


FARO_FINEST = float(np.radians(0.009))
PIXEL = float(2 * np.tan(np.radians(57.0) / 2) / 639)

# Where the numbers come from is told in docs/simulate.md.
SCANNERS: Mapping[str, Instrument] = {
    "plain": Scanner(),
    "faro-ls-840-he": Scanner(
        step=float(np.radians(0.09)), nearest=0.6, farthest=40.0, noise=0.0015, noise_per_metre=6e-5, noise_grazing=0.5,
        beam_diameter=0.003, beam_divergence=0.00025, lowest=float(np.radians(-70.0)), finest=FARO_FINEST,
    ),
    "phase": Scanner(
        step=float(np.radians(0.072)), nearest=0.5, farthest=120.0, noise=0.0004, noise_per_metre=2e-5,
        noise_grazing=0.5, beam_diameter=0.003, beam_divergence=0.0003, dimmest=0.01,
        lowest=float(np.radians(-60.0)), finest=FARO_FINEST,
    ),
    "structured-light": FrameSensor(
        step=PIXEL, finest=PIXEL, nearest=0.5, farthest=5.0, noise=0.0005, noise_per_metre2=0.0016, noise_grazing=0.5,
        beam_diameter=0.0, beam_divergence=PIXEL, mixing=0.3, dimmest=0.5,
    ),
    "photogrammetry": Photogrammetry(
        step=0.002, nearest=0.3, farthest=30.0, noise=0.002, noise_per_metre=0.001, noise_grazing=1.0,
        beam_diameter=0.005, beam_divergence=0.002, dimmest=0.03,
    ),
}  # fmt: skip
