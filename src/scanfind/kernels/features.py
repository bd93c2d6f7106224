"""Point-pair features: their angles, their hash keys, and all pairs of a model at one distance."""

from __future__ import annotations

from math import acos, floor, sqrt

from scanfind.kernels.jit import kernel


@kernel
def angle_between(ax, ay, az, bx, by, bz):
    """Angle of two unit vectors, radians, 0 … π."""
    return acos(min(1.0, max(-1.0, ax * bx + ay * by + az * bz)))


@kernel
def feature_key(f1, f2, f3, angle_cell, angle_bins):
    """The cell of the 3D hash table a feature falls into (paper 3.2, Figure 6)."""
    b1 = min(angle_bins - 1, int(floor(f1 / angle_cell)))
    b2 = min(angle_bins - 1, int(floor(f2 / angle_cell)))
    b3 = min(angle_bins - 1, int(floor(f3 / angle_cell)))
    return (b1 * angle_bins + b2) * angle_bins + b3


@kernel
def count_pairs(points, distance, tolerance, counts):
    """Count how many points j lie at distance ± tolerance from each point i, (N,)."""
    n = points.shape[0]
    near, far = (distance - tolerance) ** 2, (distance + tolerance) ** 2
    for i in range(n):
        found = 0
        for j in range(n):
            dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            squared = dx * dx + dy * dy + dz * dz
            if near <= squared <= far and j != i:
                found += 1
        counts[i] = found


@kernel
def fill_pairs(points, normals, distance, tolerance, angle_cell, angle_bins, starts, keys, first, second):
    """Write the key and the two ends of every pair counted by `count_pairs`, point i from starts[i] on."""
    n = points.shape[0]
    near, far = (distance - tolerance) ** 2, (distance + tolerance) ** 2
    for i in range(n):
        at = starts[i]
        ax, ay, az = normals[i, 0], normals[i, 1], normals[i, 2]
        for j in range(n):
            dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            squared = dx * dx + dy * dy + dz * dz
            if near <= squared <= far and j != i:
                length = sqrt(squared)
                ux, uy, uz = dx / length, dy / length, dz / length
                bx, by, bz = normals[j, 0], normals[j, 1], normals[j, 2]
                f1 = angle_between(ax, ay, az, ux, uy, uz)
                f2 = angle_between(bx, by, bz, ux, uy, uz)
                f3 = angle_between(ax, ay, az, bx, by, bz)
                keys[at] = feature_key(f1, f2, f3, angle_cell, angle_bins)
                first[at] = i
                second[at] = j
                at += 1
