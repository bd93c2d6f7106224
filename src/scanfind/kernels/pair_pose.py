"""The pose of one pair of oriented points on another (paper 3.4, Figure 8)."""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from scanfind.kernels.jit import kernel


@kernel
def frame_of_pair(p1, n1, p2, n2, frame):
    """Write the rows x, y, z of a pair's own frame: x along the pair, z the normals' mean turning axis; False if open.

    y is not chosen by one normal: see `pose_from_pairs`, which turns about x by least squares over both.
    """
    x0, x1, x2 = p2[0] - p1[0], p2[1] - p1[1], p2[2] - p1[2]
    length = sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    x0, x1, x2 = x0 / length, x1 / length, x2 / length
    # Any direction across x does: the one from the coordinate axis x is farthest from.
    a0, a1, a2 = abs(x0), abs(x1), abs(x2)
    if a0 <= a1 and a0 <= a2:
        y0, y1, y2 = 0.0, x2, -x1
    elif a1 <= a2:
        y0, y1, y2 = -x2, 0.0, x0
    else:
        y0, y1, y2 = x1, -x0, 0.0
    length = sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    y0, y1, y2 = y0 / length, y1 / length, y2 / length
    frame[0, 0], frame[0, 1], frame[0, 2] = x0, x1, x2
    frame[1, 0], frame[1, 1], frame[1, 2] = y0, y1, y2
    frame[2, 0], frame[2, 1], frame[2, 2] = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    # The normals across x, as complex numbers in the (y, z) plane.
    for k in range(2):
        n = n1 if k == 0 else n2
        frame[3, 2 * k] = frame[1, 0] * n[0] + frame[1, 1] * n[1] + frame[1, 2] * n[2]
        frame[3, 2 * k + 1] = frame[2, 0] * n[0] + frame[2, 1] * n[1] + frame[2, 2] * n[2]


@kernel
def pose_from_frames(model, scene, rotation):
    """Rotation of a model pair's frame onto a scene pair's: axes along each other, the roll least squares over normals.

    This is the least-squares pose of the two four-point sets (paper 3.4, Figure 8) as the normals' length goes to
    zero: the two points, which are measured well, fix the axis; the normals, which are not, only the roll. False where
    the normals lie along the pair and leave the roll open.
    """
    real = imaginary = 0.0
    for k in range(2):
        my, mz, sy, sz = model[3, 2 * k], model[3, 2 * k + 1], scene[3, 2 * k], scene[3, 2 * k + 1]
        real += my * sy + mz * sz
        imaginary += my * sz - mz * sy
    size = sqrt(real * real + imaginary * imaginary)
    if size < 0.05:
        return False
    c, s = real / size, imaginary / size
    for i in range(3):
        y, z = c * scene[1, i] + s * scene[2, i], c * scene[2, i] - s * scene[1, i]
        for j in range(3):
            rotation[i, j] = scene[0, i] * model[0, j] + y * model[1, j] + z * model[2, j]
    return True


