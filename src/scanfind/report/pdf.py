"""The report as a PDF: a summary, the table, and a picture and words of each item that needs a look."""

from __future__ import annotations

import io
from collections.abc import Iterator
from html import escape
from itertools import pairwise
from math import degrees
from typing import TYPE_CHECKING, Any

from scanfind.design.elements import INSTALLED
from scanfind.errors import MissingExtraError
from scanfind.picture import SCALE, png
from scanfind.report.pictures import picture_of
from scanfind.tolerances import NOT_JUDGED

if TYPE_CHECKING:
    from scanfind.report.content import Content
    from scanfind.report.items import Item

MOST_DETAILED = 100  # items with a page's half each: what has more is read on a screen
PICTURE = (760, 470)  # pixels: 150 an inch
SOFT, LINE = "#626a73", "#dfe1de"
FONTS = (
    ("DejaVu", "DejaVu-Bold", ("DejaVuSans.ttf", "DejaVuSans-Bold.ttf")),
    ("Vera", "Vera-Bold", ("Vera.ttf", "VeraBd.ttf")),
)
DOTS = {
    "installed": "#2c7a57", "found": "#2c7a57", "in_tolerance": "#2c7a57", "not_found": "#b3261e",
    "out_of_tolerance": "#b3261e", "uncertain": "#a8690f", "extra": "#a8690f", "not_judged": "#a8690f",
}  # fmt: skip


def pdf_of(content: Content) -> bytes:
    """The whole document. Raises MissingExtraError without reportlab."""
    try:
        from reportlab.lib.pagesizes import A4
        from reportlab.lib.units import mm
        from reportlab.platypus import SimpleDocTemplate
    except ImportError as error:
        msg = "a PDF report needs reportlab: pip install 'scanfind[report]'"
        raise MissingExtraError(msg) from error
    out = io.BytesIO()
    document = SimpleDocTemplate(
        out, pagesize=A4, leftMargin=18 * mm, rightMargin=18 * mm, topMargin=18 * mm, bottomMargin=18 * mm,
        title=_plain(content.title), author="scanfind", subject=content.kind, invariant=True,
    )  # fmt: skip
    footer = _footer(_plain(content.title))
    document.build(list(_story(content, document.width)), onFirstPage=footer, onLaterPages=footer)
    return out.getvalue()


def _story(content: Content, width: float) -> Iterator[Any]:
    """What follows what."""
    from reportlab.platypus import PageBreak, Paragraph, Spacer

    style = _styles()
    yield Paragraph(_safe(content.kind), style["soft"])
    yield Paragraph(_safe(content.title), style["title"])
    yield Paragraph(_safe(content.facts()), style["soft"])
    yield Spacer(1, 10)
    yield _counts(content, style, width)
    yield Spacer(1, 12)
    if content.items:
        yield _table(content, style, width)
    else:
        yield Paragraph("Nothing was found, and no design was given: there is nothing to show.", style["text"])
    for note in content.notes():
        yield Paragraph(_safe(note), style["soft"])
    yield Paragraph(_safe(content.made_by()), style["soft"])
    wanting = [item for item in content.items if not item.is_fine] if content.of_design else list(content.items)
    if not wanting:
        return
    yield PageBreak()
    yield Paragraph("What needs a look" if content.of_design else "Instances", style["title"])
    full = _full(content)
    yield from _legend(full, style, width)
    for item in wanting[:MOST_DETAILED]:
        yield from _detail(content, item, full, style, width)
    if len(wanting) > MOST_DETAILED:
        yield Paragraph(f"{len(wanting) - MOST_DETAILED} more are in the table only.", style["text"])


def _full(content: Content) -> float:
    """The deviation with the colour of the scale's end: what 95 % of the points of every item keep within."""
    return max((item.p95_m for item in content.items if item.p95_m), default=0.005)


