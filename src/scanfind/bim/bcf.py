"""BCF 2.1: one topic for each finding, with a camera, the element selected, and a picture.

https://github.com/buildingSMART/BCF-XML/tree/release_2_1/Documentation. Lengths are metres, angles degrees, coordinates
those of the IFC file. The same result gives the same bytes.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from uuid import UUID, uuid5
from xml.etree.ElementTree import Element, SubElement, indent, tostring
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np

from scanfind.bim.views import FIELD_OF_VIEW, Camera, Colour, Shown, Views
from scanfind.bim.wording import description, inspected, is_finding, title
from scanfind.design.elements import INSTALLED, NO_DATA, NOT_ENOUGH_DATA, NOT_FOUND, OCCLUDED, UNCERTAIN
from scanfind.errors import UsageError
from scanfind.library import ModelLibrary
from scanfind.picture import png
from scanfind.pose import Pose
from scanfind.results import MODELS, RESULTS_JSON, result_file

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from scanfind.results.schema import ElementEntry, Results

# Red is missing, orange stands wrong, the others are open questions; told apart by colour-blind people, too.
COLOURS: dict[str, Colour] = {
    NOT_FOUND: (213, 43, 30), INSTALLED: (240, 138, 0), UNCERTAIN: (230, 200, 30), OCCLUDED: (120, 94, 240),
    NOT_ENOUGH_DATA: (100, 143, 255), NO_DATA: (100, 143, 255),
}  # fmt: skip
PRIORITY = {NOT_FOUND: "High", INSTALLED: "High", UNCERTAIN: "Normal"}  # all others low
AUTHOR = "scanfind"
SPACE = UUID("6f3c7f0e-2a53-5d3b-9c55-1f0f3a6e6c21")  # of the names that our topics have
IFC_GUID = re.compile(r"[0-3][0-9A-Za-z_$]{21}")
# What XML 1.0 cannot hold, not even escaped.
NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class Topic(NamedTuple):
    """A finding: its element, what is told of it, from where to look at it, and what is seen (PNG)."""

    guid: UUID
    element: ElementEntry
    told: str
    camera: Camera
    picture: bytes


def write_bcf(
    result_dir: str | Path, out: str | Path, *, tolerance: str | Path | None = None, overwrite: bool = False
) -> int:
    """Write a topic for every element of an inspection that somebody has to look at; returns how many.

    result_dir : a folder that `scanfind inspect --out` wrote
    tolerance : a profile (a TOML file or the name of a preset) that says what is out of tolerance; None: as inspected

    Raises UnreadableFileError for no result, UsageError where it is not of a design, LibraryError, OutputError.
    """
    results, judgements = inspected(result_dir, tolerance)
    made = results.made or _written(Path(result_dir))
    with result_file(out, overwrite=overwrite) as path, ZipFile(path, "w", ZIP_DEFLATED, compresslevel=9) as archive:
        topics = topics_of(results, judgements, Path(result_dir) / MODELS, made)
        when = datetime.strptime(made, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC).timetuple()[:6]

        def put(name: str, data: bytes) -> None:
            # BCF wants folders to have entries of their own, and we want the file's bytes to be the result's alone.
            info = ZipInfo(name, (max(when[0], 1980), *when[1:]))
            info.compress_type, info.external_attr = (
                ZIP_DEFLATED,
                (0o40755 << 16 | 0x10) if name[-1] == "/" else 0o644 << 16,
            )
            archive.writestr(info, data)

        put("bcf.version", _xml(_version()))
        for index, topic in enumerate(topics):
            folder = f"{topic.guid}/"
            put(folder, b"")
            put(folder + "markup.bcf", _xml(_markup(topic, index, made)))
            put(folder + "viewpoint.bcfv", _xml(_viewpoint(topic)))
            put(folder + "snapshot.png", topic.picture)
    return len(topics)


def topics_of(results: Results, judgements: Mapping[int, str], models: Path, made: str) -> list[Topic]:
    """The findings in the order of the elements; judgements : see `inspected`; models : the library of their shapes."""
    views = Views(shown(results.elements, models))
    topics = []
    for number, element in enumerate(results.elements):
        if is_finding(element):
            camera = views.camera(number)
            # A design of meshes has no GlobalIds: the place in the list tells elements apart.
            guid = uuid5(SPACE, f"{made} {number} {element.global_id} {element.status}")
            told = description(results, element, judgements.get(number, ""))
            picture = png(views.picture(number, camera, COLOURS[element.status]))
            topics.append(Topic(guid, element, told, camera, picture))
    return topics


def shown(elements: Sequence[ElementEntry], models: Path) -> list[Shown]:
    """Elements as pictures show them."""
    with ModelLibrary.open(models) as library:
        meshes = {name: library.get(name).mesh for name in {element.model for element in elements}}
    found = []
    for element in elements:
        mesh = meshes[element.model]
        if mesh is None:
            msg = f"{element.model}: a piece of scan has no surface to show: inspect against a mesh or an IFC file"
            raise UsageError(msg)
        design = Pose.from_matrix(element.design_from_model)
        moved = None if element.built_from_design is None else Pose.from_matrix(element.built_from_design)
        found.append(Shown(mesh, design, None if moved is None else moved @ design))
    return found


def _version() -> Element:
    root = Element("Version", VersionId="2.1")
    SubElement(root, "DetailedVersion").text = "2.1"
    return root


def _markup(topic: Topic, index: int, made: str) -> Element:
    """markup.bcf; the schema wants its elements in this order."""
    element, view = topic.element, str(uuid5(topic.guid, "viewpoint"))
    root = Element("Markup")
    about = SubElement(root, "Topic", Guid=str(topic.guid), TopicType="Issue", TopicStatus="Open")
    for tag, text in (
        ("Title", title(element)), ("Priority", PRIORITY.get(element.status, "Low")), ("Index", str(index)),
        ("Labels", (element.verdict or element.status).replace("_", " ")), ("CreationDate", made),
        ("CreationAuthor", AUTHOR), ("Description", topic.told),
    ):  # fmt: skip
        SubElement(about, tag).text = plain(text)
    look = SubElement(root, "Viewpoints", Guid=view)
    SubElement(look, "Viewpoint").text = "viewpoint.bcfv"
    SubElement(look, "Snapshot").text = "snapshot.png"
    return root


def _viewpoint(topic: Topic) -> Element:
    """viewpoint.bcfv: the element selected and coloured, and the camera."""
    root = Element("VisualizationInfo", Guid=str(uuid5(topic.guid, "viewpoint")))
    if IFC_GUID.fullmatch(topic.element.global_id):
        components = SubElement(root, "Components")
        SubElement(
            components, "ViewSetupHints", SpacesVisible="false", SpaceBoundariesVisible="false", OpeningsVisible="false"
        )
        SubElement(SubElement(components, "Selection"), "Component", IfcGuid=topic.element.global_id)
        SubElement(components, "Visibility", DefaultVisibility="true")
        colour = "".join(f"{part:02X}" for part in COLOURS[topic.element.status])
        coloured = SubElement(SubElement(components, "Coloring"), "Color", Color=colour)
        SubElement(coloured, "Component", IfcGuid=topic.element.global_id)
    camera = SubElement(root, "PerspectiveCamera")
    for tag, vector in (
        ("CameraViewPoint", topic.camera.position), ("CameraDirection", topic.camera.direction),
        ("CameraUpVector", topic.camera.up),
    ):  # fmt: skip
        parent = SubElement(camera, tag)
        for axis, value in zip("XYZ", np.asarray(vector).tolist(), strict=True):
            SubElement(parent, axis).text = repr(value)
    SubElement(camera, "FieldOfView").text = f"{FIELD_OF_VIEW:g}"
    return root


def plain(text: str) -> str:
    """Text that XML can hold: what it cannot becomes the sign for a letter that nobody knows."""
    return NOT_XML.sub("\ufffd", text)


def _xml(root: Element) -> bytes:
    indent(root)
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))


def _written(result_dir: Path) -> str:
    """When a result was written that does not say so itself."""
    file = result_dir / RESULTS_JSON if result_dir.is_dir() else result_dir
    return datetime.fromtimestamp(file.stat().st_mtime, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
