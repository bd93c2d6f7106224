"""A search in tiles, as the command line asks for it: memory, workers, and the folder that keeps what is done."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from scanfind.cli.options import note
from scanfind.errors import Interrupted, UsageError

if TYPE_CHECKING:
    from scanfind.detection import Findings


class Tiled(NamedTuple):
    """What was asked for.

    memory : bytes of each worker; workers : processes, None: those of a scheduler, or this one
    work : keeps what is done until the result is written; None where no result is
    """

    memory: int
    workers: int | None
    scheduler: str | None
    work: Path | None
    resume: bool

    @staticmethod
    def asked(
        memory: str | None, workers: int | None, scheduler: str | None, out: Path | None, *, resume: bool
    ) -> Tiled | None:  # fmt: skip
        """From the options; None where none asks for tiles. Raises UsageError."""
        if memory is None and workers is None and scheduler is None and not resume:
            return None
        if workers is not None and scheduler is not None:
            msg = "--workers and --scheduler exclude each other: a cluster has its own workers"
            raise UsageError(msg)
        if workers is not None and workers < 1:
            msg = f"--workers is 1 or more, got {workers}"
            raise UsageError(msg)
        if resume and out is None:
            msg = "--resume has nothing to go on with: give the --out DIR the search began with"
            raise UsageError(msg)
        from scanfind.tiles import MEMORY
        from scanfind.tiles.plan import size_of

        of_each = MEMORY if memory is None else size_of(memory) // (workers or 1)
        work = None if out is None else out.absolute().with_name(f"{out.absolute().name}.scanfind-work")
        return Tiled(of_each, workers, scheduler, work, resume)

    def readable(self, scans: Sequence[Path]) -> list[Path]:
        """Those whose headers can be read: the others are left out, and told of when the search comes to them."""
        from scanfind.tiles.listed import info_of

        return [scan for number, scan in enumerate(scans) if info_of(scan, number) is not None]

    def search(self) -> Callable[..., Findings]:
        """`find_in_tiles` as it was asked for."""
        from scanfind.tiles import find_in_tiles
        from scanfind.tiles.workers import cluster, processes

        executor = None
        if self.scheduler is not None:
            executor = cluster(self.scheduler)
        elif self.workers is not None:
            executor = processes(self.workers)
        return partial(
            find_in_tiles, executor=executor, memory=self.memory, work=self.work, resume=self.resume, say=note
        )

    def threads(self, jobs: int | None) -> int:
        """Of each worker: so many, or its share of the cores."""
        from scanfind.threads import available_cores

        return jobs or max(1, available_cores() // (self.workers or 1))

    def finished(self) -> None:
        """The result is written: what was kept on the way goes."""
        if self.work is not None:
            shutil.rmtree(self.work, ignore_errors=True)


@contextmanager
def ending_workers() -> Iterator[None]:
    """Where a run is interrupted its workers end at once: else Python waits for what they are at, a minute or more."""
    from multiprocessing import active_children

    try:
        yield
    except (Interrupted, KeyboardInterrupt):
        for worker in active_children():
            worker.terminate()
        raise
