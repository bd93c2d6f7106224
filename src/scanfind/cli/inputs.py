"""What the commands read: model files into a library."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from scanfind.cli.options import note
from scanfind.errors import UsageError

if TYPE_CHECKING:
    from scanfind.cloud import CloudModel
    from scanfind.config import Run
    from scanfind.library import ModelLibrary
    from scanfind.mesh import Mesh
    from scanfind.parameters import Parameters


def expected(counts: Sequence[str] | None) -> int | dict[str, int] | None:
    """Of --expect: a number for every model, or MODEL=N for some; None where nothing is expected. Raises UsageError."""
    if counts is None:
        return None
    if len(counts) == 1 and counts[0].isdigit():
        return int(counts[0])
    by_name = {}
    for count in counts:
        name, _, number = count.rpartition("=")
        if not (name and number.isdigit()):
            msg = f"--expect: takes a number for every model, or MODEL=N for each of some, got {count!r}"
            raise UsageError(msg)
        by_name[name] = int(number)
    return by_name


@contextmanager
def open_models(
    files: Sequence[Path], library: Path | None, run: Run, parameters: Parameters
) -> Iterator[ModelLibrary]:
    """The library at that path, or one in memory made of the model files."""
    from scanfind.library import ModelLibrary

    with ModelLibrary.in_memory() if library is None else ModelLibrary.open(library) as models:
        add_models(models, files, run, parameters)
        yield models


def add_models(
    models: ModelLibrary, files: Sequence[Path], run: Run, parameters: Parameters, symmetry: str | None = None
) -> list[str]:
    """Prepare every model of the files and keep it in the library; their names. `symmetry`: see ModelParameters."""
    from scanfind.library.model import ModelParameters
    from scanfind.mesh import Mesh
    from scanfind.models import STATES_UNITS, read_models
    from scanfind.progress import progress_on
    from scanfind.threads import available_cores

    prepared = ModelParameters(surface=parameters.surface, pairs=parameters.pairs, symmetry=symmetry)
    read: list[Mesh | CloudModel] = []
    for file in files:
        # One --units may stand for a mixed list of files, of which some say theirs.
        units = None if file.suffix.lower() in STATES_UNITS else run.units
        for model in read_models(file, units=units, select=run.select):
            if isinstance(model, Mesh) and "hint" in model.notes:
                note(f"{model.name}: {model.notes['hint']}")
            read.append(model)
    names = []
    with progress_on() as tell:
        for added in models.add_all(read, prepared, run.jobs or available_cores()):
            names.append(added.name)
            tell("library", len(names), len(read))
    return names
