"""Real scans made by others: the pump room's two skids and two pipes, and the milk carton.

python -m benchmarks.real --data ../shared/data
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cyclopts
import numpy as np

import scanfind
from benchmarks.common import ROOT, Floats, PoseError, pose_error, seeds_of, symmetry_of, tell, write_csv
from scanfind.detection import Detection, Refused

PUMP = ROOT / "examples" / "pump"
NAN = float("nan")
# A carton within issue 2's bounds; a skid within what its truth, itself fitted to 46 % of the points, is good for.
MILK_LIMITS, SKID_LIMITS, PIPE_LIMITS = (2.0, 0.5), (10.0, 0.5), (10.0, 1.0)
# Heights of flange faces on the discharge pipes, metres, by pipe: the pipe's own, and others of the same size on it.
PIPE_FACES_M = ((0.138, 1.318), (0.140,))
# The carton's model is a crop of the scene: a scene point this near to one of its points is that point.
SAME_POINT_M = 1e-3


@dataclass(frozen=True)
class Row:
    """A detection, or a refused pose; see README.md for the columns."""

    case: str
    seed: int
    rank: int
    kind: str
    instance: str
    error_mm: float
    error_deg: float
    slide_mm: float
    score: float
    support: float
    visible_support: float
    penalty: float
    rms_mm: float
    points: int
    recall: float
    recall_held: float
    precision: float
    total_s: float
    note: str


@dataclass(frozen=True)
class Judged:
    """What a pose is: the name of the instance it is right for (empty: of none), and how far it is from the nearest."""

    instance: str
    error: PoseError
    slide_mm: float = NAN


class Exact(NamedTuple):
    """An object's points in the scene: all (N, 3), and those (M, 3) of them that its model holds."""

    all: Floats
    held: Floats


Judge = Callable[[scanfind.Pose], Judged]


def main(data: Path = ROOT.parent / "shared" / "data", seeds: str = "0-2", date: str = "") -> None:
    """Search the real scans; a row for each detection and each refused pose, and a summary.

    :param data: folder that holds pump_e57 and milk_kinect.
    :param seeds: of the search, `0-2` or `0,5`.
    :param date: written to the CSV.
    """
    rows: list[Row] = []
    for seed in seeds_of(seeds):
        rows += [*skids(data / "pump_e57", seed), *pipes(data / "pump_e57", seed), *milk(data / "milk_kinect", seed)]
    lines = [line for case in ("skid", "pipe", "milk") for line in summary(case, rows)]
    tell(lines, write_csv("real", rows, seeds, date, lines))


def skids(data: Path, seed: int) -> list[Row]:
    """The first skid as cut from the scan: where it came from, and as the second one."""
    model = scanfind.read_models(PUMP / "skid.ply", origin=(0.0, 0.0, 0.0))[0]
    assert isinstance(model, scanfind.CloudModel)
    derived = json.loads((data / "derived.json").read_text(encoding="utf-8"))
    first_from_second = scanfind.Pose.from_matrix(derived["unit_B_to_unit_A"])
    truths = {"first": scanfind.Pose.identity(), "second": first_from_second.inverse()}
    found = scanfind.find(PUMP / "scan.e57", model, seed=seed)
    return rows_of("skid", seed, found, judge_of(truths, symmetry_of(model), SKID_LIMITS))


def pipes(data: Path, seed: int) -> list[Row]:
    """A parametric flanged pipe at both discharge pipes."""
    derived = json.loads((data / "derived.json").read_text(encoding="utf-8"))
    feet = [np.array(pipe["centre_xy"]) for pipe in derived["vertical_pipes"]]
    found = scanfind.find(PUMP / "scan.e57", PUMP / "flanged_pipe.stl", seed=seed)
    return rows_of("pipe", seed, found, lambda pose: judge_pipe(pose, feet))


def milk(data: Path, seed: int) -> list[Row]:
    """The carton: its pose, and its points against the exact ones."""
    model = scanfind.read_models(data / "milk_model.pcd")[0]
    assert isinstance(model, scanfind.CloudModel)
    known = json.loads((data / "gt.json").read_text(encoding="utf-8"))["refined"][0]["T_model_to_scene"]
    truth = scanfind.Pose.from_matrix(known)
    carton = points_of(data / "milk_segment_in_scene.pcd")
    exact = Exact(carton, held_by(truth.move(model.points), carton))
    found = scanfind.find(data / "scene.pcd", model, seed=seed)
    judge = judge_of({"milk": truth}, symmetry_of(model), MILK_LIMITS)
    return rows_of("milk", seed, found, judge, exact)


def held_by(model: Floats, exact: Floats) -> Floats:
    """Those of `exact` (N, 3) that lie on a point of the placed model (M, 3): a twelfth of the carton's do not."""
    # Blocks of a thousand: all distances at once would take 1.4 GB.
    blocks = [exact[start : start + 1000] for start in range(0, len(exact), 1000)]
    nearest = [((block[:, None] - model[None]) ** 2).sum(axis=2).min(axis=1) for block in blocks]
    near: Floats = exact[np.sqrt(np.concatenate(nearest)) < SAME_POINT_M]
    return near


