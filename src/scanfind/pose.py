"""Rigid motions, named by their frames with the target first: `scene_from_model`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scanfind.errors import InvalidGeometryError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

# Farther from orthonormal than this and a matrix is a scale or a shear, not a rigid motion typed with few decimals.
RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion `target_from_source`: x_target = rotation @ x_source + translation.

    rotation : (3, 3) float64, right-handed, det +1
    translation : (3,) float64, metres
    """

    rotation: Floats
    translation: Floats

    @staticmethod
    def identity() -> Pose:
        """The motion that moves nothing."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Pose:
        """From a 4×4 row-major matrix, column vectors.

        Raises InvalidGeometryError for anything that is not a rigid motion. A matrix written with few decimals is
        made orthonormal (nearest rotation).
        """
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape != (4, 4) or not np.isfinite(m).all():
            msg = f"a pose is a finite 4x4 matrix, got shape {m.shape}"
            raise InvalidGeometryError(msg)
        if not np.allclose(m[3], [0, 0, 0, 1], atol=1e-9):
            msg = f"the last row of a pose is 0 0 0 1, got {m[3].tolist()}"
            raise InvalidGeometryError(msg)
        return Pose(nearest_rotation(m[:3, :3]), m[:3, 3].copy())

    @staticmethod
    def from_rotation_vector(vector: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Pose:
        """From axis × angle (3,), radians, and a translation (3,), metres."""
        return Pose(rotation_from_vector(vector), np.array(translation, dtype=np.float64))

    def matrix(self) -> Floats:
        """4×4, row-major, for column vectors."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.translation
        return m

    def inverse(self) -> Pose:
        """source_from_target."""
        return Pose(self.rotation.T.copy(), -self.rotation.T @ self.translation)

    def __matmul__(self, other: Pose) -> Pose:
        """a_from_c = a_from_b @ b_from_c."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def move(self, points: ArrayLike) -> Floats:
        """Points (N, 3) of the source frame, in the target frame."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    def turn(self, directions: ArrayLike) -> Floats:
        """Directions (N, 3) of the source frame, in the target frame."""
        return np.asarray(directions, dtype=np.float64) @ self.rotation.T

    def quaternion(self) -> dict[str, float]:
        """The rotation as a unit quaternion with named parts, w ≥ 0 (Shepperd's method)."""
        r = self.rotation
        four = np.array([np.trace(r), r[0, 0], r[1, 1], r[2, 2]])
        k = int(np.argmax(four))
        if k == 0:
            w, x, y, z = 1 + four[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
        elif k == 1:
            w, x, y, z = r[2, 1] - r[1, 2], 1 + 2 * r[0, 0] - four[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]
        elif k == 2:
            w, x, y, z = r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 + 2 * r[1, 1] - four[0], r[1, 2] + r[2, 1]
        else:
            w, x, y, z = r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 + 2 * r[2, 2] - four[0]
        q = np.array([x, y, z, w])
        q /= np.linalg.norm(q) * (1.0 if q[3] >= 0 else -1.0)
        return dict(zip("xyzw", q.tolist(), strict=True))

    def difference(self, other: Pose) -> tuple[float, float]:
        """How far apart two poses are: translation in metres, rotation in radians."""
        relative = self.rotation.T @ other.rotation
        # atan2 of |sin| and cos keeps its digits at small angles, where arccos loses half of them.
        axis = np.array(
            [relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1]]
        )
        angle = np.arctan2(np.linalg.norm(axis), np.trace(relative) - 1.0)
        return float(np.linalg.norm(self.translation - other.translation)), float(angle)


def nearest_rotation(matrix: ArrayLike) -> Floats:
    """The rotation nearest to a (3, 3) matrix that nearly is one; raises InvalidGeometryError where it is not."""
    m = np.asarray(matrix, dtype=np.float64)
    u, s, vt = np.linalg.svd(m)
    rotation: Floats = u @ vt
    if np.abs(s - 1.0).max() > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        msg = f"a pose is a rigid motion (no scale, no mirror), got singular values {s.round(4).tolist()}"
        raise InvalidGeometryError(msg)
    return rotation


def rotation_from_vector(vector: ArrayLike) -> Floats:
    """Rotation (3, 3) about `vector` by its length in radians (Rodrigues)."""
    v = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(v))
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    if angle < 1e-9:
        return nearest_rotation(np.eye(3) + k)
    k /= angle
    rotation: Floats = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)
    return rotation


def rotation_vector(rotation: Floats) -> Floats:
    """Axis × angle (3,), radians up to π, of a rotation (3, 3); the inverse of `rotation_from_vector`."""
    quaternion = Pose(rotation, np.zeros(3)).quaternion()
    axis = np.array([quaternion[part] for part in "xyz"])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.zeros(3)
    angle = 2.0 * np.arctan2(sine, quaternion["w"])
    return axis / sine * float(angle - 2.0 * np.pi if angle > np.pi else angle)


def random_rotation(rng: np.random.Generator) -> Floats:
    """A rotation (3, 3) drawn uniformly (normalised Gaussian quaternion)."""
    x, y, z, w = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
