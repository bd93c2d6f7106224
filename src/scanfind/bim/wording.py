"""Which elements somebody has to look at, and what a BIM tool shows of them."""

from __future__ import annotations

from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scanfind.design.elements import INSTALLED, OUT_OF_TOLERANCE
from scanfind.errors import UsageError
from scanfind.pose import Pose
from scanfind.results import MODELS, read_results
from scanfind.results.document import rows
from scanfind.results.explain import element_sentences, headline

if TYPE_CHECKING:
    from scanfind.results.schema import ElementEntry, Results


def inspected(result_dir: str | Path, tolerance: str | Path | None = None) -> tuple[Results, dict[int, str]]:
    """The result of an inspection, in the axes of the design; by place among the elements why a profile judges them so.

    tolerance : a profile, see `load_profile`; None: the verdicts are those of the inspection

    Raises UnreadableFileError for no result, UsageError where it is of no design or for no profile.
    """
    results, why = read_results(result_dir), dict[int, str]()
    if not results.elements:
        msg = f"{result_dir}: a result without a design: name one of `scanfind inspect --out`"
        raise UsageError(msg)
    if tolerance is not None:
        results, why = _judged(results, Path(result_dir), tolerance)
    return in_design(results), why


def in_design(results: Results) -> Results:
    """A result in the axes of the design, where it was found that the scans have others."""
    if results.alignment is None:
        return results
    design_from_scene = Pose.from_matrix(results.alignment.scene_from_design).inverse()
    scene_from_design = design_from_scene.inverse()
    elements = []
    for element in results.elements:
        changed: dict[str, object] = {
            "design_from_model": rows(design_from_scene @ Pose.from_matrix(element.design_from_model))
        }
        if element.shift_m is not None:
            changed["shift_m"] = tuple(design_from_scene.turn(np.array([element.shift_m]))[0].tolist())
        if element.built_from_design is not None:
            motion = Pose.from_matrix(element.built_from_design)
            changed["built_from_design"] = rows(design_from_scene @ motion @ scene_from_design)
        elements.append(element.model_copy(update=changed))
    detections = [
        found.model_copy(
            update={"scene_from_model": rows(design_from_scene @ Pose.from_matrix(found.scene_from_model))}
        )
        for found in results.detections
    ]
    return results.model_copy(update={"elements": elements, "detections": detections})


def is_finding(element: ElementEntry) -> bool:
    """Does somebody have to look at it? Not where it is installed and nobody says it is out of tolerance."""
    return element.status != INSTALLED or element.verdict == OUT_OF_TOLERANCE


def title(element: ElementEntry) -> str:
    """One line: which element, and what is the matter with it."""
    return f"{element.name or element.model}: {headline(element)}"


def description(results: Results, element: ElementEntry, judgement: str) -> str:
    """Some lines: the evidence, how far off in which direction, what is allowed, of which scans.

    judgement : of a tolerance profile
    """
    lines = [*element_sentences(results, element)]
    if element.shift_m is not None:
        x, y, z = (1e3 * value for value in element.shift_m)
        turn = degrees(element.turn_rad or 0.0)
        lines.append(f"Shift of its middle: x {x:+z.1f}, y {y:+z.1f}, z {z:+z.1f} mm; turned by {turn:.2f}°.")
    if judgement:
        lines.append(f"{judgement[:1].upper()}{judgement[1:]}.")
    elif results.allowed_m is not None and element.verdict is not None:
        lines.append(f"Allowed: {1e3 * results.allowed_m:g} mm.")
    lines.append(f"Scans: {scans_in_words(results)}; inspected {results.made or 'at an unknown time'}.")
    return "\n".join(lines)


def scans_in_words(results: Results) -> str:
    """The names of the scan files, without their folders."""
    return ", ".join(scan.path.replace("\\", "/").rpartition("/")[2] for scan in results.scans) or "unknown"


def _judged(results: Results, folder: Path, tolerance: str | Path) -> tuple[Results, dict[int, str]]:
    from scanfind.library import ModelLibrary
    from scanfind.tolerances import judge_element, load_profile
    from scanfind.tolerances.discs import discs_of

    profile = load_profile(tolerance)
    with ModelLibrary.open(folder / MODELS) as library:
        discs = {key: disc for model in library.models() for key, disc in discs_of(model).items()}
    judgements = [judge_element(profile, results, element, discs) for element in results.elements]
    elements = [
        element.model_copy(update={"verdict": judgement.verdict if element.status == INSTALLED else None})
        for element, judgement in zip(results.elements, judgements, strict=True)
    ]
    why = {place: judgement.why for place, judgement in enumerate(judgements) if elements[place].verdict is not None}
    return results.model_copy(update={"elements": elements, "allowed_m": None}), why
