"""`scanfind info`: what is in a scan or model file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from scanfind.cli.options import Flag, say

if TYPE_CHECKING:
    from scanfind.cloud import ScanInfo


def info(files: Annotated[list[Path], Parameter(name="FILE", negative=())], /, *, json: Flag = False) -> None:
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
    told = [_told(file) for file in files]
    if json:
        from json import dumps

        say(dumps(told, indent=2, ensure_ascii=False))
        return
    say("\n\n".join(_lines(facts) for facts in told))


def _told(file: Path) -> dict[str, Any]:
    """A file's facts, plain enough for JSON."""
    from scanfind.models import MODEL_READERS, model_info
    from scanfind.scans import SCAN_READERS, scan_info

    suffix = file.suffix.lower()
    # A PLY is a model if it has faces, else a scan.
    if suffix in MODEL_READERS and not (suffix in SCAN_READERS and scan_info(file).points):
        return model_info(file)
    return _scan_facts(scan_info(file))


def _scan_facts(about: ScanInfo) -> dict[str, Any]:
    return {
        "path": about.path,
        "format": about.format,
        "points": about.points,
        "bounds_m": about.bounds,
        "crs": about.crs,
        "attributes": dict(about.attributes),
        "scans": [{"name": s.name, "points": s.points, "origin_m": s.origin} for s in about.stations],
    }


def _lines(facts: dict[str, Any]) -> str:
    """A fact a line; of lists their length and, where they are short, their parts."""
    lines = []
    for key, value in facts.items():
        if isinstance(value, dict):
            lines.append(f"{key:<11}" + (", ".join(f"{name} {kind}" for name, kind in value.items()) or "–"))
        elif isinstance(value, list):
            lines.append(f"{key:<11}{len(value)}")
            lines += ["  " + ", ".join(f"{k} {_cell(v)}" for k, v in part.items()) for part in value]
        else:
            lines.append(f"{key:<11}{_cell(value)}")
    return "\n".join(lines)


def _cell(value: object) -> str:
    if value is None or value == -1:
        return "unknown"
    if isinstance(value, tuple):
        return " … ".join(map(_cell, value)) if isinstance(value[0], tuple) else " ".join(f"{v:.3f}" for v in value)
    return f"{value:,}" if isinstance(value, int) else str(value)
