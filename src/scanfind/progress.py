"""What a person sees on stderr while a run works: one bar a stage, with its rate and the time left."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.progress import Task, TaskID
    from rich.text import Text

# stage, done, total; a total that is not positive is unknown. What is counted is the stage's affair.
Progress = Callable[[str, float, float], None]

# The stages that count points, and so have a rate a person can compare with the file's size.
COUNTS_POINTS = ("read", "isolate", "remainder", "write")

COMPILE_STAGE = "compile"  # its total is how many seconds compiling is expected to take


@contextmanager
def progress_on(stream: TextIO | None = None) -> Iterator[Progress]:
    """A progress callback that draws on `stream` (stderr).

    Bars on a terminal; elsewhere nothing but the note that kernels are being compiled.
    """
    out = stream or sys.stderr
    if not out.isatty():
        yield _compile_note(out)
        return
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(rate(task.description, task.speed))

    columns = (TextColumn("{task.description:8}"), BarColumn(), TaskProgressColumn(), Rate(), TimeRemainingColumn())
    with Bars(*columns, console=Console(file=out), transient=True) as bars:
        note = _compile_note(out)
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: float, total: float) -> None:
            if stage == COMPILE_STAGE:
                note(stage, done, total)
                return
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=None)
            bars.update(tasks[stage], completed=done, total=total if total > 0 else None)

        yield show


def rate(stage: str, speed: float | None) -> str:
    """Points a second, for the stages that count them: "12.3 M points/s"."""
    if stage not in COUNTS_POINTS or not speed:
        return ""
    return f"{speed / 1e6:.1f} M points/s" if speed >= 1e5 else f"{speed:.0f} points/s"


def _compile_note(out: TextIO) -> Progress:
    """Says once that kernels are being compiled: a first start without a word looks like a hang."""
    said = False

    def note(stage: str, done: float, total: float) -> None:
        nonlocal said
        if stage == COMPILE_STAGE and not said:
            said = True
            about = f" (about {total:.0f} s)" if total > 0 else ""
            print(f"scanfind: compiling kernels for first use{about}", file=out, flush=True)

    return note
