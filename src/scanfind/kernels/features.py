"""Point-pair features: the cells of their angles, their hash keys, and all pairs of a model at one distance."""

from __future__ import annotations

from math import sqrt

import numpy as np

from scanfind.kernels.jit import kernel


@kernel
def angle_bin(cosine, edges):
    """The cell an angle falls into: how many of the cells' edges, given by their cosines (A - 1,), it reaches.

    Comparing cosines is a third of the time of taking their angles.
    """
    cell = 0
    for k in range(edges.shape[0]):
        cell += cosine <= edges[k]
    return cell


@kernel
def feature_key(c1, c2, c3, edges):
    """The cell of the 3D hash table a feature falls into, by its cosines (paper 3.2, Figure 6)."""
    bins = edges.shape[0] + 1
    return (angle_bin(c1, edges) * bins + angle_bin(c2, edges)) * bins + angle_bin(c3, edges)


@kernel
def _in_shell(points, i, near, far, row):
    """Mark in a row (N,) uint8, and count, which of points (3, N) lie in a shell about point i; squared metres."""
    x, y, z = points[0, i], points[1, i], points[2, i]
    count = 0
    for j in range(points.shape[1]):
        dx, dy, dz = points[0, j] - x, points[1, j] - y, points[2, j] - z
        squared = dx * dx + dy * dy + dz * dz
        row[j] = (squared >= near) & (squared <= far)
        count += row[j]
    row[i] = 0
    return count - (near <= 0.0)


@kernel
def count_pairs(points, distance, tolerance, counts):
    """Count how many points j lie at distance ± tolerance from each point i, (N,); points : (3, N)."""
    n = points.shape[1]
    near, far = max(distance - tolerance, 0.0) ** 2, (distance + tolerance) ** 2
    row = np.empty(n, np.uint8)
    for i in range(n):
        counts[i] = _in_shell(points, i, near, far, row)


@kernel
def fill_pairs(points, normals, distance, tolerance, edges, starts, keys, first, second):
    """Write the key and the two ends of every pair counted by `count_pairs`, point i from starts[i] on.

    points, normals : (3, N)
    """
    n = points.shape[1]
    near, far = max(distance - tolerance, 0.0) ** 2, (distance + tolerance) ** 2
    row = np.zeros((n + 7) // 8 * 8, np.uint8)
    eights = row.view(np.uint64)  # few are in the shell: most eights are passed over at once
    for i in range(n):
        _in_shell(points, i, near, far, row)
        at = starts[i]
        ax, ay, az = normals[0, i], normals[1, i], normals[2, i]
        for eight in range(eights.shape[0]):
            if eights[eight] == 0:
                continue
            for j in range(8 * eight, min(8 * eight + 8, n)):
                if row[j] == 0:
                    continue
                dx, dy, dz = points[0, j] - points[0, i], points[1, j] - points[1, i], points[2, j] - points[2, i]
                length = sqrt(dx * dx + dy * dy + dz * dz)
                ux, uy, uz = dx / length, dy / length, dz / length
                bx, by, bz = normals[0, j], normals[1, j], normals[2, j]
                keys[at] = feature_key(
                    ax * ux + ay * uy + az * uz, bx * ux + by * uy + bz * uz, ax * bx + ay * by + az * bz, edges
                )
                first[at] = i
                second[at] = j
                at += 1


@kernel
def sort_pairs(keys, first, second, offsets, sorted_keys, sorted_first, sorted_second):
    """Sort pairs by key, those of one key as they were; offsets : (cells + 1,) zeros, then where each key ends."""
    for k in range(keys.shape[0]):
        offsets[keys[k] + 1] += 1
    for k in range(1, offsets.shape[0]):
        offsets[k] += offsets[k - 1]
    for k in range(keys.shape[0]):
        at = offsets[keys[k]]
        offsets[keys[k]] = at + 1
        sorted_keys[at], sorted_first[at], sorted_second[at] = keys[k], first[k], second[k]
