"""Who does the work: processes of this machine, or a dask cluster. Both are executors of concurrent.futures."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

from scanfind.errors import MissingExtraError, UsageError, require


def processes(count: int) -> Callable[[], Executor]:
    """What makes a pool of so many processes, anew each time: one that is killed breaks its pool."""
    require(count >= 1, "workers", count, "1 or more")
    # Spawned: a fork of a process with threads in compiled code may never come back.
    return lambda: ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_end_quietly)


def cluster(address: str) -> Callable[[], Executor]:
    """What connects to a dask scheduler, such as `tcp://host:8786`, and gives its executor.

    Raises MissingExtraError without dask, UsageError where no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        msg = "--scheduler needs dask: pip install 'scanfind[dask]'"
        raise MissingExtraError(msg) from error

    def connected() -> Executor:
        # It logs a traceback where its scheduler is gone; that is told in one line, see `outcome_of`.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        try:
            client = Client(address)
        except (OSError, ValueError) as error:
            msg = f"--scheduler {address}: no dask scheduler answers there: {' '.join(str(error).split())}"
            raise UsageError(msg) from error
        return _Cluster(client)

    return connected


class _Cluster(Executor):
    """Dask's own executor, which closes its client with it and leaves the cluster alone."""

    def __init__(self, client: Any) -> None:
        self._client, self._executor = client, client.get_executor(pure=False)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """On any worker; done again on another where that one dies."""
        future: Future[Any] = self._executor.submit(fn, *args, **kwargs)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Tasks that were not done are cancelled: nobody is left to take their outcome."""
        self._executor.shutdown(wait=wait and not cancel_futures)
        self._client.close()


def _end_quietly() -> None:
    """Ctrl-C reaches every process of a terminal: the one a person started tells of it, and its workers just end."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
