"""`scanfind info`: what is in a scan or model file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from scanfind.cli.options import Flag, note, say
from scanfind.errors import ScanfindError

if TYPE_CHECKING:
    from scanfind.cloud import ScanInfo


def info(files: Annotated[list[Path], Parameter(name="FILE", negative=())], /, *, json: Flag = False) -> int:
    """Say what is in scan or model files, without reading their points.

    For example:

        scanfind info shop.e57 spool.stl

    Parameters
    ----------
    files
        Scan or model files.
    json
        Print JSON instead of lines.

    """
    told, code = [], 0
    for file in files:
        try:
            told.append(_told(file))
        except ScanfindError as error:  # one bad file does not keep the others from being told
            note(str(error))
            code = error.exit_code
    if json:
        from json import dumps

        say(dumps(told, indent=2, ensure_ascii=False))
    elif told:
        say("\n\n".join(_lines(facts) for facts in told))
    return code


def _told(file: Path) -> dict[str, Any]:
    """A file's facts, plain enough for JSON."""
    from dataclasses import asdict

    from scanfind.models import model_info
    from scanfind.models.ply import has_faces
    from scanfind.scans import SCAN_READERS, scan_info

    suffix = file.suffix.lower()
    is_mesh = suffix == ".ply" and file.is_file() and has_faces(file)
    if suffix in SCAN_READERS and not is_mesh:
        return _scan_facts(scan_info(file))
    return asdict(model_info(file))


def _scan_facts(about: ScanInfo) -> dict[str, Any]:
    import numpy as np

    return {
        "path": about.path,
        "format": about.format,
        "points": about.points,
        "bounds_m": about.bounds,
        "crs": about.crs,
        "attributes": {name: np.dtype(kind).name for name, kind in about.attributes.items()},
        "scans": [{"name": s.name, "points": s.points, "origin_m": s.origin} for s in about.stations],
    }


def _lines(facts: dict[str, Any]) -> str:
    """A fact a line; of lists their length and, where they are short, their parts."""
    lines = []
    for key, value in facts.items():
        if isinstance(value, dict):
            lines.append(f"{key:<11}" + (", ".join(f"{name} {kind}" for name, kind in value.items()) or "–"))
        elif key in ("scans", "models"):
            lines.append(f"{key:<11}{len(value)}")
            lines += ["  " + ", ".join(f"{k} {_cell(v)}" for k, v in part.items()) for part in value]
        else:
            lines.append(f"{key:<11}{_cell(value)}")
    return "\n".join(lines)


def _cell(value: object) -> str:
    if value is None or value == -1:
        return "unknown"
    if isinstance(value, tuple):
        return (" … " if value and isinstance(value[0], tuple) else " ").join(map(_cell, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3f}"
    return f"{value:,}" if isinstance(value, int) else str(value)
