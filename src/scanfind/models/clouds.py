"""A piece of scan as a model: "find more of this"."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanfind.cloud import CloudModel
from scanfind.errors import UnreadableFileError
from scanfind.mesh import Floats
from scanfind.models.wanted import Wanted

# A piece that shows one object has thousands of points; a whole scan given by mistake would fill the memory.
MOST_POINTS = 50_000_000
# Stations nearer to each other than this are one, written with few decimals.
SAME_STATION_M = 1e-3


def read(path: Path, wanted: Wanted, *, most_points: int = MOST_POINTS) -> list[CloudModel]:
    """All valid points of a scan file as one model.

    Its origin is the file's, if all its scans agree on one, else the one asked for: points of several scanners have no
    common side to look from. Raises UnreadableFileError where it has no points, or more than a model may have.
    """
    from scanfind.scans import read_scan

    pieces, origins, points = [], [], 0
    for chunk in read_scan(path):
        points += len(chunk)
        if points > most_points:
            msg = f"{path} has more than {most_points:,} points: cut the object out of it, and give that as the model"
            raise UnreadableFileError(msg)
        pieces.append(chunk.xyz * wanted.scale)
        if len(chunk):
            origins.append(None if chunk.origin is None else chunk.origin * wanted.scale)
    if not points:
        msg = f"{path} has neither triangles nor points: nothing to look for"
        raise UnreadableFileError(msg)
    return [CloudModel(path.stem, np.concatenate(pieces), str(path), _common(origins, wanted.origin))]


def _common(origins: list[Floats | None], asked: Floats | None) -> Floats | None:
    first = origins[0]
    if first is None:
        return asked if all(origin is None for origin in origins) else None
    agree = all(origin is not None and np.abs(origin - first).max() < SAME_STATION_M for origin in origins)
    return first if agree else None
