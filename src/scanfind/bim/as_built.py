"""A copy of the design's IFC file that says of each element what was built and, where asked, stands as it was built."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from uuid import UUID, uuid5

import numpy as np
from numpy.typing import NDArray

from scanfind.bim.wording import inspected, scans_in_words
from scanfind.errors import OutputError, ScanfindError, UnreadableFileError, UsageError
from scanfind.models.child import need_extra, one_line
from scanfind.models.ifc_select import members
from scanfind.pose import Pose
from scanfind.results import result_file

if TYPE_CHECKING:
    from scanfind.results.schema import DetectionEntry, ElementEntry, Results

Floats = NDArray[np.float64]

# Not Pset_...: that prefix is kept for the property sets of the standard.
PROPERTY_SET = "scanfind_AsBuilt"
MOVED = "PlacementMoved"
SPACE = UUID("0d6dc8c6-93cd-5c6e-8f0b-7f6bb7a1b0a4")  # of the names that our GlobalIds have


class Told(NamedTuple):
    """How many elements of the file got properties, how many were moved; GlobalIds of those that could not be."""

    described: int
    moved: int
    unmoved: tuple[str, ...]


def write_as_built(
    result_dir: str | Path, design: str | Path, out: str | Path, *, move: bool = False,
    tolerance: str | Path | None = None, overwrite: bool = False,
) -> Told:  # fmt: skip
    """Write a copy of the design with a property set `scanfind_AsBuilt` on every element that was inspected.

    result_dir : a folder that `scanfind inspect --out` wrote
    design : the IFC file that was inspected; it is not changed
    move : place installed elements where they were found, with their openings and, of an assembly, its parts
    tolerance : a profile (a TOML file or the name of a preset) that gives the verdicts; None: as inspected

    Raises UnreadableFileError for a file that is no IFC file, UsageError where it is not the design of the result,
    MissingExtraError without ifcopenshell, OutputError where `out` is the design itself or cannot be written.
    """
    need_extra("ifcopenshell", "ifc", "IFC")
    results, _ = inspected(result_dir, tolerance)
    if not Path(design).is_file():
        msg = f"{design}: {'not a file' if Path(design).exists() else 'no such file'}"
        raise UnreadableFileError(msg)
    if Path(out).exists() and Path(out).samefile(design):
        msg = f"{out}: is the design itself, which is never written to: name another file"
        raise OutputError(msg)
    with result_file(out, overwrite=overwrite) as path, _in_words(Path(design)):
        import ifcopenshell

        file = ifcopenshell.open(str(design))
        told = describe(file, results, Path(design), move=move)
        file.write(str(path), format=".ifc")
    return told


def describe(file: Any, results: Results, design: Path, *, move: bool) -> Told:
    """Put into an opened IFC file what is known of its elements; raises UsageError where it has none of them."""
    products = {product.GlobalId: product for product in file.by_type("IfcProduct")}
    pairs = [(products[each.global_id], each) for each in results.elements if each.global_id in products]
    if not pairs:
        msg = f"{design}: has none of the elements that were inspected: name the IFC file given to --design then"
        raise UsageError(msg)
    if move and any(_was_moved(product) for product, _ in pairs):
        msg = f"{design}: its elements were moved to where they stand already: name the design that was inspected"
        raise UsageError(msg)
    found = {each.id: each for each in results.detections}
    moves = Moves(file) if move else None
    own = {product.id() for product, element in pairs if element.built_from_design is not None}
    moved, unmoved, writer = 0, [], Properties(file, results)
    for product, element in pairs:
        done = False
        if moves is not None and element.built_from_design is not None:
            done = moves.move(product, Pose.from_matrix(element.built_from_design), own)
            moved += done
            unmoved += [] if done else [element.global_id]
        writer.write(product, element, found.get(element.detection or 0), moved=done)
    return Told(len(pairs), moved, tuple(unmoved))


class Moves:
    """Products of a file moved one after the other; everything else keeps its place."""

    def __init__(self, file: Any) -> None:
        from ifcopenshell.util.unit import calculate_unit_scale

        self._file, self._metres = file, calculate_unit_scale(file)

    def move(self, product: Any, motion: Pose, own: set[int]) -> bool:
        """Move a product, what is cut out of it and its ports, and of one without a shape its parts.

        motion : of the whole file's axes, metres
        own : numbers of products that are moved by themselves

        Returns False, and moves nothing, where a placement is given by a grid or an alignment.
        """
        from ifcopenshell.util.placement import get_local_placement

        along = [product, *(each for each in _along(product) if each.id() not in own)]
        if any(not _is_local(each.ObjectPlacement) for each in along):
            return False
        placements = {place.id(): place for place in (self._its_own(each, along) for each in along)}
        hanging = {c.id(): c for place in placements.values() for c in place.ReferencedByPlacements}
        staying = [c for number, c in hanging.items() if number not in placements and c.is_a("IfcLocalPlacement")]
        stand = [get_local_placement(each) for each in staying]
        in_units = motion.matrix()
        in_units[:3, 3] /= self._metres
        first = [p for p in placements.values() if p.PlacementRelTo is None or p.PlacementRelTo.id() not in placements]
        for place, where in [(each, in_units @ get_local_placement(each)) for each in first]:
            self._put(place, where)
        # What hangs on a placement that was moved is no part of this product: it stays.
        for place, where in zip(staying, stand, strict=True):
            self._put(place, where)
        return True

    def _its_own(self, product: Any, along: Sequence[Any]) -> Any:
        """The placement of a product, one that nothing but what goes along with it shares."""
        place = product.ObjectPlacement
        if place is None or {each.id() for each in place.PlacesObject} - {each.id() for each in along}:
            axes = self._axes(np.eye(4)) if place is None else place.RelativePlacement
            parent = None if place is None else place.PlacementRelTo
            product.ObjectPlacement = self._file.create_entity("IfcLocalPlacement", parent, axes)
        return product.ObjectPlacement

    def _put(self, place: Any, where: Floats) -> None:
        """Give a placement its axes so that it is at `where` (4, 4), in the file's own units and axes."""
        from ifcopenshell.util.placement import get_local_placement

        # New axes: the old ones may be shared with other placements.
        place.RelativePlacement = self._axes(np.linalg.solve(get_local_placement(place.PlacementRelTo), where))

    def _axes(self, matrix: Floats) -> Any:
        create = self._file.create_entity
        point = create("IfcCartesianPoint", matrix[:3, 3].tolist())
        z, x = (create("IfcDirection", matrix[:3, k].tolist()) for k in (2, 0))
        return create("IfcAxis2Placement3D", point, z, x)


