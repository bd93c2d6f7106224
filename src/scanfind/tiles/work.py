"""The working folder of a run and the tasks in it: each is done once, kept, and found again by the next attempt."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from concurrent.futures import CancelledError as TaskCancelled
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from scanfind.errors import OutputError, UsageError

Outcome = TypeVar("Outcome")
# An executor, or what makes one anew: a pool of processes is broken when one of them is killed.
Workers: TypeAlias = "Executor | Callable[[], Executor]"

JOB = "job.json"
DONE = "done"
ATTEMPTS = 4  # pools that break one after the other: it is the work that kills them then


class Here(Executor):
    """Does each task at once, in this process."""

    def submit(self, fn: Callable[..., Outcome], /, *args: Any, **kwargs: Any) -> Future[Outcome]:
        """The outcome, which is there already."""
        future: Future[Outcome] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def opened(folder: Path, job: Mapping[str, object], *, resume: bool) -> None:
    """Make a working folder, or go on with the one that is there.

    job : what the run is of, as JSON has it: a folder of another one is not gone on with
    Raises UsageError where it holds another run, or this one and `resume` was not asked for; OutputError.
    """
    told = json.dumps(job, indent=1, sort_keys=True)
    try:
        there = folder.exists() and any(folder.iterdir())
        before = (folder / JOB).read_text(encoding="utf-8") if there else None
    except OSError as error:
        msg = f"{folder}: is there and is no working folder of scanfind's: move it away"
        raise OutputError(msg) from error
    if before is not None and not resume:
        msg = f"{folder}: holds a run that did not end: give --resume to go on with it, or remove it"
        raise UsageError(msg)
    if before is not None and before != told:
        old, new = json.loads(before), json.loads(told)
        other = next((key for key in new if new[key] != old.get(key)), "another version of scanfind")
        msg = f"{folder}: holds a run with other {other}: remove it, or give what it was begun with"
        raise UsageError(msg)
    if before is None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / JOB).write_text(told, encoding="utf-8")
        except OSError as error:
            raise no_room(folder, error) from error


def kept(folder: Path, name: str, work: Callable[..., Outcome], *arguments: Any) -> Outcome:
    """Do a task and keep its outcome under its name; what an earlier attempt left half done goes first.

    work : is called with the task's own folder and the arguments. Runs in a worker.
    """
    mine = folder / name
    try:
        shutil.rmtree(mine, ignore_errors=True)
        mine.mkdir(parents=True)
        outcome = work(mine, *arguments)
        part = mine / f"{DONE}.{os.getpid()}"
        with part.open("wb") as file:
            pickle.dump(outcome, file)
        part.replace(mine / DONE)
    except OSError as error:  # scans and models say theirs in words of their own
        raise no_room(folder, error) from error
    return outcome


class Crew:
    """Workers for a run. Those made for it are made anew when one of them dies, and closed at the end."""

    def __init__(self, workers: Workers) -> None:
        self._workers = workers
        self._pool = workers if isinstance(workers, Executor) else None

    def pool(self) -> Executor:
        """Whom to give tasks to."""
        if self._pool is None:
            assert not isinstance(self._workers, Executor)
            self._pool = self._workers()
        return self._pool

    def renew(self) -> bool:
        """Others in the place of those that died; False where they were given, and are not ours to replace."""
        if isinstance(self._workers, Executor):
            return False
        self.__exit__()
        return True

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *raised: object) -> None:
        if self._pool is not None and self._pool is not self._workers:
            # Whoever pressed Ctrl-C does not wait for what is being done.
            self._pool.shutdown(wait=not raised or raised[0] is None, cancel_futures=True)
            self._pool = None


def all_done(
    folder: Path, crew: Crew, tasks: Mapping[str, tuple[Any, ...]], told: Callable[[str, Any], None] = lambda *_: None
) -> list[Any]:
    """The outcomes of tasks, in their order: those done before are read, the others given to the crew.

    tasks : name → function and arguments, see `kept`
    told : is called with the name and outcome of each as it comes
    Raises what a task raised; OutputError where workers die of every attempt. What was done stays done.
    """
    outcomes: dict[str, Any] = {}

    def take(name: str, outcome: Any) -> None:
        outcomes[name] = outcome
        told(name, outcome)

    for name in tasks:
        if (folder / name / DONE).is_file():
            with (folder / name / DONE).open("rb") as file:
                take(name, pickle.load(file))  # our own, written by `kept`
    attempt = 0
    while missing := [name for name in tasks if name not in outcomes]:
        try:
            _run(crew.pool(), folder, {name: tasks[name] for name in missing}, take)
        except BrokenExecutor as error:
            attempt += 1
            if attempt == ATTEMPTS or not crew.renew():
                msg = f"workers died, last of all during {missing[0]}: give them more memory, and --resume to go on"
                raise OutputError(msg) from error
    return [outcomes[name] for name in tasks]


def _run(pool: Executor, folder: Path, tasks: Mapping[str, tuple[Any, ...]], take: Callable[[str, Any], None]) -> None:
    names: dict[Future[Any], str] = {}
    left: set[Future[Any]] = set()

    def take_those(ended: set[Future[Any]]) -> None:
        left.difference_update(ended)
        for future in sorted(ended, key=lambda one: names[one]):
            take(names[future], outcome_of(future))

    try:
        for name, task in tasks.items():
            future = pool.submit(kept, folder, name, *task)
            names[future] = name
            left.add(future)
            take_those({one for one in left if one.done()})  # a serial executor has done it by now
        while left:
            take_those(wait(left, return_when=FIRST_COMPLETED).done)
    finally:
        for future in names:
            future.cancel()


def outcome_of(future: Future[Any]) -> Any:
    """What a task gave; raises what it raised, and one line for what befell a cluster."""
    try:
        return future.result()
    except (Exception, TaskCancelled) as error:
        if not type(error).__module__.startswith(("distributed", "concurrent.futures._base")):
            raise
        # KilledWorker, CommClosedError, a task cancelled because its scheduler is gone.
        why = "its scheduler is gone" if isinstance(error, TaskCancelled) else f"{type(error).__name__}, see its log"
        msg = f"the cluster gave up on a task ({why}): give --resume to go on with what is done"
        raise OutputError(msg) from error


def no_room(folder: Path, error: OSError) -> OutputError:
    """The error for a working folder that cannot be written."""
    # NumPy says how many items it wrote, and not why it was no more.
    why = error.strerror or "no room left on the disk"
    return OutputError(f"{folder}: {why}: make room, then give --resume to go on with what is done")
