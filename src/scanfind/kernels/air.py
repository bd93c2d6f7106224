"""Air: cells in which nothing lies and beyond which beams went on; a surface placed there is refuted by one look-up."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np

from scanfind.kernels.blocks import block_in, unpack_block
from scanfind.kernels.grid import cube_pixel, cube_place
from scanfind.kernels.jit import kernel

PIXELS_ACROSS = 3.0  # more are more exact, and more of them have to be looked at


@kernel
def pixel_beside(face, i, j, edge):
    """The pixel (i, j) of a face, or of the face beside it where it lies beyond an edge."""
    if 0 <= i < edge and 0 <= j < edge:
        return (face * edge + i) * edge + j
    u, v = (i + 0.5) * 2.0 / edge - 1.0, (j + 0.5) * 2.0 / edge - 1.0
    major = 1.0 if face % 2 == 0 else -1.0
    if face < 2:
        return cube_pixel(major, u, v, edge)
    return cube_pixel(u, major, v, edge) if face < 4 else cube_pixel(u, v, major, edge)


@kernel
def went_on(ranges, face, u, v, wide, edge, far):
    """Did all beams about a place on a cube map go farther than `far` metres, and did any come back?

    ranges : (6·edge²,) float32, inf where none did; u, v, wide : the place on its face, and how far around it
    """
    any_back = False
    for p in range(int(floor((u - wide + 1.0) * 0.5 * edge)), int(floor((u + wide + 1.0) * 0.5 * edge)) + 1):
        for q in range(int(floor((v - wide + 1.0) * 0.5 * edge)), int(floor((v + wide + 1.0) * 0.5 * edge)) + 1):
            reach = ranges[pixel_beside(face, p, q, edge)]
            if reach <= far:
                return False
            any_back = any_back or reach < np.inf
    return any_back


@kernel
def mark_air(start, stop, block_keys, cell, origins, edges, starts, ranges, air):
    """Mark the cells of blocks start … stop that all beams of a scanner that went towards them went through.

    block_keys : (B,) packed coordinates; cell : edge, metres; air : (B, 8) uint64, a bit a cell, out
    origins : (K, 3) scanner positions, relative to the grid's offset
    edges, starts : (L,) of the maps a scanner has, finest first: pixels along an edge, and where its pixels begin
    ranges : (K, P) float32, their pixels one map after the other, inf where no beam came back

    A map is asked in which the cell is no more than PIXELS_ACROSS wide. Where no map is as coarse, which is next to a
    scanner, nothing is marked.
    """
    radius = 0.5 * sqrt(3.0) * cell
    for b in range(start, stop):
        bx, by, bz = unpack_block(block_keys[b])
        for i in range(512):
            x = ((bx << 3) + (i >> 6) + 0.5) * cell
            y = ((by << 3) + ((i >> 3) & 7) + 0.5) * cell
            z = ((bz << 3) + (i & 7) + 0.5) * cell
            for k in range(origins.shape[0]):
                dx, dy, dz = x - origins[k, 0], y - origins[k, 1], z - origins[k, 2]
                away = sqrt(dx * dx + dy * dy + dz * dz)
                if away <= radius:
                    continue
                # So wide is the radius on the face of the cube, of two across.
                face, u, v = cube_place(dx, dy, dz)
                wide = radius / (away - radius) * (1.0 + u * u + v * v)
                level = 0
                while level < len(edges) and edges[level] * wide > PIXELS_ACROSS:
                    level += 1
                if level < len(edges):
                    seen = ranges[k, starts[level] : starts[level] + 6 * edges[level] ** 2]
                    if went_on(seen, face, u, v, wide, edges[level], away + radius):
                        air[b, i >> 6] |= np.uint64(1) << np.uint64(i & 63)
                        break


@kernel
def unmark_air(points, cell, where, air):
    """Where points (N, 3) lie there is no air; where : the blocks, a BlockTable."""
    inverse = 1.0 / cell
    for n in range(points.shape[0]):
        cx = np.int64(floor(points[n, 0] * inverse))
        cy = np.int64(floor(points[n, 1] * inverse))
        cz = np.int64(floor(points[n, 2] * inverse))
        block = block_in(where, cx >> 3, cy >> 3, cz >> 3)
        if block >= 0:
            air[block, cx & 7] &= ~(np.uint64(1) << np.uint64(((cy & 7) << 3) | (cz & 7)))