class Properties:
    """Writes the property sets; lengths and angles in the file's own units."""

    def __init__(self, file: Any, results: Results) -> None:
        from ifcopenshell.util.unit import calculate_unit_scale

        self._file, self._results = file, results
        self._length = calculate_unit_scale(file)
        self._angle = calculate_unit_scale(file, "PLANEANGLEUNIT")
        self._scans, self._dates = scans_in_words(results), file.schema != "IFC2X3"

    def write(self, product: Any, element: ElementEntry, found: DetectionEntry | None, *, moved: bool) -> None:
        """Describe a product, in the place of an earlier description."""
        create = self._file.create_entity
        self._forget(product)
        made = [
            create("IfcPropertySingleValue", name, None, create(kind, value), None)
            for name, kind, value in self._values(element, found, moved=moved)
            if value is not None
        ]
        who = product.OwnerHistory or next(iter(self._file.by_type("IfcOwnerHistory")), None)  # IFC2X3 wants one
        properties = create("IfcPropertySet", self._new_id(element, "set"), who, PROPERTY_SET, None, made)
        create("IfcRelDefinesByProperties", self._new_id(element, "relation"), who, None, None, [product], properties)

    def _values(
        self, element: ElementEntry, found: DetectionEntry | None, *, moved: bool
    ) -> Iterator[tuple[str, str, str | float | bool | None]]:
        """Name, measure and value of each property; None where it is not known."""
        yield "Status", "IfcLabel", element.status
        yield "Verdict", "IfcLabel", element.verdict
        yield "Reason", "IfcText", element.why
        for axis, shift in zip("XYZ", element.shift_m or (None, None, None), strict=True):
            yield f"Shift{axis}", "IfcLengthMeasure", self._in(shift, self._length)
        yield "Turn", "IfcPlaneAngleMeasure", self._in(element.turn_rad, self._angle)
        yield "LargestDisplacement", "IfcLengthMeasure", self._in(element.off_m, self._length)
        yield "Allowed", "IfcLengthMeasure", self._in(self._results.allowed_m, self._length)
        if found is not None:
            yield "SeenShare", "IfcReal", found.coverage
        if found is not None and (deviation := found.deviation) is not None:
            for name, value in (
                ("Mean", deviation.mean_m), ("Rms", deviation.rms_m), ("P95", deviation.p95_m),
                ("Worst", deviation.worst_m),
            ):  # fmt: skip
                yield f"Deviation{name}", "IfcLengthMeasure", self._in(value, self._length)
        yield MOVED, "IfcBoolean", moved
        yield "Inspected", "IfcDateTime" if self._dates else "IfcLabel", self._results.made
        yield "Scans", "IfcText", self._scans
        yield "Software", "IfcLabel", f"scanfind {self._results.scanfind}"

    def _in(self, value: float | None, unit: float) -> float | None:
        return None if value is None else value / unit

    def _new_id(self, element: ElementEntry, what: str) -> str:
        from ifcopenshell.guid import compress

        return str(compress(uuid5(SPACE, f"{self._results.made} {element.global_id} {what}").hex))

    def _forget(self, product: Any) -> None:
        """Take away what an earlier run said of a product."""
        for relation in _descriptions(product):
            described = relation.RelatingPropertyDefinition
            if len(relation.RelatedObjects) > 1:
                relation.RelatedObjects = [each for each in relation.RelatedObjects if each.id() != product.id()]
                continue
            properties = described.HasProperties
            for each in (relation, described, *properties):
                self._file.remove(each)


