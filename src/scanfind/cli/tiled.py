"""A search in tiles, as the command line asks for it: memory, workers, and the folder that keeps what is done."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from scanfind.cli.options import note
from scanfind.errors import Interrupted, UsageError

if TYPE_CHECKING:
    from scanfind.config import Run
    from scanfind.detection import Findings
    from scanfind.library import ModelLibrary
    from scanfind.parameters import Parameters
    from scanfind.progress import Progress
    from scanfind.scans import CloudWriter


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
            msg = "find: --workers and --scheduler exclude each other: a cluster has its own workers"
            raise UsageError(msg)
        if workers is not None and workers < 1:
            msg = f"find: --workers is 1 or more, got {workers}"
            raise UsageError(msg)
        if resume and out is None:
            msg = "find: --resume has nothing to go on with: give the --out DIR the search began with"
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

    def find(
        self, scans: Sequence[Path], models: ModelLibrary, run: Run, parameters: Parameters, progress: Progress,
        remainder: CloudWriter | None,
    ) -> Findings:  # fmt: skip
        """Search."""
        from multiprocessing import active_children

        from scanfind.threads import available_cores
        from scanfind.tiles import find_in_tiles
        from scanfind.tiles.workers import cluster, processes

        executor = None
        if self.scheduler is not None:
            executor = cluster(self.scheduler)
        elif self.workers is not None:
            executor = processes(self.workers)
        try:
            return find_in_tiles(
                scans, models, executor=executor, memory=self.memory, work=self.work, resume=self.resume,
                parameters=parameters, seed=run.seed, jobs=run.jobs or max(1, available_cores() // (self.workers or 1)),
                origin=run.origin, progress=progress, remainder=remainder, say=note,
            )  # fmt: skip
        except (Interrupted, KeyboardInterrupt):
            # Else Python waits for what workers are at, a minute or more.
            for worker in active_children():
                worker.terminate()
            raise

    def finished(self) -> None:
        """The result is written: what was kept on the way goes."""
        if self.work is not None:
            shutil.rmtree(self.work, ignore_errors=True)
