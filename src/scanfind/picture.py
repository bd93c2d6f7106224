"""Pictures of points and surfaces without a screen: a depth buffer in NumPy, shaded where depth steps, as a PNG.

A surface is drawn as points that lie on it denser than pixels do, so that one loop draws everything.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

PAPER = (255, 255, 255)
# Deviations, from the most inside (-1) over none (0) to the most outside (+1): told apart by the colour-blind too.
SCALE: tuple[tuple[float, tuple[int, int, int]], ...] = (
    (-1.0, (33, 78, 160)),
    (-0.5, (92, 156, 208)),
    (0.0, (196, 204, 196)),
    (0.5, (238, 160, 76)),
    (1.0, (186, 36, 32)),
)
SHADE, DARKEST = 6.0, 1.2  # how dark a step in depth is, of which ratios count, and how dark it can be
NEAR_M = 1e-3


class View(NamedTuple):
    """A camera with perspective, in the frame of what it looks at.

    eye : (3,) metres; forward, up : (3,) unit directions, perpendicular to each other
    field : vertical angle of view, radians
    """

    eye: Floats
    forward: Floats
    up: Floats
    field: float


class Dots(NamedTuple):
    """Points to be drawn: points (N, 3) metres, colours (N, 3), and how wide each is, pixels.

    behind : metres they yield to others by: a surface would hide half of the points that lie on it
    """

    points: Floats
    colours: Bytes
    width: int = 1
    behind: float = 0.0


def view_at(
    points: ArrayLike, towards: ArrayLike = (0.55, 0.75, -0.45), *, field: float = 0.6, aspect: float = 1.5
) -> View:
    """A camera that has all of N points (N, 3) in its picture.

    towards : (3,) direction of view; up is as near to +z as it can be
    field : vertical angle of view, radians; aspect : of the picture, width by height
    """
    given = np.asarray(points, np.float64).reshape(-1, 3)
    low, high = (given.min(axis=0), given.max(axis=0)) if len(given) else (np.zeros(3), np.ones(3))
    forward = np.asarray(towards, np.float64)
    forward = forward / np.linalg.norm(forward)
    upright = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, upright)
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    middle = (low + high) / 2.0
    corners = np.stack(np.meshgrid(*np.column_stack([low, high]), indexing="ij"), axis=-1).reshape(-1, 3) - middle
    # Back until each corner of the box is within the angle of view, both ways.
    half = np.tan(field / 2.0)
    back = max(
        (np.abs(corners @ up) / half - corners @ forward).max(),
        (np.abs(corners @ right) / (half * aspect) - corners @ forward).max(),
        10.0 * NEAR_M,
    )
    return View(middle - 1.06 * back * forward, forward, up, field)


def draw(view: View, layers: Sequence[Dots], width: int, height: int, paper: tuple[int, int, int] = PAPER) -> Bytes:
    """A picture (height, width, 3) of all layers, the nearest point of each pixel."""
    image = np.empty((height, width, 3), np.uint8)
    image[:] = paper
    depth = np.full((height, width), np.inf)
    for dots in layers:
        _splat(image, depth, view, dots)
    shade = _shade(depth)[..., None]
    return np.where(np.isfinite(depth)[..., None], (image * shade).astype(np.uint8), image)


def deviation_colours(deviation: ArrayLike, full: float) -> Bytes:
    """Colours (N, 3) of N signed distances; `full` metres and more have the colour of the scale's end."""
    at = np.clip(np.nan_to_num(np.asarray(deviation, np.float64)) / full, -1.0, 1.0)
    stops = [stop for stop, _ in SCALE]
    return np.column_stack([np.interp(at, stops, [colour[k] for _, colour in SCALE]) for k in range(3)]).astype(
        np.uint8
    )


def surface_dots(triangles: Floats, colour: Sequence[int], seed: int, count: int = 60_000) -> Dots:
    """A surface (F, 3, 3) as about `count` points that are spread evenly over it, lighter where it faces up."""
    edges = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normals = np.cross(*edges)
    doubled = np.linalg.norm(normals, axis=1)
    if not doubled.sum() > 0.0:
        return Dots(np.empty((0, 3)), np.empty((0, 3), np.uint8))
    rng = np.random.default_rng(seed)
    of = rng.choice(len(triangles), count, p=doubled / doubled.sum())
    u, v = rng.random((2, count, 1))
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
    light = 0.72 + 0.28 * np.abs(normals[of] @ np.array([0.3, -0.5, 0.81])) / np.maximum(doubled[of], 1e-300)
    colours = (np.asarray(colour) * light[:, None]).astype(np.uint8)
    return Dots(triangles[of, 0] + u * edges[0][of] + v * edges[1][of], colours, 3)


def png(image: Bytes) -> bytes:
    """A picture (H, W, 3) as a PNG file."""
    height, width, _ = image.shape
    rows = np.column_stack([np.zeros(height, np.uint8), image.reshape(height, -1)]).tobytes()
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows, 6)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


def _splat(image: Bytes, depth: Floats, view: View, dots: Dots) -> None:
    """Draw dots into a picture and its depths, in place: the nearest holds."""
    height, width = depth.shape
    away = dots.points - view.eye
    far = away @ view.forward
    scale = 0.5 * height / np.tan(view.field / 2.0)
    seen = far > NEAR_M
    away, far, colours = away[seen], far[seen], dots.colours[seen]
    x = 0.5 * width + scale * (away @ np.cross(view.forward, view.up)) / far
    y = 0.5 * height - scale * (away @ view.up) / far
    far = far + dots.behind
    for step in range(dots.width**2):
        aside, down = step % dots.width, step // dots.width
        column, row = np.floor(x - dots.width / 2 + 0.5 + aside), np.floor(y - dots.width / 2 + 0.5 + down)
        inside = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
        at = row[inside].astype(np.intp), column[inside].astype(np.intp)
        nearest = np.full(depth.shape, np.inf)
        np.minimum.at(nearest, at, far[inside])
        shown = (far[inside] <= nearest[at]) & (far[inside] < depth[at])
        at = at[0][shown], at[1][shown]
        image[at], depth[at] = colours[inside[shown]], far[inside[shown]]


def _shade(depth: Floats) -> Floats:
    """How light each pixel is: darker where neighbours are nearer (eye-dome lighting, Boucheny 2009)."""
    logs = np.log2(np.where(np.isfinite(depth), depth, 1e6))
    padded = np.pad(logs, 1, mode="edge")
    height, width = depth.shape
    sides = ((1, 0), (1, 2), (0, 1), (2, 1))
    steps = [np.maximum(logs - padded[r : r + height, c : c + width], 0.0) for r, c in sides]
    shade: Floats = np.exp(-np.minimum(SHADE * np.mean(steps, axis=0), DARKEST))
    return shade
