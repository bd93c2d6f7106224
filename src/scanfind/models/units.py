"""Length units of files that state none, and a word where a size is hard to believe."""

from __future__ import annotations

from collections.abc import Mapping

from scanfind.errors import UsageError

# Metres in one unit, by the names `--units` takes.
UNITS: Mapping[str, float] = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048}

# Valves to buildings; beyond lie the spool of 3.5 m read as 3,500 m and the one of 3.5 mm.
SMALLEST_M, LARGEST_M = 0.005, 200.0
# What a hint may propose: pipe spools measure 0.1 to 30 m, small fittings and long beams a little beyond.
LIKELY_M = (0.05, 50.0)


def metres_per(unit: str | None) -> float:
    """Metres in one `unit`; 1 where none is named. Raises UsageError for a unit scanfind does not know."""
    if unit is None:
        return 1.0
    if unit not in UNITS:
        msg = f"units must be one of {', '.join(UNITS)}, got {unit!r}"
        raise UsageError(msg)
    return UNITS[unit]


def size_hint(diameter_m: float, scale: float, *, stated: bool) -> str | None:
    """A question about the units of a model whose diameter, metres, is implausible; None where it is plausible.

    scale : metres in one of the file's units, as it was read
    stated : the format states its units, so that `--units` is no remedy
    """
    if SMALLEST_M <= diameter_m <= LARGEST_M:
        return None
    size = f"the model is {_spelled(diameter_m)} across"
    if stated:
        return f"{size}, by the units its file states: was it exported in the right ones?"
    raw = diameter_m / scale
    low, high = LIKELY_M
    # Millimetres first: they are what fabricators draw in.
    likely = next((unit for unit, metres in UNITS.items() if low <= raw * metres <= high), None)
    if likely is None or UNITS[likely] == scale:
        return f"{size}: what are its units? (--units {'|'.join(UNITS)})"
    return f"{size}: are its units {likely}? (--units {likely})"


def _spelled(metres: float) -> str:
    return f"{metres:,.0f} m" if metres >= 1 else f"{metres * 1e3:.3g} mm"
