"""What may happen in the middle of a long run, done for real: processes killed, disks full, Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanfind.cli import main
from scanfind.cloud import PointCloud
from scanfind.errors import OutputError, UsageError
from scanfind.pose import Pose
from scanfind.scans import open_stations, scan_info
from scanfind.tiles.plan import size_of
from scanfind.tiles.workers import cluster, processes
from test_find import QUICK, library
from test_tiles import assert_same, corridor, in_tiles, narrow, serial

__all__ = ["narrow"]
DEADLINE_S = 120.0
LONG = 8  # rooms of a corridor that is 1.2 GB in one piece


class Enough(Exception):  # noqa: N818
    """An end of a run that nobody foresaw."""


def until(holds: Callable[[], bool]) -> None:
    ends = time.monotonic() + DEADLINE_S
    while not holds():
        assert time.monotonic() < ends
        time.sleep(0.02)


def kill_once_searching(work: Path, victim: Callable[[], int]) -> None:
    until(lambda: any(work.glob("search-*")))
    os.kill(victim(), signal.SIGKILL)


@pytest.mark.slow
def test_two_processes_do_the_same_and_one_of_them_killed_changes_nothing(tmp_path: Path, narrow: int) -> None:
    pools: list[Any] = []

    def pool() -> Executor:
        pools.append(processes(2)())
        return pools[-1]  # type: ignore[no-any-return]

    first = lambda: next(iter(pools[0]._processes))  # noqa: E731
    killer = threading.Thread(target=kill_once_searching, args=(tmp_path / "work", first))
    killer.start()
    found = in_tiles(narrow, pool, work=tmp_path / "work")
    killer.join()
    assert len(pools) == 2
    assert_same(found, serial())


def test_workers_that_die_of_everything_are_told(tmp_path: Path, narrow: int) -> None:
    class Dying(Executor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            from concurrent.futures.process import BrokenProcessPool

            raise BrokenProcessPool

    with pytest.raises(OutputError, match=r"workers died, last of all during scan-00000: .* --resume"):
        in_tiles(narrow, Dying, work=tmp_path / "work")


def test_what_is_done_is_not_done_again(tmp_path: Path, narrow: int) -> None:
    work = tmp_path / "work"

    def stop_at_second(stage: str, so_far: float, total: float) -> None:
        if stage == "search" and so_far == 1:
            raise Enough

    with pytest.raises(Enough):
        in_tiles(narrow, work=work, progress=stop_at_second)
    with pytest.raises(UsageError, match="--resume"):
        in_tiles(narrow, work=work)
    with pytest.raises(UsageError, match="other seed"):
        in_tiles(narrow, work=work, resume=True, seed=7)
    before = {path: path.stat().st_mtime_ns for path in work.glob("*/done")}
    assert len([path for path in before if path.parent.name.startswith("search-")]) == 1
    found = in_tiles(narrow, work=work, resume=True)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert_same(found, serial())


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", folder], check=False, capture_output=True
    ).returncode:
        pytest.skip("needs the right to mount a tmpfs")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_a_full_disk_is_one_line_and_no_end(small_disk: Path, narrow: int) -> None:
    work = small_disk / "work"
    with pytest.raises(OutputError, match=r"work: .*: make room, then give --resume") as raised:
        in_tiles(narrow, work=work)
    assert "\n" not in str(raised.value)
    subprocess.run(["mount", "-o", "remount,size=900m", small_disk], check=True)
    assert_same(in_tiles(narrow, work=work, resume=True), serial())


def write_setups(folder: Path, clouds: Sequence[PointCloud]) -> None:
    folder.mkdir()
    for k, cloud in enumerate(clouds):
        assert cloud.origin is not None
        with open_stations(folder / f"setup{k}.e57", {}) as writer:
            writer.station(f"setup{k}", Pose(np.eye(3), cloud.origin), (1, 1))
            writer.write(cloud.xyz, {})


@pytest.fixture(scope="module")
def setups(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The corridor as a folder of E57 files, one a station, and the models as a library."""
    from scanfind.library import ModelLibrary

    folder = tmp_path_factory.mktemp("site")
    write_setups(folder / "setups", corridor())
    with ModelLibrary.open(folder / "parts.scanfind", create=True) as kept:
        for model in library().models():
            kept.put(model)
    (folder / "quick.toml").write_text(
        f"[grid]\ncell_m = {QUICK.grid.cell_m}\n[search]\ntime_limit_s = 'none'\n"
        f"pairs_a_round = {QUICK.search.pairs_a_round}\nhypotheses_a_round = {QUICK.search.hypotheses_a_round}\n"
        f"kept = {QUICK.search.kept}\n"
    )
    return folder


