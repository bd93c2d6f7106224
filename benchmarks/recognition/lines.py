"""The lines: for each a recipe of scenes from a seed, and what counts as success."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

from benchmarks.recognition.parts import (
    TWIN_BRANCH_M,
    TWINS,
    Part,
    box_frame_part,
    frame,
    gate_valve,
    hundred,
    likenesses,
    mirrored,
    pipe_spool_part,
    ten,
    twins,
)
from benchmarks.recognition.scenes import CLUTTER, behind_boards, free, meant, points_for
from benchmarks.recognition.sensors import SENSORS, framed
from benchmarks.recognition.trial import Key, Trial
from scanfind.mesh import Mesh
from scanfind.parameters import PRESETS
from scanfind.simulate.objects import FRAME_MEMBER_M, FRAME_SIZE_M, SpoolDesign, spool
from scanfind.simulate.piping import plant
from scanfind.simulate.scenes import shop

Wants = Callable[[Key], bool]
Line = Callable[[int, Wants], Iterator[Trial]]

# Scenes of these seeds and above are never looked at while anything is tuned; those below 100 are for that.
PUBLICATION_SEEDS = 7400
OCCLUSIONS = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.98)
PLANT_POINTS, FREE_POINTS, SENSOR_POINTS = 1_000_000, 100_000, 1_000_000
# Other sensors' points are off by 10 mm and more, and some of it is no noise that a fit would average away.
NOISY_MM, NOISY_DEG = 30.0, 1.0


def alarms(seed: int, wants: Wants) -> Iterator[Trial]:
    """False alarms: a scene with the part and with decoys of it, and the same scene without the part.

    Even seeds seek the paper's spool, odd ones its frame. Decoys are its mirror image, one that differs from it in a
    length by a hand's breadth, and whatever stands about: six other spools, racks, stairs, trays. All three are in
    sight by 30 % or more. Success: without, nothing is reported; with, the part is, at its pose, and nothing else.
    """
    part = (pipe_spool_part, box_frame_part)[seed % 2]()
    decoys = [mirrored(part.mesh), near_duplicate(part)]
    scene = None
    for case in ("with", "without"):
        if wants(("alarms", f"{part.name} {case}", seed)):
            scene = scene or shop(seed, [part.mesh, *decoys], clutter=CLUTTER)
            left_out = [part.name] if case == "without" else []
            there = meant(scene, [part.name], left_out)
            yield Trial("alarms", f"{part.name} {case}", seed, there, (part,), points_for(scene))


@cache
def near_duplicate(part: Part) -> Mesh:
    """The spool with its riser a hand's breadth further along; the frame with a rail in place of its brace."""
    if part is pipe_spool_part():
        design = SpoolDesign()
        return spool("near_spool", replace(design, branch_at=design.branch_at + TWIN_BRANCH_M))
    return frame("near_frame", FRAME_SIZE_M, FRAME_MEMBER_M, FRAME_SIZE_M[2] / 2)


def instances(seed: int, wants: Wants) -> Iterator[Trial]:
    """30 instances of 10 models, twins among them, in one plant scene, in one call.

    Success is by instance: found at its pose and by its name (recall); a detection that is none of them is false
    (precision). Every instance is in sight by 30 % or more.
    """
    if wants(("instances", "plant", seed)):
        scene = plant(seed, [part.mesh for part in ten()], copies=3, stations=8, spools=2)
        yield Trial("instances", "plant", seed, scene, ten(), PLANT_POINTS)


def occlusion(seed: int, wants: Wants) -> Iterator[Trial]:
    """One part behind boards, hidden more from case to case; even seeds the spool, odd ones the frame.

    The case names the occlusion that was asked for, the row has it as it is. Success: the part is found at its pose.
    """
    part = (pipe_spool_part, box_frame_part)[seed % 2]()
    scene = None
    for asked in OCCLUSIONS:
        if wants(("occlusion", f"{part.name} {asked:g}", seed)):
            scene = scene or shop(seed, part.mesh, clutter=CLUTTER)
            hidden = behind_boards(scene, asked, seed)
            if hidden is not None:
                yield Trial("occlusion", f"{part.name} {asked:g}", seed, hidden, (part,), points_for(scene))