def _counts(content: Content, style: dict[str, Any], width: float) -> Any:
    """The summary: a number above its word, side by side."""
    from reportlab.platypus import Paragraph, Table, TableStyle

    told = [(str(len(content.items)), content.noun, "")]
    told += [(str(count), words, key) for key, words, count in content.counts()]
    cells = [
        [Paragraph(f"<b>{count}</b>", style["count"]) for count, _, _ in told],
        [Paragraph(_dot(key) + _safe(words), style["small"]) for _, words, key in told],
    ]
    table = Table(cells, colWidths=[width / max(len(told), 5)] * len(told), hAlign="LEFT")
    table.setStyle(TableStyle([("LEFTPADDING", (0, 0), (-1, -1), 0), ("BOTTOMPADDING", (0, 0), (-1, -1), 1)]))
    return table


def _table(content: Content, style: dict[str, Any], width: float) -> Any:
    """One line an item."""
    from reportlab.platypus import Paragraph, Table, TableStyle

    heads = ("Element", "Status", "Verdict", "Off mm", "Turned °", "Surface mm", "Points")
    if not content.of_design:
        heads = ("Instance", "Status", "Verdict", "Score", "", "Surface mm", "Points")
    rows = [[Paragraph(f"<b>{head}</b>", style["small" if k < 3 else "right"]) for k, head in enumerate(heads)]]
    for item in content.items:
        score = item.found.score if item.found and not content.of_design else None
        first = _number(item.off_m, 1e3) if content.of_design else _number(score, 1.0, 2)
        turn = None if item.turn_rad is None else degrees(item.turn_rad)
        words = (
            _safe(item.name),
            _dot(item.status) + _safe(item.status_words),
            _dot(item.verdict) + _safe(item.verdict_words),
        )
        numbers = (
            first,
            _number(turn, 1.0, 2) if content.of_design else "",
            _number(item.p95_m, 1e3),
            "–" if item.found is None else f"{item.found.points:,}",
        )
        rows.append(
            [Paragraph(text, style["small"]) for text in words]
            + [Paragraph(number, style["right"]) for number in numbers]
        )
    shares = (0.27, 0.15, 0.18, 0.09, 0.1, 0.11, 0.1)
    table = Table(rows, colWidths=[share * width for share in shares], repeatRows=1)
    table.setStyle(
        TableStyle([
            ("LINEBELOW", (0, 0), (-1, -1), 0.4, LINE), ("VALIGN", (0, 0), (-1, -1), "TOP"),
            ("LEFTPADDING", (0, 0), (0, -1), 0), ("TOPPADDING", (0, 0), (-1, -1), 1.5),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 1.5),
        ])
    )  # fmt: skip
    return table


def _detail(content: Content, item: Item, full: float, style: dict[str, Any], width: float) -> Iterator[Any]:
    """An item's words, picture and checks, kept on one page."""
    from reportlab.platypus import Image, KeepTogether, Paragraph, Spacer

    ident = " · ".join(filter(None, [item.ifc_class, item.global_id, item.model if item.model != item.name else ""]))
    told = [Spacer(1, 10), Paragraph(_safe(item.name), style["name"])]
    if ident:
        told.append(Paragraph(_safe(ident), style["soft"]))
    verdict = f" — {item.verdict_words}" if item.verdict else ""
    told.append(Paragraph(f"{_dot(item.verdict or item.status)}<b>{_safe(item.headline + verdict)}</b>", style["text"]))
    told += [Paragraph(_safe(sentence), style["text"]) for sentence in item.sentences]
    if item.judgement and item.verdict != "in_tolerance":
        told.append(Paragraph(_safe(f"{item.verdict_words.capitalize()}: {item.verdict_why}."), style["text"]))
    # Nothing is to be seen of an element that stands in its place but for what a limit could not be held against.
    plain = item.verdict == NOT_JUDGED and item.status == INSTALLED
    picture = None if plain else picture_of(item, content.material, content.stations, full, *PICTURE)
    if picture is not None:
        wide = 0.72 * width
        told += [Spacer(1, 4), Image(io.BytesIO(png(picture)), wide, wide * PICTURE[1] / PICTURE[0], hAlign="LEFT")]
    yield KeepTogether(told)


