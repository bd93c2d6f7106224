"""The report's page in a headless Chromium, from file://: no complaint, and what it shows is what the result says."""

from __future__ import annotations

import io
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from browser import Page, browser, chromium
from by_hand import folder_by_hand
from scanfind.picture import Dots, View, deviation_colours, draw
from scanfind.report import write_report
from scanfind.report.content import Content
from test_report import EVIL

VIEWER = "window.scanfindReport.viewer"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Content]:
    folder = tmp_path_factory.mktemp("browser")
    inspected = folder_by_hand(folder / "inspected", names=("B1", EVIL, "B3"))
    content = write_report(inspected, [folder / "report.html"], tolerance="structural-steel")
    return folder / "report.html", content


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    if chromium() is None:
        if os.environ.get("CI"):
            pytest.fail("CI must have a Chromium")
        pytest.skip("no Chromium to try the page in")
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture
def shown(page: Page, report: tuple[Path, Content]) -> Page:
    """The page as it is when it is opened."""
    page.complaints.clear()
    page.open(report[0])
    return page


def pixels(png: bytes) -> NDArray[Any]:
    from PIL import Image

    with Image.open(io.BytesIO(png)) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def drawn(page: Page) -> None:
    """Wait until all that was asked is drawn: on a busy machine a page stands before its first picture does."""
    page.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def settled(page: Page) -> NDArray[Any]:
    """What the page looks like when all that was asked is drawn."""
    drawn(page)
    return pixels(page.screenshot())


def viewer_box(page: Page) -> tuple[int, int, int, int]:
    box = page.run(
        "(b => [b.left, b.top, b.right, b.bottom])(document.getElementById('canvas').getBoundingClientRect())"
    )
    left, top, right, bottom = (round(value) for value in box)
    return left, top, right, bottom


def on_page(page: Page, item: int) -> tuple[float, float]:
    """Where on the page an item is: the middle of the plate it stands on."""
    drawn(page)
    left, top, _, _ = viewer_box(page)
    middle = f"v.clouds[{item}].low.map((low, k) => low + v.clouds[{item}].size[k] * [0.5, 0.5, 0.06][k])"
    x, y = page.run(f"(v => v.onPage({middle}))({VIEWER})")
    return left + x, top + y


def put(page: Page, what: str, value: str, event: str = "input") -> None:
    """Set an input of the page, as a person would."""
    change = f"s.value = '{value}'; s.dispatchEvent(new Event('{event}'))"
    page.run(f"(s => {{ {change}; }})(document.querySelector({what!r}))")


def only_points(page: Page) -> None:
    for layer in ("model", "around"):
        page.run(f"document.querySelector('[data-layer={layer}]').click()")


def test_it_opens_without_a_complaint_at_any_width_light_or_dark(page: Page, report: tuple[Path, Content]) -> None:
    looks = []
    for width, dark in ((1440, False), (1440, True), (420, False)):
        page.complaints.clear()
        page.open(report[0], width, 900, dark=dark)
        looks.append(settled(page))
        assert not page.complaints
        assert page.run("document.getElementById('status').textContent") == ""
        assert page.run("document.documentElement.scrollWidth <= window.innerWidth")
        assert page.run("document.querySelectorAll('#table tbody tr').length") == 3
    assert looks[0][:50].mean() > 200
    assert looks[1][:50].mean() < 80


def test_names_are_shown_and_never_run(shown: Page) -> None:
    assert shown.run("typeof window.hacked") == "undefined"
    names = shown.run("[...document.querySelectorAll('#table tbody tr')].map(row => row.cells[0].textContent)")
    assert EVIL in names
    shown.run("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hacked = 3\">')")
    time.sleep(0.1)
    assert shown.run("typeof window.hacked") == "undefined"  # the page's own policy refuses what escaping would miss


def test_a_status_that_nobody_knows_is_shown_as_it_is(page: Page, report: tuple[Path, Content], tmp_path: Path) -> None:
    odd = tmp_path / "odd"
    shutil.copytree(report[0].parent / "inspected", odd)
    text = (odd / "results.json").read_text()
    (odd / "results.json").write_text(text.replace('"status": "not_found"', '"status": "__proto__ \\"><b>"'))
    write_report(odd, [tmp_path / "odd.html"])
    page.complaints.clear()
    page.open(tmp_path / "odd.html")
    settled(page)
    assert page.run("document.getElementById('status').textContent") == ""
    assert page.run("document.querySelectorAll('td b').length") == 0
    assert not page.complaints


def test_an_element_is_picked_in_the_picture_and_in_the_table(shown: Page) -> None:
    item = shown.run("window.scanfindReport.facts.items.findIndex(item => item.name === 'B1')")
    shown.click(*on_page(shown, item))
    settled(shown)
    chosen = "document.querySelector('.item:not([hidden]) h2').textContent"
    assert shown.run(f"{VIEWER}.selected") == item
    assert shown.run(chosen) == "B1"
    shown.run("document.querySelector('tr[data-status=not_found]').click()")
    assert shown.run(chosen) == "B3"
    assert "is empty space" in shown.run("document.querySelector('.item:not([hidden])').textContent")
    assert not shown.complaints


