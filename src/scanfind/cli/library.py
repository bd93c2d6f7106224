"""`scanfind library`: models prepared once and kept in one file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from scanfind.cli.options import Flag, Names, Units, note, say
from scanfind.errors import LibraryError

if TYPE_CHECKING:
    from scanfind.library import ModelSummary

LIBRARY_HELP = """Keep models ready for the search in one file.

For example:

    scanfind library add parts.scanfind spool.stl frame.step --units mm
"""

library = App(name="library", help=LIBRARY_HELP, usage="scanfind library COMMAND LIB ...")


@library.command(usage="scanfind library add LIB MODEL... [OPTIONS]")
def add(
    lib: Path,
    models: Annotated[list[Path], Parameter(name="MODEL", negative=())],
    /,
    *,
    units: Units | None = None,
    select: Names | None = None,
    symmetry: str | None = None,
    preset: str | None = None,
    config: Path | None = None,
) -> None:
    """Prepare models and add them; one that is there already costs no work.

    For example:

        scanfind library add parts.scanfind spool.stl frame.step --units mm
        scanfind library add parts.scanfind flange.stl --symmetry "z*"

    Parameters
    ----------
    lib
        The library file; made if there is none.
    models
        Model files: STL, OBJ, PLY, GLB, OFF, 3MF, STEP, IFC, or a point cloud cut from a scan.
    units
        Of model files whose format does not say; metres unless given.
    select
        Of an IFC file only these: class, name or GlobalId.
    symmetry
        Of these models, instead of what is found: axes and their order, as x2, z4,x2 or z* (every angle), or none.
    preset
        Settings to start from: default or sharif2017.
    config
        A TOML file of settings.

    """
    from scanfind.cli.inputs import add_models
    from scanfind.config import load_settings
    from scanfind.library import ModelLibrary
    from scanfind.parameters import PRESETS

    flags = {"preset": preset, "units": units, "select": select}
    run, parameters = load_settings(PRESETS, flags, config)
    with ModelLibrary.open(lib, create=True) as kept:
        before = len(kept)
        names = add_models(kept, models, run, parameters, symmetry)
        note(f"{lib}: models read: {len(names)}, new: {len(kept) - before}, in all: {len(kept)}")


@library.command(name="list")
def list_models(lib: Path, /, *, json: Flag = False) -> None:
    """List the models of a library.

    For example:

        scanfind library list parts.scanfind

    Parameters
    ----------
    lib
        The library file.
    json
        Print JSON instead of a table.

    """
    from scanfind.cli.tables import table
    from scanfind.library import ModelLibrary

    with ModelLibrary.open(lib) as kept:
        summaries = kept.show()
    if json:
        say(_json([_fields(summary) for summary in summaries]))
        return
    rows = [
        [s.name, f"{s.diameter:.3f}", f"{s.triangles:,}", f"{s.samples:,}", f"{s.pairs:,}", str(s.placements), s.source]
        for s in summaries
    ]
    say(table(("model", "diameter m", "triangles", "samples", "pairs", "placements", "source"), rows))


@library.command
def show(lib: Path, name: str, /, *, json: Flag = False) -> None:
    """Show one model of a library.

    For example:

        scanfind library show parts.scanfind spool

    Parameters
    ----------
    lib
        The library file.
    name
        The model's name, as `scanfind library list` prints it.
    json
        Print JSON instead of lines.

    """
    from scanfind.config import did_you_mean
    from scanfind.library import ModelLibrary

    with ModelLibrary.open(lib) as kept:
        summaries = {summary.name: summary for summary in kept.show()}
    if name not in summaries:
        msg = f"{lib}: no model {name!r}: {did_you_mean(name, list(summaries))}"
        raise LibraryError(msg)
    fields = _fields(summaries[name])
    if not json:
        fields["symmetry"] = summaries[name].symmetry.words()
    say(_json(fields) if json else "\n".join(f"{key:<11}{value}" for key, value in fields.items()))


@library.command
def remove(lib: Path, name: str, /) -> None:
    """Forget a model.

    For example:

        scanfind library remove parts.scanfind spool

    Parameters
    ----------
    lib
        The library file.
    name
        The model's name, as `scanfind library list` prints it.

    """
    from scanfind.library import ModelLibrary

    with ModelLibrary.open(lib) as kept:
        kept.remove(name)


def _fields(summary: ModelSummary) -> dict[str, object]:
    from scanfind.results.document import symmetry_entry

    return {**summary._asdict(), "symmetry": symmetry_entry(summary.symmetry).model_dump()}


def _json(value: object) -> str:
    import json

    return json.dumps(value, indent=2, ensure_ascii=False)
