"""truth.json, and the models beside a simulated scan: what is where, and how it was seen."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from scanfind.errors import UsageError
from scanfind.mesh import Mesh
from scanfind.results import Kind, safe_name
from scanfind.simulate.scanner import Survey
from scanfind.simulate.scene import Scene
from scanfind.simulate.sight import Sight

TRUTH_JSON = "truth.json"
TRUTH_SCHEMA = 2


def truth_of(
    survey: Survey, sights: Sequence[Sight], models: Mapping[str, str], files: Sequence[str]
) -> dict[str, Any]:
    """What truth.json holds. Metres, radians, poses as row-major 4x4 matrices.

    models : name of each target → its file; files : all there are beside truth.json
    """
    scene, scanner = survey.scene, survey.scanner
    return {
        "schema": TRUTH_SCHEMA,
        "files": sorted([TRUTH_JSON, *files]),
        "seed": survey.seed,
        "scanner": {"kind": type(scanner).__name__, **asdict(scanner)},
        "rows": scanner.rows(),
        "columns": scanner.columns(),
        "stations": [
            {
                "name": station_name(k),
                "origin_m": pose.translation.tolist() if scanner.has_stations else [],
                "scene_from_station": pose.matrix().tolist(),
                "points": sum(sight.points[k] for sight in sights),
            }
            for k, pose in enumerate(survey.poses)
        ],
        "models": {
            name: [{"scene_from_model": pose.matrix().tolist()} for pose in poses]
            for name, poses in scene.truth().items()
        },
        "objects": [
            {
                "id": sight.object_id,
                "name": sight.name,
                "target": sight.target,
                "model": models.get(sight.name) if sight.target else None,
                "scene_from_model": scene.objects[sight.object_id].pose.matrix().tolist(),
                **{key: value for key, value in asdict(sight).items() if key not in ("object_id", "name", "target")},
            }
            for sight in sights
        ],
    }


def station_name(number: int) -> str:
    """Of the station with this index."""
    return f"station {number + 1}"


def target_meshes(scene: Scene) -> dict[str, Mesh]:
    """The models looked for, by name. Raises UsageError where one name stands for two shapes, or two share a file."""
    meshes: dict[str, Mesh] = {}
    for thing in scene.objects:
        if not thing.target:
            continue
        mesh = meshes.setdefault(thing.name, thing.mesh)
        same = mesh is thing.mesh or (
            np.array_equal(mesh.vertices, thing.mesh.vertices) and np.array_equal(mesh.faces, thing.mesh.faces)
        )
        if not same:
            msg = f"two different targets are called {thing.name!r}: give one of them another name"
            raise UsageError(msg)
    files = [model_file(name) for name in meshes]
    if len(set(files)) < len(files):
        msg = f"targets need names that differ as file names, got {', '.join(sorted(meshes))}"
        raise UsageError(msg)
    return meshes


def model_file(name: str) -> str:
    """Where the model of this name lies in the folder."""
    return f"models/{safe_name(name)}.stl"


def write_model(path: Path, mesh: Mesh) -> None:
    """A binary STL file, metres."""
    import trimesh

    path.parent.mkdir(exist_ok=True)
    path.write_bytes(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="stl"))


def write_truth(path: Path, truth: Mapping[str, Any]) -> None:
    """truth.json, one object a line."""
    path.write_text(to_json(truth) + "\n", encoding="utf-8")


def to_json(truth: Mapping[str, Any]) -> str:
    """Lists of objects and stations one a line: a plant has a hundred."""
    entries = []
    for key, value in truth.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            lines = ",\n  ".join(json.dumps(entry) for entry in value)
            entries.append(f" {json.dumps(key)}: [\n  {lines}\n ]")
        else:
            entries.append(f" {json.dumps(key)}: {json.dumps(value)}")
    return "{\n" + ",\n".join(entries) + "\n}"


def _files_of(folder: Path) -> set[str]:
    try:
        return set(json.loads((folder / TRUTH_JSON).read_text(encoding="utf-8"))["files"])
    except (ValueError, KeyError, TypeError):
        return set()


SIMULATION = Kind(TRUTH_JSON, _files_of)
