"""What the caller asked of a model file."""

from __future__ import annotations

from dataclasses import dataclass

from scanfind.mesh import Floats


@dataclass(frozen=True, eq=False)
class Wanted:
    """What every reader is told.

    scale : metres in one of the file's units; readers of formats that state their units do not look at it
    select : which elements of an IFC file: class, name with * and ?, or GlobalId; empty means all
    origin : (3,) where the scanner of a piece of scan stood, metres, if its file does not say
    """

    scale: float = 1.0
    select: tuple[str, ...] = ()
    origin: Floats | None = None
