"""A site of many setups: time and memory as points grow, against what the file library needs to read them twice.

python -m benchmarks.scale --shops 1,4 --kind e57 --memory 3GB --folder /tmp/site
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cyclopts
import numpy as np

from benchmarks.common import Floats, tell, write_csv
from scanfind.cloud import CHUNK_POINTS
from scanfind.pose import Pose
from scanfind.scans import CloudWriter, open_stations, open_writer
from scanfind.scans.e57_writer import StationsWriter
from scanfind.simulate.objects import pipe_spool
from scanfind.simulate.scanner import scan
from scanfind.simulate.scenes import shop
from scanfind.tiles import find_in_tiles
from scanfind.tiles.plan import size_of
from scanfind.tiles.workers import cluster, processes

# Different shops, of which a site has copies side by side in rows of six; each is one file of three setups.
SEEDS = (1000, 1001)
APART_M, IN_A_ROW = 13.0, 6
FOUND_M = 0.010
KEPT = ("intensity", "row", "column")


@dataclass(frozen=True)
class Row:
    """One site, searched once; see README.md for the columns."""

    kind: str
    shops: int
    points: int
    workers: int
    dask: int
    memory_mb: float
    peak_memory_mb: float
    tiles: int
    again: int
    stored_mb: float
    read_s: float
    search_s: float
    isolate_s: float
    find_s: float
    library_twice_s: float
    ratio: float
    ns_a_point: float
    found: int
    false: int


def main(
    shops: str = "1,4", points: float = 10e6, kind: str = "e57", workers: str = "0", memory: str = "3GB",
    folder: Path | None = None, date: str = "", *, library: bool = True, dask: bool = False, each: bool = False,
) -> None:  # fmt: skip
    """Make a site, search parts of it of several sizes in tiles, each in a process of its own.

    :param shops: how many shops each size has.
    :param points: of a shop.
    :param kind: e57 or laz; laz knows no scanner positions.
    :param workers: how many processes each size is searched with; 0: in one, with a thread a core.
    :param memory: of all workers together.
    :param folder: where the site lies or is made; a temporary one unless given.
    :param date: written to the CSV.
    :param dask: workers are those of a local dask cluster.
    :param each: the memory is of each worker, so that any number of them searches the same tiles.
    :param library: also read each size twice with the file library alone.
    """
    rows = []
    with TemporaryDirectory() as temporary:
        where = folder or Path(temporary)
        counts = [int(count) for count in shops.split(",")]
        truth = make_site(where, max(counts), int(points), kind)
        for count in counts:
            files = [file_of(where, k, kind) for k in range(count)]
            alone_s = 2.0 * timed_read(files) if library else float("nan")
            for crew in workers.split(","):
                of_all = f"{size_of(memory) * (max(int(crew), 1) if each else 1)}"
                rows.append(row := measured(files, kind, int(crew), of_all, truth[:count], alone_s, dask))
                print(row, flush=True)
    lines = summary(rows)
    tell(lines, write_csv(f"scale_{kind}", rows, ",".join(map(str, SEEDS)), date, lines))


def file_of(folder: Path, k: int, kind: str) -> Path:
    """Where the k-th shop's setups lie."""
    return folder / f"shop{k:03d}.{kind}"


