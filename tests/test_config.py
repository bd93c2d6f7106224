"""Settings: who wins over whom, and what a wrong one says."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import pytest
from pydantic import Field

from scanfind.config import flag_name, leaf_keys, load_settings
from scanfind.errors import UsageError


@dataclass(frozen=True)
class Search:
    time_limit_s: Annotated[float, Field(gt=0)] = 20.0
    max_instances: int | None = None


@dataclass(frozen=True)
class Pairs:
    distances: tuple[float, ...] = (0.75, 0.4)
    signed: bool = True

    def __post_init__(self) -> None:
        if not self.distances:
            msg = "at least one pair distance is needed"
            raise UsageError(msg)


@dataclass(frozen=True)
class Parameters:
    search: Search = field(default_factory=Search)
    pairs: Pairs = field(default_factory=Pairs)


PRESETS = {"default": Parameters(), "paper": Parameters(pairs=Pairs((0.75,)))}


def _toml(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "settings.toml"
    path.write_text(text)
    return path


def test_a_flag_beats_the_environment_beats_toml_beats_the_preset(tmp_path: Path) -> None:
    toml = _toml(tmp_path, 'preset = "paper"\nseed = 1\njobs = 1\n[search]\ntime_limit_s = 1\nmax_instances = 1\n')
    environ = {"SCANFIND_SEARCH_TIME_LIMIT_S": "2", "SCANFIND_SEED": "2", "SCANFIND_DEBUG": "1", "PATH": "/bin"}
    flags = {"search.time_limit_s": 3.0, "search.max_instances": None, "seed": None}
    run, parameters = load_settings(PRESETS, flags, toml, environ)
    assert (parameters.search.time_limit_s, parameters.search.max_instances) == (3.0, 1)
    assert parameters.pairs.distances == (0.75,)
    assert (run.preset, run.seed, run.jobs) == ("paper", 2, 1)


def test_nothing_given_is_the_default_preset() -> None:
    run, parameters = load_settings(PRESETS, {}, None, {})
    assert parameters is not None
    assert parameters == PRESETS["default"]
    assert (run.preset, run.seed, run.units, run.format) == ("default", 0, None, "ply")


@pytest.mark.parametrize(
    ("value", "wanted"), [("1,2.5,-3", (1.0, 2.5, -3.0)), ("[1, 2.5, -3]", (1.0, 2.5, -3.0)), ("none", None)]
)
def test_an_origin_is_three_numbers(value: str, wanted: object) -> None:
    assert load_settings(PRESETS, {}, None, {"SCANFIND_ORIGIN": value})[0].origin == wanted


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[serch]\ntime_limit_s = 1", r"unknown key 'serch': did you mean 'search'\?"),
        ("[search]\ntimelimit = 1", r"unknown key 'search\.timelimit': did you mean 'search\.time_limit_s'\?"),
        ("time_limit_s = 1", r"unknown key 'time_limit_s': did you mean 'search\.time_limit_s'\?"),
        ("sead = 1", r"unknown key 'sead': did you mean 'seed'\?"),
        ("xyzzy = 1", r"unknown key 'xyzzy': use one of "),
        ("[search]\ntime_limit_s = 0", r"search\.time_limit_s: input should be greater than 0, got 0"),
        ("[search]\ntime_limit_s = nan", r"search\.time_limit_s: "),
        ("[search]\nmax_instances = 'many'", r"search\.max_instances: .*got 'many'"),
        ("search = 3", r"'search' is a table of settings, got 3"),
        ("[pairs]\ndistances = [0.75, 'x']", r"pairs\.distances\[1\]: "),
        ("[pairs]\ndistances = []", r"pairs: at least one pair distance is needed"),
        ("origin = [1.0, 2.0]", r"origin: takes 3 values with commas between, got 2"),
        ("origin = [1, 2, 3, 4]", r"origin: takes 3 values with commas between, got 4"),
        ("units = 'feet'", r"units: .*'mm'"),
        ("seed = -1", r"seed: "),
        ("seed = ", r"cannot be read as a TOML settings file"),
    ],
)
def test_a_wrong_setting_is_one_line_naming_place_and_key(tmp_path: Path, text: str, says: str) -> None:
    toml = _toml(tmp_path, text)
    with pytest.raises(UsageError, match=says) as caught:
        load_settings(PRESETS, {}, toml, {})
    assert str(caught.value).startswith(str(toml))
    assert "\n" not in str(caught.value)


def test_an_unknown_variable_or_preset_is_told() -> None:
    with pytest.raises(UsageError, match=r"SCANFIND_SEEED: no such setting, unset it: did you mean 'SCANFIND_SEED'\?$"):
        load_settings(PRESETS, {}, None, {"SCANFIND_SEEED": "1"})
    with pytest.raises(UsageError, match="no preset 'papre': did you mean 'paper'"):
        load_settings(PRESETS, {"preset": "papre"}, None, {})


def test_a_flag_is_named_as_it_was_typed() -> None:
    with pytest.raises(UsageError, match=r"^--time-limit: search\.time_limit_s: .*got -1"):
        load_settings(PRESETS, {"search.time_limit_s": -1.0}, None, {})
    assert flag_name("search.max_instances") == "--max-instances"


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.toml: .*: No such file or directory$"):
        load_settings(PRESETS, {}, tmp_path / "none.toml", {})


def test_every_setting_has_a_variable() -> None:
    keys = leaf_keys(PRESETS["default"])
    assert keys == ["search.time_limit_s", "search.max_instances", "pairs.distances", "pairs.signed"]
    assert len({key.replace(".", "_") for key in keys}) == len(keys)