def _legend(full: float, style: dict[str, Any], width: float) -> Iterator[Any]:
    """The scale of deviations, with its unit."""
    from reportlab.graphics.shapes import Drawing, Rect
    from reportlab.lib.colors import Color
    from reportlab.platypus import Paragraph

    steps, wide = 60, 0.36 * width
    drawing = Drawing(width, 14)
    for k in range(steps):
        at = 2.0 * k / (steps - 1) - 1.0
        fill = Color(*(_between(at, channel) / 255.0 for channel in range(3)))
        drawing.add(Rect(k * wide / steps, 2, wide / steps + 0.3, 8, fillColor=fill, strokeColor=None))
    yield drawing
    ends = f"{1e3 * full:.1f} mm inside (blue) to {1e3 * full:.1f} mm outside the model (red)"
    yield Paragraph(f"Points by their distance from the model, from {ends}.", style["soft"])
    yield Paragraph("Grey: the model, and the scan around it. Red surface: designed, and not found.", style["soft"])


def _between(at: float, channel: int) -> float:
    for (low, one), (high, other) in pairwise(SCALE):
        if at <= high:
            return one[channel] + (other[channel] - one[channel]) * max(at - low, 0.0) / (high - low)
    return float(SCALE[-1][1][channel])


def _styles() -> dict[str, Any]:
    from reportlab.lib.enums import TA_RIGHT
    from reportlab.lib.styles import ParagraphStyle

    font, bold = _fonts()
    text = ParagraphStyle("text", fontName=font, fontSize=9, leading=12.5)
    return {
        "text": text,
        "small": ParagraphStyle("small", text, fontSize=7.5, leading=9.5, splitLongWords=1),
        "right": ParagraphStyle("right", text, fontSize=7.5, leading=9.5, alignment=TA_RIGHT),
        "soft": ParagraphStyle("soft", text, fontSize=8, leading=11, textColor=SOFT),
        "name": ParagraphStyle("name", text, fontName=bold, fontSize=11, leading=14),
        "count": ParagraphStyle("count", text, fontName=bold, fontSize=15, leading=18),
        "title": ParagraphStyle("title", text, fontName=bold, fontSize=16, leading=20, spaceAfter=3),
    }


def _fonts() -> tuple[str, str]:
    """A font to embed and its bold: DejaVu, which has most scripts, where the system has it; else reportlab's own."""
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFError, TTFont

    for plain, bold, files in FONTS:
        try:
            if bold not in pdfmetrics.getRegisteredFontNames():
                for name, file in zip((plain, bold), files, strict=True):
                    pdfmetrics.registerFont(TTFont(name, file))
                pdfmetrics.registerFontFamily(plain, normal=plain, bold=bold, italic=plain, boldItalic=bold)
        except TTFError:
            continue
        return plain, bold
    return "Helvetica", "Helvetica-Bold"


def _footer(title: str) -> Any:
    def draw(canvas: Any, document: Any) -> None:
        font, _ = _fonts()
        canvas.setFont(font, 7)
        canvas.setFillColor(SOFT)
        canvas.drawString(document.leftMargin, 24, title[:100])
        canvas.drawRightString(document.leftMargin + document.width, 24, str(document.page))

    return draw


def _dot(key: str) -> str:
    colour = DOTS.get(key, "#7c858e")
    return f'<font color="{colour}">•</font> ' if key else ""


def _number(value: float | None, factor: float, decimals: int = 1) -> str:
    return "–" if value is None else f"{value * factor:z.{decimals}f}"


def _plain(text: str) -> str:
    """Without what no page can show."""
    return "".join(letter if letter >= " " else " " for letter in text if letter < "\ud800" or letter > "\udfff")


def _safe(text: str) -> str:
    """Text for reportlab's paragraphs, which read markup."""
    return escape(_plain(text))
