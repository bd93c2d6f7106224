"""The command line as its users meet it: exit codes, one-line errors, data on stdout and words on stderr."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scanfind.cli import main
from scanfind.cli.tables import closest, table, turned
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.results import read_results
from scanfind.results.schema import ModelEntry, Results
from scanfind.scans import open_writer, read_scan
from scanfind.simulate.objects import pipe_spool
from scanfind.simulate.scanner import scan
from scanfind.simulate.scene import Scene, SceneObject

POSE = Pose.from_rotation_vector((0.0, 0.0, 0.6), (0.5, -0.8, 0.7))
ORIGIN = "-0.5,-2.5,2.0"


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scan of a spool over a floor (scan.ply), its model in mm, and one of a ball that is not there."""
    import trimesh

    folder = tmp_path_factory.mktemp("shop")
    spool = pipe_spool()
    trimesh.Trimesh(spool.vertices * 1000.0, spool.faces).export(folder / "spool.stl")
    trimesh.creation.icosphere(radius=300.0).export(folder / "ball.stl")
    floor = trimesh.creation.box((8.0, 8.0, 0.2)).apply_translation((0.0, 0.0, -0.1))
    objects = (
        SceneObject("floor", Mesh.of("floor", floor.vertices, floor.faces), Pose.identity()),
        SceneObject("spool", spool, POSE, target=True),
    )
    stand = np.array([[float(x) for x in ORIGIN.split(",")]])
    (station,) = scan(Scene(objects, stand), points=100_000).stations
    with open_writer(folder / "scan.ply", {"intensity": np.dtype(np.float32)}) as writer:
        writer.write(station.xyz, {"intensity": station.attributes["intensity"]})
    return folder


def _points(path: Path) -> int:
    return sum(len(chunk) for chunk in read_scan(path))


def _files(found: Path) -> dict[str, bytes]:
    """The point clouds of a result folder."""
    return {path.name: path.read_bytes() for path in [*found.glob("points/*"), found / "remainder.ply"]}


def _find(shop: Path, *more: str, model: str = "spool.stl") -> int:
    # The limit is for the searches in vain; the spool is found in a second.
    scan = str(shop / "scan.ply")
    return main(
        [
            "find",
            scan,
            "--model",
            str(shop / model),
            "--units",
            "mm",
            "--origin",
            ORIGIN,
            "--time-limit",
            "5",
            *more,
        ]
    )


def _scanfind(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "scanfind", *arguments], capture_output=True, text=True, check=False, timeout=120,
        env={**os.environ, **environment},
    )  # fmt: skip


# find


