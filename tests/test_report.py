"""Reports: what a result says and nothing else, whatever its names are; whole files or none; the result untouched."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import shutil
import sys
import time
from datetime import date
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from by_hand import absent, detection, folder_by_hand, results
from scanfind.cli import main
from scanfind.design.elements import NOT_FOUND
from scanfind.errors import (
    MissingExtraError,
    OutputError,
    ScanfindError,
    UnreadableFileError,
    UnsupportedFormatError,
    UsageError,
)
from scanfind.report import write_report
from scanfind.report.content import Content
from scanfind.report.material import Points, _level, _thinned, shape_of
from scanfind.report.page import page_of
from scanfind.report.scene import scene_of
from scanfind.report.tables import COLUMNS, csv_of
from scanfind.results import RESULTS_JSON, read_results
from scanfind.tolerances import IN, OUT

EVIL = '</script><script>window.hacked=1</script><img src=x onerror="window.hacked=2">\'&{{7*7}}'
FORMULAS = ("=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "  =cmd|'/C calc'!A0")
DAY = date(2026, 11, 22)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder_by_hand(tmp_path_factory.mktemp("report") / "inspected")


@pytest.fixture(scope="module")
def evil(tmp_path_factory: pytest.TempPathFactory) -> Path:
    names = ("B1", EVIL, "梁 Träger Балка 🏗", *FORMULAS)
    return folder_by_hand(tmp_path_factory.mktemp("report") / "evil", names=names)


class Tags(HTMLParser):
    """Every tag of a page, its attributes, and its text outside of scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs

    def handle_data(self, data: str) -> None:
        if self.tags[-1:] != ["script"]:
            self.text.append(data)


def written(folder: Path, out: Path, **options: Any) -> Content:
    return write_report(folder, [out], made=DAY, **options)


