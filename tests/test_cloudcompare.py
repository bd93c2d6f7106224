"""What the users' own tool makes of our files: CloudCompare gives the same poses, fields and distances."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import scanfind
from scanfind.pose import Pose
from scanfind.scans import read_scan
from scanfind.simulate.parts import blocks
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject

pytestmark = pytest.mark.slow

BRACKET = blocks("bracket", [((0, 0, 0), (1, 0.3, 0.1)), ((0, 0, 0), (0.1, 0.3, 0.7))])
STANDS = Pose.from_rotation_vector((0.0, 0.0, 0.7), (0.5, -0.3, 0.0))


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of a search for a bracket on a floor; CloudCompare is there."""
    if shutil.which("CloudCompare") is None:
        if os.environ.get("CI"):
            pytest.fail("CI must have CloudCompare: .ci/run installs it")
        pytest.skip("no CloudCompare: apt-get install cloudcompare")
    floor = SceneObject("floor", blocks("floor", [((-3, -3, -0.1), (3, 3, 0))]), Pose.identity())
    scene = Scene((floor, SceneObject("bracket", BRACKET, STANDS)), np.array([[2.0, -2.5, 1.5], [-2.5, -1.5, 1.6]]))
    stations = scan(scene, scanner=Scanner(step=0.002), seed=1).stations
    folder = tmp_path_factory.mktemp("cloudcompare")
    with scanfind.ModelLibrary.in_memory() as library:
        library.add(BRACKET)
        findings = scanfind.find(stations, library)
        scanfind.write_results(findings, folder / "found", models=library, parameters=scanfind.PRESETS["default"])
    return folder / "found"


def cloudcompare(folder: Path, *arguments: str | Path) -> dict[str, np.ndarray]:
    """What CloudCompare saves as text: column by column, a row a point."""
    out = folder / "out.asc"
    command = ["CloudCompare", "-SILENT", "-NO_TIMESTAMP", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", "ASC", "-PREC", "9"]
    command += ["-ADD_HEADER", *map(str, arguments), "-SAVE_CLOUDS", "FILE", str(out)]
    environment = os.environ | {"QT_QPA_PLATFORM": "offscreen", "XDG_RUNTIME_DIR": str(folder), "HOME": str(folder)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert out.is_file(), done.stdout + done.stderr
    head, *rows = out.read_text().splitlines()
    names = head.removeprefix("//").split()
    table = np.array([row.split() for row in rows], np.float64)
    return dict(zip(names, table.T, strict=True))


def test_a_pose_file_puts_the_model_where_it_was_found(found: Path, tmp_path: Path) -> None:
    [detection] = scanfind.read_results(found).detections
    assert detection.pose is not None
    np.savetxt(tmp_path / "corners.xyz", BRACKET.vertices, fmt="%.9f")
    moved = cloudcompare(tmp_path, "-O", tmp_path / "corners.xyz", "-APPLY_TRANS", found / detection.pose)
    expected = Pose.from_matrix(detection.scene_from_model).move(BRACKET.vertices)
    np.testing.assert_allclose(np.stack([moved[axis] for axis in "XYZ"], axis=1), expected, atol=1e-6)
    np.testing.assert_allclose(expected, STANDS.move(BRACKET.vertices), atol=5e-4)


def test_fields_arrive_and_distances_to_the_mesh_are_ours(found: Path, tmp_path: Path) -> None:
    [detection] = scanfind.read_results(found).detections
    assert detection.isolated is not None
    (chunk,) = read_scan(found / detection.isolated)
    placed = Pose.from_matrix(detection.scene_from_model).move(BRACKET.vertices)
    corners = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in placed.tolist())
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in (BRACKET.faces + 1).tolist())
    (tmp_path / "model.obj").write_text(corners + faces)
    arrived = cloudcompare(tmp_path, "-O", found / detection.isolated, "-O", tmp_path / "model.obj", "-C2M_DIST")
    assert len(arrived["X"]) == len(chunk.xyz) > 10_000
    np.testing.assert_allclose(np.stack([arrived[axis] for axis in "XYZ"], axis=1), chunk.xyz, atol=1e-6)
    for name, values in chunk.attributes.items():
        np.testing.assert_allclose(arrived[name], values.astype(np.float32), rtol=1e-6, atol=1e-8)
    distances = arrived["C2M_signed_distances"]
    np.testing.assert_allclose(distances, chunk.attributes["deviation"], atol=1e-4)
