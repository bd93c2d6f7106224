"""Beams about a scanner: which of them go towards a placed model, and where each went."""

from __future__ import annotations

from math import sqrt

from scanfind.kernels.grid import NO_BEAM, cube_place, unpack_beam
from scanfind.kernels.jit import kernel


@kernel
def pixels_towards(points, origin, reach, edge, nearest, silent, met, pixels):
    """The pixels within `reach` metres of points (N, 3) in which a scanner has a beam; returns how many.

    nearest : (6·edge²,) the scanner's beams (kernels.grid.pack_beam); where it is empty, silent : (6·edge²/8,) uint8, a
        bit for each pixel that counts
    met : (6·edge²,) all False
    pixels : out, the first so many of at most 6·edge²
    """
    count = 0
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        if dx == 0.0 and dy == 0.0 and dz == 0.0:
            continue
        face, u, v = cube_place(dx, dy, dz)
        # A metre across the line of sight is so much on the face, which is closest in its middle.
        wide = reach / sqrt(dx * dx + dy * dy + dz * dz) * (1.0 + u * u + v * v)
        low_u, high_u = int((u - wide + 1.0) * 0.5 * edge), int((u + wide + 1.0) * 0.5 * edge)
        low_v, high_v = int((v - wide + 1.0) * 0.5 * edge), int((v + wide + 1.0) * 0.5 * edge)
        for iu in range(max(0, low_u), min(edge - 1, high_u) + 1):
            for iv in range(max(0, low_v), min(edge - 1, high_v) + 1):
                pixel = (face * edge + iu) * edge + iv
                if met[pixel]:
                    continue
                if nearest[pixel] < NO_BEAM if len(nearest) else silent[pixel >> 3] >> (7 - (pixel & 7)) & 1:
                    met[pixel] = True
                    pixels[count] = pixel
                    count += 1
    return count


@kernel
def beams_of(pixels, beams, edge, directions, ranges, angles):
    """Unit directions (B, 3), ranges and solid angles (B,) of beams (B,) in pixels (B,)."""
    for i in range(pixels.shape[0]):
        x, y, z, distance, angle = unpack_beam(pixels[i], beams[i], edge)
        directions[i, 0], directions[i, 1], directions[i, 2] = x, y, z
        ranges[i], angles[i] = distance, angle
