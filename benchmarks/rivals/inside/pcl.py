"""PCL's recognisers, each a small program of ours (../pcl) that is asked over a pipe."""

from __future__ import annotations

import os
import subprocess
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.rivals.inside.matcher import Matcher, Model
from scanfind.cloud import OrientedCloud
from scanfind.pose import Pose


def train(program: str, model: Model) -> Matcher:
    """Start a program on a model; it has trained when it says so."""
    folder = Path(tempfile.mkdtemp())  # in the runner's own folder, which goes with the run
    path = Path(os.environ["SCANFIND_RIVALS_PCL"]) / program
    asked = subprocess.Popen(
        [path, _write(folder / "model.bin", model.cloud), str(model.voxel), str(model.diameter)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert asked.stdin is not None
    assert asked.stdout is not None
    to, answers = asked.stdin, asked.stdout

    def line() -> str:
        if said := answers.readline():
            return said
        msg = f"{program} ended with exit code {asked.wait()}"
        raise RuntimeError(msg)

    def match(scene: OrientedCloud, seed: int) -> list[Pose]:
        to.write(f"{_write(folder / 'scene.bin', scene)} {seed + 1}\n")
        to.flush()
        rows = [np.array(line().split(), dtype=np.float64) for _ in range(int(line()))]
        return [Pose.from_matrix(np.vstack([row.reshape(3, 4), [0, 0, 0, 1]])) for row in rows]

    line()
    return match


train_objrecransac = partial(train, "objrecransac")
train_ppf = partial(train, "ppf")
train_prerejective = partial(train, "prerejective")


def _write(path: Path, cloud: OrientedCloud) -> str:
    """Rows of six float32: position, normal."""
    path.write_bytes(np.hstack([cloud.points, cloud.normals]).astype(np.float32).tobytes())
    return str(path)
