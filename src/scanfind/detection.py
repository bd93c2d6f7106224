"""What is found: a detection, its isolated points, and how far it is from the design."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import isnan, nan
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.design.alignment import Alignment
    from scanfind.design.elements import Element
    from scanfind.tolerances.profile import Profile

Floats = NDArray[np.float64]

# Off the design from here on: what fabricators allow a pipe spool of up to 10 inches (Pipe Fabrication
# Institute, ES-3: an eighth of an inch).
OFF_M = 0.003


@dataclass(frozen=True)
class Motion:
    """A rigid motion the data do not fix, or hardly, in the model's frame: turning about a line, or sliding along it.

    kind : "slide" or "roll" (a screw is reported as the one it mostly is)
    axis : unit direction in the model's frame
    through : a point on the axis, model frame, metres (for a slide: the model's centre)
    sigma : of a motion fixed no better than a single point is measured: its standard deviation, metres for a slide,
        radians for a roll; None where the data say nothing at all
    """

    kind: str
    axis: tuple[float, float, float]
    through: tuple[float, float, float]
    sigma: float | None = None


@dataclass(frozen=True)
class Deviation:
    """Signed distances of the isolated points from the model's surface, metres, + outside."""

    mean_m: float
    rms_m: float
    p95_m: float
    worst_m: float


@dataclass(frozen=True, eq=False)
class PartFit:
    """One part of a found assembly, measured against the parts that keep to the design; all in the model's frame.

    status : "measured"; "missing": beams passed through most of it; "not_seen": too little of it was looked at to say
    joined_to : the part it hangs on; None for the one all others hang on
    built_from_design : what moves the part's design to where it was built, but for what the data do not fix
    shift_m : (3,) of the part's middle; turn_rad : axis × angle (3,)
    off_m, off_sigma_m : how far the point of the part's surface that moved the most did; its standard deviation
    shift_sigma_m, turn_sigma_rad : one standard deviation in the worst direction of those the data fix
    free : motions of the part the data do not fix: shift and turn hold none of them
    support, visible_support, penalty : as of a detection, of the part's surface alone
    Not measured: no motion, and NaN for off_m and all deviations.
    """

    name: str
    status: str
    joined_to: str | None
    built_from_design: Pose
    shift_m: tuple[float, float, float]
    turn_rad: tuple[float, float, float]
    off_m: float
    off_sigma_m: float
    shift_sigma_m: float
    turn_sigma_rad: float
    free: tuple[Motion, ...]
    support: float
    visible_support: float
    penalty: float

    def is_off(self, tolerance_m: float = OFF_M) -> bool:
        """Is some of it surely farther from the design than a tolerance: by that and by three standard deviations?"""
        return self.off_m > max(tolerance_m, 3.0 * self.off_sigma_m)


# What a dimension is of: a length, a radius, a face's tilt across its diameter, a distance from where the design puts
# something (metres), an angle (radians).
LINEAR, RADIUS, FACE, PLACE, ANGLE = "linear", "radius", "face", "place", "angle"


@dataclass(frozen=True)
class Dimension:
    """A key dimension as designed and as built, metres or, of an ANGLE, radians.

    kind : one of LINEAR, RADIUS, FACE, PLACE, ANGLE
    built, sigma : NaN where it was not measured; `why` says why not
    """

    name: str
    kind: str
    design: float
    built: float
    sigma: float
    why: str = ""


@dataclass(frozen=True, eq=False)
class IsolatedPoints:
    """The raw points of one detection with all their attributes.

    xyz : (N, 3) float64, the scan file's frame
    attributes : name → (N,), every input field
    scan_id, source_index : (N,) which scan of the scene, which record of its file
    deviation : (N,) signed distance to the placed model, metres, + outside
    """

    xyz: Floats
    attributes: Mapping[str, NDArray[Any]]
    scan_id: NDArray[np.int32]
    source_index: NDArray[np.int64]
    deviation: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.xyz)


class StationSays(NamedTuple):
    """What the beams of one station say of a placed model, as shares of the surface that those of all went to.

    station : its number, from 1, among those of all scans in order; the others : see free_space.Spoken
    """

    station: int
    on: float
    beside: float
    through: float
    hidden: float


