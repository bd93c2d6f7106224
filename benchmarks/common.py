"""What every benchmark shares: seeds, how far a pose is off, and CSV files that say where they come from."""

from __future__ import annotations

import csv
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import scanfind
from scanfind.cloud import CloudModel
from scanfind.library.cloud_surface import sample_cloud
from scanfind.library.onto_itself import OntoItself
from scanfind.library.surface import SurfaceParameters, sample_mesh
from scanfind.library.symmetries import find_symmetry
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.symmetry import Symmetry
from scanfind.threads import available_cores

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Floats = NDArray[np.float64]

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
STAGES = ("grid", "search", "refine", "verify", "isolate")


@dataclass(frozen=True)
class PoseError:
    """How far a pose is from the truth: of its symmetry's centre in millimetres, of its rotation in degrees."""

    mm: float
    deg: float

    def within(self, mm: float, deg: float) -> bool:
        return self.mm <= mm and self.deg <= deg


def pose_error(found: Pose, truth: Pose, symmetry: Symmetry) -> PoseError:
    """`scanfind.pose_error` in millimetres, at the symmetry's centre, and degrees."""
    error = scanfind.pose_error(found, truth, symmetry)
    return PoseError(1e3 * error.translation_m, float(np.degrees(error.rotation_rad)))


@lru_cache(maxsize=8)
def symmetry_of(model: Mesh | CloudModel) -> Symmetry:
    """The rotations that do not count as errors of a model's pose; where there are none, about the middle of its box.

    An origin far from the model would turn degrees into millimetres.
    """
    if isinstance(model, Mesh):
        itself = OntoItself(sample_mesh(model, SurfaceParameters()), model)
    else:
        itself = OntoItself(sample_cloud(model, SurfaceParameters()), None)
    found = find_symmetry(itself)
    points = model.vertices if isinstance(model, Mesh) else model.points
    return found if found.axes else Symmetry(centre_of(points))


def centre_of(points: Floats) -> Floats:
    """Middle (3,) of the box around points (N, 3)."""
    middle: Floats = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return middle


def seeds_of(text: str) -> list[int]:
    """`3`, `1000-1019` or `1,5,9` as numbers."""
    first, dash, last = text.partition("-")
    return list(range(int(first), int(last) + 1)) if dash else [int(seed) for seed in text.split(",")]


def median(values: Sequence[float]) -> float:
    """NaN where there is none."""
    return float(np.median(values)) if values else float("nan")


def origin_lines(seeds: str, date: str) -> list[str]:
    """On which machine, with what, from which commit."""
    versions = " ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "scanfind"))
    return [
        f"machine: {cpu_model()}, {available_cores()} cores",
        f"versions: python {platform.python_version()} {versions}",
        f"commit: {commit()}",
        f"seeds: {seeds or 'none'}",
        f"date: {date or 'none'}",
    ]


def write_csv(name: str, rows: Sequence[DataclassInstance], seeds: str, date: str, summary: Sequence[str] = ()) -> Path:
    """Rows, all of one dataclass, as results/<name>.csv below comment lines of their origin and summary; its path."""
    return write_rows(RESULTS / f"{name}.csv", rows, [*origin_lines(seeds, date), *summary])


def write_rows(path: Path, rows: Sequence[DataclassInstance], comments: Sequence[str]) -> Path:
    """Rows, all of one dataclass, as CSV below comment lines; all of it or, when interrupted, what was there before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("w", newline="", encoding="utf-8") as file:
        file.writelines(f"# {line}\n" for line in comments)
        writer = csv.DictWriter(file, [field.name for field in fields(rows[0])], lineterminator="\n")
        writer.writeheader()
        writer.writerows({column: _short(value) for column, value in asdict(row).items()} for row in rows)
    return part.replace(path)


def tell(lines: Sequence[str], path: Path) -> None:
    """Print a summary and where its rows lie."""
    print(*lines, f"rows: {path.relative_to(ROOT)}", sep="\n")


def cpu_model() -> str:
    """As the kernel calls it; where it does not say, as Python does."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def commit() -> str:
    """The git commit, with "+" where files differ from it; "unknown" outside a clone.

    What benchmarks write does not count: a run that goes on is still of the commit it began with.
    """
    changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!benchmarks/results", ":!docs")
    return git("rev-parse", "--short", "HEAD") + ("+" if changed else "") or "unknown"


def git(*arguments: str) -> str:
    """What git says of this clone; empty where there is none."""
    told = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    return told.stdout.strip()


def _short(value: object) -> object:
    """Numbers as a person reads them."""
    return f"{value:.4g}" if isinstance(value, float) else value
