"""python -m benchmarks.rivals.install [NAME...]: set up the environments of rivals (all of them where none is named).

Each is a virtual environment below `.rivals/`, with this project's C++ built there. What is there already stays.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.rivals.table import ENVIRONMENTS, RIVALS, SOURCE, UNAVAILABLE, Environment
from scanfind.errors import UsageError

PCL_WANTED = "apt-get install --no-install-recommends libpcl-dev cmake g++ pkg-config"
# Two compilers at a time: PCL's headers take a gigabyte each.
JOBS = 2
INSTALL_LIMIT_S = 3600.0


def main(names: Sequence[str]) -> int:
    """One line for each environment; 1 where something could not be had."""
    if unknown := [name for name in names if name not in RIVALS]:
        msg = f"no rival is called {unknown[0]!r}: {UNAVAILABLE.get(unknown[0], 'there are ' + ', '.join(RIVALS))}"
        raise UsageError(msg)
    for name in UNAVAILABLE if not names else []:
        print(f"{name}: not to be had: {UNAVAILABLE[name]}")
    wanted = {RIVALS[name].environment for name in names} or set(ENVIRONMENTS)
    missing = 0
    for environment in ENVIRONMENTS.values():
        if environment.name not in wanted:
            continue
        if environment.is_current():
            print(f"{environment.name}: there already ({environment.folder})")
            continue
        try:
            install(environment)
            print(f"{environment.name}: installed in {environment.folder}")
        except (OSError, subprocess.SubprocessError) as error:
            missing += 1
            shutil.rmtree(environment.folder, ignore_errors=True)
            print(f"{environment.name}: not to be had here: {reason(error)}")
    return 1 if missing else 0


def install(environment: Environment) -> None:
    """From nothing, marked complete only at the end."""
    shutil.rmtree(environment.folder, ignore_errors=True)
    _run(sys.executable, "-m", "venv", environment.folder)
    _run(environment.python, "-m", "pip", "install", "--quiet", *environment.packages)
    if environment.programs:
        build = environment.folder / "build"
        _run("cmake", "-S", SOURCE, "-B", build)
        _run("cmake", "--build", build, "--parallel", str(JOBS))
    for module in environment.imports:
        _run(environment.python, "-c", f"import {module}")
    versions = _run(environment.python, "-m", "pip", "freeze")
    environment.complete.write_text(f"{environment.recipe()}\n{versions}", encoding="utf-8")


def reason(error: Exception) -> str:
    """The last line of what a command said, and what to do where PCL lacks."""
    if not isinstance(error, subprocess.CalledProcessError):
        return str(error)
    said = [line.strip() for line in (error.stderr or error.stdout or "").splitlines() if line.strip()]
    command = " ".join(Path(str(part)).name if os.sep in str(part) else str(part) for part in error.cmd[:4])
    hint = f"; PCL needs: {PCL_WANTED}" if Path(str(error.cmd[0])).name == "cmake" else ""
    return f"`{command} …` failed: {said[-1] if said else 'no word'}{hint}"


def _run(*command: str | Path) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=INSTALL_LIMIT_S).stdout


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except UsageError as error:
        sys.exit(str(error))
