"""Which products of an IFC file are meant."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

from scanfind.errors import UsageError

# Products that are no built thing: rooms and storeys, holes, drawing aids, analysis models. Taken only if asked for.
NOT_BUILT = frozenset({
    "IfcSpatialElement", "IfcSpatialStructureElement", "IfcFeatureElement", "IfcVirtualElement", "IfcAnnotation",
    "IfcGrid", "IfcPort", "IfcPositioningElement", "IfcLinearElement", "IfcStructuralActivity", "IfcStructuralItem",
})  # fmt: skip


def choose(file: Any, select: Sequence[str], path: str) -> list[Any]:
    """The products that `select` means, in the file's order; all built ones with a shape where it is empty.

    A selector that is a class of the schema means its products and those of its subclasses; any other is a GlobalId, or
    the name of a product or of its type, with * and ?, in capitals or not. It may also mean a whole that only its parts
    give a shape, such as an assembly; by class, if the parts are not of that class themselves. Raises UsageError for a
    selector that means nothing.
    """
    schema = _Schema(file)
    products = sorted(file.by_type("IfcProduct"), key=lambda product: product.id())
    shaped = [product for product in products if product.Representation]
    if not select:
        return [product for product in shaped if schema.is_built(product)]
    chosen = {}
    for selector in select:
        found = _selected(products, selector, schema)
        if not found:
            counts = Counter(product.is_a() for product in shaped).most_common()
            has = ", ".join(f"{kind} {count}" for kind, count in counts) or "nothing with a shape"
            msg = (
                f"nothing in {path} matches {selector!r}; it has {has}: select a class, a name (* and ?) or a GlobalId"
            )
            raise UsageError(msg)
        chosen.update({product.id(): product for product in found})
    return [chosen[number] for number in sorted(chosen)]


def members(product: Any) -> list[Any]:
    """The product itself if it has a shape, else those of its parts, and theirs, that have one."""
    found, open_, seen = [], [product], set()
    while open_:
        each = open_.pop()
        # A damaged file may make a thing a part of itself.
        if each.id() in seen:
            continue
        seen.add(each.id())
        if each.Representation:
            found.append(each)
        else:
            parts = (part for relation in each.IsDecomposedBy for part in relation.RelatedObjects)
            open_ += [part for part in parts if part.is_a("IfcProduct")]
    return sorted(found, key=lambda member: member.id())


def type_name(product: Any) -> str:
    """The name of the product's type, "" where it has none."""
    # `IsTypedBy` since IFC4; IFC2X3 keeps types among all the other definitions.
    for relation in (*getattr(product, "IsTypedBy", ()), *getattr(product, "IsDefinedBy", ())):
        if relation.is_a("IfcRelDefinesByType"):
            return relation.RelatingType.Name or ""
    return ""


def _selected(products: Sequence[Any], selector: str, schema: _Schema) -> list[Any]:
    kind = schema.class_named(selector)
    if kind is None:
        pattern = selector.lower()
        meant = [
            product for product in products
            if product.GlobalId == selector
            or any(fnmatchcase(name.lower(), pattern) for name in (product.Name or "", type_name(product)))
        ]  # fmt: skip
        return [product for product in meant if _has_shape(product, schema)]
    # IfcElement is the class of holes, too: they are meant only where the selector is a kind of them.
    holes_too = bool(schema.ancestors(kind) & NOT_BUILT)
    meant = [p for p in products if kind in schema.lineage(p) and (holes_too or schema.is_built(p))]
    return [
        product for product in meant
        if product.Representation
        or (_has_shape(product, schema) and not any(kind in schema.lineage(part) for part in members(product)))
    ]  # fmt: skip


def _has_shape(product: Any, schema: _Schema) -> bool:
    """Whether it has a shape, or is an element whose parts have one; a storey is not the sum of what stands in it."""
    return bool(product.Representation) or (schema.is_built(product) and bool(members(product)))


class _Schema:
    """The classes of the file's schema, by name, with all they descend from."""

    def __init__(self, file: Any) -> None:
        from ifcopenshell import ifcopenshell_wrapper

        declarations = ifcopenshell_wrapper.schema_by_name(file.schema_identifier).entities()
        self._classes = {declaration.name(): declaration for declaration in declarations}
        self._by_lower = {name.lower(): name for name in self._classes}
        self._ancestors: dict[str, frozenset[str]] = {}

    def class_named(self, word: str) -> str | None:
        return self._by_lower.get(word.lower())

    def ancestors(self, kind: str) -> frozenset[str]:
        """The class itself and every class above it."""
        if kind not in self._ancestors:
            above = self._classes[kind].supertype()
            self._ancestors[kind] = frozenset({kind}) | (self.ancestors(above.name()) if above else frozenset())
        return self._ancestors[kind]

    def lineage(self, product: Any) -> frozenset[str]:
        return self.ancestors(product.is_a())

    def is_built(self, product: Any) -> bool:
        return not self.lineage(product) & NOT_BUILT