def judge_of(truths: dict[str, scanfind.Pose], symmetry: scanfind.Symmetry, limits: tuple[float, float]) -> Judge:
    """Right for the nearest true pose where it is within limits (mm, degrees)."""

    def judge(pose: scanfind.Pose) -> Judged:
        errors = {name: pose_error(pose, truth, symmetry) for name, truth in truths.items()}
        name = min(errors, key=lambda one: errors[one].mm)
        return Judged(name if errors[name].within(*limits) else "", errors[name])

    return judge


def judge_pipe(pose: scanfind.Pose, feet: Sequence[Floats]) -> Judged:
    """A pipe may roll and turn end for end: how far its axis is from each pipe's, and its flange from a flange there.

    feet : (2,) where each vertical pipe's axis stands
    """
    along = pose.rotation[:, 2]
    tilt = float(np.degrees(np.arccos(min(1.0, abs(along[2])))))
    middle = pose.move(np.array([[0.0, 0.0, 0.475]]))[0]
    aside = [1e3 * float(np.linalg.norm(middle[:2] - foot)) for foot in feet]
    nearest = int(np.argmin(aside))
    face = float(pose.translation[2])
    slide = min((1e3 * (face - at) for at in PIPE_FACES_M[nearest]), key=abs)
    error = PoseError(aside[nearest], tilt)
    return Judged(("first", "second")[nearest] if error.within(*PIPE_LIMITS) else "", error, slide)


def rows_of(case: str, seed: int, found: scanfind.Findings, judge: Judge, exact: Exact | None = None) -> list[Row]:
    """A row a detection, then a row a refused pose."""
    rows = [
        row_of(case, seed, rank, "found", one, judge, found, "".join(m.kind + " " for m in one.unobservable), exact)
        for rank, one in enumerate(found, 1)
    ]
    rows += [row_of(case, seed, k, "refused", one, judge, found, one.reason) for k, one in enumerate(found.refused, 1)]
    return rows


def row_of(
    case: str, seed: int, rank: int, kind: str, one: Detection | Refused, judge: Judge, found: scanfind.Findings,
    note: str, exact: Exact | None = None,
) -> Row:  # fmt: skip
    """What was found against what is there."""
    judged = judge(one.scene_from_model)
    cut = one.isolated if isinstance(one, Detection) else None
    recall, recall_held, precision = (NAN, NAN, NAN) if cut is None or exact is None else rates(cut.xyz, exact)
    return Row(
        case=case,
        seed=seed,
        rank=rank,
        kind=kind,
        instance=judged.instance,
        error_mm=judged.error.mm,
        error_deg=judged.error.deg,
        slide_mm=judged.slide_mm,
        score=one.score,
        support=one.support,
        visible_support=one.visible_support,
        penalty=one.penalty,
        rms_mm=1e3 * one.rms_m if isinstance(one, Detection) else NAN,
        points=0 if cut is None else len(cut),
        recall=recall,
        recall_held=recall_held,
        precision=precision,
        total_s=found.timings_s["total"],
        note=note.strip(),
    )


def rates(isolated: Floats, exact: Exact) -> tuple[float, float, float]:
    """Recall, recall of what the model holds, and precision; points are the same where their coordinates are."""
    ours, every, held = ({point.tobytes() for point in points.astype(np.float32)} for points in (isolated, *exact))
    return len(ours & every) / len(every), len(ours & held) / len(held), len(ours & every) / len(ours)


def points_of(path: Path) -> Floats:
    """All points of a scan file, (N, 3)."""
    return np.concatenate([chunk.xyz for chunk in scanfind.read_scan(path)])


def summary(case: str, rows: Sequence[Row]) -> list[str]:
    """How often each instance was found, how well, and how much was found that is not there or there twice."""
    mine = [row for row in rows if row.case == case and row.kind == "found"]
    seeds = sorted({row.seed for row in rows if row.case == case})
    lines = []
    for name in sorted({row.instance for row in mine if row.instance}):
        best = [min((r for r in mine if r.seed == s and r.instance == name), key=lambda r: r.error_mm, default=None)
                for s in seeds]  # fmt: skip
        hits = [row for row in best if row is not None]
        worst_mm, worst_deg = max(row.error_mm for row in hits), max(row.error_deg for row in hits)
        lines.append(f"{case} {name}: {len(hits)} of {len(seeds)} seeds, within {worst_mm:.2f} mm, {worst_deg:.3f} deg")
        if case == "milk":
            one = hits[0]
            lines.append(
                f"milk: recall {one.recall:.4f}, of the points its model holds {one.recall_held:.4f}; "
                f"precision {one.precision:.4f}"
            )
    right = {(row.seed, row.instance) for row in mine if row.instance}
    lines.append(f"{case}: {len(mine) - len(right)} other detections")
    return lines


if __name__ == "__main__":
    cyclopts.run(main)
