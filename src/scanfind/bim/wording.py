"""Which elements somebody has to look at, and what a BIM tool shows of them."""

from __future__ import annotations

from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scanfind.design.elements import FAR_M, INSTALLED, OUT_OF_TOLERANCE
from scanfind.errors import UsageError
from scanfind.library import ModelLibrary
from scanfind.pose import Pose
from scanfind.results import MODELS, read_results
from scanfind.results.document import rows
from scanfind.results.explain import element_sentences, headline
from scanfind.tolerances import judge_results, load_profile

if TYPE_CHECKING:
    from scanfind.results.schema import ElementEntry, Results


def inspected(result_dir: str | Path, tolerance: str | Path | None = None) -> Results:
    """The result of an inspection, in the axes of the design.

    tolerance : a profile, see `load_profile`; None: the verdicts are those of the inspection

    Raises UnreadableFileError for no result, UsageError where it is of no design or for no profile.
    """
    results = read_results(result_dir)
    if not results.elements:
        msg = f"{result_dir}: a result without a design: name one of `scanfind inspect --out`"
        raise UsageError(msg)
    if tolerance is not None:
        with ModelLibrary.open(Path(result_dir) / MODELS) as models:
            results = judge_results(results, load_profile(tolerance), models)
    return in_design(results)


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
    """Does somebody have to look at it? Not where it is installed, in no other place, and not out of tolerance."""
    elsewhere = element.off_m is not None and element.off_m > FAR_M
    return element.status != INSTALLED or elsewhere or element.verdict == OUT_OF_TOLERANCE


def title(element: ElementEntry) -> str:
    """One line: which element, and what is the matter with it."""
    return f"{element.name or element.model}: {headline(element)}"


def description(results: Results, element: ElementEntry) -> str:
    """Some lines: the evidence, how far off in which direction, what is allowed, of which scans."""
    lines = [*element_sentences(results, element)]
    if element.shift_m is not None:
        x, y, z = (1e3 * value for value in element.shift_m)
        turn = degrees(element.turn_rad or 0.0)
        lines.append(f"Shift of its middle: x {x:+z.1f}, y {y:+z.1f}, z {z:+z.1f} mm; turned by {turn:.2f}°.")
    if why := element.verdict_why:
        lines.append(f"{why[:1].upper()}{why[1:]}.")
    lines.append(f"Scans: {scans_in_words(results)}; inspected {results.made or 'at an unknown time'}.")
    return "\n".join(lines)


def scans_in_words(results: Results) -> str:
    """The names of the scan files, without their folders."""
    return ", ".join(scan.path.replace("\\", "/").rpartition("/")[2] for scan in results.scans) or "unknown"
