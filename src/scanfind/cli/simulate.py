"""`scanfind simulate`: a scene and a scanner in, a scan with its truth out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from scanfind.cli.options import Count, Flag, Metres, Paths, Units, note, say
from scanfind.errors import UsageError

if TYPE_CHECKING:
    from scanfind.mesh import Mesh
    from scanfind.simulate import Instrument, Scene, Simulated

GENERATORS = ("shop", "plant", "frame")
Degrees = Annotated[float, Parameter(metavar="DEG")]
Number = Annotated[str, Parameter(metavar="N")]
Positions = Annotated[list[str], Parameter(consume_multiple=True, allow_leading_hyphen=True, metavar="X,Y,Z")]


def simulate(
    scene: str,
    /,
    *,
    out: Path | None = None,
    plan: Flag = False,
    format: Literal["e57", "laz", "ply", "ptx"] = "e57",
    model: Paths | None = None,
    units: Units | None = None,
    copies: Count | None = None,
    scanner: str | None = None,
    stations: Count | None = None,
    station: Positions | None = None,
    step: Degrees | None = None,
    points: Number | None = None,
    noise: Metres | None = None,
    range: Annotated[str | None, Parameter(metavar="MIN,MAX")] = None,
    seed: Count | None = None,
    jobs: Count | None = None,
    overwrite: Flag = False,
    json: Flag = False,
) -> None:
    """Scan a scene with a virtual scanner, or find out what would be seen of it.

    For example:

        scanfind simulate plant --out sim --points 1e6

        scanfind simulate shop --model spool.stl --units mm --copies 2 --plan

    Parameters
    ----------
    scene
        A TOML file, or a scene made from the seed: shop (fabrication shop), plant (dense piping), frame (steel).
    out
        A new folder for scan, truth.json and models; or a file for the cloud alone.
    plan
        Write nothing: only say what of each target would be seen.
    format
        Of the scan: E57 and PTX keep each station's pose.
    model
        Model files to look for, placed in a shop, plant or frame instead of the paper's objects.
    units
        Of model files whose format does not say; metres unless given.
    copies
        How many of each target are in a shop, plant or frame.
    scanner
        plain, faro-ls-840-he (the paper's), phase, structured-light or photogrammetry.
    stations
        How many stations; where they stand is chosen by what they see.
    station
        X,Y,Z of each station, metres, instead.
    step
        Angle between neighbouring beams, degrees.
    points
        About how many points to bring home, instead of --step; 2e6 is two million.
    noise
        Standard deviation of a range, metres, before it grows with range and incidence.
    range
        MIN,MAX the scanner measures, metres.
    seed
        Of the scene and of the scanner's noise: the same seed gives the same points.
    jobs
        Threads; one a core unless given.
    overwrite
        Replace an older simulation in --out.
    json
        Print truth.json on stdout instead of a table.

    """
    if (out is None) == (not plan):
        msg = "simulate: nowhere to write to: give --out DIR, or --plan to write nothing"
        raise UsageError(msg if out is None else "simulate: --plan writes nothing: leave out --out, or --plan")
    if step is not None and points is not None:
        msg = "simulate: --step and --points exclude each other: give one of them"
        raise UsageError(msg)
    if stations is not None and station is not None:
        msg = "simulate: --stations and --station exclude each other: give one of them"
        raise UsageError(msg)

    import numpy as np

    from scanfind.progress import progress_on
    from scanfind.simulate import simulate as simulate_scene

    preset = _preset(scanner)
    changes = {
        "step": None if step is None else float(np.radians(step)),
        "noise": noise,
        **dict(zip(("nearest", "farthest"), _numbers(range, 2, "--range MIN,MAX"), strict=False)),
    }
    asked = None if points is None else _whole(points)
    where = None if station is None else [_numbers(text, 3, "--station X,Y,Z") for text in station]
    made, device, wanted, chance = _scene(scene, model or [], units, copies, stations, seed)
    device = replace(preset or device, **{key: value for key, value in changes.items() if value is not None})
    if asked is not None or step is not None:
        wanted = asked
    with progress_on() as progress:
        done = simulate_scene(
            made, out, scanner=device, stations=where, points=wanted, seed=chance, format=format,
            overwrite=overwrite, jobs=jobs, progress=progress,
        )  # fmt: skip
    _report(done, out, json=json)


def _scene(
    name: str, models: list[Path], units: Units | None, copies: int | None, stations: int | None, seed: int | None
) -> tuple[Scene, Instrument, int | None, int]:
    """The scene, and its own scanner, number of points and seed."""
    from scanfind.config import did_you_mean
    from scanfind.simulate import SCANNERS, frame, plant, read_scene, shop
    from scanfind.simulate.objects import pipe_spool
    from scanfind.simulate.scene_file import with_best_stations

    if Path(name).suffix.lower() == ".toml":
        if models or copies is not None:
            msg = "simulate: --model and --copies are for shop, plant and frame: name the models in the scene file"
            raise UsageError(msg)
        read = read_scene(name)
        chance = read.seed if seed is None else seed
        made = read.scene if stations is None else with_best_stations(read.scene, stations, chance)
        return made, read.scanner, read.points, chance
    if name not in GENERATORS:
        msg = f"simulate: there is no scene {name!r}: {did_you_mean(name, GENERATORS)}, or give a .toml file"
        raise UsageError(msg)
    targets = _targets(models, units)
    chance = seed or 0
    given = {key: value for key, value in {"copies": copies, "stations": stations}.items() if value is not None}
    if name == "shop":
        # What a clutter ratio is usual for the paper's objects says nothing of a model of another size.
        clutter = (0.0, float("inf"))
        made = shop(chance, targets or pipe_spool(), clutter=clutter, **given)
    else:
        made = (plant if name == "plant" else frame)(chance, targets or None, **given)
    return made, SCANNERS["plain"], None, chance


def _targets(files: list[Path], units: Units | None) -> list[Mesh]:
    from scanfind.models import STATES_UNITS, read_models
    from scanfind.simulate.scene_file import surfaces

    found = []
    for file in files:
        stated = file.suffix.lower() in STATES_UNITS
        for mesh in surfaces(file, read_models(file, units=None if stated else units)):
            if "hint" in mesh.notes:
                note(f"{mesh.name}: {mesh.notes['hint']}")
            found.append(mesh)
    return found


def _preset(name: str | None) -> Instrument | None:
    from scanfind.simulate.scene_file import scanner_preset

    return None if name is None else scanner_preset(name, "--scanner")


def _whole(text: str) -> int:
    """A number of points as people type it: 2e6."""
    try:
        number = float(text)
        if number >= 1 and number == int(number):
            return int(number)
    except (ValueError, OverflowError):
        pass
    msg = f"--points must be a whole number of at least 1, such as 2e6, got {text!r}"
    raise UsageError(msg)


def _numbers(text: str | None, count: int, what: str) -> list[float]:
    """Numbers with commas between; none for None."""
    if text is None:
        return []
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        msg = f"{what}: takes {count} numbers with commas between, got {text!r}"
        raise UsageError(msg)
    return numbers


def _report(done: Simulated, out: Path | None, *, json: bool) -> None:
    """The table (or truth.json) on stdout; on stderr what a planner should know, and where it lies."""
    from scanfind.cli.tables import sight_table
    from scanfind.simulate.truth import to_json

    if json:
        say(to_json(done.truth))
    elif done.targets():
        say(sight_table(done.targets()))
    for remark in done.remarks:
        note(remark)
    where = "nothing written, as planned" if out is None else f"written to {out}"
    stations = len(done.survey.poses)
    note(f"{done.points():,} points from {stations} station{'s' if stations > 1 else ''}; {where}")
