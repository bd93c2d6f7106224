"""What a survey sees of each object: the answer to "will this spool be seen from here?"."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanfind.simulate.placement import sample_oriented
from scanfind.simulate.scanner import Survey

Floats = NDArray[np.float64]

# Points of a surface that its share in sight is judged by: within 1.5 % for a target.
SAMPLES, TARGET_SAMPLES = 500, 4000
# What a detection needs: see "What to expect" in the README.
LIKELY_FOUND = 1 / 3
INSIDE = 0.5


@dataclass(frozen=True)
class Sight:
    """What of one object is seen. Metres, radians; None where nothing of it is.

    object_id : in the scene
    points : its points, by station
    visible : the share of its surface that a station sees: in view and in range, with nothing in front, and returning
        light enough for at least every other beam; by station
    together : the share that at least one station sees
    spacing_m : mean distance between its points, over what is seen
    incidence, steepest : median and largest angle between the beams and the surface's normal, each point of the
        surface from the station that sees it best
    nearest_m, farthest_m : from the stations to what they see
    """

    object_id: int
    name: str
    target: bool
    points: tuple[int, ...]
    visible: tuple[float, ...]
    together: float
    spacing_m: float | None
    incidence: float | None
    steepest: float | None
    nearest_m: float | None
    farthest_m: float | None


def sight_of(survey: Survey, object_id: int, points: tuple[int, ...]) -> Sight:
    """What a survey sees of an object on which it has `points`, by station."""
    thing = survey.scene.objects[object_id]
    rng = np.random.default_rng(object_id)
    sample, normals = sample_oriented(thing.mesh, rng, TARGET_SAMPLES if thing.target else SAMPLES)
    surface, outward = thing.pose.move(sample), thing.pose.turn(normals)
    seen, cosines, ranges = [], [], []
    for pose in survey.poses:
        away = surface - pose.translation
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        beam = away / distance[:, None]
        cosine = np.abs(np.einsum("ij,ij->i", beam, outward))
        can = survey.scanner.reaches(distance) & survey.scanner.in_view(pose.inverse().turn(beam))
        can &= survey.scanner.brightness(distance, thing.reflectance * cosine) > 0.5
        seen.append(can & survey.caster.sees(pose.translation, surface))
        cosines.append(cosine)
        ranges.append(distance)
    sees, best = np.array(seen), np.where(seen, cosines, 0.0).max(axis=0)
    any_ = sees.any(axis=0)
    together, total = float(any_.mean()), sum(points)
    spacing = float(np.sqrt(together * thing.mesh.area() / total)) if total and together else None
    incidence = np.arccos(np.minimum(best[any_], 1.0))
    reach = np.array(ranges)[sees]
    return Sight(
        object_id,
        thing.name,
        thing.target,
        points,
        tuple(float(share) for share in sees.mean(axis=1)),
        together,
        spacing,
        *((float(np.median(incidence)), float(incidence.max())) if any_.any() else (None, None)),
        *((float(reach.min()), float(reach.max())) if any_.any() else (None, None)),
    )


def remarks(survey: Survey, sights: list[Sight]) -> list[str]:
    """What a planner should know: stations that stand in or too near to something, targets that show little."""
    lines = []
    for number, pose in enumerate(survey.poses, 1):
        nearest, backs = survey.caster.around(pose.translation)
        x, y, z = pose.translation
        where = f"station {number} at {x:.2f} {y:.2f} {z:.2f}"
        if backs > INSIDE:
            lines.append(f"{where} stands inside of something: move it, it sees the backs of surfaces")
        elif nearest < survey.scanner.nearest:
            near = f"{nearest:.2f} m from a surface, nearer than the {survey.scanner.nearest} m it measures"
            lines.append(f"{where} stands {near}")
    for sight in sights:
        if sight.target and sight.together < LIKELY_FOUND:
            share = f"{100 * sight.together:.0f} % in sight"
            lines.append(f"{sight.name} ({sight.object_id}): {share}, may be missed below a third: move a station")
    return lines
