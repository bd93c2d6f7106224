"""IFC: one model for each distinct geometry, and where the design puts the products that have it.

Read in a child process: some damaged files crash the reader, others never end.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from scanfind.errors import InvalidGeometryError, UnreadableFileError
from scanfind.mesh import Mesh, Placement
from scanfind.models.child import need_extra, read_in_child
from scanfind.models.parts import join
from scanfind.models.wanted import Wanted
from scanfind.pose import Pose


def read(path: Path, wanted: Wanted) -> list[Mesh]:
    """One mesh for each distinct geometry of the selected products, with its placements.

    Named after the type of the first product that has it, or that product; where two would be of one name, six digits
    of a hash of the geometry tell them apart. A selected assembly without a shape of its own is one mesh of its parts.
    Raises UnreadableFileError, UnsupportedFormatError, UsageError for a selector that means nothing,
    MissingExtraError without ifcopenshell.
    """
    need_extra("ifcopenshell", "ifc", "IFC")
    parts, facts = read_in_child("ifc_shapes", path, {"select": list(wanted.select)})
    meshes, built, failed = [], 0, facts["failed"]
    rest = iter(parts)
    for model in facts["models"]:
        products = model["products"]
        try:
            mesh = join(model["name"], islice(rest, model["parts"]), str(path))
        except InvalidGeometryError:
            failed += len(products)
            continue
        placed = tuple(Placement(gid, kind, name, Pose.from_matrix(matrix)) for gid, kind, name, matrix in products)
        meshes.append(replace(mesh, placements=placed))
        built += len(placed)
    if not meshes:
        msg = f"{path} has no product whose shape could be built ({failed} failed)"
        raise UnreadableFileError(msg)
    if failed:
        hint = f"{failed} of {failed + built} products of {path.name} have no usable shape and are left out"
        meshes[0] = replace(meshes[0], notes={**meshes[0].notes, "hint": hint})
    return _named_apart(meshes)


def _named_apart(meshes: list[Mesh]) -> list[Mesh]:
    """The same meshes under names that are unique, and say the same whatever else is selected with them."""
    counts = Counter(mesh.name for mesh in meshes)
    taken: Counter[str] = Counter()
    named = []
    for mesh in meshes:
        name = mesh.name if counts[mesh.name] == 1 else f"{mesh.name}-{_digits(mesh)}"
        taken[name] += 1
        # Two shapes within the hash's rounding, or a name that ends in such digits already.
        named.append(replace(mesh, name=name if taken[name] == 1 else f"{name}-{taken[name]}"))
    return named


def _digits(mesh: Mesh) -> str:
    rounded = np.round(mesh.vertices * 1e4).astype("<i8")
    return hashlib.sha256(rounded.tobytes() + mesh.faces.astype("<i4").tobytes()).hexdigest()[:6]
