"""Where to look at an element from, and what is seen from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.rays import RayCaster
from scanfind.mesh import Mesh
from scanfind.pose import Pose

Floats = NDArray[np.float64]
Colour = tuple[int, int, int]

FIELD_OF_VIEW = 60.0  # degrees across: what BCF 2.1 allows at most
WIDTH, HEIGHT = 800, 600
THUMB = 10  # so many times coarser an image tells how much of the element a camera sees
AIR = 1.5  # the element takes up this part of the height
# What a person would try: from each side at eye level and from above, then from below.
ELEVATIONS, AZIMUTHS = (20.0, 45.0, -20.0), 12
ENOUGH = 0.9  # of what the best camera sees: the first with so much is taken
SKY, OTHERS = (245, 246, 248), (176, 182, 190)
TINT = 0.55  # of the colour of where the design puts an element that stands elsewhere


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective camera: position (3,), metres, unit direction (3,) and up (3,), in the design's frame."""

    position: Floats
    direction: Floats
    up: Floats

    def rays(self, width: int, height: int) -> Floats:
        """Unit directions (height × width, 3), row by row from the top left."""
        half = np.tan(np.radians(0.5 * FIELD_OF_VIEW))
        x = (2.0 * (np.arange(width) + 0.5) / width - 1.0) * half
        y = (1.0 - 2.0 * (np.arange(height) + 0.5) / height) * half * height / width
        right = np.cross(self.direction, self.up)
        ways = self.direction + y[:, None, None] * self.up + x[None, :, None] * right
        ways = ways.reshape(-1, 3)
        return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True))


class Shown(NamedTuple):
    """An element of a design: its mesh, design_from_mesh where it should stand, and where it does (None: nowhere)."""

    mesh: Mesh
    design: Pose
    built: Pose | None


class Views:
    """The elements of a design, to be looked at one at a time."""

    def __init__(self, elements: Sequence[Shown]) -> None:
        self._elements = elements
        self._design = RayCaster([(one.mesh, one.design) for one in elements]) if elements else None

    def camera(self, number: int) -> Camera:
        """From where element `number` is seen well: near enough to fill the view, with little before it."""
        one = self._elements[number]
        corners = [one.design.move(one.mesh.vertices)]
        corners += [] if one.built is None else [one.built.move(one.mesh.vertices)]
        points = np.concatenate(corners)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - middle, axis=1).max())
        half_height = np.arctan(np.tan(np.radians(0.5 * FIELD_OF_VIEW)) * HEIGHT / WIDTH)
        cameras = [camera_at(middle, AIR * radius / np.sin(half_height), way) for way in ways()]
        seen = np.array([self._seen(number, camera) for camera in cameras])
        return cameras[int(np.argmax(seen >= ENOUGH * seen.max()))]

    def picture(self, number: int, camera: Camera, colour: Colour) -> NDArray[np.uint8]:
        """(HEIGHT, WIDTH, 3): the element where it stands (or should stand) in its colour, all others grey.

        Where it should stand and does not is shown through, tinted.
        """
        rays = camera.rays(WIDTH, HEIGHT)
        assert self._design is not None  # there is an element `number`
        hits = self._design.shoot(camera.position, rays)
        image = np.full((len(rays), 3), SKY, np.float64)
        met = hits.owner >= 0
        light = 0.35 + 0.65 * hits.cosine[:, None]
        image[met] = (light * np.array(OTHERS))[met]
        mine = hits.owner == number
        one = self._elements[number]
        if one.built is None:
            image[mine] = (light * np.array(colour))[mine]
            return _image(image)
        stands = RayCaster([(one.mesh, one.built)]).shoot(camera.position, rays)
        image[mine] = TINT * image[mine] + (1.0 - TINT) * np.array(SKY)
        before = (stands.owner >= 0) & ((stands.distance <= hits.distance) | mine)
        image[before] = ((0.35 + 0.65 * stands.cosine[:, None]) * np.array(colour))[before]
        return _image(image)

    def _seen(self, number: int, camera: Camera) -> int:
        """How many pixels of a small picture show the element."""
        assert self._design is not None
        rays = camera.rays(WIDTH // THUMB, HEIGHT // THUMB)
        return int((self._design.shoot(camera.position, rays).owner == number).sum())


def ways() -> list[Floats]:
    """Unit directions from the middle of an element to where one may look at it from."""
    found = []
    for elevation in np.radians(ELEVATIONS):
        for azimuth in 2.0 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS:
            level = np.cos(elevation)
            found.append(np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]))
    return found


def camera_at(middle: Floats, distance: float, way: Floats) -> Camera:
    """The camera so far from a point, in that direction, looking at it, upright."""
    right = np.cross(-way, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return Camera(middle + distance * way, -way, np.cross(right, -way))


def _image(pixels: Floats) -> NDArray[np.uint8]:
    return np.round(pixels).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
