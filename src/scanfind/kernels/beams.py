"""Beams about a scanner: which of them go towards a placed model, and where each went."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np

from scanfind.kernels.grid import NO_BEAM, RANGE_UNITS, cube_place, unpack_beam
from scanfind.kernels.jit import kernel

BLOCK = 4  # pixels of a block to each side
SHORT_STEP_M = 0.25  # how far a beam must go is rounded down to such steps: fewer blocks are gone through again
NOT_ASKED = np.iinfo(np.int32).max


@kernel
def pixels_towards(points, origin, reach, edge, nearest, silent, short, farthest, across, asked, met, pixels):
    """The pixels within `reach` metres of points (N, 3) in which a scanner has a beam; returns how many.

    Where that is many pixels about each point, as near the scanner, whole blocks of them are taken, each once.

    nearest : (6·edge²,) the scanner's beams (kernels.grid.pack_beam); where it is empty, silent : (6·edge²/8,) uint8, a
        bit for each pixel that counts
    short : beams that end more than so many metres before the point, and a step, are left out …
    farthest : … and how far any of a patch goes, (6·(edge/across)²,) float32, spares most of the looking
    asked : (6·⌈edge/BLOCK⌉²,) int32, all NOT_ASKED; met : (6·edge²,) all False
    pixels : out, the first so many of at most 6·edge²
    """
    count, blocks = 0, (edge + BLOCK - 1) // BLOCK
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        if dx == 0.0 and dy == 0.0 and dz == 0.0:
            continue
        face, u, v = cube_place(dx, dy, dz)
        distance = sqrt(dx * dx + dy * dy + dz * dz)
        # A metre across the line of sight is so much on the face, which is closest in its middle.
        wide = reach / distance * (1.0 + u * u + v * v)
        low_u, high_u = max(0, int((u - wide + 1.0) * 0.5 * edge)), min(edge - 1, int((u + wide + 1.0) * 0.5 * edge))
        low_v, high_v = max(0, int((v - wide + 1.0) * 0.5 * edge)), min(edge - 1, int((v + wide + 1.0) * 0.5 * edge))
        least = 0.0
        if distance > short:
            least = floor((distance - short) / SHORT_STEP_M) * SHORT_STEP_M
        asks = least <= 0.0 or len(farthest) == 0
        if not asks and not _any_beyond(least, farthest, edge, across, face, low_u, high_u, low_v, high_v):
            continue
        units = np.int64(least * RANGE_UNITS)
        if wide * edge < BLOCK:  # half a block to each side
            count = _met_in(face, low_u, high_u, low_v, high_v, edge, nearest, silent, units << 16, met, pixels, count)
            continue
        for bu in range(low_u // BLOCK, high_u // BLOCK + 1):
            for bv in range(low_v // BLOCK, high_v // BLOCK + 1):
                block = (face * blocks + bu) * blocks + bv
                if asked[block] <= units:
                    continue
                asked[block] = units
                count = _met_in(
                    face, bu * BLOCK, min(bu * BLOCK + BLOCK, edge) - 1, bv * BLOCK, min(bv * BLOCK + BLOCK, edge) - 1,
                    edge, nearest, silent, units << 16, met, pixels, count,
                )  # fmt: skip
    return count


@kernel
def _met_in(face, low_u, high_u, low_v, high_v, edge, nearest, silent, shortest, met, pixels, count):
    """Add those of some pixels of a face that have a beam so long, and are not met yet; returns how many there are."""
    for iu in range(low_u, high_u + 1):
        for iv in range(low_v, high_v + 1):
            pixel = (face * edge + iu) * edge + iv
            if met[pixel]:
                continue
            if shortest <= nearest[pixel] < NO_BEAM if len(nearest) else silent[pixel >> 3] >> (7 - (pixel & 7)) & 1:
                met[pixel] = True
                pixels[count] = pixel
                count += 1
    return count


@kernel
def _any_beyond(least, farthest, edge, across, face, low_u, high_u, low_v, high_v):
    """Does any beam of the patches go so far that some pixels of a face are in?"""
    few = edge // across
    for iu in range(low_u // across, high_u // across + 1):
        for iv in range(low_v // across, high_v // across + 1):
            if farthest[(face * few + iu) * few + iv] >= least:
                return True
    return False


@kernel
def beams_of(pixels, beams, edge, directions, ranges, angles):
    """Unit directions (B, 3), ranges and solid angles (B,) of beams (B,) in pixels (B,)."""
    for i in range(pixels.shape[0]):
        x, y, z, distance, angle = unpack_beam(pixels[i], beams[i], edge)
        directions[i, 0], directions[i, 1], directions[i, 2] = x, y, z
        ranges[i], angles[i] = distance, angle
