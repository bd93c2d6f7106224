"""README, `--help` and the commands say the same: every example parses, and runs."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scanfind.cli import app, main
from scanfind.scans import open_writer, read_scan

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [README, *(page.read_text(encoding="utf-8") for page in sorted((ROOT / "docs").glob("*.md")))]
COMMANDS = [
    ("find",), ("inspect",), ("report",), ("bim",), ("isolate",), ("info",), ("library", "add"), ("library", "list"),
    ("library", "show"), ("library", "remove"), ("simulate",),
]  # fmt: skip
# Enough for the examples to come to an end; how well they find is for other tests to say.
TIME_LIMIT = "SCANFIND_SEARCH_TIME_LIMIT_S"


def _fences(language: str) -> list[str]:
    fence = re.compile(rf"^```{language}\n(.*?)^```", re.MULTILINE | re.DOTALL)
    return [code for page in PAGES for code in fence.findall(page)]


def _readme_lines(*programs: str) -> list[str]:
    return [line for fence in _fences("sh") for line in fence.splitlines() if line.startswith(programs)]


def _readme_commands() -> list[str]:
    return _readme_lines("scanfind ")


def _help(command: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> str:
    assert main([*command, "--help"]) == 0
    return capsys.readouterr().out


def _examples(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.startswith("    scanfind ")]


def _walk(group: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    commands = app
    for name in group:
        commands = commands[name]
    for name in commands:
        if not name.startswith("-"):
            below = list(_walk((*group, name)))
            yield from below or [(*group, name)]


def _parses(line: str) -> None:
    words = shlex.split(line.partition(">")[0])
    assert words[0] == "scanfind"
    app.parse_args(words[1:], exit_on_error=False, print_error=False)


def _thinner(line: str) -> str:
    """A plan with fewer beams: a scanner's own 20 million take 20 s of processor time the same way as these."""
    return f"{line} --points 2e5" if "--plan" in line and "--points" not in line else line


def test_these_are_all_the_commands() -> None:
    assert sorted(_walk()) == sorted(COMMANDS)


@pytest.mark.parametrize("command", [(), ("library",), *COMMANDS], ids=" ".join)
def test_every_help_has_an_example_that_parses(command: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    examples = _examples(_help(command, capsys))
    assert examples
    for example in examples:
        assert example.startswith(" ".join(("scanfind", *command)))
        _parses(example)


@pytest.mark.parametrize("line", _readme_commands())
def test_every_command_of_the_readme_parses(line: str) -> None:
    _parses(line)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_option_is_explained(command: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    text = _help(command, capsys)
    found = app
    for name in command:
        found = found[name]
    arguments = found.assemble_argument_collection(parse_docstring=True)
    assert len(arguments) > 0
    for argument in arguments:
        assert argument.parameter.help, argument.name
        assert argument.name.strip("-") in text


def test_files_the_readme_names_are_there() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).exists(), target
    for path in re.findall(r"examples/[\w./-]+", README):
        assert (ROOT / path).exists(), path


def test_the_makefile_has_what_the_readme_promises() -> None:
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"\bmake (\w+)", README)) <= targets


@pytest.mark.slow
def test_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:/usr/bin:/bin")
    monkeypatch.setenv(TIME_LIMIT, "5")
    for line in _readme_lines("scanfind ", "python examples/"):
        done = subprocess.run(["bash", "-c", _thinner(line)], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
    assert (tmp_path / "found" / "results.json").is_file()
    assert (tmp_path / "results.json").is_file()
    assert (tmp_path / "findings.bcf").is_file()
    assert (tmp_path / "asbuilt.ifc").is_file()
    for code in _fences("python"):
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{code}\n{done.stderr}"


@pytest.mark.slow
def test_the_examples_of_every_help_run(
    tmp_path: Path, shared_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import trimesh

    shutil.copy(ROOT / "examples" / "pump" / "scan.e57", tmp_path / "shop.e57")
    shutil.copy(shared_data / "cad" / "box_sides.STEP", tmp_path / "frame.step")
    lift = shared_data / "ifc" / "schependomlaan" / "ROOT-prefab_vloer_lifttop" / "IFC-prefab_vloer_lifttop.ifc"
    shutil.copy(lift, tmp_path / "steel.ifc")
    trimesh.creation.cylinder(radius=88.0, height=600.0).export(tmp_path / "spool.stl")
    trimesh.creation.annulus(r_min=50.0, r_max=90.0, height=20.0).export(tmp_path / "flange.stl")
    (chunk,) = read_scan(tmp_path / "shop.e57")
    for name, half in (("station1.laz", slice(None, None, 2)), ("station2.laz", slice(1, None, 2))):
        with open_writer(tmp_path / name, {"intensity": np.dtype(np.uint16)}) as writer:
            writer.write(chunk.xyz[half], {"intensity": np.ones(len(chunk.xyz[half]), np.uint16)})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(TIME_LIMIT, "1")  # the spool of the examples is not in this scan
    order = [
        "simulate",
        "library add",
        "library list",
        "library show",
        "find",
        "inspect",
        "report",
        "bim",
        "isolate",
        "info",
        "library remove",
    ]
    for command in order:
        for example in _examples(_help(tuple(command.split()), capsys)):
            code = main(shlex.split(_thinner(example))[1:])
            assert code == 0, f"{example}\n{capsys.readouterr().err}"
