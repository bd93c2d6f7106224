"""In tolerance, out of it, or not judged: what a profile says of one element or instance of a result.

A measurement is a value and how uncertain it is. It is in tolerance where even value + K σ is, out where value − K σ is
not, and otherwise too close to call: the decision rule of ISO 14253-1. What the scan leaves open is infinitely
uncertain, so that nothing passes because nobody could look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees, hypot, inf
from typing import TYPE_CHECKING

import numpy as np

from scanfind.design.elements import IN_TOLERANCE, INSTALLED, NOT_JUDGED, OUT_OF_TOLERANCE
from scanfind.detection import ANGLE, FACE, LINEAR, PLACE, RADIUS
from scanfind.results.document import document, model_entries
from scanfind.results.explain import STATUS_WORDS, length
from scanfind.results.schema import (
    DetectionEntry,
    DimensionEntry,
    ElementEntry,
    ModelEntry,
    MotionEntry,
    PartEntry,
    Results,
)
from scanfind.tolerances.discs import Disc, discs_of
from scanfind.tolerances.profile import OF_DIMENSIONS, Limit, Profile, allowed_off, profile_of

if TYPE_CHECKING:
    from scanfind.detection import Findings
    from scanfind.library import ModelLibrary

IN, OUT = IN_TOLERANCE, OUT_OF_TOLERANCE

K = 2.0  # standard deviations: 95 % of them, were they normal
LEAST_POINTS = 100  # of a percentile: five points beyond it
# Points are cut out of the scan within some distance, and what is bent farther away is not among them: so much of the
# surface that was looked at must have points, or their distances say nothing of the whole.
LEAST_THERE = 0.9
PARALLEL = 0.999

WHAT = {
    "shift_mm": "shift of its middle",
    "off_mm": "point that moved the most",
    "turn_deg": "turn",
    "roll_mm": "turn about its axis, at its rim",
    "tilt_mm": "tilt across its diameter",
    "surface_p95_mm": "95 % of its points, from the surface",
    "surface_mean_mm": "its points in the mean, from the surface",
    "linear_mm": "off the drawing",
    "radius_mm": "off the drawing",
    "face_mm": "off the drawing",
    "place_mm": "off the drawing",
    "angle_deg": "off the drawing",
}
LIMIT_OF = {LINEAR: "linear_mm", RADIUS: "radius_mm", FACE: "face_mm", PLACE: "place_mm", ANGLE: "angle_deg"}


@dataclass(frozen=True)
class Measured:
    """A value and its standard deviation, metres or radians; `why` says what makes it more uncertain than that."""

    value: float
    sigma: float = 0.0
    why: str = ""


@dataclass(frozen=True)
class Check:
    """One limit held against one measurement.

    part : or dimension; empty for the whole
    value : None where there is none, see `why`
    """

    key: str
    part: str
    limit: Limit
    value: float | None
    verdict: str
    why: str

    @property
    def is_of_dimension(self) -> bool:
        """Is it about a key dimension?"""
        return self.key in OF_DIMENSIONS

    def words(self) -> str:
        """For people: "shift of its middle 12 mm, allowed 3.0 mm (PFI ES-3 …)"."""
        what = f"{self.part}: {WHAT[self.key]}" if self.part else WHAT[self.key]
        return f"{what} {self.told(self.value)}, allowed {self.told(self.limit.value)}"

    def told(self, value: float | None) -> str:
        """A value of this kind, for people."""
        if value is None:
            return "not measured"
        return f"{degrees(value):.3f}°" if self.key.endswith("_deg") else length(value, 2)


@dataclass(frozen=True)
class Judgement:
    """The verdict over all limits that hold for an element, and why in one sentence."""

    verdict: str
    why: str
    checks: tuple[Check, ...] = ()


def judge_findings(findings: Findings, profile: Profile, models: ModelLibrary) -> None:
    """Give the elements of an inspection their verdicts; models : all of the design."""
    results = document(findings, models=model_entries(models), parameters={}, seed=0)
    told = judge_results(results, profile, models).elements
    findings.profile = profile
    findings.elements = [
        replace(each, verdict=entry.verdict, verdict_why=entry.verdict_why)
        for each, entry in zip(findings.elements, told, strict=True)
    ]


def judge_results(results: Results, profile: Profile, models: ModelLibrary) -> Results:
    """A result with other tolerances: nothing is searched again. models : all of the design."""
    discs = {key: disc for model in models.models() for key, disc in discs_of(model).items()}
    elements = []
    for each in results.elements:
        judgement = judge_element(profile, results, each, discs)
        told = (judgement.verdict, judgement.why) if each.status == INSTALLED else (None, "")
        elements.append(each.model_copy(update=dict(zip(("verdict", "verdict_why"), told, strict=True))))
    return results.model_copy(update={"elements": elements, "profile": profile.tables(), "allowed_m": None})


def profile_in(results: Results) -> Profile | None:
    """The profile that a result was judged by; None where nobody said how far off elements may be."""
    if results.profile is not None:
        return profile_of(results.profile, "the result's profile")
    return None if results.allowed_m is None else allowed_off(results.allowed_m)


def judge_element(
    profile: Profile, results: Results, each: ElementEntry, discs: Mapping[tuple[str, str], Disc] | None = None
) -> Judgement:
    """What a profile says of an element of the design, one of `results.elements`.

    discs : (model, part) → its axis and radius, model frame, for those parts whose geometry is known
    """
    found = next((one for one in results.detections if one.id == each.detection), None)
    if each.status != INSTALLED or found is None or each.shift_m is None:
        return Judgement(NOT_JUDGED, f"its status is: {STATUS_WORDS.get(each.status, each.status)}")
    words = {"class": each.ifc_class, "type": each.model, "name": each.name or each.model}
    model = _model(results, each.model)
    whole = {**_placed(each, found, model), **_surface(results, found)}
    return _judged(profile, words, whole, found, model, discs or {})


def judge_detection(
    profile: Profile, results: Results, found: DetectionEntry, discs: Mapping[tuple[str, str], Disc] | None = None
) -> Judgement:
    """What a profile says of an instance that has no place in a design: of its surface and of its parts."""
    words = {"class": "", "type": found.model, "name": found.model}
    return _judged(
        profile, words, _surface(results, found), found, _model(results, found.model), discs or {}, placed=False
    )


def _judged(
    profile: Profile, words: Mapping[str, str], whole: Mapping[str, Measured | str], found: DetectionEntry,
    model: ModelEntry | None, discs: Mapping[tuple[str, str], Disc], *, placed: bool = True,
) -> Judgement:  # fmt: skip
    """All limits of a profile held against one element. A measurement that is a str could not be made: that is why."""
    limits = profile.limits(**words)
    checks = [
        _check(key, "", limit, whole[key])
        for key, limit in limits.items()
        if key not in OF_DIMENSIONS and (placed or key in whole)
    ]
    checks += [
        _check(key, each.name, limit, _dimension(each))
        for each in found.dimensions
        for key, limit in profile.limits(**words, dimension=each.name).items()
        if key == LIMIT_OF[each.kind]
    ]
    for part in found.parts:
        of_part = profile.limits(**words, part=part.name)
        if of_part:
            disc = discs.get((found.model, part.name))
            measured = _part(part, disc) if part.status == "measured" else {}
            gone = "it is missing" if part.status == "missing" else "too little of it was looked at"
            checks += [_check(key, part.name, limit, measured.get(key, gone)) for key, limit in of_part.items()]
        if part.status == "missing":
            limit = Limit(inf, "the design")
            checks.append(Check("off_mm", part.name, limit, None, OUT, f"its part {part.name} is missing"))
    return _summed(checks)


def _summed(checks: Sequence[Check]) -> Judgement:
    told = {verdict: [check for check in checks if check.verdict == verdict] for verdict in (OUT, NOT_JUDGED, IN)}
    for verdict, some in told.items():
        if some:
            why = f"within {len(some)} of {len(some)} limits" if verdict == IN else "; ".join(one.why for one in some)
            return Judgement(verdict, why, tuple(checks))
    return Judgement(NOT_JUDGED, "no rule of the profile limits what was measured of it")


def _check(key: str, part: str, limit: Limit, measured: Measured | str) -> Check:
    """A limit held against a measurement, by K standard deviations."""
    if isinstance(measured, str):
        return Check(key, part, limit, None, NOT_JUDGED, f"{_what(key, part)}: {measured}")
    value, margin = abs(measured.value), K * measured.sigma
    # What may be anywhere may be back in place: only what was seen to be off is out.
    least = value if margin == inf else value - margin
    verdict = IN if value + margin <= limit.value else OUT if least > limit.value else NOT_JUDGED
    check = Check(key, part, limit, value, verdict, "")
    if verdict == IN:
        why = ""
    elif verdict == OUT:
        why = check.words()
    elif measured.why:
        why = f"{_what(key, part)}: {measured.why}"
    else:
        why = f"{check.words()}: too close to call, measured to ± {check.told(margin)}"
    return Check(key, part, limit, value, verdict, why)


def _what(key: str, part: str) -> str:
    return f"{part}: {WHAT[key]}" if part else WHAT[key]


def _placed(each: ElementEntry, found: DetectionEntry, model: ModelEntry | None) -> dict[str, Measured | str]:
    """How far an element is from its place, and how surely."""
    if each.shift_m is None or each.off_m is None or each.turn_rad is None:
        return dict.fromkeys(("shift_mm", "off_mm", "turn_deg"), "not measured")
    radius = 0.0 if model is None else 0.5 * model.diameter_m
    motions = [motion for motion in found.unobservable if not _is_symmetry(motion, model)]
    slides = [motion for motion in motions if motion.kind == "slide"]
    rolls = [motion for motion in motions if motion.kind != "slide"]
    sigma, angle = found.sigma_m, found.sigma_rad
    if sigma is None or angle is None:
        return dict.fromkeys(("shift_mm", "off_mm", "turn_deg"), "nobody knows how uncertain the pose is")
    held_m = _held(each, found, model)
    shift = _open(Measured(hypot(*each.shift_m), sigma), slides, 1.0, held_m)
    turn = _open(Measured(each.turn_rad, angle), rolls, 1.0)
    off = _open(_open(Measured(each.off_m, hypot(sigma, radius * angle)), slides, 1.0, held_m), rolls, radius)
    return {"shift_mm": shift, "off_mm": off, "turn_deg": turn}


def _open(measured: Measured, motions: Sequence[MotionEntry], radius: float, held_m: float = 0.0) -> Measured:
    """A measurement made as uncertain as motions leave it. `radius`: what a motion of 1, rad or m, does to it."""
    if any(motion.sigma is None for motion in motions):
        kind = "slide along itself" if motions[0].kind == "slide" else "turn about itself"
        return Measured(measured.value, inf, f"it may {kind} and the scan would not tell")
    # That of a slide with a sigma is in the pose's covariance already; the larger of the two holds.
    loose = max((radius * (motion.sigma or 0.0) for motion in motions), default=0.0)
    sigma = max(measured.sigma, loose)
    if K * held_m > max(K * sigma, 1e-12):
        why = f"another {length(held_m)}, along a motion that the scan hardly fixes, are not counted"
        return Measured(measured.value, max(sigma, held_m / K), why)
    return Measured(measured.value, sigma, measured.why)


def _held(each: ElementEntry, found: DetectionEntry, model: ModelEntry | None) -> float:
    """How much of its shift an inspection left out because the scan hardly fixes it, metres.

    The centre of a model's symmetry stays where it is under all of them, so which of its like poses was found is one.
    """
    if model is None or model.symmetry is None or each.shift_m is None:
        return 0.0
    centre = np.append(model.symmetry.centre_m, 1.0)
    apart = (np.array(found.scene_from_model) - np.array(each.design_from_model)) @ centre
    left_out = float(np.linalg.norm(apart[:3] - np.array(each.shift_m)))
    return left_out if left_out > 1e-4 else 0.0


def _surface(results: Results, found: DetectionEntry) -> dict[str, Measured | str]:
    """How far its own points lie from its surface, or why that says nothing."""
    keys = ("surface_p95_mm", "surface_mean_mm")
    deviation, within = found.deviation, found.tolerance_m or results.tolerance_m
    if deviation is None or deviation.p95_m is None or deviation.mean_m is None or within is None:
        return dict.fromkeys(keys, "it has no points of its own")
    if found.points < LEAST_POINTS:
        return dict.fromkeys(keys, f"it has only {found.points} points of its own")
    seen = found.visible_support
    if not seen:
        return dict.fromkeys(keys, "without a scanner's position, what is bent away looks like what is hidden")
    if seen < LEAST_THERE:
        why = f"only {seen:.0%} of the surface that was looked at has points within {length(within)}"
        return dict.fromkeys(keys, why)
    return {"surface_p95_mm": _cut(deviation.p95_m, within), "surface_mean_mm": Measured(deviation.mean_m)}


def _cut(p95: float, within: float) -> Measured | str:
    """A percentile of distances that were cut off at `within`: near to that it says nothing."""
    if p95 > 0.9 * within:
        return f"points were cut out only to {length(within)} from it: cut them again with a larger --tolerance"
    return Measured(p95)


def _dimension(each: DimensionEntry) -> Measured | str:
    """How far a dimension is from the drawing, or why nobody knows."""
    if each.built is None or each.sigma is None:
        return each.why or "not measured"
    return Measured(each.built - each.design, each.sigma)


def _part(part: PartEntry, disc: Disc | None) -> dict[str, Measured | str]:
    """How far a part of an assembly is from its place among the others."""
    if part.shift_m is None or part.turn_rad is None or part.off_m is None:
        return {}
    slides = [motion for motion in part.free if motion.kind == "slide"]
    rolls = [motion for motion in part.free if motion.kind != "slide"]
    far, angle = part.shift_sigma_m or 0.0, part.turn_sigma_rad or 0.0
    told: dict[str, Measured | str] = {
        "shift_mm": _open(Measured(hypot(*part.shift_m), far), slides, 1.0),
        "off_mm": _open(Measured(part.off_m, part.off_sigma_m or 0.0), slides, 1.0),
        "turn_deg": _open(Measured(hypot(*part.turn_rad), angle), rolls, 1.0),
    }
    if disc is None:
        return {**told, **dict.fromkeys(("roll_mm", "tilt_mm"), "it has no axis that its shape would tell")}
    about = float(np.dot(part.turn_rad, disc.axis))
    tilt = float(np.linalg.norm(np.array(part.turn_rad) - about * np.array(disc.axis)))
    own = [motion for motion in rolls if abs(np.dot(motion.axis, disc.axis)) > PARALLEL]
    other = [motion for motion in rolls if motion not in own]
    told["roll_mm"] = _open(Measured(about * disc.radius, angle * disc.radius), own, disc.radius)
    told["tilt_mm"] = _open(Measured(2.0 * tilt * disc.radius, 2.0 * angle * disc.radius), other, 2.0 * disc.radius)
    return told


def _is_symmetry(motion: MotionEntry, model: ModelEntry | None) -> bool:
    """Is it a turn after which the model looks the same? That one needs no judging."""
    if model is None or model.symmetry is None or motion.kind == "slide":
        return False
    round_axes = [axis for axis in model.symmetry.axes if axis.order is None]
    return any(abs(np.dot(axis.direction, motion.axis)) > PARALLEL for axis in round_axes)


def _model(results: Results, name: str) -> ModelEntry | None:
    return next((model for model in results.models if model.name == name), None)