def _along(product: Any) -> Iterator[Any]:
    """What goes where a product goes: its openings and projections, its ports, and of an assembly its parts."""
    features = [each.RelatedOpeningElement for each in getattr(product, "HasOpenings", ())]
    features += [each.RelatedFeatureElement for each in getattr(product, "HasProjections", ())]
    ports = [each.RelatingPort for each in getattr(product, "HasPorts", ())]
    ports += [
        each for nest in getattr(product, "IsNestedBy", ()) for each in nest.RelatedObjects if each.is_a("IfcPort")
    ]
    yield from (*features, *ports)
    if not product.Representation:
        for part in members(product):
            yield part
            yield from _along(part)


def _is_local(placement: Any) -> bool:
    """Is a placement, with all it hangs on, one of axes in axes? None (the file's own axes) is."""
    seen = set()
    while placement is not None:
        if not placement.is_a("IfcLocalPlacement") or placement.id() in seen:
            return False
        seen.add(placement.id())
        placement = placement.PlacementRelTo
    return True


def _descriptions(product: Any) -> list[Any]:
    """The relations that give a product our property set."""
    return [
        each for each in product.IsDefinedBy
        if each.is_a("IfcRelDefinesByProperties") and each.RelatingPropertyDefinition.is_a("IfcPropertySet")
        and each.RelatingPropertyDefinition.Name == PROPERTY_SET
    ]  # fmt: skip


def _was_moved(product: Any) -> bool:
    properties: Sequence[Any] = [p for r in _descriptions(product) for p in r.RelatingPropertyDefinition.HasProperties]
    return any(each.Name == MOVED and each.NominalValue.wrappedValue for each in properties)


@contextmanager
def _in_words(design: Path) -> Iterator[None]:
    """Whatever ifcopenshell throws at a damaged file, in one line."""
    try:
        yield
    except (ScanfindError, OSError):
        raise
    except Exception as error:
        msg = f"{design} cannot be read as the IFC file it was: {one_line(error)}: export it again"
        raise UnreadableFileError(msg) from error
