"""The report as a table for spreadsheets, one line an item: CSV and XLSX. No cell of it is ever run as a formula."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from math import degrees
from typing import TYPE_CHECKING, Any

from scanfind.errors import MissingExtraError
from scanfind.tolerances import IN, NOT_JUDGED, OUT

if TYPE_CHECKING:
    from scanfind.report.content import Content
    from scanfind.report.dimensions import Line
    from scanfind.report.items import Item

COLUMNS = (
    "name", "ifc_class", "global_id", "model", "status", "verdict", "verdict_why", "off_mm", "shift_x_mm", "shift_y_mm",
    "shift_z_mm", "turn_deg", "instance", "score", "points", "deviation_mean_mm", "deviation_p95_mm", "dimensions",
    "evidence",
)  # fmt: skip
DIMENSION_COLUMNS = (
    "name", "instance", "dimension", "unit", "design", "built", "difference", "sigma", "allowed", "verdict", "why",
    "source",
)  # fmt: skip
WIDTHS = {
    "dimension": 44,
    "why": 60,
    "source": 60,
    "name": 26,
    "ifc_class": 14,
    "global_id": 24,
    "model": 20,
    "verdict_why": 50,
    "evidence": 90,
}
# What a spreadsheet would take for a formula, also after it has cut off the blanks before it.
FORMULA = ("=", "+", "-", "@", "\t", "\r")

MOST_LETTERS = 32_000  # a cell of XLSX holds 32,767

Cell = str | float | int | None


def csv_of(content: Content) -> bytes:
    """The table as CSV, UTF-8 with the mark that Excel looks for; text that begins like a formula has a ' before it."""
    out = io.StringIO(newline="")
    writer = csv.writer(out)
    writer.writerow(COLUMNS)
    for item in content.items:
        writer.writerow([_harmless(cell) if isinstance(cell, str) else cell for cell in _row(item)])
    return out.getvalue().encode("utf-8-sig", errors="replace")


def xlsx_of(content: Content) -> bytes:
    """The table as XLSX, text kept as text. Raises MissingExtraError without XlsxWriter."""
    try:
        import xlsxwriter
    except ImportError as error:
        msg = "an XLSX report needs XlsxWriter: pip install 'scanfind[report]'"
        raise MissingExtraError(msg) from error
    out = io.BytesIO()
    with xlsxwriter.Workbook(out, {"in_memory": True, "strings_to_formulas": False, "strings_to_urls": False}) as book:
        bold, number = book.add_format({"bold": True, "bottom": 1}), book.add_format({"num_format": "0.0##"})
        formats = bold, number
        _sheet(book, content.noun.capitalize(), COLUMNS, [_row(item) for item in content.items], formats)
        if measured := [row for item in content.items for row in _dimension_rows(item)]:
            _sheet(book, "Dimensions", DIMENSION_COLUMNS, measured, formats)
        about = book.add_worksheet("About")
        for line, text in enumerate(
            [content.title, content.kind, content.facts(), content.made_by(), *content.notes()]
        ):
            about.write_string(line, 0, _printable(text))
    return out.getvalue()


def _sheet(book: Any, title: str, columns: Sequence[str], rows: Sequence[Sequence[Cell]], formats: Any) -> None:
    """A sheet with a head that stays, and a filter."""
    bold, number = formats
    sheet = book.add_worksheet(title)
    for column, name in enumerate(columns):
        sheet.write_string(0, column, name, bold)
        sheet.set_column(column, column, WIDTHS.get(name, 13))
    for line, cells in enumerate(rows, 1):
        for column, cell in enumerate(cells):
            if isinstance(cell, str):
                sheet.write_string(line, column, _printable(cell))
            elif cell is not None:
                sheet.write_number(line, column, cell, number if isinstance(cell, float) else None)
    sheet.freeze_panes(1, 1)
    sheet.autofilter(0, 0, len(rows), len(columns) - 1)


def _dimension_rows(item: Item) -> list[list[Cell]]:
    """The key dimensions of an item, one a line, in the unit each says: mm or degrees."""
    instance = item.found.id if item.found else None
    return [
        [item.name, instance, line.name, "deg" if line.unit == "°" else "mm",
         *(None if value is None else round(value, 5) + 0.0  # never -0.0
           for value in (line.design, line.built, line.difference, line.sigma, line.allowed)),
         line.verdict, line.why, line.source]
        for line in item.dimensions
    ]  # fmt: skip


def _in_words(line: Line) -> str:
    """A dimension in one cell with others: "pipe 1 radius -0.16 ± 0.02 mm"."""
    if line.difference is None or line.sigma is None:
        return f"{line.name} not measured"
    verdict = {IN: "", OUT: " (out of tolerance)", NOT_JUDGED: " (not judged)", "": ""}[line.verdict]
    return f"{line.name} {line.difference:+z.2f} ± {line.sigma:.2f} {line.unit}{verdict}"


def _row(item: Item) -> list[Cell]:
    found = item.found
    deviation = None if found is None else found.deviation
    shift = item.shift_m or (None, None, None)
    return [
        item.name, item.ifc_class, item.global_id, item.model, item.status, item.verdict, item.verdict_why,
        *(_mm(value) for value in (item.off_m, *shift)),
        None if item.turn_rad is None else round(degrees(item.turn_rad), 4),
        None if found is None else found.id,
        None if found is None else found.score,
        None if found is None else found.points,
        _mm(None if deviation is None else deviation.mean_m),
        _mm(None if deviation is None else deviation.p95_m),
        "; ".join(map(_in_words, item.dimensions)),
        " ".join(item.sentences),
    ]  # fmt: skip


def _mm(value: float | None) -> float | None:
    return None if value is None else round(1e3 * value, 4) + 0.0  # never -0.0


def _harmless(text: str) -> str:
    return f"'{text}" if text.lstrip().startswith(FORMULA) or text.startswith(FORMULA) else text


def _printable(text: str) -> str:
    """Without what XML cannot hold, and no longer than a cell."""
    held = (letter for letter in text if not "\ud800" <= letter <= "\udfff")
    return "".join(letter if letter >= " " or letter in "\n\t" else " " for letter in held)[:MOST_LETTERS]
