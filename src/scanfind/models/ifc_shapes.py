"""The shapes of an IFC file's products, as ifcopenshell builds them: what runs in the child process."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scanfind.errors import UnreadableFileError, UnsupportedFormatError
from scanfind.mesh import Floats
from scanfind.models.child import one_line
from scanfind.models.distinct import rigid_and_rest, same_shapes
from scanfind.models.ifc_select import choose, members, type_name
from scanfind.models.parts import Part, as_one, moved


class Shape(NamedTuple):
    """A chosen product: its geometry in its own frame, one part or those of an assembly; design_from_model (4, 4)."""

    product: Any
    parts: list[Part]
    matrix: Floats


def read_here(path: Path, options: dict[str, Any]) -> tuple[list[Part], dict[str, Any]]:
    """The parts of each distinct geometry, end to end, and facts.

    options : `select`, as in `choose`
    facts : `models`, for each distinct geometry its `name`, how many `parts` it has, and its `products`, each as
        (GlobalId, class, name, design_from_model); `failed`, how many products have a body that could not be built
    """
    file = _open(path)
    products = choose(file, options["select"], str(path))
    if not products:
        msg = f"{path} has no built product with a shape of its own: select others by class, for example IfcSpace"
        raise UnreadableFileError(msg)
    shapes, failed = _shapes(file, products)
    groups = same_shapes([as_one(shape.parts) for shape in shapes])
    parts, models = [], []
    for group in groups:
        first = shapes[group[0].part]
        parts += first.parts
        placed = [(shapes[copy.part].product, shapes[copy.part].matrix @ copy.copy_from_first) for copy in group]
        models.append({
            "name": _model_name(first.product),
            "parts": len(first.parts),
            "products": [(each.GlobalId, each.is_a(), each.Name or "", matrix.tolist()) for each, matrix in placed],
        })  # fmt: skip
    return parts, {"models": models, "failed": failed}


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


def _shapes(file: Any, products: Sequence[Any]) -> tuple[list[Shape], int]:
    """What could be built of the products, in their order; how many of those with a body could not."""
    from ifcopenshell.util.unit import calculate_unit_scale

    metres = calculate_unit_scale(file)
    built = _built(file, {member.id(): member for product in products for member in members(product)})
    shapes, failed = [], 0
    for product in products:
        found = [built[member.id()] for member in members(product) if member.id() in built]
        if not found:
            failed += any(_has_body(member) for member in members(product))
        elif product.Representation:
            [(part, matrix)] = found
            rigid, rest = rigid_and_rest(matrix)
            shapes.append(Shape(product, [part if rest is None else moved(part, rest)], rigid))
        else:
            design_from_whole = _placement(product, metres)
            whole_from_design = np.linalg.inv(design_from_whole)
            shapes.append(
                Shape(product, [moved(part, whole_from_design @ matrix) for part, matrix in found], design_from_whole)
            )
    return shapes, failed


def _built(file: Any, wanted: dict[int, Any]) -> dict[int, tuple[Part, Floats]]:
    """What the geometry kernel makes of the products: number → part in its own frame, design_from_part (4, 4)."""
    import ifcopenshell.geom

    settings = ifcopenshell.geom.settings()
    # Own coordinates: a thousand equal bolts then have one geometry and a thousand placements.
    settings.set("use-world-coords", False)
    settings.set("no-normals", True)
    iterator = ifcopenshell.geom.iterator(settings, file, os.cpu_count() or 1, include=list(wanted.values()))
    found = {}
    going = iterator.initialize()
    while going:
        shape = iterator.get()
        vertices = np.array(shape.geometry.verts, dtype=np.float64).reshape(-1, 3)
        faces = np.array(shape.geometry.faces, dtype=np.int64).reshape(-1, 3)
        matrix = np.array(shape.transformation.matrix, dtype=np.float64).reshape(4, 4, order="F")
        # Annotations and the like come as lines.
        if shape.id in wanted and len(faces):
            found[shape.id] = (Part(_model_name(wanted[shape.id]), vertices, faces), matrix)
        going = iterator.next()
    return found


def _placement(product: Any, metres: float) -> Floats:
    """design_from_product (4, 4), metres, of a whole that has no shape of its own."""
    from ifcopenshell.util.placement import get_local_placement

    if product.ObjectPlacement is None:
        return np.eye(4)
    matrix: Floats = np.array(get_local_placement(product.ObjectPlacement), dtype=np.float64)
    matrix[:3, 3] *= metres
    return matrix


def _model_name(product: Any) -> str:
    """What people call a geometry: its type, else the product that has it."""
    return " ".join((type_name(product) or product.ObjectType or product.Name or product.is_a()).split())


def _has_body(product: Any) -> bool:
    """Whether it should have a shape, not only an axis or a footprint."""
    representations = product.Representation.Representations or ()
    return any((each.RepresentationIdentifier or "") in ("Body", "Facetation") for each in representations)
