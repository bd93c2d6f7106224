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
    """The products with a representation that `select` means, in the file's order; all built ones where it is empty.

    A selector that is a class of the schema means its products and those of its subclasses; any other is a GlobalId, or
    the name of a product or of its type, with * and ?, in capitals or not. Raises UsageError where one means nothing.
    """
    schema = _Schema(file)
    products = sorted(
        (product for product in file.by_type("IfcProduct") if product.Representation), key=lambda product: product.id()
    )
    if not select:
        return [product for product in products if not schema.lineage(product) & NOT_BUILT]
    chosen = {}
    for selector in select:
        found = _selected(products, selector, schema)
        if not found:
            counts = Counter(product.is_a() for product in products).most_common()
            has = ", ".join(f"{kind} {count}" for kind, count in counts) or "nothing with a shape"
            msg = (
                f"nothing in {path} matches {selector!r}; it has {has}: select a class, a name (* and ?) or a GlobalId"
            )
            raise UsageError(msg)
        chosen.update({product.id(): product for product in found})
    return [chosen[number] for number in sorted(chosen)]


def type_name(product: Any) -> str:
    """The name of the product's type, "" where it has none."""
    # `IsTypedBy` since IFC4; IFC2X3 keeps types among all the other definitions.
    for relation in (*getattr(product, "IsTypedBy", ()), *getattr(product, "IsDefinedBy", ())):
        if relation.is_a("IfcRelDefinesByType"):
            return relation.RelatingType.Name or ""
    return ""


def _selected(products: Sequence[Any], selector: str, schema: _Schema) -> list[Any]:
    kind = schema.class_named(selector)
    if kind is not None:
        # IfcElement also is the class of holes: they are meant only where the selector is a kind of them.
        skip = NOT_BUILT if not schema.ancestors(kind) & NOT_BUILT else frozenset()
        return [p for p in products if kind in (lineage := schema.lineage(p)) and not lineage & skip]
    pattern = selector.lower()
    return [
        p for p in products
        if p.GlobalId == selector or any(fnmatchcase(name.lower(), pattern) for name in (p.Name or "", type_name(p)))
    ]  # fmt: skip


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
