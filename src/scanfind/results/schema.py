"""What results.json holds, field by field. `Results.model_json_schema()` gives it as a JSON schema.

Everything is in metres, radians and the scan file's own frame, scaled to metres where its scale was free. A number that
does not exist is null, never NaN.
"""

from __future__ import annotations

import re
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

SCHEMA = 1

Vector = tuple[float, float, float]
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]
Six = tuple[float, float, float, float, float, float]
Covariance = tuple[Six, Six, Six, Six, Six, Six]


class Entry(BaseModel):
    """A part of results.json: unchanging; a key it does not know is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class ScanEntry(Entry):
    """A scan file of the scene. `stations_m`: where its scanners stood, null where nobody knows.

    `fingerprint` tells whether a file is still the one that was searched; null for points that came in memory.
    """

    path: str
    points: int
    dropped: int
    stations_m: list[Vector | None]
    fingerprint: str | None = None


class AxisEntry(Entry):
    """A unit direction of the model's frame, and the order of the turns about it: n for 2π/n, null for every angle."""

    direction: Vector
    order: int | None


class SymmetryEntry(Entry):
    """The rotations that map a model onto itself: those about these axes through `centre_m`, in any succession.

    No axis: none. Two of order null: every rotation, as of a sphere. Of poses that look the same the one reported is
    nearest to the model standing as it was drawn. `words` says it for people.
    """

    words: str
    centre_m: Vector
    axes: list[AxisEntry]


class ModelEntry(Entry):
    """A model that was sought. `sha256`: of its geometry and of the parameters it was prepared with.

    `symmetry` is null in results of scanfind before it knew of it. `expected`: how many instances there should be, null
    where nobody said.
    """

    name: str
    sha256: str
    diameter_m: float
    pairs: int
    symmetry: SymmetryEntry | None = None
    expected: int | None = None


class Quaternion(Entry):
    """A rotation, its parts named because half the world puts w first."""

    x: float
    y: float
    z: float
    w: float


class MotionEntry(Entry):
    """A motion the data do not fix, or hardly, model frame: `kind` is slide or roll.

    `sigma` is how uncertain the pose is along it, where the data say so little that it is more than the noise of a
    single point: metres for a slide, radians for a roll. null: the data say nothing, the pose may be anywhere along it.
    """

    kind: str
    axis: Vector
    through_m: Vector
    sigma: float | None = None


class DeviationEntry(Entry):
    """Signed distances of the isolated points from the model's surface, + outside."""

    mean_m: float | None
    rms_m: float | None
    p95_m: float | None
    worst_m: float | None


class PartEntry(Entry):
    """One part of a found assembly, against the parts that keep to the design; model frame.

    `status`: measured; missing: beams passed through most of it; not_seen: too little of it was looked at to say.
    `joined_to`: the part it hangs on. `shift_m`, of its middle, and `turn_rad`, axis × angle, hold nothing of the
    motions in `free`, which the scan does not fix; each sigma is a standard deviation in the worst of the others.
    `off_m`: how far the point of its surface that moved the most did. All null where it was not measured.
    """

    name: str
    status: str
    joined_to: str | None
    built_from_design: Matrix | None
    shift_m: Vector | None
    turn_rad: Vector | None
    off_m: float | None
    off_sigma_m: float | None
    shift_sigma_m: float | None
    turn_sigma_rad: float | None
    free: list[MotionEntry]
    support: float | None
    visible_support: float | None
    penalty: float | None


class DimensionEntry(Entry):
    """A key dimension as designed and as built; metres, of the kind `angle` radians.

    `kind`: linear, radius, face (its tilt across its diameter), place (how far from where the design puts it) or angle.
    `sigma` is a standard deviation, of what the points of its surfaces disagree by. `built` and `sigma` are null where
    it was not measured, and `why` says why.
    """

    name: str
    kind: str
    design: float
    built: float | None
    sigma: float | None
    why: str = ""


class StationEntry(Entry):
    """What the beams of one station say of a placed model, as shares of the surface that those of all went to.

    `station`: its number, from 1, among the `stations_m` of all scans in order. Stations that went to less than a
    hundredth are left out.
    """

    station: int
    on: float
    beside: float
    through: float
    hidden: float


class DetectionEntry(Entry):
    """One instance of one model. `isolated` and `pose` are files of the result folder, null where none was written.

    `covariance` is of the error of `scene_from_model`, rows and columns (rx, ry, rz, x, y, z) in the axes of the scan
    file, radians and metres: the true pose is the found one turned by the rotation vector (rx, ry, rz) about `pivot_m`,
    a point of the scan file's frame, then shifted by (x, y, z). No number is infinite: along those of `unobservable`
    whose sigma is null it is zero, and means nothing; it has a pseudo-inverse then, no inverse. It knows what points
    disagree by, not what they are all off by, such as a registration. `sigma_m` and `sigma_rad` say it in short: by how
    much the pivot and the rotation are off, root mean square. All four are null in results of an earlier version.

    `parts` is empty where they were not asked for (`assembly.parts`, --parts) and where the model has but one. With
    parts, `isolated` and `deviation` are of the parts where they were built.

    `dimensions` are what a drawing would give: of a model with round parts its flange faces and pipes, of another its
    extents. They are empty for pieces of scan and free forms, and in results of an earlier version. `stations`: of
    where it was found; empty where there are not several. `instead_of`: the element of the design in whose place it
    stands, where two were swapped.

    `rival`: the best score among poses of the same surface that were refused in its favour, null where there is none.
    `probability`: that the model is there, at this pose; docs/score.md says what it was measured on. null where nobody
    measured: at a design's place, by parts, of a piece of scan, with weights of one's own; and in results of an earlier
    version. `tolerance_m`: how far from the placed model its isolated points may lie, null where none were isolated.
    """

    id: int
    model: str
    scene_from_model: Matrix
    translation_m: Vector
    quaternion: Quaternion
    score: float | None
    support: float | None
    visible_support: float | None
    penalty: float | None
    coverage: float | None
    rms_m: float | None
    unobservable: list[MotionEntry]
    points: int
    isolated: str | None
    pose: str | None
    deviation: DeviationEntry | None
    covariance: Covariance | None = None
    pivot_m: Vector | None = None
    sigma_m: float | None = None
    sigma_rad: float | None = None
    parts: list[PartEntry] = []
    dimensions: list[DimensionEntry] = []
    stations: list[StationEntry] = []
    instead_of: str = ""
    rival: float | None = None
    probability: float | None = None
    tolerance_m: float | None = None


