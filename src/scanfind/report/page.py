"""The report as one HTML file: style, scripts and points are inside, nothing is fetched, only our script may run."""

from __future__ import annotations

import base64
import hashlib
import json
from importlib import resources
from math import degrees
from typing import TYPE_CHECKING, Any, NamedTuple

from scanfind.errors import MissingExtraError
from scanfind.picture import SCALE
from scanfind.report.dimensions import HEADS
from scanfind.report.scene import scene_of

if TYPE_CHECKING:
    from scanfind.report.content import Content
    from scanfind.report.items import Item

SCRIPTS = ("camera.js", "shaders.js", "viewer.js", "pointer.js", "page.js")
OF_DESIGN = (
    ("Element", False), ("Status", False), ("Verdict", False), ("Off mm", True), ("x mm", True), ("y mm", True),
    ("z mm", True), ("Turned °", True), ("Surface mm", True),
)  # fmt: skip
OF_INSTANCES = (
    ("Instance", False), ("Status", False), ("Verdict", False), ("Score", True), ("x m", True), ("y m", True),
    ("z m", True), ("Surface mm", True),
)  # fmt: skip


class Cell(NamedTuple):
    """A cell of the table: its text, the number it is sorted by (None: by its text), and a dot's colour."""

    text: str
    sort: float | None = None
    dot: str = ""
    numeric: bool = False


class Row(NamedTuple):
    """A line of the table."""

    item: Item
    cells: list[Cell]


def page_of(content: Content) -> bytes:
    """The whole page, UTF-8. Raises MissingExtraError without jinja2."""
    try:
        from jinja2 import Environment
        from markupsafe import Markup
    except ImportError as error:
        msg = "an HTML report needs jinja2: pip install 'scanfind[report]'"
        raise MissingExtraError(msg) from error
    # Names come from files of strangers: what is not marked as ours is escaped.
    template = Environment(autoescape=True).from_string(_text("page.html"))
    style, script = _text("style.css"), '"use strict";\n(() => {\n' + "\n".join(map(_text, SCRIPTS)) + "})();\n"
    scene = scene_of(content.items, content.material)
    facts = scene.facts | {"scale": SCALE, "limit": _limit(content, scene.facts["full"])}
    buffers = {"positions": scene.positions, "values": scene.values, "vertices": scene.vertices, "faces": scene.faces}
    page = template.render(
        title=content.title,
        kind=content.kind,
        noun=content.noun,
        facts=content.facts(),
        counts=content.counts(),
        items=content.items,
        columns=OF_DESIGN if content.of_design else OF_INSTANCES,
        rows=[Row(item, _cells(item, of_design=content.of_design)) for item in content.items],
        has_design=content.of_design,
        heads=HEADS,
        notes=content.notes(),
        made=content.made_by(),
        style=Markup(style),
        script=Markup(script),
        style_hash=_hash(style),
        script_hash=_hash(script),
        scene_json=Markup(_json(facts)),
        buffers=[(name, Markup(base64.b64encode(data).decode())) for name, data in buffers.items()],
    )
    return page.encode(errors="replace")


def _limit(content: Content, full: float) -> float:
    """Where the slider of deviations begins: at the profile's limit of surfaces, or half of what is shown."""
    rules = content.profile.rules if content.profile else ()
    limits = [rule.limits["surface_p95_mm"].value for rule in rules if "surface_p95_mm" in rule.limits]
    return min(limits[0], full) if limits else full / 2.0


def _cells(item: Item, *, of_design: bool) -> list[Cell]:
    verdict = Cell(item.verdict_words, dot=item.verdict)
    named = [Cell(item.name), Cell(item.status_words, dot=item.status), verdict]
    p95 = _number(item.p95_m, 1e3)
    if of_design:
        x, y, z = item.shift_m or (None, None, None)
        turn = None if item.turn_rad is None else degrees(item.turn_rad)
        moved = [_number(value, 1e3) for value in (item.off_m, x, y, z)]
        return [*named, *moved, _number(turn, 1.0, 2), p95]
    x, y, z = (row[3] for row in item.scene_from_model[:3]) if item.scene_from_model else (None, None, None)
    score = None if item.found is None else item.found.score
    return [*named, _number(score, 1.0, 2), *(_number(value, 1.0, 3) for value in (x, y, z)), p95]


def _number(value: float | None, factor: float, decimals: int = 1) -> Cell:
    if value is None:
        return Cell("–", numeric=True)
    return Cell(f"{value * factor:z,.{decimals}f}", round(value * factor, 6), numeric=True)


def _text(name: str) -> str:
    return (resources.files("scanfind.report") / "web" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _json(facts: dict[str, Any]) -> str:
    """JSON that ends no script element, whatever names it holds."""
    text = json.dumps(facts, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