def test_the_table_is_filtered_and_sorted(shown: Page) -> None:
    visible = "[...document.querySelectorAll('#table tbody tr:not([hidden])')].map(row => row.dataset.status)"
    shown.run("document.querySelector('.chip[data-show=out_of_tolerance]').click()")
    assert shown.run(visible) == ["installed"]
    shown.run("document.querySelector('.chip[data-show=out_of_tolerance]').click()")
    put(shown, "#search", "gid3")
    assert shown.run(visible) == ["not_found"]
    put(shown, "#search", "")
    shown.run("document.querySelectorAll('#table th button')[3].click()")
    offs = "[...document.querySelectorAll('#table tbody tr')].map(row => row.cells[3].textContent.trim())"
    assert shown.run(offs) == ["0.0", "20.0", "–"]
    shown.run("document.querySelectorAll('#table th button')[3].click()")
    assert shown.run(offs) == ["20.0", "0.0", "–"]


def test_it_recolours_by_a_tolerance(shown: Page) -> None:
    only_points(shown)
    left, top, right, bottom = viewer_box(shown)

    def reds(limit_mm: float) -> tuple[int, float]:
        put(shown, "#limit", f"{10 * limit_mm}")
        put(shown, "#colour", "1", "change")
        seen = settled(shown)[top + 60 : bottom - 120, left:right]
        red = (seen[..., 0] > seen[..., 1] + 60) & (seen[..., 0] > seen[..., 2] + 60)
        return int(red.sum()), shown.run(f"{VIEWER}.within(0) ?? {VIEWER}.within(1)")

    wide, narrow = reds(6.0), reds(3.0)
    assert narrow[0] > 50 > wide[0]
    assert wide[1] == pytest.approx(1.0, abs=0.02)
    assert narrow[1] == pytest.approx(0.9, abs=0.03)  # a tenth of the points were put 6 mm outside


def test_what_it_shows_is_what_another_renderer_draws(shown: Page, report: tuple[Path, Content]) -> None:
    only_points(shown)
    left, top, right, bottom = viewer_box(shown)
    seen = settled(shown)[top:bottom, left:right]
    camera = "v.camera.eye(), v.camera.back(), v.camera.axes().up, v.camera.field"
    eye, back, up, field, origin, limit = shown.run(f"(v => [{camera}, v.facts.origin, v.limit])({VIEWER})")
    view = View(np.add(eye, origin), -np.array(back), np.array(up), field)
    clouds = report[1].material.points.values()
    dots = [Dots(cloud.xyz, deviation_colours(cloud.values, limit), 2) for cloud in clouds]
    drawn = draw(view, dots, right - left, bottom - top).astype(int)
    # Coarsely, and where no button lies: shading and the size of dots are each renderer's own.
    ours, theirs = (np.abs(picture - picture[150, 5]).sum(axis=2) > 40 for picture in (seen, drawn))
    rows, columns = slice(64, -130), slice(8, -8)
    cells = [_coarse(mask[rows, columns]) for mask in (ours, theirs)]
    both, either = (cells[0] & cells[1]).sum(), (cells[0] | cells[1]).sum()
    assert either > 50
    assert both / either > 0.8


def test_measures_cuts_and_flies(shown: Page) -> None:
    shown.run("document.getElementById('measure').click()")
    low, high = on_page(shown, 1), on_page(shown, 2)
    shown.click(*low)
    shown.click(*high)
    settled(shown)
    assert " m" in shown.run("document.querySelector('#over text').textContent")
    shown.run("document.getElementById('section').click()")
    before = settled(shown)
    put(shown, '[data-cut="1"]', "700")
    assert (settled(shown) != before).any()
    eye = f"{VIEWER}.camera.eye()"
    was = shown.run(eye)
    left, top, right, bottom = viewer_box(shown)
    shown.drag((left + right) / 2, (top + bottom) / 2, (left + right) / 2 + 80, (top + bottom) / 2)
    assert np.linalg.norm(np.subtract(shown.run(eye), was)) > 0.1
    shown.run("document.getElementById('fly').click()")
    was = shown.run(eye)
    shown.drag((left + right) / 2, (top + bottom) / 2, (left + right) / 2 + 80, (top + bottom) / 2)
    np.testing.assert_allclose(shown.run(eye), was, atol=1e-6)  # who flies looks about from where he is
    assert not shown.complaints


def test_it_prints_light_with_all_that_needs_a_look(page: Page, report: tuple[Path, Content]) -> None:
    import pypdfium2

    page.open(report[0], dark=True)
    with pypdfium2.PdfDocument(page.pdf()) as document:
        text = "".join(sheet.get_textpage().get_text_range() for sheet in document)
        first = document[0].render(scale=0.3).to_numpy()
    assert first.mean() > 200
    assert "is empty space" in text
    assert "20 mm too low" in text


def _coarse(mask: NDArray[np.bool_], cell: int = 12) -> NDArray[np.bool_]:
    height, width = (size // cell * cell for size in mask.shape)
    blocks = mask[:height, :width].reshape(height // cell, cell, width // cell, cell)
    return np.asarray(blocks.mean(axis=(1, 3)) > 0.15)
