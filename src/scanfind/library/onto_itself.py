"""A model's surface laid onto itself after a motion: how much of it then lies on it, and where it would settle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.library.near_surface import near_samples, near_triangles, signed_distances, unit_normals
from scanfind.mesh import doubled_areas
from scanfind.pose import Pose
from scanfind.symmetry import turn_about
from scanfind.threads import once

if TYPE_CHECKING:
    from scanfind.library.surface import ModelSurface
    from scanfind.mesh import Mesh

Floats = NDArray[np.float64]

# A symmetry brings this share of so many samples this near to the surface, in spacings of the samples (3,000 on a spool
# of 3 m: 2.4 mm; a pipe of 0.1 m drawn with 48 sides is flat by 0.2 mm). A piece of scan has noise, and no faces.
TRUE_SHARE, TRUE_SHARE_CLOUD, TRUE_TRIED = 0.995, 0.94, 2000
TRUE_WITHIN, TRUE_WITHIN_CLOUD = 0.1, 0.3
# … and most of the samples near samples: a face that nobody sees is no part of the surface, nor is the other side of a
# sheet. Not more of them, for the walls of bolt holes hold too few samples to have one of like normal everywhere.
TRUE_SAMPLES = 0.9
OVERLAP_SAMPLES = 200
# Few samples, and far off, show that a motion is hopeless.
ROUGH_SAMPLES, ROUGH_WITHIN, ROUGH_SHARE = 60, 2.0, 0.8
SETTLING_SAMPLES, SETTLING_STEPS = 400, 8
FACETS, FACET_COSINE, FACET_SHARE = 6, 0.999, 0.02
LIKE = 0.7  # least cosine between normals


class OntoItself:
    """A model's samples and the surface they are laid onto, both in the model's frame.

    mesh : None for a piece of scan, whose samples then stand for its surface
    """

    def __init__(self, surface: ModelSurface, mesh: Mesh | None) -> None:
        self.points, self.normals = surface.samples.points, surface.samples.normals
        self.spacing, self.diameter, self.signed = surface.spacing, surface.diameter, surface.signed
        self._reach = ROUGH_WITHIN * surface.spacing
        if mesh is None:
            self._near = near_samples(surface.samples, surface.spacing, self._reach)
            self._corners, self._faces = self.points, self.normals
        else:
            triangles = mesh.triangles()
            self._near = near_triangles(triangles, self._reach, signed=False)
            self._corners, self._faces = triangles[:, 0], unit_normals(triangles)
        self._within = surface.spacing * (TRUE_WITHIN_CLOUD if mesh is None else TRUE_WITHIN)
        self._share = TRUE_SHARE_CLOUD if mesh is None else TRUE_SHARE
        # What no symmetry moves: the middle of the surface. That of the samples is it nearly, that of the triangles
        # exactly, unless many of them are hidden.
        self.centre: Floats = self.points.mean(axis=0)
        if mesh is not None and np.linalg.norm(middle_of(mesh) - self.centre) < self.spacing:
            self.centre = middle_of(mesh)
        self.radius = float(np.linalg.norm(self.points - self.centre, axis=1).max())

    def _faces_below(self, motion: Pose, count: int) -> tuple[Floats, Floats, NDArray[np.int32], NDArray[np.bool_]]:
        """The first `count` samples moved, (count, 3); how far from the surface; the face there; is it the like of
        theirs, whichever side it shows.
        """
        moved, normals = motion.move(self.points[:count]), motion.turn(self.normals[:count])
        distance, face = signed_distances(self._near, moved)
        like = (face >= 0) & (np.abs((normals * self._faces[face]).sum(axis=1)) > LIKE)
        return moved, np.abs(distance.astype(np.float64)), face, like

    def off(self, motion: Pose, count: int) -> Floats:
        """How far each of the first `count` samples then is from surface of its direction, metres, clipped."""
        _, distance, _, like = self._faces_below(motion, count)
        return np.where(like, distance, self._reach)

    def overlap(self, motion: Pose, count: int = OVERLAP_SAMPLES) -> float:
        """The share of the first `count` samples that a motion brings within two spacings of a sample like them."""
        from scanfind.kernels.overlap import self_overlap

        count = min(count, len(self.points))
        rotation, translation = np.ascontiguousarray(motion.rotation), motion.translation
        return float(
            self_overlap(
                self.points, self.normals, count, *self._in_order, self.signed, rotation, translation,
                2.0 * self.spacing,
            )
        )  # fmt: skip

    @once
    def _in_order(self) -> tuple[Floats, Floats, Floats, int]:
        """The samples and their normals sorted along the longest side of their box, where they are there, which it is.

        So few of them are asked whether they are near.
        """
        axis = int(np.argmax(np.ptp(self.points, axis=0)))
        order = np.argsort(self.points[:, axis], kind="stable")
        points = self.points[order]
        return points, self.normals[order], np.ascontiguousarray(points[:, axis]), axis

    def is_symmetry(self, motion: Pose) -> bool:
        """Does a motion bring the surface onto itself?"""
        if np.mean(self.off(motion, OVERLAP_SAMPLES) <= self._within) < self._share - 0.03:
            return False  # most fail here, at a fifteenth of the cost
        if np.mean(self.off(motion, TRUE_TRIED) <= self._within) < self._share:
            return False
        return self.overlap(motion, 2 * OVERLAP_SAMPLES) >= TRUE_SAMPLES

    def is_hopeless(self, motion: Pose) -> bool:
        """Does so little of the surface come near itself that settling would not help?"""
        return bool(np.mean(self.off(motion, ROUGH_SAMPLES) < self._reach) < ROUGH_SHARE)

    def settled(self, motion: Pose) -> Pose:
        """The motion near this one that brings the surface onto itself best: point-to-plane ICP."""
        centre = motion.move(self.centre[None])[0]
        for _ in range(SETTLING_STEPS):
            moved, _, face, like = self._faces_below(motion, SETTLING_SAMPLES)
            if like.sum() < 6:
                break
            moved, normals, corners = moved[like], self._faces[face[like]], self._corners[face[like]]
            residual = ((moved - corners) * normals).sum(axis=1)
            lever = np.cross(moved - centre, normals) / self.radius
            # What the surface leaves open (the roll of a pipe) stays as it is: the shortest of all best steps.
            step = np.linalg.lstsq(np.hstack([lever, normals]), -residual, rcond=0.02)[0]
            turn = Pose.from_rotation_vector(step[:3] / self.radius)
            motion = Pose(turn.rotation, centre - turn.rotation @ centre + step[3:]) @ motion
            if np.abs(step).max() < 1e-4 * self._within:
                break
        return motion

    @once
    def facets(self) -> list[Floats]:
        """Directions of the largest plane faces, largest first, up to sign."""
        normals = self.normals[:SETTLING_SAMPLES]
        like = np.abs(normals @ normals.T) > FACET_COSINE
        found: list[Floats] = []
        while len(found) < FACETS:
            largest = int(np.argmax(like.sum(axis=1)))
            theirs = np.flatnonzero(like[largest])
            if len(theirs) < max(FACET_SHARE * len(normals), 3):
                break
            found.append(unit(np.sign(normals[theirs] @ normals[largest]) @ normals[theirs]))
            like[:, theirs] = False
        return found


def middle_of(mesh: Mesh) -> Floats:
    """The middle of a mesh's surface, (3,)."""
    areas = doubled_areas(mesh.vertices, mesh.faces)
    return np.asarray(areas @ mesh.triangles().mean(axis=1) / areas.sum())


def about(direction: Floats, point: Floats, angle: float) -> Pose:
    """The turn by `angle` about a line."""
    turn = turn_about(direction, angle)
    return Pose(turn, point - turn @ point)


def any_across(direction: Floats) -> Floats:
    """A unit direction across this one: that of the coordinate axis it is farthest from."""
    across = np.eye(3)[int(np.argmin(np.abs(direction)))]
    across = across - (across @ direction) * direction
    return unit(across)


def unit(vector: Floats) -> Floats:
    """The same direction at unit length."""
    return np.asarray(vector / np.linalg.norm(vector))