def likeness(seed: int, wants: Wants) -> Iterator[Trial]:
    """A part that is nearly the same when it is turned over or end for end; nothing else is sought.

    Failure is a detection that lies on the part in another pose, or in the right one and another besides, where
    ENOUGH_TELLING points or more tell the poses apart; a part that is not found at all is no failure of this line.
    """
    part = likenesses()[seed % len(likenesses())]
    if wants(("likeness", part.name, seed)):
        scene = shop(seed, part.mesh, clutter=CLUTTER)
        yield Trial("likeness", part.name, seed, scene, (part,), points_for(scene), (part,))


def pose(seed: int, wants: Wants) -> Iterator[Trial]:
    """A part that hangs free in an empty hall, turned anyhow, scanned from eight sides with 2 mm range noise.

    What counts is the error of the pose at the part's middle, and of its rotation; medians over the scenes.
    """
    parts = (pipe_spool_part(), box_frame_part(), gate_valve("valve", 0.15, geared=True))
    part = parts[seed % len(parts)]
    if wants(("pose", part.name, seed)):
        yield Trial("pose", part.name, seed, free(part, seed), (part,), FREE_POINTS)


def library(seed: int, wants: Wants) -> Iterator[Trial]:
    """One shop scene with one spool of the library, sought alone, among its eight like it, and among all hundred.

    What counts is the time of the hundred over that of the one, models prepared beforehand, and whether it is found.
    """
    every = hundred()
    part = every[5 * (seed % 8)]
    sizes = {"1": (part,), "40 spools": every[:40], "100": every}
    scene = None
    for case, sought in sizes.items():
        if wants(("library", case, seed)):
            scene = scene or shop(seed, part.mesh, clutter=CLUTTER)
            yield Trial("library", case, seed, scene, sought, points_for(scene))


def choice(seed: int, wants: Wants) -> Iterator[Trial]:
    """Two parts that differ in one respect, one of them in the scene, both sought; which respect goes by the seed.

    Success: the one that is there is found at its pose, and the other is not reported in its place; asked only where
    ENOUGH_TELLING points lie on what tells them apart.
    """
    kind, second = TWINS[seed % len(TWINS)], seed // len(TWINS) % 2
    there, other = twins(kind)[second], twins(kind)[1 - second]
    case = f"{kind} {'other' if second else 'first'}"
    if wants(("choice", case, seed)):
        scene = shop(seed, there.mesh, clutter=CLUTTER)
        yield Trial("choice", case, seed, scene, (there, other), points_for(scene), (other,))


def sensors(seed: int, wants: Wants) -> Iterator[Trial]:
    """A part in clouds by other sensors, and the same scene without it; even seeds the spool, odd ones the frame.

    Six other spools stand about. Each cloud is searched with the default parameters and with the sensor's preset, where
    there is one. Success: without, nothing is reported; with, the part is, within NOISY_MM and NOISY_DEG, and nothing
    else.
    """
    part = (pipe_spool_part, box_frame_part)[seed % 2]()
    scene, framed_there = None, None
    for sensor in SENSORS:
        for there in ("with", "without"):
            for preset in ("default", sensor) if sensor in PRESETS else ("default",):
                case = f"{sensor} {part.name} {there} {'preset' if preset == sensor else 'default'}"
                if not wants(("sensors", case, seed)):
                    continue
                scene = scene or shop(seed, part.mesh, clutter=CLUTTER)
                seen_from = scene
                if sensor == "structured-light":
                    seen_from = framed_there = framed_there or framed(meant(scene, [part.name]))
                shown = meant(seen_from, [part.name], [part.name] if there == "without" else [])
                yield Trial(
                    "sensors", case, seed, shown, (part,), SENSOR_POINTS, (), preset, sensor, NOISY_MM, NOISY_DEG
                )


LINES: dict[str, Line] = {
    "alarms": alarms,
    "instances": instances,
    "occlusion": occlusion,
    "likeness": likeness,
    "pose": pose,
    "library": library,
    "choice": choice,
    "sensors": sensors,
}