def make_site(folder: Path, shops: int, points: int, kind: str) -> Floats:
    """Write shops side by side where they are not there yet; where the middle of the spool in each is, (shops, 3)."""
    mesh = pipe_spool()
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    truth = np.empty((shops, 3))
    folder.mkdir(parents=True, exist_ok=True)
    for at, seed in enumerate(SEEDS):
        scanned = None
        for k in range(at, shops, len(SEEDS)):
            shift = APART_M * np.array([k % IN_A_ROW, k // IN_A_ROW, 0.0])
            scene = shop(seed, mesh)
            (pose,) = scene.truth()[mesh.name]
            truth[k] = pose.move(middle[None])[0] + shift
            if file_of(folder, k, kind).exists():
                continue
            scanned = scanned or scan(scene, seed=seed, points=points)
            fields = {name: scanned.stations[0].attributes[name].dtype for name in KEPT}
            with opened(file_of(folder, k, kind), fields) as writer:
                for number, cloud in enumerate(scanned.stations):
                    if isinstance(writer, StationsWriter):
                        assert cloud.origin is not None
                        raster = (int(cloud.attributes["row"].max()) + 1, int(cloud.attributes["column"].max()) + 1)
                        writer.station(f"shop {k} setup {number}", Pose(np.eye(3), cloud.origin + shift), raster)
                    for first in range(0, len(cloud), CHUNK_POINTS):
                        some = slice(first, first + CHUNK_POINTS)
                        writer.write(cloud.xyz[some] + shift, {name: cloud.attributes[name][some] for name in KEPT})
    return truth


def opened(file: Path, fields: Mapping[str, np.dtype[Any]]) -> CloudWriter:
    """A file to write to, which keeps where its setups stood if it can."""
    return open_stations(file, fields) if file.suffix == ".e57" else open_writer(file, fields)


def timed_read(files: list[Path]) -> float:
    """Seconds the file library alone takes to read all points once, in chunks, with all fields."""
    began = time.perf_counter()
    for file in files:
        if file.suffix == ".laz":
            import laspy

            with laspy.open(file) as reader:
                for chunk in reader.chunk_iterator(CHUNK_POINTS):
                    _ = chunk.xyz
        else:
            read_e57(file)
    return time.perf_counter() - began


def read_e57(file: Path) -> None:
    """With pye57's own buffers, in chunks: its read_scan takes a whole setup at once."""
    import pye57
    from pye57 import libe57

    with pye57.E57(str(file)) as e57:
        for k in range(e57.scan_count):
            header = e57.get_header(k)
            buffers = libe57.VectorSourceDestBuffer()
            # Kept: the buffers do not hold on to the arrays they fill.
            columns = [np.empty(CHUNK_POINTS, np.float64) for _ in header.point_fields]
            for name, column in zip(header.point_fields, columns, strict=True):
                buffers.append(libe57.SourceDestBuffer(e57.image_file, name, column, CHUNK_POINTS, True, True))
            reader = header.points.reader(buffers)
            while reader.read():
                pass
            reader.close()


def measured(files: list[Path], kind: str, workers: int, memory: str, truth: Floats, alone_s: float, dask: bool) -> Row:
    """Search in a process of its own, whose memory is nobody else's."""
    call = [sys.executable, "-m", "benchmarks.scale", "child", str(workers), memory, str(int(dask)), *map(str, files)]
    told = json.loads(subprocess.run(call, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
    places = np.array(told.pop("places")).reshape(-1, 3)
    apart = np.linalg.norm(places[:, None] - truth[None], axis=2)
    right = int((apart.min(axis=0, initial=np.inf) < FOUND_M).sum())
    return Row(
        kind=kind, shops=len(files), workers=workers, dask=int(dask), memory_mb=size_of(memory) / 1e6,
        library_twice_s=alone_s, ratio=told["find_s"] / alone_s, ns_a_point=1e9 * told["find_s"] / told["points"],
        found=right, false=len(places) - right, **told,
    )  # fmt: skip


def child(workers: int, memory: str, files: list[Path], *, dask: bool) -> None:
    """Search and print what it took as JSON."""
    mesh = pipe_spool()
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    began: dict[str, float] = {}
    with ExitStack() as stack:
        work = stack.enter_context(TemporaryDirectory(dir=files[0].parent))
        executor = processes(workers) if workers else None
        if dask:
            from distributed import LocalCluster

            local = stack.enter_context(LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0"))
            executor = cluster(local.scheduler_address)
        start = time.perf_counter()
        found = find_in_tiles(
            files, mesh, executor=executor,
            memory=size_of(memory) // max(workers, 1), work=work, jobs=1 if workers else None,
            progress=lambda stage, done, total: began.__setitem__(stage, time.perf_counter() - start),
            say=lambda line: print(line, file=sys.stderr, flush=True),
        )  # fmt: skip
        took = time.perf_counter() - start
        tiles, again = (sum(1 for _ in Path(work).glob(f"{name}-*")) for name in ("search", "again"))
        stored = sum(path.stat().st_size for path in Path(work).glob("scan-*/**/*") if path.is_file())
    # Each stage's last word is its end.
    ends = [began.get(stage, 0.0) for stage in ("read", "search", "isolate")]
    read_s, search_s, isolate_s = ends[0], *(max(0.0, later - earlier) for earlier, later in pairwise(ends))
    own, theirs = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(
        json.dumps({
            "points": sum(each.points for each in found.scans), "tiles": tiles, "again": again,
            "stored_mb": stored / 1e6,
            # Of workers the largest counts for each: they do the same.
            "peak_memory_mb": (own + workers * theirs) / 1024, "read_s": read_s, "search_s": search_s,
            "isolate_s": isolate_s, "find_s": took,
            "places": [one.scene_from_model.move(middle[None])[0].tolist() for one in found],
        })
    )  # fmt: skip


def summary(rows: list[Row]) -> list[str]:
    """Each size in a line, and how much faster more workers were than one."""
    one = {row.shops: row.find_s for row in rows if row.workers == 1}
    return [
        f"{row.points / 1e6:.0f} M points, {row.workers or 'no'} workers: {row.found} of {row.shops} found, "
        f"{row.false} false; {row.find_s:.0f} s, {row.ns_a_point:.0f} ns a point, {row.ratio:.2f} x reading twice; "
        f"peak {row.peak_memory_mb:.0f} of {row.memory_mb:.0f} MB; {row.tiles} tiles, {row.again} again"
        + (f"; {one[row.shops] / row.find_s:.2f} x as fast as one" if row.workers > 1 and row.shops in one else "")
        for row in rows
    ]


if __name__ == "__main__":
    if sys.argv[1:2] == ["child"]:
        child(int(sys.argv[2]), sys.argv[3], [Path(file) for file in sys.argv[5:]], dask=sys.argv[4] == "1")
    else:
        cyclopts.run(main)
