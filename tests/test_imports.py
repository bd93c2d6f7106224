"""Starting is quick: heavy libraries are imported where they are used, and numba by kernels only."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

import scanfind

PACKAGE = Path(scanfind.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
# These cost from 50 ms to 2 s each to import.
HEAVY = {
    "numba", "scipy", "trimesh", "pye57", "laspy", "lazrs", "pypcd4", "pandas", "ifcopenshell", "cascadio", "embreex",
    "networkx", "lxml",
}  # fmt: skip
START_S = 0.3


def _python(*arguments: str) -> str:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True, timeout=60).stdout


def _imported(nodes: Iterable[ast.AST]) -> set[str]:
    """The top packages that these nodes themselves import."""
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(str(node.module).partition(".")[0])
    return found


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_heavy_libraries_are_not_imported_at_the_top(module: Path) -> None:
    allowed = {"numba"} if "kernels" in module.parts else set()
    assert not (_imported(ast.parse(module.read_text(encoding="utf-8")).body) & HEAVY) - allowed


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_kernels_import_numba(module: Path) -> None:
    if "kernels" not in module.parts:
        assert "numba" not in _imported(ast.walk(ast.parse(module.read_text(encoding="utf-8"))))


def test_import_and_help_load_no_array_library() -> None:
    code = (
        "import sys, scanfind, scanfind.cli\n"
        "try: scanfind.cli.main(['find', '--help'])\n"
        "finally: print('LOADED', *sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    loaded = _python("-c", code).rpartition("LOADED")[2].split()
    assert not {"numpy", "pydantic", *HEAVY} & set(loaded)


def test_the_main_path_loads_kernels_only_when_it_runs() -> None:
    code = "import sys, scanfind.find, scanfind.inspect; print(*{name.partition('.')[0] for name in sys.modules})"
    assert not HEAVY & set(_python("-c", code).split())


@pytest.mark.parametrize("arguments", [("-c", "import scanfind"), ("-m", "scanfind", "--help")])
def test_start_is_quick(arguments: tuple[str, ...]) -> None:
    import resource

    # The best of five, in processor time: what the machine does beside us is not our slowness.
    took = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        _python(*arguments)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(took) < START_S


@pytest.mark.parametrize("name", scanfind.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(scanfind, name) is getattr(scanfind, name)


@pytest.mark.parametrize("verb", ["find", "inspect"])
def test_a_verb_stays_a_function_whoever_imports_its_module(verb: str) -> None:
    code = f"import scanfind, scanfind.{verb}; from scanfind.{verb} import __name__ as n; print(scanfind.{verb}, n)"
    assert _python("-c", code).startswith(f"<function {verb}")


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'serch'"):
        scanfind.__getattr__("serch")
