"""Readers that may crash, hang or fill the memory, kept in a process of their own.

C++ readers of STEP and IFC fall over on some damaged files, and a few kilobytes of glTF or 3MF may describe billions of
instances. In a child process that costs a time limit and one clear line.

    parts, facts = read_in_child("step", path)

runs `scanfind.models.step.read_here(path, options)` there. What it returns, or the ScanfindError it raises, comes back
through two files of a temporary folder: arrays without pickles, and JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from scanfind import errors
from scanfind.errors import MissingExtraError, UnreadableFileError
from scanfind.models.parts import Part

TIME_LIMIT_S = 300.0
MEMORY_LIMIT = 8 << 30

ARRAYS, FACTS = "parts.npz", "facts.json"


def read_in_child(
    module: str, path: Path, options: Mapping[str, Any] | None = None, *, time_limit_s: float = TIME_LIMIT_S
) -> tuple[list[Part], dict[str, Any]]:
    """What `read_here` of that module of this package makes of the file: parts, and facts about them.

    Raises UnreadableFileError where the child crashes, takes too long or too much memory, and whatever ScanfindError
    it raised itself.
    """
    with TemporaryDirectory(prefix="scanfind-") as folder:
        order = json.dumps({"module": module, "path": str(path.absolute()), "folder": folder, "options": options or {}})
        # -P: a numpy.py lying in the current folder is not what we mean to import.
        command = [sys.executable, "-P", "-m", "scanfind.models.child", str(time_limit_s)]
        try:
            # The readers' own chatter goes nowhere: what matters comes back as facts.
            ended = subprocess.run(
                command, input=order.encode(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                timeout=time_limit_s, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            msg = f"{path} was not read within {time_limit_s:g} s: it is damaged or too large; select or export a part"
            raise UnreadableFileError(msg) from None
        facts = _read_facts(Path(folder))
        if facts is None:
            msg = f"{path} crashes its reader (exit {ended.returncode}): the file is damaged; export it again"
            raise UnreadableFileError(msg)
        if "error" in facts:
            raise getattr(errors, facts["error"])(facts["message"])
        return _read_parts(Path(folder), facts.pop("names")), facts


def need_extra(library: str, extra: str, what: str) -> None:
    """Raises MissingExtraError where the optional `library` is not installed."""
    from importlib.util import find_spec

    if find_spec(library) is None:
        msg = f'reading {what} needs {library}, which is not installed: pip install "scanfind[{extra}]"'
        raise MissingExtraError(msg)


def main() -> None:
    """The child's own work: order in on stdin, parts and facts out into the folder it names."""
    time_limit_s = float(sys.argv[1])
    order = json.loads(sys.stdin.buffer.read())
    _limit(time_limit_s)
    path, folder = Path(order["path"]), Path(order["folder"])
    try:
        parts, facts = _reader(order["module"]).read_here(path, order["options"])
        _write_parts(folder, parts)
        told = {**facts, "names": [part.name for part in parts]}
    except errors.ScanfindError as error:
        told = {"error": type(error).__name__, "message": str(error)}
    except MemoryError:
        told = _unreadable(f"{path} needs more than {MEMORY_LIMIT >> 30} GB to read: damaged, or too large")
    except Exception as error:  # whatever a reader may throw at a damaged file
        told = _unreadable(f"{path} cannot be read: {one_line(error)}")
    (folder / FACTS).write_text(json.dumps(told), encoding="utf-8")


def one_line(error: BaseException) -> str:
    """What a foreign exception says, in one short line."""
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= 120 else words[:117] + "..."


def _unreadable(message: str) -> dict[str, str]:
    return {"error": UnreadableFileError.__name__, "message": message}


def _reader(module: str) -> Any:
    from importlib import import_module

    return import_module(f"scanfind.models.{module}")


def _limit(time_limit_s: float) -> None:
    """The memory this process may take, and an end even where the parent is gone and cannot set one."""
    if sys.platform == "win32":
        return
    import resource
    import signal

    _, most = resource.getrlimit(resource.RLIMIT_AS)
    limit = MEMORY_LIMIT if most == resource.RLIM_INFINITY else min(most, MEMORY_LIMIT)
    if sys.platform == "linux":  # macOS counts its shared libraries, and refuses
        resource.setrlimit(resource.RLIMIT_AS, (limit, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.alarm(int(time_limit_s) + 5)


def _write_parts(folder: Path, parts: Sequence[Part]) -> None:
    """All parts end to end, and where each begins."""
    np.savez(
        folder / ARRAYS,
        vertices=np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)]),
        faces=np.concatenate([np.zeros((0, 3), np.int64), *(part.faces for part in parts)]),
        vertex_ends=np.cumsum([len(part.vertices) for part in parts], dtype=np.int64),
        face_ends=np.cumsum([len(part.faces) for part in parts], dtype=np.int64),
    )


def _read_parts(folder: Path, names: Sequence[str]) -> list[Part]:
    with np.load(folder / ARRAYS, allow_pickle=False) as arrays:
        vertices = np.split(arrays["vertices"], arrays["vertex_ends"])
        faces = np.split(arrays["faces"], arrays["face_ends"])
    return [Part(name, vertices[k], faces[k]) for k, name in enumerate(names)]


def _read_facts(folder: Path) -> dict[str, Any] | None:
    """What the child said of the file; None where it died before it could."""
    try:
        facts: dict[str, Any] = json.loads((folder / FACTS).read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError):
        return None
    return facts


if __name__ == "__main__":
    main()