@kernel
def refine_four_points(m1, a1, m2, a2, s1, b1, s2, b2, length, rotation):
    """Newton steps from the limit above to the least-squares rotation for normals of a given length, metres."""
    q = 0.25 * length
    for _ in range(4):
        gx = gy = gz = h00 = h01 = h02 = h11 = h12 = h22 = 0.0
        for k in range(4):
            half = -0.5 if k % 2 == 0 else 0.5
            along = 0.0 if k < 2 else length
            a, b = (a1, b1) if k % 2 == 0 else (a2, b2)
            p0 = half * (m2[0] - m1[0]) + along * a[0] - q * (a1[0] + a2[0])
            p1 = half * (m2[1] - m1[1]) + along * a[1] - q * (a1[1] + a2[1])
            p2 = half * (m2[2] - m1[2]) + along * a[2] - q * (a1[2] + a2[2])
            x = rotation[0, 0] * p0 + rotation[0, 1] * p1 + rotation[0, 2] * p2
            y = rotation[1, 0] * p0 + rotation[1, 1] * p1 + rotation[1, 2] * p2
            z = rotation[2, 0] * p0 + rotation[2, 1] * p1 + rotation[2, 2] * p2
            u = half * (s2[0] - s1[0]) + along * b[0] - q * (b1[0] + b2[0])
            v = half * (s2[1] - s1[1]) + along * b[1] - q * (b1[1] + b2[1])
            w = half * (s2[2] - s1[2]) + along * b[2] - q * (b1[2] + b2[2])
            gx += y * w - z * v
            gy += z * u - x * w
            gz += x * v - y * u
            dot = x * u + y * v + z * w
            h00 += dot - x * u
            h11 += dot - y * v
            h22 += dot - z * w
            h01 -= 0.5 * (x * v + y * u)
            h02 -= 0.5 * (x * w + z * u)
            h12 -= 0.5 * (y * w + z * v)
        d0, d1, d2 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
        determinant = h00 * d0 + h01 * d1 + h02 * d2
        if determinant < 1e-9:
            return
        wx = (d0 * gx + d1 * gy + d2 * gz) / determinant
        wy = (d1 * gx + (h00 * h22 - h02 * h02) * gy + (h01 * h02 - h00 * h12) * gz) / determinant
        wz = (d2 * gx + (h01 * h02 - h00 * h12) * gy + (h00 * h11 - h01 * h01) * gz) / determinant
        turn(rotation, wx, wy, wz)


@kernel
def turn(rotation, wx, wy, wz):
    """Turn a rotation (in place) by a small rotation vector, from the left; exact (Rodrigues)."""
    angle = sqrt(wx * wx + wy * wy + wz * wz)
    if angle < 1e-15:
        return
    kx, ky, kz, c, s = wx / angle, wy / angle, wz / angle, cos(angle), sin(angle)
    for j in range(3):
        x, y, z = rotation[0, j], rotation[1, j], rotation[2, j]
        dot = (kx * x + ky * y + kz * z) * (1.0 - c)
        rotation[0, j] = c * x + s * (ky * z - kz * y) + dot * kx
        rotation[1, j] = c * y + s * (kz * x - kx * z) + dot * ky
        rotation[2, j] = c * z + s * (kx * y - ky * x) + dot * kz


@kernel
def fit_pairs(m1, a1, m2, a2, s1, b1, s2, b2, length, rotations, translations):
    """`scene_from_model` of K matching pairs, all (K, 3); used by tests and by whoever has pairs in hand."""
    model, scene = np.empty((4, 4)), np.empty((4, 4))
    for k in range(m1.shape[0]):
        frame_of_pair(m1[k], a1[k], m2[k], a2[k], model)
        frame_of_pair(s1[k], b1[k], s2[k], b2[k], scene)
        if not pose_from_frames(model, scene, rotations[k]):
            rotations[k, :, :] = np.nan
        elif length > 0.0:
            refine_four_points(m1[k], a1[k], m2[k], a2[k], s1[k], b1[k], s2[k], b2[k], length, rotations[k])
        place_pair(m1[k], a1[k], m2[k], a2[k], s1[k], b1[k], s2[k], b2[k], length, rotations[k], translations[k])


@kernel
def place_pair(m1, a1, m2, a2, s1, b1, s2, b2, length, rotation, translation):
    """The translation that goes with a rotation: centroid of four points onto centroid of four."""
    q = 0.25 * length
    x = 0.5 * (m1[0] + m2[0]) + q * (a1[0] + a2[0])
    y = 0.5 * (m1[1] + m2[1]) + q * (a1[1] + a2[1])
    z = 0.5 * (m1[2] + m2[2]) + q * (a1[2] + a2[2])
    for i in range(3):
        centre = 0.5 * (s1[i] + s2[i]) + q * (b1[i] + b2[i])
        translation[i] = centre - (rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] * z)
