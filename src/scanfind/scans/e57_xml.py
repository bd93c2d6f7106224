"""The XML section of an E57 file, looked over before libE57 builds its tree.

libE57 takes time quadratic in the depth of the tree and in the children of a structure: 200 thousand nested elements,
4 MB of XML, kept it busy for more than two minutes with no way to interrupt it.
"""

from __future__ import annotations

import struct
from pathlib import Path
from xml.parsers import expat

from scanfind.errors import UnreadableFileError

# Real files nest about ten deep; a structure has tens of children. Vectors (scans, images) are long, and linear.
DEEPEST, MOST_CHILDREN = 64, 1000
# Each page ends with its checksum, which is no part of the text.
PAGE_BYTES, PAYLOAD_BYTES = 1024, 1020


def check_xml(path: Path) -> None:
    """Raise UnreadableFileError where the file is not E57, is cut short, or its XML would keep libE57 busy for ever."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(48)
        if len(head) < 48 or head[:8] != b"ASTM-E57":
            msg = f"{path.name} is not an E57 file: it does not begin with ASTM-E57"
            raise UnreadableFileError(msg)
        whole, start, length, page = struct.unpack_from("<4Q", head, 16)
        if whole > size:
            msg = f"{path.name} is cut short: its header promises {whole:,} bytes, {size:,} are there"
            raise UnreadableFileError(msg)
        if page != PAGE_BYTES or start + length > size:
            msg = f"{path.name} is damaged: XML of {length:,} bytes at byte {start:,} of {size:,}, pages of {page:,}"
            raise UnreadableFileError(msg)
        within = start % PAGE_BYTES
        file.seek(start - within)
        pages = file.read(((within + length) // PAYLOAD_BYTES + 1) * PAGE_BYTES)
    text = b"".join(pages[at : at + PAYLOAD_BYTES] for at in range(0, len(pages), PAGE_BYTES))
    _check_shape(text[within : within + length], path.name)


def _check_shape(text: bytes, name: str) -> None:
    parser = expat.ParserCreate()
    children = [0]
    is_vector = [False]

    def enter(_: str, attributes: dict[str, str]) -> None:
        children[-1] += 1
        if len(children) > DEEPEST or (children[-1] > MOST_CHILDREN and not is_vector[-1]):
            msg = f"{name} is damaged: its XML is nested {DEEPEST} deep, or a structure has {MOST_CHILDREN} children"
            raise UnreadableFileError(msg)
        children.append(0)
        is_vector.append(attributes.get("type") == "Vector")

    def leave(_: str) -> None:
        children.pop()
        is_vector.pop()

    parser.StartElementHandler = enter
    parser.EndElementHandler = leave
    try:
        parser.Parse(text, True)
    except (expat.ExpatError, LookupError) as error:  # of an unknown encoding
        msg = f"{name} is damaged: its XML is not well formed ({error})"
        raise UnreadableFileError(msg) from error