def digest(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


# ── what it says ──────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_tolerance_is_changed_in_the_report_and_the_result_stays(sound: Path, tmp_path: Path) -> None:
    before = digest(sound)
    profile = tmp_path / "strict.toml"
    profile.write_text('title = "strict"\n[[rule]]\nclass = "IfcBeam"\nshift_mm = 5\n')
    as_inspected = written(sound, tmp_path / "a.html")
    strictly = written(sound, tmp_path / "b.html", tolerance=profile)
    assert {item.name: item.verdict for item in as_inspected.items} == {"B1": IN, "B2": IN, "B3": ""}
    assert {item.name: item.verdict for item in strictly.items} == {"B1": IN, "B2": OUT, "B3": ""}
    assert digest(sound) == before


def test_what_needs_a_look_comes_first_and_says_why(sound: Path, tmp_path: Path) -> None:
    content = written(sound, tmp_path / "a.html", tolerance="structural-steel")
    assert [item.name for item in content.items] == ["B3", "B2", "B1"]
    page = (tmp_path / "a.html").read_text()
    for words in (
        "86 % of the surface that the 3 stations should see is empty space.",
        "Its middle stands 20 mm too low",
        "shift of its middle 20 mm, allowed 10 mm",
        "EN 1090-2",
        ["2 installed", " 1 not found"][0].split()[1],
    ):
        assert words in page


def test_a_result_of_find_is_reported_by_its_instances(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / "found")
    told = json.loads((folder / RESULTS_JSON).read_text())
    told["elements"], told["allowed_m"] = [], None
    (folder / RESULTS_JSON).write_text(json.dumps(told))
    content = write_report(folder, [tmp_path / f"r{suffix}" for suffix in (".html", ".pdf", ".csv", ".xlsx")])
    assert [item.name for item in content.items] == ["beam 1", "beam 2"]
    assert content.noun == "instances"


def test_points_are_kept_to_a_65536th_of_their_box_and_deviations_to_a_127th(sound: Path, tmp_path: Path) -> None:
    content = written(sound, tmp_path / "a.html")
    scene = scene_of(content.items, content.material)
    positions = np.frombuffer(scene.positions, "<u2").reshape(-1, 3)
    values = np.frombuffer(scene.values, np.int8)
    assert len(positions) == len(values)
    for item in scene.facts["items"]:
        if item["cloud"] is None:
            continue
        cloud = item["cloud"]
        some = slice(cloud["first"], cloud["first"] + cloud["count"])
        xyz = np.array(cloud["low"]) + positions[some] / 65535.0 * np.array(cloud["size"]) + scene.facts["origin"]
        number = next(i.found.id for i in content.items if i.key == item["key"] and i.found)
        points = content.material.points[number]
        assert np.abs(xyz - points.xyz).max() < 2.1 / 65535.0
        assert (
            np.abs(values[some] / 127.0 * scene.facts["full"] - points.values).max()
            <= 0.51 / 127.0 * scene.facts["full"]
        )


def test_an_instance_that_no_element_is_taken_for_is_told(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / "copy")
    told = json.loads((folder / RESULTS_JSON).read_text())
    told["elements"][1].update(status="not_found", detection=None, shift_m=None, turn_rad=None, off_m=None)
    (folder / RESULTS_JSON).write_text(json.dumps(told))
    items = written(folder, tmp_path / "a.html").items
    assert [(item.name, item.status_words) for item in items] == [
        ("B2", "not found"), ("B3", "not found"), ("beam 2", "not in the design"), ("B1", "installed"),
    ]  # fmt: skip


def test_fewer_points_make_a_smaller_page(sound: Path, tmp_path: Path) -> None:
    content = written(sound, tmp_path / "a.html", points=1000)
    assert sum(len(cloud.xyz) for cloud in content.material.points.values()) <= 1000
    written(sound, tmp_path / "b.html")
    assert (tmp_path / "a.html").stat().st_size < (tmp_path / "b.html").stat().st_size


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=20), st.integers(0, 5000))
def test_small_clouds_keep_their_points_and_all_keep_to_the_sum(sizes: list[int], most: int) -> None:
    level = _level(sizes, most)
    kept = [min(size, level) for size in sizes]
    assert sum(kept) <= most
    assert kept == sizes or sum(kept) > most - len(sizes)


def test_thinning_is_the_same_each_time() -> None:
    cloud = Points(np.random.default_rng(0).normal(size=(100, 3)), np.zeros(100))
    np.testing.assert_array_equal(_thinned(cloud, 10, 3).xyz, _thinned(cloud, 10, 3).xyz)


def test_a_model_of_very_many_faces_is_drawn_coarser_and_as_large() -> None:
    from dataclasses import replace

    from scanfind.library.model import ModelParameters, build_model
    from scanfind.library.surface import SurfaceParameters
    from scanfind.mesh import Mesh
    from scanfind.report.material import MOST_FACES
    from scanfind.simulate.parts import box

    side = np.linspace(0.0, 1.0, 200)
    x, y = np.meshgrid(side, side)
    vertices = np.column_stack([x.ravel(), y.ravel(), 0.1 * np.sin(5.0 * x.ravel())])
    corner = (np.arange(199)[:, None] * 200 + np.arange(199)).ravel()
    faces = np.vstack([np.column_stack([corner, corner + 1, corner + 200]),
                       np.column_stack([corner + 1, corner + 201, corner + 200])])  # fmt: skip
    model = build_model(box(1.0, 1.0, 1.0), ModelParameters(SurfaceParameters(samples=200)))
    shape = shape_of(replace(model, mesh=Mesh.of("wave", vertices, faces)))
    assert 0 < len(shape.faces) <= MOST_FACES
    np.testing.assert_allclose(np.ptp(shape.vertices, axis=0), np.ptp(vertices, axis=0), atol=0.02)


# ── whatever the names are ────────────────────────────────────────────────────────────────────────────────────────


