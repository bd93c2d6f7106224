"""Tolerance profiles: which limits hold for which elements, as a TOML file says it.

A profile is a list of rules. Each names elements by glob patterns and gives limits; all rules that fit an element hold,
and of two that give the same limit the later one. Lengths are in millimetres and angles in degrees, as their names
say: these files are written by people, from standards that are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib import resources
from math import inf, isfinite, radians
from os import PathLike
from pathlib import Path
from typing import Any

from scanfind.config import did_you_mean, read_toml
from scanfind.errors import UsageError

# What can be limited, and one of its unit in metres or radians; `scanfind.tolerances.judge` says how each is measured.
UNITS: Mapping[str, float] = {
    "shift_mm": 1e-3,
    "off_mm": 1e-3,
    "turn_deg": radians(1.0),
    "roll_mm": 1e-3,
    "tilt_mm": 1e-3,
    "surface_p95_mm": 1e-3,
    "surface_mean_mm": 1e-3,
    "linear_mm": 1e-3,
    "radius_mm": 1e-3,
    "face_mm": 1e-3,
    "place_mm": 1e-3,
    "angle_deg": radians(1.0),
}
PATTERNS = ("class", "type", "name", "part", "dimension")
OF_PARTS = ("shift_mm", "off_mm", "turn_deg", "roll_mm", "tilt_mm")
OF_DIMENSIONS = ("linear_mm", "radius_mm", "face_mm", "place_mm", "angle_deg")
OF_WHOLES = ("shift_mm", "off_mm", "turn_deg", "surface_p95_mm", "surface_mean_mm", *OF_DIMENSIONS)
PRESETS = ("pipe-spools", "structural-steel", "fabricated-steel")


@dataclass(frozen=True)
class Limit:
    """How much is allowed, metres or radians, and which document says so."""

    value: float
    source: str = ""


@dataclass(frozen=True)
class Rule:
    """Limits of the elements that all patterns fit.

    patterns : of PATTERNS → glob patterns of which one must fit; without `part` the rule is of wholes, and without
        `dimension` of all their dimensions
    limits : key of UNITS → limit
    """

    patterns: Mapping[str, tuple[str, ...]]
    limits: Mapping[str, Limit]

    def fits(self, words: Mapping[str, str]) -> bool:
        """Is something with these words (of PATTERNS) one the rule is about? Capitals do not count."""
        if ("part" in self.patterns) != ("part" in words):
            return False
        return all(
            any(fnmatchcase(words.get(kind, "").lower(), pattern.lower()) for pattern in patterns)
            for kind, patterns in self.patterns.items()
        )


@dataclass(frozen=True)
class Profile:
    """A list of rules under a title."""

    title: str
    rules: tuple[Rule, ...] = field(default=())

    def limits(self, **words: str) -> dict[str, Limit]:
        """The limits of what goes by these words: class, type, name, and part or dimension where it is one."""
        found: dict[str, Limit] = {}
        for rule in self.rules:
            if rule.fits(words):
                found |= rule.limits
        return found

    def tables(self) -> dict[str, Any]:
        """What a TOML file of this profile says; `profile_of` makes it back."""
        rules = [
            {kind: list(patterns) for kind, patterns in rule.patterns.items()}
            | {key: {"limit": each.value / UNITS[key], "source": each.source} for key, each in rule.limits.items()}
            for rule in self.rules
        ]
        return {"title": self.title, "rule": rules}


def profile_allowing(what: float | str | PathLike[str] | Profile) -> Profile:
    """What may be said of how far elements may be off: a length in metres, a preset's name, a TOML file, a profile.

    Raises UsageError for a length that is none, and as `load_profile` does.
    """
    if isinstance(what, Profile):
        return what
    try:
        metres = float(what)  # type: ignore[arg-type]  # a path is no number
    except (TypeError, ValueError):
        return load_profile(Path(what))  # type: ignore[arg-type]
    if not 0.0 < metres < inf:
        msg = f"allowed: a length above 0, in metres, or a tolerance profile, got {what}"
        raise UsageError(msg)
    return allowed_off(metres)


def allowed_off(metres: float) -> Profile:
    """The profile of a mere length: no point of an element is farther from its place."""
    return Profile(
        f"No point off by more than {1e3 * metres:g} mm", (Rule({}, {"off_mm": Limit(metres, "--allowed")}),)
    )


def load_profile(name: str | Path) -> Profile:
    """A profile from a TOML file, or one of PRESETS by its name.

    Raises UsageError, in one line with the place, for a file that cannot be read or says what no profile says.
    """
    if str(name) in PRESETS:
        with resources.as_file(resources.files("scanfind.tolerances") / f"{name}.toml") as path:
            return profile_of(read_toml(path), str(name))
    path = Path(name)
    if not path.suffix and not path.exists():
        msg = f"{name}: neither a TOML file nor a tolerance profile of scanfind: {did_you_mean(str(name), PRESETS)}"
        raise UsageError(msg)
    return profile_of(read_toml(path), str(name))


def profile_of(tables: Mapping[str, Any], where: str) -> Profile:
    """The profile that a TOML file's tables say; `where` is how an error calls the file."""
    _known(tables, ("title", "rule"), where, "")
    rules = tables.get("rule")
    if not isinstance(rules, list) or not rules or not all(isinstance(rule, dict) for rule in rules):
        msg = f"{where}: a tolerance profile has rules: write [[rule]] above each"
        raise UsageError(msg)
    title = tables.get("title", Path(where).stem)
    if not isinstance(title, str):
        msg = f"{where}: title: must be text, got {title!r}"
        raise UsageError(msg)
    return Profile(title, tuple(_rule(rule, where, number) for number, rule in enumerate(rules, 1)))


