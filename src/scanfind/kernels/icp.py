"""Iterative closest points, point to plane, with robust weights: the model's samples on the scene's surfels."""

from __future__ import annotations

from math import sqrt

import numpy as np

from scanfind.kernels.jit import kernel
from scanfind.kernels.nearest import nearest_surfel
from scanfind.kernels.pair_pose import turn
from scanfind.kernels.placed import placed


@kernel
def solve_damped(hessian, gradient, damping, step):
    """Solve (H + damping · diag) step = gradient for six unknowns by Cholesky; False where H is not positive."""
    lower = np.empty((6, 6))
    for i in range(6):
        for j in range(i + 1):
            total = hessian[i, j]
            if i == j:
                total += damping
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if total <= 0.0:
                    return False
                lower[i, i] = sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(6):
        total = gradient[i]
        for k in range(i):
            total -= lower[i, k] * step[k]
        step[i] = total / lower[i, i]
    for i in range(5, -1, -1):
        total = step[i]
        for k in range(i + 1, 6):
            total -= lower[k, i] * step[k]
        step[i] = total / lower[i, i]
    return True


@kernel
def refine_poses(
    start, stop, models, model_starts, model_points, model_normals, model_centres, model_radii, most_points,
    gates, least_cosine, signed, cell, hash_keys, hash_values, filled, block_rows, first_surfel, sides, means, normals,
    rotations, translations, hessians, matched, residuals,
):  # fmt: skip
    """Refine poses start … stop in place (paper 3.4: post-ICP), one Gauss–Newton step for each gate.

    models : (H,) which model each pose places; model_centres (models, 3), model_radii (models,) metres
    most_points : samples used of each model, its first ones
    gates : (I,) metres, shrinking: correspondences farther apart do not count; Tukey's weight over the gate
    hessians : (H, 6, 6) out: of the last step, in (rotation × radius, translation) about the placed centre, with
        unit weight a full match: metres² cancel
    matched : (H,) out: share of samples that had a correspondence; residuals : (H,) out: their weighted rms
    """
    gradient, step = np.empty(6), np.empty(6)
    row = np.empty(6)
    for h in range(start, stop):
        model = models[h]
        base = model_starts[model]
        n = min(most_points, model_starts[model + 1] - base)
        rotation, translation, hessian = rotations[h], translations[h], hessians[h]
        centre, radius = model_centres[model], model_radii[model]
        for iteration in range(gates.shape[0]):
            gate = gates[iteration]
            for i in range(6):
                gradient[i] = 0.0
                for j in range(6):
                    hessian[i, j] = 0.0
            weights = squares = 0.0
            count = 0
            ox = rotation[0, 0] * centre[0] + rotation[0, 1] * centre[1] + rotation[0, 2] * centre[2] + translation[0]
            oy = rotation[1, 0] * centre[0] + rotation[1, 1] * centre[1] + rotation[1, 2] * centre[2] + translation[1]
            oz = rotation[2, 0] * centre[0] + rotation[2, 1] * centre[1] + rotation[2, 2] * centre[2] + translation[2]
            for t in range(n):
                x, y, z, nx, ny, nz = placed(model_points, model_normals, base + t, rotation, translation)
                s = nearest_surfel(
                    x, y, z, nx, ny, nz, gate, least_cosine, signed,
                    cell, hash_keys, hash_values, filled, block_rows, first_surfel, sides, means, normals,
                )  # fmt: skip
                if s < 0:
                    continue
                ux, uy, uz = normals[s, 0], normals[s, 1], normals[s, 2]
                distance = ux * (means[s, 0] - x) + uy * (means[s, 1] - y) + uz * (means[s, 2] - z)
                qx, qy, qz = x - ox, y - oy, z - oz
                share = distance / gate
                weight = (1.0 - share * share) ** 2
                count += 1
                row[0] = (qy * uz - qz * uy) / radius
                row[1] = (qz * ux - qx * uz) / radius
                row[2] = (qx * uy - qy * ux) / radius
                row[3], row[4], row[5] = ux, uy, uz
                for i in range(6):
                    gradient[i] += weight * row[i] * distance
                    for j in range(i + 1):
                        hessian[i, j] += weight * row[i] * row[j]
                weights += weight
                squares += weight * distance * distance
            for i in range(6):
                for j in range(i):
                    hessian[j, i] = hessian[i, j]
            matched[h] = count / n
            residuals[h] = sqrt(squares / weights) if weights > 0.0 else np.inf
            # A thousandth of one match in a thousand: holds what the data leave open where it is, moves nothing else.
            if weights < 6.0 or not solve_damped(hessian, gradient, 1e-6 * weights, step):
                break
            # Turn about the placed centre, so that a rotation does not drag the model through the room.
            turn(rotation, step[0] / radius, step[1] / radius, step[2] / radius)
            translation[0] = (
                ox + step[3] - (rotation[0, 0] * centre[0] + rotation[0, 1] * centre[1] + rotation[0, 2] * centre[2])
            )
            translation[1] = (
                oy + step[4] - (rotation[1, 0] * centre[0] + rotation[1, 1] * centre[1] + rotation[1, 2] * centre[2])
            )
            translation[2] = (
                oz + step[5] - (rotation[2, 0] * centre[0] + rotation[2, 1] * centre[1] + rotation[2, 2] * centre[2])
            )
