"""Simulated scans as files: one cloud a station, and truth.json beside them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from scanfind.cloud import CHUNK_POINTS
from scanfind.errors import OutputError
from scanfind.scans import open_writer
from scanfind.simulate.scanner import SimulatedScan

TRUTH_SCHEMA = 1


def write_scan(scan: SimulatedScan, folder: str | Path, suffix: str = "ply") -> list[Path]:
    """Write station_1.<suffix>, station_2.<suffix>, … and truth.json into `folder`, made if need be; the paths.

    suffix : a format scanfind writes (ply, e57, laz, las, pcd)
    Formats that have no place for a scanner's position have it in truth.json. Raises OutputError and
    UnsupportedFormatError.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"{target}: cannot make this folder ({error.strerror}); choose another"
        raise OutputError(msg) from error
    paths = [target / f"station_{k}.{suffix}" for k in range(1, len(scan.stations) + 1)]
    for path, station in zip(paths, scan.stations, strict=True):
        with open_writer(path, {name: values.dtype for name, values in station.attributes.items()}) as out:
            for start in range(0, len(station), CHUNK_POINTS):
                part = slice(start, start + CHUNK_POINTS)
                out.write(station.xyz[part], {name: values[part] for name, values in station.attributes.items()})
    write_truth(scan, target / "truth.json", [path.name for path in paths])
    return paths


def write_truth(scan: SimulatedScan, path: Path, files: list[str]) -> None:
    """Write what is where: poses by model, stations, objects by id, the scanner. Metres, radians, row-major 4x4."""
    truth: dict[str, Any] = {
        "schema": TRUTH_SCHEMA,
        "models": {
            name: [{"scene_from_model": pose.matrix().tolist()} for pose in poses] for name, poses in scan.truth.items()
        },
        "stations": [
            {
                "file": file,
                "origin_m": [] if station.origin is None else station.origin.tolist(),
                "points": len(station),
            }
            for file, station in zip(files, scan.stations, strict=True)
        ],
        "objects": list(scan.object_names),
        "scanner": asdict(scan.scanner),
    }
    try:
        path.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        msg = f"{path}: cannot write ({error.strerror}); choose another folder"
        raise OutputError(msg) from error