def command(setups: Path, out: Path, *more: str) -> list[str]:
    return ["find", str(setups / "setups"), "--library", str(setups / "parts.scanfind"), "--config",
            str(setups / "quick.toml"), "--memory", "1200MB", "--out", str(out), *more]  # fmt: skip


def detections(out: Path, expected: int = 3) -> list[Any]:
    found = json.loads((out / "results.json").read_text())["detections"]
    assert len(found) == expected
    return sorted(([one["model"], one["scene_from_model"], one["points"]] for one in found), key=str)


@pytest.fixture(scope="module")
def undisturbed(setups: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    out = tmp_path_factory.mktemp("undisturbed") / "found"
    assert main(command(setups, out)) == 0
    assert not out.with_name("found.scanfind-work").exists()
    return detections(out)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_run_goes_on(setups: Path, undisturbed: list[Any], tmp_path: Path, how: signal.Signals) -> None:
    out, work = tmp_path / "found", tmp_path / "found.scanfind-work"
    # What a shell runs in the background ignores SIGINT, and so would its children.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    run = subprocess.Popen([sys.executable, "-m", "scanfind", *command(setups, out)], stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, before)
    with run:
        until((work / "scan-00002" / "done").exists)
        run.send_signal(how)
        said = run.communicate()[1]
    assert run.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL)
    if how == signal.SIGINT:
        assert f"interrupted: what is done lies in {work}: give --resume" in said
        assert "Traceback" not in said
    assert not out.exists()
    assert main(command(setups, out, "--resume")) == 0
    assert detections(out) == undisturbed
    assert not work.exists()


@pytest.mark.slow
def test_an_unreadable_setup_among_others_is_told_by_the_exit_code(
    setups: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(setups, tmp_path / "site")
    damaged = tmp_path / "site" / "setups" / "setup9.e57"
    damaged.write_bytes((setups / "setups" / "setup1.e57").read_bytes()[:100_000])
    assert main(command(tmp_path / "site", tmp_path / "found", "--remainder")) == 4
    assert "setup9.e57 was left out" in capsys.readouterr().err
    isolated = sum(points for _, _, points in detections(tmp_path / "found"))
    left = scan_info(tmp_path / "found" / "remainder.ply").points
    assert isolated + left == sum(len(cloud) for cloud in corridor())


@pytest.mark.slow
def test_a_dask_cluster_does_the_same_and_a_killed_worker_changes_nothing(tmp_path: Path, narrow: int) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as local:
        victim = next(iter(local.workers.values())).pid
        killer = threading.Thread(target=kill_once_searching, args=(tmp_path / "work", lambda: victim))
        killer.start()
        found = in_tiles(narrow, cluster(local.scheduler_address), work=tmp_path / "work")
        killer.join()
    assert_same(found, serial())


def dask_process(what: str, *options: str) -> subprocess.Popen[bytes]:
    call = [sys.executable, "-m", f"distributed.cli.dask_{what}", *options, "--no-dashboard"]
    return subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.mark.slow
def test_a_killed_scheduler_is_told_in_a_line_and_the_run_goes_on_without_it(tmp_path: Path, narrow: int) -> None:
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address, work = f"tcp://127.0.0.1:{port}", tmp_path / "work"
    with (
        dask_process("scheduler", "--port", str(port)) as scheduler,
        dask_process("worker", address, "--nthreads", "1", "--no-nanny") as worker,
    ):
        killer = threading.Thread(target=kill_once_searching, args=(work, lambda: scheduler.pid))
        killer.start()
        with pytest.raises(OutputError, match=r"gave up on a task \(its scheduler is gone\): give --resume"):
            in_tiles(narrow, cluster(address), work=work)
        killer.join()
        worker.kill()
    assert any(work.glob("scan-*/done"))
    assert_same(in_tiles(narrow, work=work, resume=True), serial())


@pytest.mark.slow
def test_the_memory_given_is_kept(setups: Path, tmp_path: Path) -> None:
    """By a worker, as the system counts it, on a site that is more than the memory holds at once."""
    memory = "700MB"
    write_setups(tmp_path / "setups", corridor(LONG))
    searched = (
        "import resource, sys; from scanfind.cli import main; code = main(sys.argv[1:]); "
        "print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    call = [
        sys.executable, "-c", searched, "find", str(tmp_path / "setups"), "--library", str(setups / "parts.scanfind"),
        "--config", str(setups / "quick.toml"), "--memory", memory, "--workers", "1", "--out", str(tmp_path / "found"),
    ]  # fmt: skip
    ended = subprocess.run(call, capture_output=True, text=True, check=True)
    code, peak = map(int, ended.stdout.splitlines()[-1].split())
    whole = re.search(r"up to (\S+ \S+) to be one tile", ended.stderr)
    assert code == 0
    assert whole is not None
    assert size_of(whole[1]) > size_of(memory) > 1024 * peak
    detections(tmp_path / "found", LONG)
