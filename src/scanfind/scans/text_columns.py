"""What the columns of a text file are: named by a header, by the format, or told from the numbers themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UnreadableFileError
from scanfind.scans.fields import COLOURS, NORMALS, attribute_columns, axes
from scanfind.scans.records import fits
from scanfind.scans.rows import Layout, Rows, excerpt, is_number, layout_of, parse, split

# PTX and PTS: columns → names behind x y z.
CYCLONE: Mapping[int, tuple[str, ...]] = {3: (), 4: ("intensity",), 6: COLOURS, 7: ("intensity", *COLOURS)}
# What holds whole numbers gets the first of these types that holds the first rows; all else is float64.
WHOLE: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(COLOURS, ("u1", "u2")),
    **dict.fromkeys(("classification", "return_number", "number_of_returns"), ("u1",)),
    **dict.fromkeys(("row", "column"), ("u4",)),
}
# A normal written with two decimals is this far from unit length.
UNIT_TOLERANCE = 0.01


class TextColumns(NamedTuple):
    """How rows are divided, which columns are x y z, and name → column and type of the others."""

    layout: Layout
    xyz: tuple[int, int, int]
    attributes: dict[str, tuple[int, np.dtype[Any]]]


def columns_of(
    sample: Rows, name: str, header: Sequence[str] | None = None, *, is_cyclone: bool = False
) -> TextColumns:
    """The columns of a file whose first rows are `sample`.

    header : the names that its header gives; None where it has none
    is_cyclone : the rows of PTX and PTS, whose columns are fixed
    Raises UnreadableFileError where there are fewer than three, or a row is not one of numbers.
    """
    layout = layout_of(sample.text)
    if header is not None:
        layout = layout._replace(columns=len(header))
    if layout.columns < 3:
        line = excerpt(sample.text.split(b"\n", 1)[0].decode("utf-8", "replace"))
        msg = f"{name}: line {sample.line} has {layout.columns} columns, a point has three or more: {line}"
        raise UnreadableFileError(msg)
    table = parse(sample, layout, name)
    if header is None and is_cyclone and layout.columns in CYCLONE:
        header = ("x", "y", "z", *CYCLONE[layout.columns])
    names = guessed_names(table) if header is None else header
    xyz = axes(names)
    if xyz is None:
        msg = f"{name}: its header names no x, y and z, only {', '.join(names)[:80]}"
        raise UnreadableFileError(msg)
    attributes = {attribute: (k, _dtype(attribute, table[k])) for k, attribute in attribute_columns(names).items()}
    return TextColumns(layout, xyz, attributes)


def header_names(line: str) -> list[str] | None:
    """The names in a header line, comment signs apart; None for a row of numbers."""
    line = line.strip().lstrip("#/").strip()
    layout = layout_of(line.encode())
    if all(is_number(cell.replace(layout.decimal, ".")) for cell in split(line, layout.separator)):
        return None
    # Names may have spaces in them where tabs divide.
    return split(line, next((mark for mark in ";,\t" if mark in line), ""))


def guessed_names(table: Sequence[NDArray[Any]]) -> list[str]:
    """Names for columns (N,) without a header: x y z, then what the numbers look like.

    Three whole numbers of 0 to 255 are colours, three of unit length a normal. A single column behind x y z is the
    intensity, and so is one just before or after colours, unless it is 255 throughout, which is an opacity. The rest is
    field_4, field_5 and so on: a header removes all doubt.
    """
    names = ["x", "y", "z"]
    while (k := len(names)) < len(table):
        ahead, beyond = table[k : k + 3], table[k + 1 : k + 4]
        opacity = len(table) > k + 3 and bool((table[k + 3] == 255).all())
        if "red" not in names and _are_colours(ahead) and (opacity or not _are_colours(beyond)):
            names += COLOURS
        elif "normal_x" not in names and _are_normals(ahead):
            names += NORMALS
        elif "intensity" not in names and _is_intensity(table, names, before_colours=_are_colours(beyond)):
            names.append("intensity")
        else:
            names.append(f"field_{k + 1}")
    return names


def _is_intensity(table: Sequence[NDArray[Any]], names: Sequence[str], *, before_colours: bool) -> bool:
    if len(names) == 3:
        return before_colours or len(table) == 4
    return names[-1] == "blue" and not (table[len(names)] == 255).all()


def _are_colours(columns: Sequence[NDArray[Any]]) -> bool:
    # Beyond 1, because labels are whole numbers too.
    return (
        len(columns) == 3
        and all(fits(column, np.dtype(np.uint8)) for column in columns)
        and any(bool((column > 1).any()) for column in columns)
    )


def _are_normals(columns: Sequence[NDArray[Any]]) -> bool:
    if len(columns) != 3 or not len(columns[0]):
        return False
    with np.errstate(all="ignore"):
        length = np.sqrt(sum(column**2 for column in columns))
    return bool((np.abs(length - 1.0) < UNIT_TOLERANCE).all())


def _dtype(attribute: str, values: NDArray[Any]) -> np.dtype[Any]:
    types = (np.dtype(kind) for kind in WHOLE.get(attribute, ()))
    return next((dtype for dtype in types if fits(values, dtype)), np.dtype(np.float64))
