"""Model files in: one reader a format, each yielding named models in metres.

A reader module has one function, `read(path, wanted) -> list[Mesh | CloudModel]`; those whose libraries crash on
damaged files also have `read_here`, which runs in a child process (see `child`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from scanfind.cloud import CloudModel
from scanfind.errors import InvalidGeometryError, UnreadableFileError, UnsupportedFormatError, UsageError
from scanfind.mesh import Mesh
from scanfind.models.units import UNITS, metres_per, size_hint
from scanfind.models.wanted import Wanted

__all__ = ["MODEL_READERS", "UNITS", "ModelFacts", "ModelInfo", "model_info", "read_models"]

# Suffix → module of this package.
MODEL_READERS: Mapping[str, str] = {
    ".stl": "meshes",
    ".off": "meshes",
    ".obj": "obj",
    ".ply": "ply",
    ".glb": "scenes",
    ".gltf": "scenes",
    ".3mf": "scenes",
    ".step": "step",
    ".stp": "step",
    ".ifc": "ifc",
    **dict.fromkeys((".e57", ".las", ".laz", ".pcd", ".ptx", ".pts", ".xyz", ".txt", ".csv", ".asc"), "clouds"),
}

# Formats that say in which units they are: `--units` there could only contradict them.
STATES_UNITS = (".glb", ".gltf", ".3mf", ".step", ".stp", ".ifc", ".e57")


@dataclass(frozen=True)
class ModelFacts:
    """What there is to say of one model.

    triangles : 0 for a piece of scan
    points : 0 for a mesh
    extent_m : size of its bounding box along x, y, z, metres
    area_m2 : surface area, m²; 0 for a piece of scan
    watertight : every part is closed, each edge between two faces
    placements : how many products of the design use it
    """

    name: str
    triangles: int
    points: int
    extent_m: tuple[float, float, float]
    area_m2: float
    watertight: bool
    placements: int


@dataclass(frozen=True)
class ModelInfo:
    """What is in a model file.

    format : the suffix without its dot
    units : whether the file states them or metres were assumed, in words
    hints : what a person should look at, one line each
    """

    path: str
    format: str
    units: str
    models: tuple[ModelFacts, ...]
    hints: tuple[str, ...] = ()


def read_models(
    path: str | Path, *, units: str | None = None, select: Sequence[str] = (), origin: ArrayLike | None = None
) -> list[Mesh | CloudModel]:
    """The models of one file, in metres, each with its own name.

    A mesh file or STEP assembly is one model, named after the file; an IFC file gives one model for each distinct
    geometry; a scan, or a PLY without faces, is a model that is a piece of scan.

    units : what the numbers of a file that does not say mean: mm, cm, m (the default), in, ft
    select : elements of an IFC file by class, name (with * and ?) or GlobalId; empty means all that are built.
        Files of other formats have nothing to select from, and are read whole.
    origin : (3,) where the scanner stood, metres, for a piece of scan whose file does not say
    A mesh's `notes["hint"]` is a line for the user, where its size is implausible or elements were left out.

    Raises UnreadableFileError, UnsupportedFormatError, InvalidGeometryError, MissingExtraError, and UsageError for
    arguments that cannot be.
    """
    path = Path(path)
    module = _reader_of(path)
    stated = path.suffix.lower() in STATES_UNITS
    scale = metres_per(units)
    if units is not None and stated:
        msg = f"{path.name} states its own units: leave out --units {units}"
        raise UsageError(msg)
    wanted = Wanted(scale, _texts(select), None if origin is None else _position(origin))
    try:
        models: list[Mesh | CloudModel] = import_module(f"scanfind.models.{module}").read(path, wanted)
    except OSError as error:
        msg = f"{path}: {error.strerror or error}"
        raise UnreadableFileError(msg) from error
    return [_with_hint(model, scale, stated=stated) for model in models]


def model_info(path: str | Path) -> ModelInfo:
    """What is in a model file; reads it whole, and raises as `read_models` does."""
    path = Path(path)
    models = read_models(path)
    stated = path.suffix.lower() in STATES_UNITS
    return ModelInfo(
        path=str(path),
        format=path.suffix.lower().removeprefix("."),
        units="stated by the file" if stated else "not stated by the file, metres assumed (--units)",
        models=tuple(_facts(model) for model in models),
        hints=tuple(model.notes["hint"] for model in models if isinstance(model, Mesh) and "hint" in model.notes),
    )


def _reader_of(path: Path) -> str:
    """The module that reads the file; raises where there is no such file or format."""
    suffix = path.suffix.lower()
    if suffix not in MODEL_READERS:
        known = ", ".join(MODEL_READERS)
        msg = f"{path.name}: {suffix or 'a name without a suffix'} is not a model format; models are read from {known}"
        raise UnsupportedFormatError(msg)
    if not path.is_file():
        msg = f"{path}: {'not a file' if path.exists() else 'no such file'}"
        raise UnreadableFileError(msg)
    return MODEL_READERS[suffix]


def _texts(select: Sequence[str]) -> tuple[str, ...]:
    # A lone string is a sequence of letters: "IfcBeam" is meant as one selector, not seven.
    return (select,) if isinstance(select, str) else tuple(select)


def _position(origin: ArrayLike) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    array = np.asarray(origin, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        msg = f"a position is three finite numbers x y z in metres, got {origin!r}"
        raise UsageError(msg)
    return array


def _with_hint(model: Mesh | CloudModel, scale: float, *, stated: bool) -> Mesh | CloudModel:
    if isinstance(model, CloudModel):
        return model
    hint = size_hint(float(np.linalg.norm(_extent(model))), scale, stated=stated)
    hints = [text for text in (model.notes.get("hint"), hint) if text]
    return replace(model, notes={**model.notes, "hint": "; ".join(hints)}) if hints else model


def _extent(model: Mesh | CloudModel) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    points = model.vertices[np.unique(model.faces)] if isinstance(model, Mesh) else model.points
    extent: np.ndarray[tuple[int], np.dtype[np.float64]] = np.ptp(points, axis=0)
    if not np.isfinite(extent).all():
        msg = f"model {model.name!r} is larger than numbers go"
        raise InvalidGeometryError(msg)
    return extent


def _facts(model: Mesh | CloudModel) -> ModelFacts:
    x, y, z = _extent(model).tolist()
    if isinstance(model, CloudModel):
        return ModelFacts(model.name, 0, len(model.points), (x, y, z), 0.0, watertight=False, placements=0)
    watertight = bool(model.notes.get("watertight", False))
    return ModelFacts(
        model.name, len(model.faces), 0, (x, y, z), model.area(), watertight, placements=len(model.placements)
    )
