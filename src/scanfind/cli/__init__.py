"""The command line: one library call a command. Data on stdout, words on stderr, errors in one line.

Exit codes: 0 done, 1 error, 2 wrong call, 3 done but something was not found (only with --fail-on), 4 done
but some of many scans could not be read, 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from cyclopts import App, CycloptsError, MissingArgumentError

from scanfind.cli.bim import bim
from scanfind.cli.find import find
from scanfind.cli.info import info
from scanfind.cli.inspect import inspect
from scanfind.cli.isolate import isolate
from scanfind.cli.library import library
from scanfind.cli.options import note
from scanfind.cli.report import report
from scanfind.cli.simulate import simulate
from scanfind.errors import Interrupted, ScanfindError, UsageError

HELP = """Find known 3D objects (CAD, BIM or a piece of scan) in cluttered laser scans.

For example:

    scanfind find shop.e57 --model spool.stl --units mm --out found
"""


def _version() -> str:
    from scanfind import __version__

    return __version__


app = App(name="scanfind", help=HELP, version=_version, help_format="plaintext", suppress_keyboard_interrupt=False)
app.command(find, usage="scanfind find SCAN... (--model FILE... | --library LIB) [OPTIONS]")
app.command(inspect, usage="scanfind inspect SCAN... --design FILE... [OPTIONS]")
app.command(bim, usage="scanfind bim RESULT_DIR [--bcf FILE] [--ifc FILE --design FILE] [OPTIONS]")
app.command(library)
app.command(isolate, usage="scanfind isolate RESULT_DIR SCAN... [OPTIONS]")
app.command(report, usage="scanfind report RESULT_DIR [--out FILE...] [--tolerance PROFILE] [OPTIONS]")
app.command(info, usage="scanfind info FILE... [--json]")
app.command(simulate, usage="scanfind simulate SCENE (--out OUT | --plan) [OPTIONS]")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; its exit code. `arguments` are the process's own where None."""
    # Paths may hold bytes that are no text, and terminals letters they cannot show: neither is worth dying for.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        code = app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        if isinstance(error, MissingArgumentError) and "parameter SCAN" in str(error):
            # `find --model spool.stl shop.e57` reads as two models and no scan.
            return _fail("no scan given: scans come before --model and other options", UsageError.exit_code)
        return _fail(f"{str(error).rstrip('.')}; see scanfind --help", UsageError.exit_code)
    except ScanfindError as error:
        return _fail(error, error.exit_code)
    except KeyboardInterrupt:
        return _fail("interrupted: nothing half done is left behind", Interrupted.exit_code)
    except MemoryError as error:
        return _fail(f"out of memory: {error}: give fewer scans or a coarser grid", ScanfindError.exit_code)
    except Exception as error:  # whatever it is, a user gets one line
        what = f"{type(error).__name__}: {error}"
        return _fail(f"internal error: {what}: please report it, with SCANFIND_DEBUG=1 set", ScanfindError.exit_code)
    return code if isinstance(code, int) else 0


def _fail(why: object, code: int) -> int:
    """Say in one line what went wrong; SCANFIND_DEBUG=1 shows where."""
    if os.environ.get("SCANFIND_DEBUG"):
        import traceback

        traceback.print_exc()
    note(str(why))
    return code
