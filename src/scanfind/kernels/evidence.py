"""What the scene says of each sample of a placed model: on the surface, seen through, hidden, never looked at."""

from __future__ import annotations

from math import sqrt

import numpy as np

from scanfind.kernels.grid import cube_pixel
from scanfind.kernels.jit import kernel
from scanfind.kernels.nearest import nearest_surfel
from scanfind.kernels.placed import placed

NO_EVIDENCE, SUPPORTED, SEEN_THROUGH, HIDDEN, SILENT = 0, 1, 2, 3, 4


@kernel
def gather_evidence(
    start, stop, models, model_starts, model_points, model_normals, most_points, rotations, translations,
    gate, inlier, least_cosine, signed, cell, hash_keys, hash_values, filled, block_rows, first_surfel, sides, means,
    normals, origins, ranges, edge, margin, least_facing, first_sample, states, residuals, claims,
):  # fmt: skip
    """Gather the evidence of poses start … stop.

    most_points : samples looked at of each model, its first ones
    gate, inlier : metres; a sample is supported by a surfel within `gate` whose plane it meets within `inlier`
    origins : (K, 3) scanner positions; ranges : (K, 6·edge²) their depth maps
    margin : metres; a beam must have gone on so far behind a sample to have passed through it
    least_facing : cosine to the beam below which a surface may return nothing, so that its absence says nothing
    first_sample : (H,) where each pose's samples begin in the outputs
    states : out, uint8, one of the five above, SILENT where too few beams lead to the sample to tell
    residuals : out, float32, metres along the surfel's normal, + where the scene is outside the model
    claims : out, int32, the supporting surfel, -1 for none
    """
    pixel_angle = 2.0 / edge
    for h in range(start, stop):
        base = model_starts[models[h]]
        rotation, translation = rotations[h], translations[h]
        for t in range(min(most_points, model_starts[models[h] + 1] - base)):
            x, y, z, nx, ny, nz = placed(model_points, model_normals, base + t, rotation, translation)
            at = first_sample[h] + t
            states[at], residuals[at], claims[at] = NO_EVIDENCE, np.float32(np.nan), -1
            s = nearest_surfel(
                x, y, z, nx, ny, nz, gate, least_cosine, signed,
                cell, hash_keys, hash_values, filled, block_rows, first_surfel, sides, means, normals,
            )  # fmt: skip
            if s >= 0:
                ux, uy, uz = normals[s, 0], normals[s, 1], normals[s, 2]
                distance = ux * (means[s, 0] - x) + uy * (means[s, 1] - y) + uz * (means[s, 2] - z)
                if abs(distance) <= inlier:
                    if nx * ux + ny * uy + nz * uz < 0.0:
                        distance = -distance
                    states[at], residuals[at], claims[at] = SUPPORTED, np.float32(distance), s
                    continue
            for k in range(origins.shape[0]):
                dx, dy, dz = x - origins[k, 0], y - origins[k, 1], z - origins[k, 2]
                away = sqrt(dx * dx + dy * dy + dz * dz)
                if away <= 0.0 or -(nx * dx + ny * dy + nz * dz) < least_facing * away:
                    continue
                # The pixel and four around it: at a silhouette one of them is the nearer surface, and nothing is said.
                ax, ay, az = (0.0, dz, -dy) if abs(dx) < 0.6 * away else (-dz, 0.0, dx)
                size = sqrt(ax * ax + ay * ay + az * az)
                step = pixel_angle * away
                ax, ay, az = ax / size * step, ay / size * step, az / size * step
                bx, by, bz = (dy * az - dz * ay) / away, (dz * ax - dx * az) / away, (dx * ay - dy * ax) / away
                nearest, seen = np.float32(np.inf), 0
                for j in range(5):
                    u = (1.0 if j == 1 else 0.0) - (1.0 if j == 2 else 0.0)
                    v = (1.0 if j == 3 else 0.0) - (1.0 if j == 4 else 0.0)
                    depth = ranges[k, cube_pixel(
                        dx + u * ax + v * bx, dy + u * ay + v * by, dz + u * az + v * bz, edge
                    )]  # fmt: skip
                    if depth < np.inf:
                        seen += 1
                        nearest = min(nearest, depth)
                if seen < 3:
                    if states[at] == NO_EVIDENCE:
                        states[at] = SILENT
                    continue
                if nearest > away + margin:
                    states[at] = SEEN_THROUGH
                    break
                if states[at] != SUPPORTED:
                    states[at] = HIDDEN