class RefusedEntry(Entry):
    """A hypothesis that came close, and why it was not believed.

    `rival`: the best score among what is told of the same surface; `probability`: see DetectionEntry.
    """

    model: str
    scene_from_model: Matrix
    score: float | None
    support: float | None
    visible_support: float | None
    penalty: float | None
    reason: str
    rival: float | None = None
    probability: float | None = None


class ElementEntry(Entry):
    """An element of the design: what became of it, and the evidence that decided it.

    `design_from_model`: where the design puts it, in the scan's frame (moved there by `alignment`, where there is one).

    `status`: installed, uncertain, occluded, not_found, not_enough_data or no_data. `verdict`: in_tolerance,
    out_of_tolerance or not_judged, `verdict_why` in words; null where it was not found or there is no `profile`.
    `detection`: the id of the instance taken for it. `shift_m` of its middle, in the scan's axes, `turn_rad` by what
    angle it is turned, `off_m` how far the point of its surface that moved the most did; all null where it was not
    found. `on`, `beside`, `through`, `hidden`: what beams say at the design's place, as shares of the surface they went
    to: they ended on it, near it but not on it, behind it, before it; where it was not found those that should have
    come back and did not went behind it; null where no scanner position is known.
    `built_from_design` moves it from its place in the design to where it stands, without the motions the scan hardly
    fixes: null unless it is installed, and in results of an earlier version. `stations`: of the design's place; empty
    where there are not several.
    """

    global_id: str
    ifc_class: str
    name: str
    model: str
    status: str
    verdict: str | None
    detection: int | None
    design_from_model: Matrix
    shift_m: Vector | None
    turn_rad: float | None
    off_m: float | None
    on: float | None
    beside: float | None
    through: float | None
    hidden: float | None
    why: str
    built_from_design: Matrix | None = None
    verdict_why: str = ""
    stations: list[StationEntry] = []


class AlignmentEntry(Entry):
    """Where the design lies in the scan's frame, found from its elements: all of them are where it puts them.

    `covariance`, `pivot_m`, `sigma_m`, `sigma_rad`: of `scene_from_design`, as of a detection; `agreeing` of `found`
    instances lie where it says, and are off from there by `rms_m`, root mean square of one coordinate.
    """

    scene_from_design: Matrix
    covariance: Covariance
    pivot_m: Vector
    sigma_m: float
    sigma_rad: float
    agreeing: int
    found: int
    rms_m: float


class ScaleEntry(Entry):
    """`metres` a unit of the scans' coordinates, and its standard deviation; null where nothing told the scale."""

    metres: float
    sigma: float | None


class Results(Entry):
    """results.json. `shift_m` was taken off while computing; every coordinate here has it added back.

    `tolerance_m`: no point farther from a model was isolated, null where none were. `elements` are those of the design,
    where a search was asked what became of it; `profile` by how much they may be off, as a TOML file says it (see
    docs/report.md). `allowed_m` says so in results of an earlier version: no point of theirs by more. `made`: when this
    was written, UTC as in 2026-11-22T17:30:00Z, null in results of an earlier version. `alignment`: null where scans
    and design are in one frame. `scan_scale`: where the scale of the scans was free; poses, points and all else are in
    the scans' frame with every coordinate times its `metres`. null: the scans were in metres.
    """

    schema_: int = Field(SCHEMA, alias="schema")
    scanfind: str
    seed: int
    made: str | None = None
    parameters: dict[str, Any]
    shift_m: Vector
    crs: str | None
    tolerance_m: float | None = None
    scans: list[ScanEntry]
    models: list[ModelEntry]
    detections: list[DetectionEntry]
    refused: list[RefusedEntry]
    elements: list[ElementEntry] = []
    profile: dict[str, Any] | None = None
    allowed_m: float | None = None
    alignment: AlignmentEntry | None = None
    scan_scale: ScaleEntry | None = None
    remainder: str | None = None
    notes: list[str] = []
    timings_s: dict[str, float]
    peak_memory_bytes: int

    def measured(self) -> bool:
        """Was what a drawing would dimension asked for?"""
        asked: bool = self.parameters.get("isolate", {}).get("dimensions", False)
        return asked

    def to_json(self) -> str:
        """The text of results.json: two blanks a level, keys in the order above, a list of plain values on one line."""
        text = self.model_dump_json(indent=2, by_alias=True)
        # No string of JSON holds a line break as it is, so what spans lines is structure.
        return re.sub(r"\[\n\s+([^][{}]*?)\n\s+\]", lambda x: "[" + re.sub(r"\n\s+", " ", x[1]) + "]", text)
