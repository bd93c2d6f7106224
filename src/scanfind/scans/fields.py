"""Twenty names for one thing: what the columns of PLY, PCD and text files are called here, and back.

A column keeps its own name unless it is one of KNOWN_ATTRIBUTES in another spelling. CloudCompare's prefix `scalar_`
is taken off when reading and, in PLY, put on when writing: `scalar_Intensity` and `intensity` are the same field.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import KNOWN_ATTRIBUTES

COLOURS = ("red", "green", "blue")
NORMALS = ("normal_x", "normal_y", "normal_z")
# Colours of 16 bits are stored exactly under these names, beside a preview of 8 bits that viewers understand.
EXACT_COLOURS = tuple(f"{colour}_16bit" for colour in COLOURS)

# Spelled small, without _ and spaces.
SPELLINGS = {name.replace("_", ""): name for name in KNOWN_ATTRIBUTES} | {
    "nx": "normal_x", "ny": "normal_y", "nz": "normal_z",
    "r": "red", "g": "green", "b": "blue",
    "diffusered": "red", "diffusegreen": "green", "diffuseblue": "blue",
    "i": "intensity", "class": "classification", "col": "column",
}  # fmt: skip


def attribute_name(name: str) -> str:
    """What a column called `name` is called here; units in brackets go: `Intensity [DN]` is `intensity`."""
    own = name.removeprefix("scalar_") or name
    spelled = re.sub(r"[\[(].*|[_\s]", "", own).lower()
    return SPELLINGS.get(spelled, own)


def axes(names: Sequence[str]) -> tuple[int, int, int] | None:
    """The columns of x, y and z, in either case, with or without a unit; None if one is missing."""
    spelled = [re.sub(r"[\[(].*", "", name).strip().lower() for name in names]
    if not {"x", "y", "z"} <= set(spelled):
        return None
    return spelled.index("x"), spelled.index("y"), spelled.index("z")


def attribute_columns(names: Sequence[str]) -> dict[int, str]:
    """Column → attribute name, each name once, for all columns but the coordinates.

    A preview of colours that are stored exactly beside it is left out.
    """
    wanted = {k: attribute_name(name) for k, name in enumerate(names) if k not in (axes(names) or ())}
    if set(EXACT_COLOURS) <= set(wanted.values()):
        exact = dict(zip(EXACT_COLOURS, COLOURS, strict=True))
        wanted = {k: exact.get(name, name) for k, name in wanted.items() if name not in COLOURS}
    columns: dict[int, str] = {}
    for k, name in wanted.items():
        columns[k] = unused(name or f"field_{k + 1}", {"x", "y", "z", *columns.values()})
    return columns


def header_words(names: Iterable[str]) -> list[str]:
    """The names as single ASCII words, each once: what a PLY or PCD header can hold."""
    words: list[str] = []
    for name in names:
        word = re.sub(r"[^A-Za-z0-9_.+-]", "_", name)
        # In PCD, _ is padding and rgb the packed colours.
        words.append(unused(word if word.strip("_") else "field", {"x", "y", "z", "rgb", "rgba", *words}))
    return words


def unused(name: str, taken: Collection[str]) -> str:
    """`name`, or the first of name_2, name_3, ... that is not taken."""
    tried, number = name, 1
    while tried in taken:
        number += 1
        tried = f"{name}_{number}"
    return tried


def has_colours(fields: Mapping[str, np.dtype[Any]]) -> bool:
    """Whether red, green and blue are there, in 8 or 16 bits, so that viewers can be given something."""
    return all(fields.get(colour) in (np.uint8, np.uint16) for colour in COLOURS)


def beyond_8_bits(columns: Mapping[str, NDArray[Any]]) -> bool:
    """Whether colours of 16 bits use more than 8 of them: many a LAS file does not."""
    return any(columns[c].dtype == np.uint16 and columns[c].max() > 255 for c in COLOURS if c in columns)


def preview(colour: NDArray[Any], *, scaled: bool) -> NDArray[np.uint8]:
    """A colour of 16 bits (N,) in 8: its upper half if `scaled`, else cut off at 255."""
    eight: NDArray[np.uint8] = (colour >> 8 if scaled else np.minimum(colour, 255)).astype(np.uint8)
    return eight
