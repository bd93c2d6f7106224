"""The report as a table for spreadsheets, one line an item: CSV and XLSX. No cell of it is ever run as a formula."""

from __future__ import annotations

import csv
import io
from math import degrees
from typing import TYPE_CHECKING

from scanfind.errors import MissingExtraError

if TYPE_CHECKING:
    from scanfind.report.content import Content
    from scanfind.report.items import Item

COLUMNS = (
    "name", "ifc_class", "global_id", "model", "status", "verdict", "verdict_why", "off_mm", "shift_x_mm", "shift_y_mm",
    "shift_z_mm", "turn_deg", "instance", "score", "points", "deviation_mean_mm", "deviation_p95_mm", "evidence",
)  # fmt: skip
WIDTHS = {"name": 26, "ifc_class": 14, "global_id": 24, "model": 20, "verdict_why": 50, "evidence": 90}
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
        sheet = book.add_worksheet(content.noun.capitalize())
        for column, name in enumerate(COLUMNS):
            sheet.write_string(0, column, name, bold)
            sheet.set_column(column, column, WIDTHS.get(name, 13))
        for line, item in enumerate(content.items, 1):
            for column, cell in enumerate(_row(item)):
                if isinstance(cell, str):
                    sheet.write_string(line, column, _printable(cell))
                elif cell is not None:
                    sheet.write_number(line, column, cell, number if isinstance(cell, float) else None)
        sheet.freeze_panes(1, 1)
        sheet.autofilter(0, 0, len(content.items), len(COLUMNS) - 1)
        about = book.add_worksheet("About")
        for line, text in enumerate(
            [content.title, content.kind, content.facts(), content.made_by(), *content.notes()]
        ):
            about.write_string(line, 0, _printable(text))
    return out.getvalue()


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
