"""How long one waits before anything happens: compilation at the first run, later starts, --help, import.

python -m benchmarks.startup
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cyclopts
import numpy as np

from benchmarks.common import median, tell, write_csv
from scanfind.simulate.objects import pipe_spool
from scanfind.simulate.scanner import scan
from scanfind.simulate.scenes import shop

# Issue 2's limits, seconds; importing has none.
LIMITS = {"compile": 25.0, "later_start": 2.0, "help": 0.3, "import": float("inf")}

# A process of its own: what it imports and compiles, nobody has before it.
CHILD = """
import json, sys, time
began = time.perf_counter()
import numpy, scanfind
data = numpy.load(sys.argv[1])
cloud = scanfind.PointCloud(data["xyz"], {}, data["origin"])
mesh = scanfind.Mesh.of("pipe_spool", data["vertices"], data["faces"])
start = time.perf_counter()
seconds = []
for _ in range(2):
    at = time.perf_counter()
    scanfind.find(cloud, mesh)
    seconds.append(time.perf_counter() - at)
print(json.dumps({"overhead": start - began + seconds[0] - seconds[1]}))
"""


@dataclass(frozen=True)
class Row:
    """One measurement; see README.md for the columns."""

    what: str
    median_s: float
    least_s: float
    most_s: float
    runs: int
    limit_s: float


def main(points: float = 50e3, runs: int = 5, date: str = "") -> None:
    """Measure starts in fresh processes.

    :param points: of the small scene that is searched.
    :param runs: of each measurement; the first run of all, which compiles everything, is measured once.
    :param date: written to the CSV.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene = small_scene(Path(folder) / "scene.npz", int(points))
        fresh = {**os.environ, "NUMBA_CACHE_DIR": str(Path(folder) / "numba")}
        rows = [row_of("compile", [overhead(scene, fresh)])]
        rows.append(row_of("later_start", [overhead(scene, fresh) for _ in range(runs)]))
    rows.append(row_of("help", [seconds_of(["-m", "scanfind", "--help"]) for _ in range(runs)]))
    bare = median([seconds_of(["-c", ""]) for _ in range(runs)])
    rows.append(row_of("import", [seconds_of(["-c", "import scanfind"]) - bare for _ in range(runs)]))
    lines = [
        f"{row.what}: {row.median_s:.3f} s (limit {row.limit_s}, "
        f"{'held' if row.median_s <= row.limit_s else 'NOT held'})"
        for row in rows
    ]
    tell(lines, write_csv("startup", rows, "1000", date, lines))


def small_scene(path: Path, points: int) -> Path:
    """One station's scan of a shop, and its pipe spool, as an .npz file."""
    mesh = pipe_spool()
    cloud = scan(shop(1000, mesh), seed=1000, points=3 * points).stations[0]
    origin = np.zeros(3) if cloud.origin is None else cloud.origin
    np.savez(path, xyz=cloud.xyz, origin=origin, vertices=mesh.vertices, faces=mesh.faces)
    return path


def overhead(scene: Path, environment: dict[str, str]) -> float:
    """Seconds a fresh process spends on import and on the first find beyond what a second one takes."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(scene)], env=environment, capture_output=True, text=True, check=True
    )
    return float(json.loads(done.stdout)["overhead"])


def seconds_of(arguments: list[str]) -> float:
    """Seconds from start to end of a Python process."""
    began = time.perf_counter()
    subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


def row_of(what: str, seconds: list[float]) -> Row:
    """Median and range."""
    return Row(what, median(seconds), min(seconds), max(seconds), len(seconds), LIMITS[what])


if __name__ == "__main__":
    cyclopts.run(main)
