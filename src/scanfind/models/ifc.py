"""IFC: one model for each distinct geometry, and where the design puts the products that have it.

Read in a child process: some damaged files crash the reader, others never end.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import InvalidGeometryError, UnreadableFileError, UnsupportedFormatError
from scanfind.mesh import Floats, Mesh, Placement
from scanfind.models.child import need_extra, one_line, read_in_child
from scanfind.models.distinct import rigid_and_rest, same_shapes
from scanfind.models.ifc_select import choose, type_name
from scanfind.models.parts import Part, join, moved
from scanfind.models.wanted import Wanted
from scanfind.pose import Pose


class Shape(NamedTuple):
    """A product as the geometry kernel gives it: who it is, its own geometry, design_from_model (4, 4), metres."""

    global_id: str
    ifc_class: str
    name: str
    type_name: str
    part: Part
    matrix: Floats


def read(path: Path, wanted: Wanted) -> list[Mesh]:
    """One mesh for each distinct geometry of the selected products, with its placements.

    Named after the type of the first product that has it, or that product; where two would be of one name, six digits
    of a hash of the geometry tell them apart. Raises UnreadableFileError, UnsupportedFormatError, UsageError for a
    selector that means nothing, MissingExtraError without ifcopenshell.
    """
    need_extra("ifcopenshell", "ifc", "IFC")
    parts, facts = read_in_child("ifc", path, {"select": list(wanted.select)})
    meshes, failed = [], facts["failed"]
    for part, products in zip(parts, facts["products"], strict=True):
        try:
            mesh = join(part.name, [part], str(path))
        except InvalidGeometryError:
            failed += len(products)
            continue
        placements = [Placement(gid, kind, name, Pose.from_matrix(matrix)) for gid, kind, name, matrix in products]
        meshes.append(replace(mesh, placements=tuple(placements)))
    if not meshes:
        msg = f"{path} has no product whose shape could be built ({failed} failed)"
        raise UnreadableFileError(msg)
    if failed:
        hint = f"{failed} of {failed + sum(len(m.placements) for m in meshes)} products have no usable shape: left out"
        meshes[0] = replace(meshes[0], notes={**meshes[0].notes, "hint": hint})
    return _named_apart(meshes)


def read_here(path: Path, options: dict[str, Any]) -> tuple[list[Part], dict[str, Any]]:
    """In the child: a part for each distinct geometry; its products with their placements; how many products failed."""
    file = _open(path)
    products = choose(file, options["select"], str(path))
    if not products:
        msg = (
            f"{path} has no product with a shape of its own that is built; select others by class, for example IfcSpace"
        )
        raise UnreadableFileError(msg)
    shapes = _shapes(file, products)
    groups = same_shapes([shape.part for shape in shapes])
    built = {shape.global_id for shape in shapes}
    failed = sum(product.GlobalId not in built and _has_body(product) for product in products)
    parts = [shapes[group[0]].part for group in groups]
    placements = [
        [(s.global_id, s.ifc_class, s.name, s.matrix.tolist()) for s in (shapes[index] for index in group)]
        for group in groups
    ]
    return parts, {"products": placements, "failed": failed}


def _open(path: Path) -> Any:
    import ifcopenshell

    try:
        return ifcopenshell.open(str(path))
    except Exception as error:
        if "schema" in str(error).lower():
            msg = f"{path}: {one_line(error)}; scanfind reads IFC2X3, IFC4 and IFC4X3: export it as one of these"
            raise UnsupportedFormatError(msg) from error
        msg = f"{path} is not a readable IFC file: {one_line(error)}"
        raise UnreadableFileError(msg) from error


def _shapes(file: Any, products: Sequence[Any]) -> list[Shape]:
    """What the geometry kernel can build of the products, in the file's order, whatever thread built it."""
    import ifcopenshell.geom

    settings = ifcopenshell.geom.settings()
    # Own coordinates: a thousand equal bolts then have one geometry and a thousand placements.
    settings.set("use-world-coords", False)
    settings.set("no-normals", True)
    iterator = ifcopenshell.geom.iterator(settings, file, os.cpu_count() or 1, include=list(products))
    by_number = {product.id(): product for product in products}
    found: dict[int, Shape] = {}
    going = iterator.initialize()
    while going:
        built = iterator.get()
        if built.id in by_number:
            found[built.id] = _shape(by_number[built.id], built)
        going = iterator.next()
    return [found[number] for number in sorted(found)]


def _shape(product: Any, built: Any) -> Shape:
    vertices = np.array(built.geometry.verts, dtype=np.float64).reshape(-1, 3)
    faces: NDArray[np.int64] = np.array(built.geometry.faces, dtype=np.int64).reshape(-1, 3)
    matrix = np.array(built.transformation.matrix, dtype=np.float64).reshape(4, 4, order="F")
    rigid, rest = rigid_and_rest(matrix)
    kind = type_name(product)
    name = " ".join((kind or product.ObjectType or product.Name or product.is_a()).split())
    part = Part(name, vertices, faces)
    return Shape(
        product.GlobalId, product.is_a(), product.Name or "", kind, part if rest is None else moved(part, rest), rigid
    )


def _has_body(product: Any) -> bool:
    """Whether it should have a shape, not only an axis or a footprint."""
    representations = product.Representation.Representations or ()
    return any((each.RepresentationIdentifier or "") in ("Body", "Facetation") for each in representations)


def _named_apart(meshes: list[Mesh]) -> list[Mesh]:
    """The same meshes under names that are unique, and stay so when the file's other elements change."""
    counts = Counter(mesh.name for mesh in meshes)
    named = [mesh if counts[mesh.name] == 1 else replace(mesh, name=f"{mesh.name}-{_digits(mesh)}") for mesh in meshes]
    # Two shapes within the hash's rounding, or a name that already ends in such digits.
    taken: Counter[str] = Counter()
    unique = []
    for mesh in named:
        taken[mesh.name] += 1
        unique.append(mesh if taken[mesh.name] == 1 else replace(mesh, name=f"{mesh.name}-{taken[mesh.name]}"))
    return unique


def _digits(mesh: Mesh) -> str:
    rounded = np.round(mesh.vertices * 1e4).astype("<i8")
    return hashlib.sha256(rounded.tobytes() + mesh.faces.astype("<i4").tobytes()).hexdigest()[:6]
