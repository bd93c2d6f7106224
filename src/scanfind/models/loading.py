"""The one door to trimesh's readers: bytes in, parts out, and one error for whatever they throw."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np

from scanfind.errors import UnreadableFileError
from scanfind.models.child import one_line
from scanfind.models.parts import Part, moved

if TYPE_CHECKING:
    from trimesh import Scene

GLTF = {"skip_materials": True, "merge_primitives": True}
OPTIONS: Mapping[str, Mapping[str, Any]] = {"stl": {}, "off": {}, "3mf": {}, "glb": GLTF, "gltf": GLTF}


class Beside:
    """The files beside a model that its own text may name: none by URL, none absolute, none above its folder."""

    def __init__(self, model: Path) -> None:
        self.folder = model.absolute().parent

    def __getitem__(self, name: str) -> bytes:
        """The bytes of a file named relative to the model; raises ValueError where it may not be read."""
        folder = self.folder.resolve()
        path = (folder / unquote(name)).resolve()
        if not path.is_relative_to(folder) or not path.is_file():
            msg = f"it names {name[:60]!r}, which is no file beside it"
            raise ValueError(msg)
        return path.read_bytes()

    def get(self, name: str) -> bytes:
        """The same."""
        return self[name]


def load_parts(data: bytes, kind: str, path: Path) -> tuple[list[Part], str | None]:
    """The triangle meshes of a file's scene, each in its place, and the unit it states (trimesh's word for it).

    kind : trimesh's name of the format. Raises UnreadableFileError.
    """
    import trimesh

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # NumPy reads numbers up to the first one damaged, and only warns: to us that file is cut short.
            warnings.filterwarnings("error", category=DeprecationWarning, message="string or file could not be read")
            scene = trimesh.load_scene(
                BytesIO(data), file_type=kind, resolver=Beside(path), process=False, **OPTIONS[kind]
            )
            return _parts(scene), scene.units
    except MemoryError:
        raise
    except Exception as error:
        msg = f"{path} is not a readable {kind.upper()} file: {one_line(error)}"
        raise UnreadableFileError(msg) from error


def _parts(scene: Scene) -> list[Part]:
    parts = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if hasattr(geometry, "faces"):
            part = Part(str(name), np.asarray(geometry.vertices, np.float64), np.asarray(geometry.faces, np.int64))
            parts.append(moved(part, np.asarray(matrix)))
    return parts