def test_find_writes_a_result_and_prints_a_table(
    shop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _find(shop, "--out", str(tmp_path / "found"), "--remainder") == 0
    out, err = capsys.readouterr()
    header, line = out.splitlines()
    assert header.split()[:2] == ["id", "model"]
    assert line.split()[:2] == ["1", "spool"]
    assert str(tmp_path / "found") in err
    results = json.loads((tmp_path / "found" / "results.json").read_text())
    (found,) = results["detections"]
    distance, angle = Pose.from_matrix(found["scene_from_model"]).difference(POSE)
    assert distance < 0.002
    assert angle < 0.005
    isolated = _points(tmp_path / "found" / found["isolated"])
    assert isolated == found["points"] > 1_000
    assert isolated + _points(tmp_path / "found" / results["remainder"]) == _points(shop / "scan.ply")


@pytest.mark.slow
def test_find_prints_results_json_and_nothing_else(shop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _find(shop, "--json", "--seed", "5") == 0
    results = json.loads(capsys.readouterr().out)
    assert results["seed"] == 5
    assert results["detections"][0]["isolated"] is None  # nothing is written unless asked


@pytest.mark.slow
def test_finding_nothing_is_no_error_but_is_explained(shop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _find(shop, model="ball.stl") == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "ball: not found: " in err


@pytest.mark.slow
def test_not_finding_fails_where_that_is_asked_for(shop: Path) -> None:
    assert _find(shop, "--fail-on", "not-found", model="ball.stl") == 3
    assert _find(shop, "--fail-on", "not-found") == 0


@pytest.mark.slow
def test_the_same_run_from_a_library(shop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    library = str(tmp_path / "parts.scanfind")
    assert main(["library", "add", library, str(shop / "spool.stl"), "--units", "mm"]) == 0
    assert _find(shop, "--json") == 0
    first = json.loads(capsys.readouterr().out)["detections"]
    assert main(["find", str(shop / "scan.ply"), "--library", library, "--origin", ORIGIN, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["detections"] == first


@pytest.mark.slow
def test_a_config_file_and_the_environment_are_heard(
    shop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run.toml").write_text("seed = 3\n[verify]\nmin_score = 0.99999\n")
    monkeypatch.setenv("SCANFIND_SEED", "4")
    assert _find(shop, "--config", str(tmp_path / "run.toml"), "--json") == 0
    results = json.loads(capsys.readouterr().out)
    assert results["seed"] == 4
    assert results["parameters"]["verify"]["min_score"] == 0.99999
    assert results["detections"] == []


@pytest.mark.slow
def test_points_are_cut_again_without_searching(shop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found, scan_file = tmp_path / "found", str(shop / "scan.ply")
    assert _find(shop, "--out", str(found), "--remainder") == 0
    first = read_results(found)
    points = _files(found)
    assert main(["isolate", str(found), scan_file]) == 0
    same = read_results(found)
    told_anew = {"made": same.made, "timings_s": same.timings_s, "peak_memory_bytes": same.peak_memory_bytes}
    assert same == first.model_copy(update=told_anew)
    assert _files(found) == points

    other = tmp_path / "other"
    assert main(["isolate", str(found), scan_file, "--tolerance", "0.001", "--out", str(other), "--format", "laz"]) == 0
    less = read_results(other)
    assert 0 < less.detections[0].points < first.detections[0].points
    assert less.detections[0].points + _points(other / "remainder.ply") == _points(shop / "scan.ply")
    assert _files(found) == points
    assert main(["isolate", str(found), scan_file, "--out", str(other)]) == 1
    assert "pass --overwrite" in capsys.readouterr().err
    assert main(["isolate", str(found), scan_file, "--out", str(other), "--overwrite"]) == 0
    assert read_results(other).detections[0].points == first.detections[0].points
    capsys.readouterr()


# library and info


def test_a_library_is_listed_shown_and_shrunk(shop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    library = str(tmp_path / "parts.scanfind")
    assert main(["library", "add", library, str(shop / "spool.stl"), str(shop / "ball.stl"), "--units", "mm"]) == 0
    assert main(["library", "add", library, str(shop / "ball.stl"), "--units", "mm"]) == 0
    assert "models read: 1, new: 0, in all: 2" in capsys.readouterr().err
    assert main(["library", "list", library]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["model", "ball", "spool"]
    assert main(["library", "show", library, "ball", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["diameter"] == pytest.approx(0.6, rel=0.02)
    assert shown["symmetry"]["words"] == "free to turn about every axis"
    assert main(["library", "show", library, "spool"]) == 0
    assert "symmetry   none\n" in capsys.readouterr().out
    assert main(["library", "show", library, "bal"]) == 1
    assert "did you mean 'ball'?" in capsys.readouterr().err
    assert main(["library", "remove", library, "ball"]) == 0
    assert main(["library", "list", library, "--json"]) == 0
    assert [model["name"] for model in json.loads(capsys.readouterr().out)] == ["spool"]


def test_a_symmetry_is_declared(shop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    library = str(tmp_path / "parts.scanfind")
    add = ["library", "add", library, str(shop / "ball.stl"), "--units", "mm", "--symmetry"]
    assert main([*add, "z5,x4"]) == 2
    assert "make no finite group" in capsys.readouterr().err
    assert main([*add, "z4,x2"]) == 0
    assert main(["library", "show", library, "ball"]) == 0
    assert "symmetry   4-fold about z; 2-fold about x\n" in capsys.readouterr().out


def test_reading_a_library_that_is_not_there_makes_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["library", "list", str(tmp_path / "none.scanfind")]) == 1
    assert list(tmp_path.iterdir()) == []
    capsys.readouterr()


def test_info_tells_scans_from_models(shop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(shop / "scan.ply"), str(shop / "spool.stl")]) == 0
    out = capsys.readouterr().out
    assert f"points     {_points(shop / 'scan.ply'):,}" in out
    assert "intensity float32" in out
    assert main(["info", "--json", str(shop / "scan.ply"), str(shop / "spool.stl")]) == 0
    cloud, model = json.loads(capsys.readouterr().out)
    assert cloud["points"] == _points(shop / "scan.ply")
    assert "points" not in model


# errors


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["fnd"], 2, 'Did you mean "find"?'),
        (["find", "a.e57", "--modle", "b"], 2, "Did you mean --model?"),
        (["find", "a.e57"], 2, "--model FILE... after the scans"),
        (["find", "--model", "a.stl", "b.e57"], 2, "scans come before --model"),
        (["find", "a.e57", "--model", "a.stl", "--library", "lib"], 2, "exclude each other"),
        (["find", "a.e57", "--model", "a.stl", "--seed", "x"], 2, "--seed"),
        (["find", "a.e57", "--model", "a.stl", "--remainder"], 2, "--out DIR"),
        (["find", "a.e57", "--model", "a.stl", "--origin", "1,2"], 2, "takes 3 values with commas between, got 2"),
        (["find", "a.e57", "--model", "a.stl", "--seed", "-1"], 2, "--seed: seed: input should be"),
        (["find", "a.e57", "--model", "a.stl", "--preset", "shraif2017"], 2, "did you mean 'sharif2017'?"),
        (["find", "none.e57", "--model", "none.stl"], 1, "none.stl"),
        (["find", "a.e57", "--library", "none.scanfind"], 1, "none.scanfind"),
        (["isolate", "none", "a.e57"], 1, "no result to read"),
        (["info", "none.e57"], 1, "none.e57"),
        (["info", "none.docx"], 1, ".docx"),
    ],
)
def test_an_error_is_one_line_and_its_code(
    arguments: list[str], code: int, says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("scanfind: ")
    assert err.count("\n") == 1
    assert says in err
    assert list(tmp_path.iterdir()) == []


def test_a_foreign_folder_is_refused_before_any_work(
    shop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    assert _find(shop, "--out", str(tmp_path)) == 1
    assert "not scanfind's" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError("8 GB"), 1, "out of memory"),
        (ZeroDivisionError("division by zero"), 1, "internal error: ZeroDivisionError"),
    ],
)
def test_whatever_happens_is_one_line_and_leaves_nothing(
    shop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    error: BaseException, code: int, says: str,
) -> None:  # fmt: skip
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(sys.modules["scanfind.find"], "find", fail)
    assert _find(shop, "--out", str(tmp_path / "found")) == code
    err = capsys.readouterr().err
    assert says in err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv("SCANFIND_DEBUG", "1")
    assert _find(shop, "--out", str(tmp_path / "found")) == code


def test_a_reader_that_goes_away_is_no_error(shop: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as gone:
        command = [sys.executable, "-m", "scanfind", "info", "--json", str(shop / "scan.ply")]
        done = subprocess.run(command, stdout=gone, stderr=subprocess.PIPE, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_path_that_is_no_text_is_named_all_the_same() -> None:
    done = _scanfind("info", os.fsdecode(b"/tmp/\xff.e57"), PYTHONIOENCODING="ascii")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1


def test_python_m_is_the_command() -> None:
    assert _scanfind("--version").stdout.strip().count(".") == 2


# tables


def test_numbers_stand_on_the_right() -> None:
    rows = [["1", "pipe", "-0.5", "1,000"], ["12", "Ø", "10.25", "–"]]
    assert table(("id", "model", "x", "points"), rows).splitlines() == [
        "id  model      x  points",
        " 1  pipe    -0.5   1,000",
        "12  Ø      10.25       –",
    ]
    assert table(("id",), []) == "id"


def test_where_nothing_looks_like_a_model_its_size_is_told() -> None:
    spool = ModelEntry(name="spool", sha256="", diameter_m=3501.98, pairs=0)
    (line,) = closest(Results.model_construct(models=[spool], detections=[], refused=[]))
    assert line.startswith("spool: not found: ")
    assert line.endswith("3,501.980 m across")


def test_angles_are_yaw_pitch_roll() -> None:
    def degrees(*vector: float) -> list[float]:
        a, b, c, d = (tuple(row) for row in Pose.from_rotation_vector(vector).matrix().tolist())
        return [round(angle, 6) for angle in turned((a, b, c, d))]

    quarter = np.pi / 2
    assert degrees(0, 0, quarter / 3) == [30, 0, 0]
    assert degrees(0, quarter / 3, 0) == [0, 30, 0]
    assert degrees(quarter / 3, 0, 0) == [0, 0, 30]
