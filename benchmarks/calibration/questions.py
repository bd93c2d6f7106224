"""What is asked, from a seed: a kind of scene, an instrument, three likenesses sought, two of them there at most."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from benchmarks.recognition.parts import Part, frame_and_twins, spool_and_twins
from benchmarks.recognition.scenes import CLUTTER, behind_boards, meant
from benchmarks.recognition.sensors import framed
from scanfind.cloud import PointCloud
from scanfind.simulate.building import frame
from scanfind.simulate.instruments import SCANNERS
from scanfind.simulate.objects import SpoolDesign
from scanfind.simulate.piping import plant
from scanfind.simulate.scanner import scan
from scanfind.simulate.scene import Scene
from scanfind.simulate.scenes import shop

SCENES = ("shop", "boards", "plant", "frame", "sparse")
# Blind: the plain instrument, and nobody knows where it stood.
SENSORS = ("faro-ls-840-he", "phase", "structured-light", "blind")
# One frame of structured light is of a room; in the open the plain instrument takes its turn.
OPEN = ("plant", "frame")
THERE = ("both", "both", "one", "none")
# Of the part's surface, where boards hide it; of the points, where a scan is thinned.
HIDDEN, KEPT = (0.6, 0.9), (0.02, 0.2)
POINTS = 120_000
STATIONS = 3


@dataclass(frozen=True, eq=False)
class Question:
    """Which of the parts are in the scan, and where? `scene` and `sensor` are kinds, `world` is what was scanned."""

    seed: int
    scene: str
    sensor: str
    sought: tuple[Part, ...]
    world: Scene
    clouds: list[PointCloud]


def question(seed: int) -> Question:
    """Everything follows from the seed: of 20 in a row each has another scene or sensor."""
    rng = np.random.default_rng([seed, 21])
    kind, sensor = SCENES[seed % len(SCENES)], SENSORS[seed // len(SCENES) % len(SENSORS)]
    if sensor == "structured-light" and kind in OPEN:
        sensor = "plain"
    family = families()[int(rng.integers(2))]
    one, other, missing = (family[k] for k in rng.permutation(len(family))[:3])
    world = stood(kind, seed, one, other)
    if sensor == "structured-light":
        world = framed(meant(world, [one.name]))
    if kind == "boards":
        world = behind_boards(meant(world, [one.name]), float(rng.uniform(*HIDDEN)), seed) or world
    there = THERE[int(rng.integers(len(THERE)))]
    gone = {"both": (), "one": (other.name,), "none": (one.name, other.name)}[there]
    world = replace(world, objects=tuple(thing for thing in world.objects if thing.name not in gone))
    clouds = scanned(world, sensor, seed)
    if kind == "sparse":
        share = float(np.exp(rng.uniform(*np.log(KEPT))))
        clouds = [thinned(cloud, share, rng) for cloud in clouds]
    return Question(seed, kind, sensor, (one, other, missing), world, clouds)


@cache
def families() -> tuple[tuple[Part, ...], ...]:
    """Four spools and four frames that are easily taken for each other."""
    spools = spool_and_twins("spool", SpoolDesign())
    frames = frame_and_twins("frame", (2.2, 1.4, 1.5), 0.08)
    return tuple(
        tuple(Part.of(mesh) for mesh in meshes)
        for meshes in ([spools[kind] for kind in ("", "branch", "rating", "mirrored")], frames.values())
    )


def stood(kind: str, seed: int, one: Part, other: Part) -> Scene:
    """A scene of a kind with two parts in it."""
    meshes = [one.mesh, other.mesh]
    if kind == "plant":
        return plant(seed, meshes, copies=1, stations=STATIONS, spools=2)
    if kind == "frame":
        return frame(seed, meshes, copies=1, stations=STATIONS)
    return shop(seed, meshes, clutter=CLUTTER, stations=STATIONS)


def scanned(world: Scene, sensor: str, seed: int) -> list[PointCloud]:
    """The scene as an instrument sees it."""
    if sensor == "structured-light":  # one frame, of as many pixels as it has
        return scan(world, scanner=SCANNERS[sensor], seed=seed, threads=1).stations
    scanner = SCANNERS["plain" if sensor == "blind" else sensor]
    clouds = scan(world, scanner=scanner, seed=seed, points=POINTS, threads=1).stations
    return [replace(cloud, origin=None) for cloud in clouds] if sensor == "blind" else clouds


def thinned(cloud: PointCloud, share: float, rng: np.random.Generator) -> PointCloud:
    """A share of the points, drawn at random."""
    kept = rng.random(len(cloud)) < share
    return replace(cloud, xyz=cloud.xyz[kept], attributes={k: v[kept] for k, v in cloud.attributes.items()})
