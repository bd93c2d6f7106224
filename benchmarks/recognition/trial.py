"""A scene to be searched and what is known of it, and the row that comes of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from benchmarks.common import Floats, PoseError
from benchmarks.recognition.parts import Part
from benchmarks.recognition.scenes import visible_shares
from benchmarks.recognition.sensors import SENSORS
from scanfind.pose import Pose
from scanfind.simulate.scanner import SimulatedScan, scan
from scanfind.simulate.scene import Scene

Key = tuple[str, str, int]

# A pose is right within 10 mm at the part's middle and half a degree, as in the paper's tables; of a part smaller than
# two metres its ends may be 10 mm off: half a degree of a 0.5 m flange is 2 mm, the noise.
RIGHT_MM, RIGHT_DEG = 10.0, 0.5
# So many points on what tells two poses, or two parts, apart are enough: a patch of 140 mm at 20 mm spacing.
ENOUGH_TELLING = 50


@dataclass(frozen=True, eq=False)
class Instance:
    """A part that stands in a scene: its object id there, where it is, and the share of its surface in sight."""

    part: Part
    object_id: int
    pose: Pose
    visible: float
    right_mm: float = RIGHT_MM
    least_deg: float = RIGHT_DEG

    def is_right(self, found: Pose) -> bool:
        """Is a pose this instance's own?"""
        return self.error(found).within(self.right_mm, max(self.least_deg, right_deg(self.part)))

    def error(self, found: Pose) -> PoseError:
        """Modulo the part's symmetry."""
        return self.part.error(found, self.pose)


@dataclass(frozen=True, eq=False)
class Trial:
    """A question: which of the parts are in the scene, and where?

    line, case : of the benchmark; seed : of the scene, its scan and the search
    sought : all parts of the library
    points : about how many the scan has
    rivals : parts sought, or the part itself, that an instance may be taken for: asked how many points tell
    preset : of parameters, that the search is made with
    sensor : that scans the scene, one of SENSORS; None: a terrestrial scanner
    right_mm, least_deg : how far from the truth a pose is still right
    instance objects are those of the scene that are marked as targets; each has the name of its part
    """

    line: str
    case: str
    seed: int
    scene: Scene
    sought: tuple[Part, ...]
    points: int
    rivals: tuple[Part, ...] = ()
    preset: str = "default"
    sensor: str | None = None
    right_mm: float = RIGHT_MM
    least_deg: float = RIGHT_DEG

    def key(self) -> Key:
        """What it is about, within one benchmark."""
        return (self.line, self.case, self.seed)

    @cached_property
    def scanned(self) -> SimulatedScan:
        """Its scan."""
        if self.sensor is None:
            return scan(self.scene, seed=self.seed, points=self.points)
        return SENSORS[self.sensor](self.scene, self.seed, self.points)

    @cached_property
    def instances(self) -> list[Instance]:
        """Of the parts sought, those that are there."""
        by_name = {part.name: part for part in self.sought}
        objects, ids = self.scene.objects, self.scene.target_ids()
        seen = zip(ids, visible_shares(self.scene, ids), strict=True)
        limits = self.right_mm, self.least_deg
        return [Instance(by_name[objects[k].name], k, objects[k].pose, share, *limits) for k, share in seen]

    def points_on(self, instance: Instance) -> Floats:
        """(N, 3): the scanned points of an instance, scene frame."""
        return self.scanned.points_on(instance.object_id)


def right_deg(part: Part) -> float:
    """How far a right pose may be turned, degrees."""
    return max(RIGHT_DEG, float(np.degrees(2e-3 * RIGHT_MM / part.diameter())))


@dataclass(frozen=True)
class Row:
    """One search of one scene; see benchmarks/README.md for the columns."""

    line: str
    case: str
    seed: int
    points: int
    models: int
    instances: int
    object_points: int
    occlusion: float
    telling: float
    right: int
    false: int
    likeness: int
    false_on: str
    error_mm: float
    error_deg: float
    score: float
    false_score: float
    grid_s: float
    search_s: float
    refine_s: float
    verify_s: float
    total_s: float
    note: str

    def key(self) -> Key:
        """What it is about."""
        return (self.line, self.case, self.seed)

    def can_tell(self) -> bool:
        """Do the data tell the part from its likenesses, or from its twin? True where nobody asks."""
        return not self.telling < ENOUGH_TELLING