def test_no_name_becomes_markup(evil: Path, tmp_path: Path) -> None:
    written(evil, tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    tags = Tags(page)
    assert tags.tags.count("script") == 6  # four buffers, the facts, and ours
    assert "img" not in tags.tags
    assert not any(name.startswith("on") for name, _ in tags.attributes)
    assert EVIL in "".join(tags.text)
    assert "梁 Träger Балка 🏗" in page


def test_nothing_is_fetched(sound: Path, tmp_path: Path) -> None:
    written(sound, tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "").replace("http-equiv", "")
    assert not {"src", "href"} & {name for name, _ in Tags(page).attributes}
    assert "default-src 'none'" in page


def test_no_cell_is_a_formula(evil: Path, tmp_path: Path) -> None:
    import openpyxl

    write_report(evil, [tmp_path / "a.csv", tmp_path / "a.xlsx"])
    rows = list(csv.DictReader(io.StringIO((tmp_path / "a.csv").read_text(encoding="utf-8-sig"))))
    assert tuple(rows[0]) == COLUMNS
    assert {row["name"] for row in rows} >= {f"'{formula}" for formula in FORMULAS} | {EVIL}
    assert not any(row["name"].lstrip().startswith(("=", "+", "-", "@")) for row in rows)
    (book, *_) = openpyxl.load_workbook(tmp_path / "a.xlsx").worksheets
    cells = [cell for row in book.iter_rows() for cell in row]
    assert {cell.value for cell in cells} >= {*FORMULAS, EVIL}
    assert {cell.data_type for cell in cells} <= {"s", "n"}
    assert not any(cell.hyperlink for cell in cells)


def test_numbers_stay_numbers_in_a_table(sound: Path, tmp_path: Path) -> None:
    rows = list(csv.DictReader(io.StringIO(csv_of(written(sound, tmp_path / "a.csv")).decode("utf-8-sig"))))
    assert {row["name"]: row["shift_z_mm"] for row in rows} == {"B1": "0.0", "B2": "-20.0", "B3": ""}


def test_the_pdf_is_one_with_pictures_and_any_name(evil: Path, tmp_path: Path) -> None:
    import pypdfium2

    written(evil, tmp_path / "a.pdf", tolerance="structural-steel")
    with pypdfium2.PdfDocument(tmp_path / "a.pdf") as document:
        text = "".join(page.get_textpage().get_text_range() for page in document)
        picture = np.asarray(document[1].render(scale=0.5).to_numpy()).astype(int)
    assert "not found" in text
    assert "window.hacked=1" in text
    assert (np.ptp(picture, axis=2) > 60).any()  # a colour, not only black on white


def test_the_same_report_is_the_same_file(sound: Path, tmp_path: Path) -> None:
    for name in ("a.html", "b.html", "a.pdf", "b.pdf", "a.csv", "b.csv"):
        written(sound, tmp_path / name)
    for suffix in (".html", ".pdf", ".csv"):
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


# ── odd results ───────────────────────────────────────────────────────────────────────────────────────────────────


def by_hand(folder: Path, told: Any) -> Path:
    folder.mkdir()
    (folder / RESULTS_JSON).write_text(told.to_json())
    return folder


@pytest.mark.parametrize("suffix", [".html", ".pdf", ".csv", ".xlsx"])
def test_an_empty_result_and_one_without_points_are_reported(tmp_path: Path, suffix: str) -> None:
    empty = by_hand(tmp_path / "empty", results())
    bare = by_hand(
        tmp_path / "bare", results(absent(NOT_FOUND, 0.0, 0.0, 1.0, 0.0), detection(points=0, deviation=None))
    )
    for folder in (empty, bare):
        written(folder, tmp_path / f"{folder.name}{suffix}")
        assert (tmp_path / f"{folder.name}{suffix}").stat().st_size


def test_a_thousand_elements_are_a_page_of_seconds(tmp_path: Path) -> None:
    many = [absent(NOT_FOUND, 0.0, 0.0, 1.0, 0.0, name=f"B{k}", global_id=f"g{k}") for k in range(1000)]
    folder = by_hand(tmp_path / "many", results(*many))
    began = time.process_time()
    content = write_report(folder, [tmp_path / "a.html", tmp_path / "a.xlsx"])
    assert time.process_time() - began < 10.0
    assert len(content.items) == 1000
    assert (tmp_path / "a.html").stat().st_size < 5e6


def test_points_that_are_gone_or_elsewhere_are_told_and_never_read(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / "copy")
    told = json.loads((folder / RESULTS_JSON).read_text())
    (folder / told["detections"][0]["isolated"]).unlink()
    told["detections"][1]["isolated"] = "../secret.ply"
    shutil.copy(sound / "points" / "001_beam.ply", tmp_path / "secret.ply")
    (folder / RESULTS_JSON).write_text(json.dumps(told))
    content = written(folder, tmp_path / "a.html")
    assert not content.material.points
    assert sum("not in the result folder" in note for note in content.notes()) == 2


@pytest.mark.parametrize("name", [RESULTS_JSON, "points/001_beam.ply", "models.scanfind"])
def test_a_damaged_result_is_one_line_and_no_report(
    sound: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(sound, tmp_path / "copy")
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(ScanfindError):
        written(folder, tmp_path / "a.html")
    assert main(["report", str(folder), "--out", str(tmp_path / "a.html")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "a.html").exists()


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity"])
def test_numbers_that_are_none_are_refused(sound: Path, tmp_path: Path, number: str) -> None:
    folder = shutil.copytree(sound, tmp_path / "copy")
    text = (folder / RESULTS_JSON).read_text()
    (folder / RESULTS_JSON).write_text(text.replace('"off_m": 0.02', f'"off_m": {number}'))
    with pytest.raises(UnreadableFileError):
        written(folder, tmp_path / "a.html")


def test_no_result_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UnreadableFileError):
        written(tmp_path, tmp_path / "a.html")


# ── whole or not at all ───────────────────────────────────────────────────────────────────────────────────────────


def test_what_is_there_is_replaced_only_when_asked(sound: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.csv"
    out.write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        written(sound, out)
    assert out.read_text() == "mine"
    written(sound, out, overwrite=True)
    assert out.read_text() != "mine"


def test_of_several_files_all_are_written_or_none(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "reportlab", None)
    monkeypatch.setitem(sys.modules, "reportlab.lib.pagesizes", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'scanfind\[report\]'"):
        write_report(sound, [tmp_path / "a.html", tmp_path / "a.pdf"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("suffix", "library"), [(".html", "jinja2"), (".xlsx", "xlsxwriter")])
def test_a_missing_library_is_named(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, library: str
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'scanfind\[report\]'"):
        written(sound, tmp_path / f"a{suffix}")


def test_a_disk_that_refuses_leaves_nothing(sound: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        write_report(sound, [tmp_path / "a.csv", tmp_path / "file" / "b.csv"])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_wrong_calls_say_what_to_do(sound: Path, tmp_path: Path) -> None:
    with pytest.raises(UnsupportedFormatError, match=r"\.html, \.pdf, \.csv, \.xlsx"):
        written(sound, tmp_path / "a.docx")
    with pytest.raises(UsageError, match="--points"):
        written(sound, tmp_path / "a.html", points=-1)
    with pytest.raises(UsageError, match="structural-steel"):
        written(sound, tmp_path / "a.html", tolerance="structural-steal")


def test_the_command_says_what_it_wrote(sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep" / "a.html"
    assert main(["report", str(sound), "--out", str(out), "--tolerance", "structural-steel"]) == 0
    assert "3 elements: 2 installed, 1 not found, 1 in tolerance, 1 out of tolerance" in capsys.readouterr().err
    assert out.read_bytes() == page_of(write_report(sound, [], tolerance="structural-steel"))
    assert read_results(sound).elements