@dataclass(frozen=True, eq=False)
class Detection:
    """One instance of one model, as found.

    scene_from_model : in the scan file's own frame, metres
    score : 0 … 1, how much the evidence speaks for it (see `verify`)
    support : share of the model's surface samples that lie on the scene (the paper's λs = m_s / m)
    visible_support : share of the surface the scanners' beams speak of that they ended on; 0 without origins
    penalty : share of the surface beams went to through which they passed (Papazov & Burschka 2010); 0 without origins
    coverage : share of the model's surface the scan shows, 0 … 1
    rms_m : root mean square distance of supported samples to the scene's surface
    unobservable : motions the data do not fix, or hardly
    covariance : (6, 6) of the pose's error (rotation vector, translation of the pivot) in the scene's axes, rad and m:
        the true pose turns the found one about the pivot, then shifts it. It says nothing (is zero) along the motions
        of `unobservable` without a sigma. None in results of a version that had none
    pivot : (3,) the point the covariance is about, in the middle of the placed model, scene frame, metres
    parts : of an assembly, each measured by itself; empty where that was not asked for or it has but one
    dimensions : what a drawing of it would give, as built; empty for a piece of scan and for free forms
    stations : what each station says of it; empty where there are not several
    slide : (3,) unit direction along which beams that went past its ends, not its faces, say where it stands; None
        where none was asked or none could
    instead_of : the element in whose place it stands, where two were swapped; else empty
    rival : the best score among poses of the same surface that were refused in its favour; NaN where there is none
    probability : that it is right, by how often simulated poses of such a score were (see `evidence.confidence`); NaN
        where nobody measured, and in results of a version that did not know
    tolerance_m : how far from the placed model its own points may lie, metres; None where none were isolated
    """

    id: int
    model: str
    scene_from_model: Pose
    score: float
    support: float
    visible_support: float
    penalty: float
    coverage: float
    rms_m: float
    unobservable: tuple[Motion, ...] = ()
    isolated: IsolatedPoints | None = None
    deviation: Deviation | None = None
    covariance: Floats | None = None
    pivot: tuple[float, float, float] | None = None
    parts: tuple[PartFit, ...] = ()
    dimensions: tuple[Dimension, ...] = ()
    stations: tuple[StationSays, ...] = ()
    slide: tuple[float, float, float] | None = None
    instead_of: str = ""
    rival: float = nan
    probability: float = nan
    tolerance_m: float | None = None

    @property
    def sigma_m(self) -> float:
        """How far the pivot is from where it truly is, root mean square, metres; NaN without a covariance."""
        return float("nan") if self.covariance is None else float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def sigma_rad(self) -> float:
        """By what angle the rotation is off, root mean square, radians; NaN without a covariance."""
        return float("nan") if self.covariance is None else float(np.sqrt(np.trace(self.covariance[:3, :3])))


@dataclass(frozen=True)
class Refused:
    """A hypothesis that came close and was not believed, and why, in words.

    rival : the best score among what is told of the same surface, NaN where there is nothing
    probability : see Detection
    """

    model: str
    scene_from_model: Pose
    score: float
    support: float
    visible_support: float
    penalty: float
    reason: str
    rival: float = nan
    probability: float = nan


@dataclass(frozen=True)
class SceneScan:
    """One scan file (or array) of the scene, as read: valid points, dropped records, where its scanners stood."""

    path: str
    points: int
    dropped: int
    stations: tuple[tuple[float, float, float] | None, ...]


class ScanScale(NamedTuple):
    """Metres a unit of the scans' coordinates, and its standard deviation; NaN where nothing told the scale."""

    metres: float
    sigma: float

    def words(self) -> str:
        """What a user should know of it."""
        if isnan(self.sigma):
            return "nothing tells the scale of the scans: they are taken to be in metres"
        return f"scale of the scans: {self.metres:.6f} ± {self.sigma:.6f} m a unit; results are in metres, scaled by it"


class Findings(list[Detection]):
    """The detections, best first, with what a report needs around them.

    tolerance_m : no point farther from a placed model than this was isolated, metres; None where none were. Each
        detection has its own, see there
    elements : of the design, what became of each; empty where that was not asked for
    profile : how far elements may be off; None: nobody says
    missing : scans that could not be read and were left out, and why
    alignment : where the design lies in the scans, where that was found; None: they are in one frame
    expected : how many instances of a model, by its name, were expected; of others nobody said
    scan_scale : where the scale was free: all coordinates here are those of the scans times this; None: it was not
    """

    refused: list[Refused]
    scans: list[SceneScan]
    shift: tuple[float, float, float]
    crs: str | None
    timings_s: dict[str, float]
    notes: list[str]
    tolerance_m: float | None
    elements: list[Element]
    profile: Profile | None
    missing: list[str]
    alignment: Alignment | None
    expected: dict[str, int]
    scan_scale: ScanScale | None

    def __init__(self, detections: list[Detection] | None = None) -> None:
        super().__init__(detections or [])
        self.refused, self.scans, self.notes, self.elements, self.missing = [], [], [], [], []
        self.shift, self.crs, self.timings_s, self.tolerance_m = (0.0, 0.0, 0.0), None, {}, None
        self.profile, self.alignment, self.expected, self.scan_scale = None, None, {}, None

    def as_known(self) -> list[str]:
        """In words: the scale where it was free; of models of which so many were expected, how many were found."""
        found = Counter(one.model for one in self)
        scale = [self.scan_scale.words()] if self.scan_scale else []
        return scale + [f"{name}: {found[name]} of {count} expected found" for name, count in self.expected.items()]

    def stations(self) -> Floats:
        """Where the scanners of all scans stood, in order, (S, 3); NaN where nobody knows."""
        nowhere = (np.nan,) * 3
        return np.array([where or nowhere for scan in self.scans for where in scan.stations]).reshape(-1, 3)
