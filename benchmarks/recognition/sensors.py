"""Scans by others than a terrestrial laser scanner: matched photographs, a SLAM walk, a frame of structured light."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from benchmarks.common import Floats
from benchmarks.recognition.scenes import spread_over
from scanfind.pose import Pose
from scanfind.simulate.instruments import SCANNERS, Scanner
from scanfind.simulate.scanner import SimulatedScan, scan
from scanfind.simulate.scene import Scene

Sensor = Callable[[Scene, int, int], SimulatedScan]

# A handheld SLAM scanner: makers tell 6 to 10 mm for a single range, and a walk's passes that disagree by as much.
SLAM = Scanner(noise=0.008, beam_diameter=0.01, beam_divergence=0.003, lowest=float(np.radians(-80.0)))
DRIFT_M, DRIFT_DEG = 0.008, 0.05
# A frame is taken from a person's height, at one of these distances from the part, from where most of it is in sight.
FRAME_FROM_M, FRAME_HEIGHT_M, FRAME_WAYS = (2.5, 3.2, 4.0), 1.7, 16
WALL_M = 0.2


def photogrammetry(scene: Scene, seed: int, points: int) -> SimulatedScan:
    """A cloud matched from photographs: no stations, holes where nothing has texture."""
    return scan(scene, scanner=SCANNERS["photogrammetry"], seed=seed, points=points)


def slam(scene: Scene, seed: int, points: int) -> SimulatedScan:
    """A walk by the scene's stations, each pass shifted and turned a little; nobody kept where the scanner was."""
    seen, rng = scan(scene, scanner=SLAM, seed=seed, points=points), np.random.default_rng([seed, 9])
    drifts = [
        Pose.from_rotation_vector(np.radians(rng.normal(scale=DRIFT_DEG, size=3)), rng.normal(scale=DRIFT_M, size=3))
        for _ in seen.stations
    ]
    passes = [replace(c, xyz=drift.move(c.xyz), origin=None) for c, drift in zip(seen.stations, drifts, strict=True)]
    return replace(seen, stations=passes)


def structured_light(scene: Scene, seed: int, points: int) -> SimulatedScan:
    """One frame of 640 × 465 pixels that shows the part, or where it would be; `points` are as many as it has."""
    return scan(scene, scanner=SCANNERS["structured-light"], seed=seed)


def framed(scene: Scene) -> Scene:
    """The scene with one station, turned to its target, from which most of it is in sight."""
    (target,) = scene.target_ids()
    points, caster = spread_over(scene, target), scene.caster()
    middle, hall = points.mean(axis=0), scene.objects[0].mesh.vertices
    low, high = hall.min(axis=0) + WALL_M, hall.max(axis=0) - WALL_M
    places: list[Floats] = []
    for angle in np.linspace(0.0, 2.0 * np.pi, FRAME_WAYS, endpoint=False):
        for away in FRAME_FROM_M:
            at = np.array([middle[0] + away * np.cos(angle), middle[1] + away * np.sin(angle), FRAME_HEIGHT_M])
            if (at >= low).all() and (at <= high).all():
                places.append(at)
    best = max(places, key=lambda at: float(caster.sees(at, points).mean()))
    return Scene(scene.objects, best[None], middle[None])


SENSORS: Mapping[str, Sensor] = {
    "photogrammetry": photogrammetry,
    "slam": slam,
    "structured-light": structured_light,
}
