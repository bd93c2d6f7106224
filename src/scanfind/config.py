"""Settings from flags, environment, a TOML file and presets, merged into frozen dataclasses.

Precedence: a flag beats an environment variable (SCANFIND_…), which beats the TOML file, which beats the preset.
Nothing here knows a parameter by name: a field added to a stage's dataclass is at once a TOML key and a variable.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from math import isnan
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pydantic import Field, TypeAdapter, ValidationError

from scanfind.errors import InvalidGeometryError, UsageError

T = TypeVar("T")

ENV_PREFIX = "SCANFIND_"
# Variables of this name that are not settings of a run.
ENV_RESERVED = ("SCANFIND_DEBUG", "SCANFIND_DATA")


@dataclass(frozen=True)
class Run:
    """What a run needs to know besides its files and the method's parameters.

    units : of model files whose format has none; None means metres
    origin : where the scanner stood, scan frame, metres, for scans whose file does not say
    select : which models of an IFC file: class, name or GlobalId; empty means all
    jobs : threads; None means one a core
    """

    preset: str = "default"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    jobs: Annotated[int, Field(ge=1)] | None = None
    units: Literal["mm", "cm", "m", "in", "ft"] | None = None
    origin: tuple[float, float, float] | None = None
    select: tuple[str, ...] = ()
    format: Literal["ply", "laz", "las", "e57", "pcd"] = "ply"


@dataclass(frozen=True)
class Layer:
    """Settings from one place: nested tables of values, and how an error should call the place."""

    where: str
    values: Mapping[str, Any]


def load_settings(
    presets: Mapping[str, T],
    flags: Mapping[str, object],
    config: Path | None = None,
    environ: Mapping[str, str] = os.environ,
) -> tuple[Run, T]:
    """The run and the method's parameters, a preset overlaid with TOML, environment and flags.

        presets : name → parameters, a frozen dataclass of frozen dataclasses, one a stage
        flags : dotted key → value, such as {"search.max_instances": 3}; a None was not given
        config : a TOML file: keys of `Run` at its top, one [table] a stage

    Raises UsageError naming the place and the key, with the nearest known one where the key is unknown.
    """
    sample = presets["default"]
    known = [field.name for field in fields(Run)] + leaf_keys(sample)
    layers = [] if config is None else [Layer(str(config), read_toml(config))]
    layers += environment_layers(environ, known)
    layers += [Layer(flag_name(key), nested(key, value)) for key, value in flags.items() if value is not None]

    run_keys = {field.name for field in fields(Run)}
    run = resolve(Run(), [pick(layer, run_keys) for layer in layers])
    if run.preset not in presets:
        msg = f"preset: there is no preset {run.preset!r}: {did_you_mean(run.preset, list(presets))}"
        raise UsageError(msg)
    rest = [Layer(x.where, {key: value for key, value in x.values.items() if key not in run_keys}) for x in layers]
    return run, resolve(presets[run.preset], rest, known)


def resolve(base: T, layers: Sequence[Layer], known: Sequence[str] = ()) -> T:
    """`base`, a (nested) frozen dataclass, overlaid with the layers, the last one winning.

        known : further dotted keys to suggest where one is unknown

    Raises UsageError for an unknown key, or a value of the wrong type or out of range.
    """
    for layer in layers:
        base = _overlay(base, layer.values, layer.where, "", known or leaf_keys(base))
    return base


def leaf_keys(node: object, prefix: str = "") -> list[str]:
    """The dotted names of all settings in a nested dataclass."""
    if not is_dataclass(node):
        return [prefix.removesuffix(".")]
    return [key for f in fields(node) for key in leaf_keys(getattr(node, f.name), f"{prefix}{f.name}.")]


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file's tables; raises UsageError where it is missing or is not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        msg = f"{path}: cannot be read as a TOML settings file: {why}"
        raise UsageError(msg) from error


def environment_layers(environ: Mapping[str, str], known: Sequence[str]) -> list[Layer]:
    """One layer for each SCANFIND_… variable: SCANFIND_SEARCH_TIME_LIMIT_S=5 sets search.time_limit_s."""
    names = {ENV_PREFIX + key.replace(".", "_").upper(): key for key in known}
    layers = []
    for name in sorted(environ):
        if not name.startswith(ENV_PREFIX) or name in ENV_RESERVED:
            continue
        if name not in names:
            msg = f"{name}: no such setting, unset it: {did_you_mean(name, list(names))}"
            raise UsageError(msg)
        layers.append(Layer(name, nested(names[name], _as_toml(environ[name]))))
    return layers


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """A hint for an unknown word: the nearest known one, or all there is where nothing comes near."""
    # A dotted key is also known by its last part, which is what people remember, and so is its table.
    names = {key.rpartition(".")[2]: key for key in known}
    names |= {table: table for table in (key.partition(".")[0] for key in known)} | {key: key for key in known}
    near = get_close_matches(word, names, n=1, cutoff=0.6)
    if near:
        return f"did you mean {names[near[0]]!r}?"
    return f"use one of {', '.join(sorted(known))}"


def nested(dotted: str, value: object) -> dict[str, Any]:
    """As tables: "search.max_instances", 3 → {"search": {"max_instances": 3}}."""
    stage, _, key = dotted.rpartition(".")
    return {stage: {key: value}} if stage else {key: value}


def flag_name(key: str) -> str:
    """How the command line spells a setting: search.time_limit_s → --time-limit."""
    last = key.rpartition(".")[2]
    return "--" + last.removesuffix("_s").removesuffix("_m").removesuffix("_deg").replace("_", "-")


def pick(layer: Layer, keys: set[str]) -> Layer:
    """The part of a layer that has these keys."""
    return Layer(layer.where, {key: value for key, value in layer.values.items() if key in keys})


def _overlay(node: T, values: Mapping[str, Any], where: str, prefix: str, known: Sequence[str]) -> T:
    hints = get_type_hints(type(node), include_extras=True)
    changes: dict[str, Any] = {}
    for key, value in values.items():
        name = prefix + key
        if key not in hints:
            msg = f"{where}: unknown key {name!r}: {did_you_mean(key, known)}"
            raise UsageError(msg)
        current = getattr(node, key)
        if not is_dataclass(current):
            changes[key] = checked(value, hints[key], where, name)
        elif isinstance(value, Mapping):
            changes[key] = _overlay(current, value, where, f"{name}.", known)
        else:
            msg = f"{where}: {name!r} is a table of settings, got {value!r}: write [{name}] above its keys"
            raise UsageError(msg)
    try:
        return replace(node, **changes)  # type: ignore[type-var]
    except (ValueError, UsageError, InvalidGeometryError) as error:
        msg = f"{where}: {prefix.removesuffix('.') or 'settings'}: {error}"
        raise UsageError(msg) from error


def checked(value: object, hint: Any, where: str, name: str) -> Any:
    """The value as the field's type; UsageError in one line where it is none."""
    if value == "none" and type(None) in get_args(hint):
        return None  # neither TOML nor the environment has a word for it
    if isinstance(value, str) and _is_tuple(hint) and value not in _words(hint):
        value = [part.strip() for part in value.split(",")]
    try:
        checked = TypeAdapter(hint).validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] in ("missing", "too_long") and isinstance(value, Sequence):
            msg = f"{where}: {name}: takes {_length(hint)} values with commas between, got {len(value)}: {value!r}"
            raise UsageError(msg) from error
        at = "".join(f"[{part}]" for part in first["loc"] if isinstance(part, int))
        msg = f"{where}: {name}{at}: {first['msg'][0].lower()}{first['msg'][1:]}, got {value!r}"
        raise UsageError(msg) from error
    if isinstance(checked, float) and isnan(checked):
        msg = f"{where}: {name}: must be a number, got nan"
        raise UsageError(msg)
    return checked


def _is_tuple(hint: Any) -> bool:
    return any(get_origin(kind) is tuple for kind in (hint, *get_args(hint)))


def _words(hint: Any) -> list[Any]:
    """The words a hint knows beside its tuple, as an axis beside a direction in numbers."""
    return [word for kind in (hint, *get_args(hint)) if get_origin(kind) is Literal for word in get_args(kind)]


def _length(hint: Any) -> int:
    """How many parts the tuple has that the hint asks for."""
    return next(len(get_args(kind)) for kind in (hint, *get_args(hint)) if get_origin(kind) is tuple)


def _as_toml(text: str) -> object:
    """A variable's text as TOML would read it (numbers, true, [lists]); else the text itself."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
