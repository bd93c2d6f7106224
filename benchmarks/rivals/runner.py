"""A rival in a child process of its own environment: it may crash or hang, the benchmark goes on."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.answer import TIME_LIMIT, Answer, read_answer
from benchmarks.rivals.table import ENVIRONMENTS, RIVALS, ROOT
from scanfind.cloud import as_points
from scanfind.errors import InvalidGeometryError, UsageError
from scanfind.library.surface import ModelSurface, SurfaceParameters, sample_mesh
from scanfind.mesh import Mesh

Floats = NDArray[np.float64]

# Rivals are given the model's surface as scanfind sees it, without the bores nobody sees; 10 samples a voxel.
VOXEL_SHARE, SAMPLES = 0.02, 12_000
# Interpreter, libraries, files and training on the model are not the search; OpenCV trains for half a minute.
START_LIMIT_S = 180.0


def run(
    name: str, points: Floats, origins: Floats | None, station: NDArray[np.int64] | None, mesh: Mesh,
    time_limit_s: float = 60.0, seed: int = 0,
) -> Answer:  # fmt: skip
    """Ask a rival where a model is.

    points : (N, 3) scene, metres; origins : (S, 3) where scanners stood, None where nobody knows
    station : (N,) which of them saw each point; None: all the first
    time_limit_s : of the search, plane removal and refinement included
    Raises UsageError for an unknown name or one not installed; whatever the rival itself does wrong is in the Answer.
    """
    if name not in RIVALS:
        msg = f"no rival is called {name!r}; there are {', '.join(RIVALS)}"
        raise UsageError(msg)
    rival = RIVALS[name]
    environment = ENVIRONMENTS[rival.environment]
    if not environment.is_current():
        msg = f"{rival.title} is not installed, or not as it is now; run `{rival.install}`"
        raise UsageError(msg)
    points = as_points(points)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        surface = sample_mesh(mesh, SurfaceParameters(samples=SAMPLES))
        write_problem(
            folder / "problem.npz", points, viewpoints(points, origins, station), origins is not None, surface, seed
        )
        command: list[str | Path] = [
            environment.python,
            "-m",
            "benchmarks.rivals.inside.child",
            rival.train,
            str(rival.tries),
            folder,
        ]
        variables = {"SCANFIND_RIVALS_PCL": str(environment.folder / "build"), "TMPDIR": scratch}
        return ask(command, folder, time_limit_s, variables)


def viewpoints(points: Floats, origins: Floats | None, station: NDArray[np.int64] | None) -> Floats:
    """From where each point was seen, (N, 3); where nobody knows, the middle: a side at least that all agree on."""
    if origins is None:
        return np.broadcast_to(points.mean(axis=0), points.shape)
    seen_from = as_points(origins, "origins")
    stations = np.zeros(len(points), dtype=np.int64) if station is None else station
    if len(stations) != len(points) or stations.min(initial=0) < 0 or stations.max(initial=0) >= len(seen_from):
        msg = f"station must name one of {len(seen_from)} origins for each of {len(points)} points"
        raise InvalidGeometryError(msg)
    return seen_from[stations]


def write_problem(
    path: Path, points: Floats, seen_from: Floats, signed: bool, surface: ModelSurface, seed: int
) -> None:
    """What the child reads."""
    np.savez(
        path, points=points, viewpoints=seen_from, signed=signed, seed=seed, diameter=surface.diameter,
        voxel=VOXEL_SHARE * surface.diameter,
        model_points=surface.samples.points, model_normals=surface.samples.normals,
    )  # fmt: skip


def ask(command: Sequence[str | Path], folder: Path, time_limit_s: float, variables: dict[str, str]) -> Answer:
    """Run a child that says "ready" on stdout, searches, and leaves answer.json in `folder`.

    The limit counts from "ready". At the limit all of its process group is killed.
    """
    environment = {**os.environ, **variables, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])}
    log = folder / "log.txt"
    with log.open("wb") as errors, subprocess.Popen(
        command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors,
        start_new_session=True,
    ) as child:  # fmt: skip
        try:
            assert child.stdout is not None
            if not select.select([child.stdout], [], [], START_LIMIT_S)[0]:
                return Answer(error=f"not ready after {START_LIMIT_S:.0f} s")
            child.wait(time_limit_s)
        except subprocess.TimeoutExpired:
            return Answer(error=TIME_LIMIT)
        finally:
            # Programs it started may outlive it.
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
    if child.returncode != 0 or not (folder / "answer.json").exists():
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["no word"]
        return Answer(error=f"exit code {child.returncode}: {said[-1]}")
    return read_answer(folder / "answer.json")
