"""The result folder: complete, safe, readable by others, and there only when all of it is."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import isnan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanfind.detection import Detection, Deviation, Findings, IsolatedPoints, Motion, Refused, SceneScan
from scanfind.errors import OutputError, UnreadableFileError, UnsupportedFormatError
from scanfind.library import ModelLibrary
from scanfind.mesh import Mesh
from scanfind.pose import Pose, random_rotation
from scanfind.results import NAME_BYTES, read_results, result_folder, safe_name, schema, write_results
from scanfind.results.document import document, findings_of, fingerprint, model_entries
from scanfind.scans import read_scan

# The schema of results.json that other programs were promised; more keys may come, none of these may go.
PROMISED = {
    "": "schema scanfind seed parameters shift_m crs scans models detections refused timings_s peak_memory_bytes",
    "scans": "path points dropped stations_m",
    "models": "name sha256 diameter_m pairs symmetry",
    "detections": "id model scene_from_model translation_m quaternion score support visible_support penalty coverage "
    "rms_m unobservable points isolated covariance pivot_m sigma_m sigma_rad",
    "timings_s": "read grid search verify refine isolate write total",
}


@dataclass(frozen=True)
class Stage:
    time_limit_s: float = 20.0
    shares: tuple[float, ...] = (0.75, 0.4)


@dataclass(frozen=True)
class Settings:
    search: Stage = field(default_factory=Stage)


@pytest.fixture(scope="module")
def models() -> Iterator[ModelLibrary]:
    import trimesh

    with ModelLibrary.in_memory() as library:
        for name, size in (("Rohr Ø 168/4", 1.0), ("frame", 2.0)):
            box = trimesh.creation.box((size, 0.5 * size, 0.3 * size))
            library.add(Mesh.of(name, box.vertices, box.faces))
        yield library


@pytest.fixture
def findings(tmp_path: Path) -> Findings:
    rng = np.random.default_rng(20)
    scan = tmp_path / "shop.xyz"
    scan.write_text("1 2 3\n")
    found = Findings([_detection(1, "Rohr Ø 168/4", rng, 50), _detection(2, "Rohr Ø 168/4", rng, 0)])
    why = "seen through at 12 % of its surface"
    found.refused = [Refused("frame", _pose(rng), 0.3, 0.4, 0.5, float("nan"), why, 0.9, 0.01)]
    found.scans = [SceneScan(str(scan), 1_000, 17, ((1.0, 2.0, 3.0), None))]
    found.shift, found.crs, found.notes = (650_000.0, 5_100_000.0, 0.0), None, ["one scan has no origin"]
    found.tolerance_m = 0.01
    found.timings_s = {"read": 1.0, "search": 2.5, "total": 4.0}
    return found


def _pose(rng: np.random.Generator) -> Pose:
    return Pose(random_rotation(rng), rng.uniform([650e3, 51e5, 0], [651e3, 5101e3, 9]))


def _detection(number: int, model: str, rng: np.random.Generator, points: int) -> Detection:
    pose = _pose(rng)
    isolated = IsolatedPoints(
        xyz=np.round(pose.translation + rng.uniform(-1, 1, (points, 3)), 4),
        attributes={
            "intensity": rng.random(points, np.float32),
            "red": rng.integers(0, 255, points, np.uint8),
            "instance": np.full(points, 99, np.int32),
        },
        scan_id=rng.integers(0, 2, points, np.int32),
        source_index=np.arange(points, dtype=np.int64) * 3,
        deviation=rng.normal(0, 0.002, points).astype(np.float32),
    )
    deviation = Deviation(0.0001, 0.002, 0.004, -0.009) if points else None
    free = (Motion("roll", (1.0, 0.0, 0.0), (0.0, 0.0, 0.1), 0.02 if points else None),)
    found = Detection(number, model, pose, 0.9, 0.6, 0.95, 0.01, 0.55, 0.0012, free, isolated, deviation)
    root = rng.normal(0, 1e-4, (6, 6))
    pivot = tuple(pose.translation.tolist())
    return replace(found, covariance=root @ root.T, pivot=pivot, probability=0.97) if points else found


def test_results_json_keeps_the_promised_schema(tmp_path: Path, findings: Findings, models: ModelLibrary) -> None:
    write_results(findings, tmp_path / "out", models=models, parameters=Settings(), seed=7)
    text = (tmp_path / "out" / "results.json").read_text(encoding="utf-8")

    def refuse(constant: str) -> float:
        msg = f"{constant} is no JSON"
        raise ValueError(msg)

    results = json.loads(text, parse_constant=refuse)
    assert list(results)[:3] == ["schema", "scanfind", "seed"]
    for part, keys in PROMISED.items():
        entries = results if not part else results[part]
        for entry in entries if isinstance(entries, list) else [entries]:
            assert set(keys.split()) <= set(entry), part
    assert results["schema"] == 1
    assert results["seed"] == 7
    assert results["parameters"] == {"search": {"time_limit_s": 20.0, "shares": [0.75, 0.4]}}
    assert results["shift_m"] == [650_000.0, 5_100_000.0, 0.0]
    assert results["scans"][0]["stations_m"] == [[1.0, 2.0, 3.0], None]
    assert results["refused"][0]["penalty"] is None
    assert {model["name"]: model["pairs"] > 0 for model in results["models"]} == {"Rohr Ø 168/4": True, "frame": True}
    for model, summary in zip(results["models"], models.show(), strict=True):
        assert model["symmetry"]["words"] == summary.symmetry.words()
        assert [axis["order"] or 0 for axis in model["symmetry"]["axes"]] == [a.order for a in summary.symmetry.axes]
        assert model["symmetry"]["centre_m"] == summary.symmetry.centre.tolist()
    assert results["timings_s"]["total"] == pytest.approx(4.0 + results["timings_s"]["write"])
    assert results["peak_memory_bytes"] > 1_000_000
    for entry, found in zip(results["detections"], findings, strict=True):
        assert np.array_equal(entry["scene_from_model"], found.scene_from_model.matrix())
        assert entry["translation_m"] == found.scene_from_model.translation.tolist()
        assert entry["quaternion"] == found.scene_from_model.quaternion()
        assert found.isolated is not None
        assert entry["points"] == len(found.isolated)


def test_document_and_back_is_the_identity(findings: Findings, models: ModelLibrary) -> None:
    first = document(findings, models=model_entries(models), parameters=Settings(), seed=3)
    again = document(findings_of(first), models=first.models, parameters=first.parameters, seed=first.seed)
    # The points themselves are not in results.json, and the two were made at different times.
    without = [entry.model_copy(update={"points": 0}) for entry in first.detections]
    assert again == first.model_copy(update={"detections": without, "peak_memory_bytes": again.peak_memory_bytes})


def test_what_is_uncertain_is_read_back_to_the_last_bit(findings: Findings, models: ModelLibrary) -> None:
    told = document(findings, models=model_entries(models), parameters=Settings(), seed=3)
    again = findings_of(schema.Results.model_validate_json(told.to_json()))
    assert again[1].covariance is None
    assert again[1].pivot is None
    np.testing.assert_array_equal(np.array(again[0].covariance), np.array(findings[0].covariance))
    for mine, theirs in zip(findings, again, strict=True):
        assert (mine.pivot, mine.unobservable) == (theirs.pivot, theirs.unobservable)


def test_results_of_before_there_were_probabilities_are_read(findings: Findings, models: ModelLibrary) -> None:
    told = json.loads(document(findings, models=model_entries(models), parameters=Settings(), seed=3).to_json())
    assert [entry["probability"] for entry in told["detections"] + told["refused"]] == [0.97, None, 0.01]
    for entry in told["detections"] + told["refused"]:
        del entry["probability"], entry["rival"]
    older = findings_of(schema.Results.model_validate(told))
    assert all(isnan(one.probability) and isnan(one.rival) for one in [*older, *older.refused])


def test_poses_read_back_lie_in_memory_as_the_search_makes_them(findings: Findings, models: ModelLibrary) -> None:
    # Kernels are compiled for each layout they meet, and isolating again would start with that.
    told = document(findings, models=model_entries(models), parameters=Settings(), seed=3)
    for found in findings_of(told):
        assert found.scene_from_model.rotation.flags.c_contiguous
        assert found.scene_from_model.translation.flags.c_contiguous


def test_a_folder_that_cannot_be_made_is_told_without_our_names(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    told = r"results cannot be written: [^:]*: choose another"
    with pytest.raises(OutputError, match=told), result_folder(tmp_path / "file" / "out"):
        pass


def test_what_is_written_is_what_is_read(tmp_path: Path, findings: Findings, models: ModelLibrary) -> None:
    written = write_results(findings, tmp_path / "out", models=models, parameters=Settings())
    assert read_results(tmp_path / "out") == written
    assert read_results(tmp_path / "out" / "results.json") == written


def test_poses_are_four_rows_of_four_numbers(tmp_path: Path, findings: Findings, models: ModelLibrary) -> None:
    results = write_results(findings, tmp_path / "out", models=models, parameters=Settings())
    for entry, found in zip(results.detections, findings, strict=True):
        assert entry.pose is not None
        assert np.array_equal(np.loadtxt(tmp_path / "out" / entry.pose), found.scene_from_model.matrix())


@pytest.mark.parametrize("format", ["ply", "las", "laz", "e57", "pcd"])
def test_isolated_points_keep_every_field(
    tmp_path: Path, findings: Findings, models: ModelLibrary, format: str
) -> None:
    results = write_results(findings, tmp_path / "out", models=models, parameters=Settings(), format=format)
    name = results.detections[0].isolated
    assert name == f"points/001_Rohr_Ø_168_4.{format}"
    (chunk,) = read_scan(tmp_path / "out" / name)
    expected = findings[0].isolated
    assert expected is not None
    assert np.allclose(chunk.xyz, expected.xyz, rtol=0, atol=1e-4)
    assert np.array_equal(chunk.attributes["red"], expected.attributes["red"])
    assert set(chunk.attributes["instance"]) == {1}  # ours, not the stale one of the input
    assert np.array_equal(chunk.attributes["scan_id"], expected.scan_id)
    assert np.array_equal(chunk.attributes["source_index"], expected.source_index)
    assert np.allclose(chunk.attributes["deviation"], expected.deviation, rtol=0, atol=1e-7)


def test_csv_has_a_line_a_detection(tmp_path: Path, findings: Findings, models: ModelLibrary) -> None:
    write_results(findings, tmp_path / "out", models=models, parameters=Settings())
    with (tmp_path / "out" / "results.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["id"], row["model"], row["unobservable"]) for row in rows] == [
        ("1", "Rohr Ø 168/4", "roll"),
        ("2", "Rohr Ø 168/4", "roll"),
    ]
    assert float(rows[0]["x_m"]) == findings[0].scene_from_model.translation[0]
    assert float(rows[0]["deviation_worst_m"]) == -0.009
    assert rows[1]["deviation_worst_m"] == ""
    assert float(rows[0]["sigma_m"]) == findings[0].sigma_m
    assert float(rows[0]["sigma_deg"]) == np.degrees(findings[0].sigma_rad)
    assert rows[1]["sigma_m"] == rows[1]["sigma_deg"] == ""


def test_the_folder_holds_the_models_found(tmp_path: Path, findings: Findings, models: ModelLibrary) -> None:
    write_results(findings, tmp_path / "out", models=models, parameters=Settings())
    with ModelLibrary.open(tmp_path / "out" / "models.scanfind") as kept:
        assert kept.names() == ["Rohr Ø 168/4"]
        assert kept.get("Rohr Ø 168/4").sha256 == models.get("Rohr Ø 168/4").sha256


def test_nothing_found_is_a_result(tmp_path: Path, models: ModelLibrary) -> None:
    write_results(Findings(), tmp_path / "out", models=models, parameters=Settings())
    assert read_results(tmp_path / "out").detections == []
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["results.csv", "results.json"]


@given(st.text())
def test_any_model_name_makes_a_safe_file_name(name: str) -> None:
    safe = safe_name(name)
    assert safe == safe_name(name)
    assert 0 < len(safe.encode("utf-8")) <= NAME_BYTES
    assert not set(safe) & set('/\\:*?"<>|\0\n ')
    assert safe[0] != "."


def test_names_that_differ_only_in_marks_stay_apart(tmp_path: Path, findings: Findings, models: ModelLibrary) -> None:
    results = write_results(findings, tmp_path / "out", models=models, parameters=Settings())
    names = [name for found in results.detections for name in (found.pose, found.isolated)]
    assert len(set(names)) == 4
    assert all((tmp_path / "out" / str(name)).is_file() for name in names)


def test_a_failure_leaves_nothing(tmp_path: Path, findings: Findings, models: ModelLibrary) -> None:
    before = sorted(tmp_path.iterdir())
    with pytest.raises(UnsupportedFormatError, match="xyz"):
        write_results(findings, tmp_path / "out", models=models, parameters=Settings(), format="xyz")
    with pytest.raises(KeyboardInterrupt), result_folder(tmp_path / "out") as folder:  # noqa: PT012
        (folder / "half").write_text("half")
        raise KeyboardInterrupt
    assert sorted(tmp_path.iterdir()) == before


def test_a_foreign_folder_is_never_touched(tmp_path: Path) -> None:
    mine = tmp_path / "thesis"
    mine.mkdir()
    (mine / "chapter1.txt").write_text("years of work")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="not scanfind's"), result_folder(mine, overwrite=overwrite):
            pass
    assert (mine / "chapter1.txt").read_text() == "years of work"
    with pytest.raises(OutputError, match="is a file"), result_folder(mine / "chapter1.txt"):
        pass


def test_an_older_result_goes_only_when_asked(tmp_path: Path, findings: Findings, models: ModelLibrary) -> None:
    out = tmp_path / "out"
    write_results(findings, out, models=models, parameters=Settings(), seed=1)
    with pytest.raises(OutputError, match="--overwrite"):
        write_results(findings, out, models=models, parameters=Settings(), seed=2)
    assert read_results(out).seed == 1
    write_results(findings, out, models=models, parameters=Settings(), seed=3, overwrite=True)
    assert read_results(out).seed == 3
    # What the user put among the results stays, even when they are to be replaced.
    (out / "points" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"points/notes\.txt"):
        write_results(findings, out, models=models, parameters=Settings(), seed=4, overwrite=True)
    assert read_results(out).seed == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "shop.xyz"]


def test_an_interrupted_overwrite_keeps_the_older_result(
    tmp_path: Path, findings: Findings, models: ModelLibrary
) -> None:
    out = tmp_path / "out"
    write_results(findings, out, models=models, parameters=Settings(), seed=1)
    with pytest.raises(KeyboardInterrupt), result_folder(out, overwrite=True):
        raise KeyboardInterrupt
    assert read_results(out).seed == 1


def test_an_empty_folder_may_be_filled(tmp_path: Path, models: ModelLibrary) -> None:
    (tmp_path / "out").mkdir()
    write_results(Findings(), tmp_path / "out", models=models, parameters=Settings())
    assert read_results(tmp_path / "out").detections == []


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": 1}', "\xff"])
def test_a_damaged_results_json_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "results.json").write_text(text, encoding="latin-1")
    with pytest.raises(UnreadableFileError) as caught:
        read_results(tmp_path)
    assert "\n" not in str(caught.value)


def test_no_result_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UnreadableFileError, match="no result to read"):
        read_results(tmp_path)


def test_a_fingerprint_sees_both_ends_and_the_length(tmp_path: Path) -> None:
    file = tmp_path / "scan"
    data = bytearray(3 << 20)
    marks = set()
    for change in (None, 0, len(data) - 1):
        if change is not None:
            data[change] = 1
        file.write_bytes(data)
        marks.add(fingerprint(file))
    file.write_bytes(data + b"\0")
    marks.add(fingerprint(file))
    assert len(marks) == 4
    assert fingerprint(tmp_path / "none") is None


def test_results_have_a_json_schema() -> None:
    described = schema.Results.model_json_schema()
    assert set(PROMISED[""].split()) <= set(described["properties"])
