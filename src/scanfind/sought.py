"""What is sought: models from libraries, files, meshes and pieces of scan, prepared."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from scanfind.cloud import CloudModel
from scanfind.errors import UsageError
from scanfind.library import ModelLibrary
from scanfind.library.model import Model, ModelParameters
from scanfind.mesh import Mesh
from scanfind.threads import available_cores

if TYPE_CHECKING:
    from scanfind.parameters import Parameters
    from scanfind.progress import Progress

ModelInput: TypeAlias = "ModelLibrary | Model | Mesh | CloudModel | str | PathLike[str]"


def models_of(
    models: ModelInput | Sequence[ModelInput], parameters: Parameters, units: str | None, select: Sequence[str],
    jobs: int | None = None, tell: Progress | None = None,
) -> list[Model]:  # fmt: skip
    """The models sought, prepared: from a library as they are there, from files and meshes with these parameters.

    jobs : prepared at a time; None: one a core; tell : called with ("library", prepared so far, all of them)
    """
    listed = [models] if isinstance(models, (ModelLibrary, Model, Mesh, CloudModel, str, PathLike)) else list(models)
    prepare = ModelParameters(parameters.surface, parameters.pairs)
    sought: list[Model] = []
    unprepared: list[Mesh | CloudModel] = []
    with ModelLibrary.in_memory() as fresh:
        for given in listed:
            if isinstance(given, ModelLibrary):
                sought.extend(given.models())
            elif isinstance(given, Model):
                sought.append(given)
            elif isinstance(given, (Mesh, CloudModel)):
                unprepared.append(given)
            elif is_library(given):
                with ModelLibrary.open(Path(given)) as library:
                    sought.extend(library.models())
            else:
                from scanfind.models import read_models

                unprepared += read_models(Path(given), units=units, select=select)
        for done, _ in enumerate(fresh.add_all(unprepared, prepare, jobs or available_cores()), start=1):
            if tell:
                tell("library", done, len(unprepared))
        sought.extend(fresh.models())
    names = [model.name for model in sought]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        msg = f"find: two models are called {twice[0]!r}: rename one, so that detections can be told apart"
        raise UsageError(msg)
    if not sought:
        msg = "find: no model to look for: the library is empty; add one with `scanfind library add`"
        raise UsageError(msg)
    return sought


def is_library(path: str | PathLike[str]) -> bool:
    """Does a file begin as every SQLite file does?"""
    try:
        with Path(path).open("rb") as file:
            return file.read(16) == b"SQLite format 3\0"
    except OSError:
        return False