def _rule(table: Mapping[str, Any], where: str, number: int) -> Rule:
    at = f"rule {number}: "
    _known(table, (*PATTERNS, *UNITS), where, at)
    patterns = {kind: _patterns(table[kind], where, f"{at}{kind}") for kind in PATTERNS if kind in table}
    allowed = OF_PARTS if "part" in patterns else OF_DIMENSIONS if "dimension" in patterns else OF_WHOLES
    limits = {}
    for key in UNITS:
        if key not in table:
            continue
        if key not in allowed:
            what = "parts, name them with `part`" if key in OF_PARTS else "whole elements, leave out `part`"
            what = "dimensions, leave out `part`" if key in OF_DIMENSIONS else what
            msg = f"{where}: {at}{key} is a limit of {what}"
            raise UsageError(msg)
        limits[key] = _limit(table[key], UNITS[key], where, f"{at}{key}")
    if not limits:
        msg = f"{where}: {at}has no limit: give one of {', '.join(allowed)}"
        raise UsageError(msg)
    return Rule(patterns, limits)


def _patterns(value: object, where: str, name: str) -> tuple[str, ...]:
    patterns = value if isinstance(value, list) else [value]
    if not patterns or not all(isinstance(pattern, str) and pattern for pattern in patterns):
        msg = f"{where}: {name}: must be a pattern such as 'Ifc*', or a list of them, got {value!r}"
        raise UsageError(msg)
    return tuple(patterns)


def _limit(value: object, unit: float, where: str, name: str) -> Limit:
    table = value if isinstance(value, dict) else {"limit": value}
    _known(table, ("limit", "source"), where, f"{name}: ")
    limit, source = table.get("limit"), table.get("source", "")
    if isinstance(limit, bool) or not isinstance(limit, (int, float)) or not (isfinite(limit) and limit > 0):
        msg = f"{where}: {name}: must be a number above 0, got {limit!r}"
        raise UsageError(msg)
    if not isinstance(source, str):
        msg = f"{where}: {name}: source: must be text, got {source!r}"
        raise UsageError(msg)
    return Limit(limit * unit, source)


def _known(table: Mapping[str, Any], keys: Iterable[str], where: str, at: str) -> None:
    known = list(keys)
    for key in table:
        if key not in known:
            msg = f"{where}: {at}unknown key {key!r}: {did_you_mean(key, known)}"
            raise UsageError(msg)
