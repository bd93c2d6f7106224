"""python -m benchmarks.rivals.inside.child MODULE:FUNCTION TRIES FOLDER

Reads problem.npz in FOLDER, trains, says "ready" on stdout, searches, and writes answer.json there.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.rivals.answer import Answer, write_answer
from benchmarks.rivals.inside.finish import finish
from benchmarks.rivals.inside.matcher import Model, trainer
from benchmarks.rivals.inside.prepare import prepare_model, prepare_scene
from scanfind.cloud import OrientedCloud

JUDGED = 3000


def main(where: str, tries: int, folder: Path) -> None:
    """One scene, one model."""
    problem = np.load(folder / "problem.npz")
    voxel, seed = float(problem["voxel"]), int(problem["seed"])
    samples = OrientedCloud(problem["model_points"], problem["model_normals"])
    start = perf_counter()
    matcher = trainer(where)(Model(prepare_model(samples, voxel), voxel, float(problem["diameter"])))
    trained = perf_counter()

    print("ready", flush=True)
    os.dup2(2, 1)  # What libraries print from here on goes to the log.
    begin = perf_counter()
    scene = prepare_scene(problem["points"], problem["viewpoints"], bool(problem["signed"]), voxel, seed)
    prepared = perf_counter()
    proposals = [pose for attempt in range(tries) for pose in matcher(scene.coarse, seed + attempt)]
    matched = perf_counter()
    # Every prefix of the samples is itself evenly spread.
    judged = OrientedCloud(samples.points[:JUDGED], samples.normals[:JUDGED])
    best = finish(proposals, judged, scene, voxel)
    refined = perf_counter()

    seconds = {
        "train": trained - start, "planes": prepared - begin, "match": matched - prepared,
        "refine": refined - matched, "total": refined - begin,
    }  # fmt: skip
    write_answer(Answer([pose for _, pose in best], [score for score, _ in best], seconds), folder / "answer.json")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
