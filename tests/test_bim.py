"""Back into the BIM: BCF as its schemas want it, and a copy of the design that says, and stands, as it was built."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from lxml import etree

import scanfind
from scanfind.bim.as_built import PROPERTY_SET, write_as_built
from scanfind.bim.bcf import plain, write_bcf
from scanfind.bim.views import Shown, Views
from scanfind.cli import main
from scanfind.design.elements import INSTALLED, NOT_FOUND, Element
from scanfind.detection import Findings
from scanfind.errors import OutputError, UnreadableFileError, UsageError
from scanfind.library import ModelLibrary
from scanfind.library.model import ModelParameters
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh, Placement
from scanfind.models import read_models
from scanfind.pose import Pose
from scanfind.results import write_results
from scanfind.simulate.parts import box
from test_models_ifc import write

SCHEMAS = Path(__file__).parent / "data" / "bcf-2.1"
SMALL = ModelParameters(SurfaceParameters(samples=100))
PLACE = Pose.from_rotation_vector((0.3, -0.2, 0.9), (4.0, 5.0, 6.0))
FAR = Pose.from_rotation_vector((0.0, 0.0, 0.4), (4e5, 5.2e6, 12.0))
OFF = Pose.from_rotation_vector((0.001, 0.002, -0.003), (0.012, -0.005, -0.02))  # in the element's own frame
FOOT = 0.3048
# What a file from anywhere may call its elements.
ODD = 'Träger <1> & "Co" \x07\x1b ]]> 柱'


def result(out: Path, design: Path, *, moved: Iterable[str], missing: Iterable[str] = ()) -> Path:
    """The result of an inspection: the elements of these names stand OFF, or nowhere, all others in place."""
    elements = []
    with ModelLibrary.in_memory() as library:
        for mesh in read_models(design):
            assert isinstance(mesh, Mesh)
            library.add(mesh, SMALL)
            for placement in mesh.placements:
                place = placement.design_from_model
                motion = place @ OFF @ place.inverse() if placement.name in moved else Pose.identity()
                elements.append(an_element(placement, mesh.name, None if placement.name in missing else motion))
        findings = Findings()
        findings.elements, findings.allowed_m = elements, 0.01
        write_results(findings, out, models=library, parameters=scanfind.PRESETS["default"])
    return out


def an_element(placement: Placement, model: str, motion: Pose | None) -> Element:
    if motion is None:
        return Element(placement, model, NOT_FOUND, None, None, None, None, 0.0, 0.1, 0.9, 0.0, "empty space")
    there = placement.design_from_model.translation
    x, y, z = (motion.move(there[None])[0] - there).tolist()
    off = float(np.linalg.norm((x, y, z)))
    return Element(placement, model, INSTALLED, None, (x, y, z), 0.003, off, 0.9, 0.0, 0.0, 0.1, "found", motion)


@pytest.fixture(scope="module")
def bars(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bars in millimetres; what they are called is in OTHERS."""
    names = [("IfcColumn", "as designed", FAR), ("IfcBeam", "off", FAR @ PLACE), ("IfcBeam", ODD, FAR @ PLACE @ PLACE)]
    return write(tmp_path_factory.mktemp("bim") / "bars.ifc", names, scale=1e-3, schema="IFC2X3")


@pytest.fixture(scope="module")
def inspected(bars: Path) -> Path:
    return result(bars.with_name("inspected"), bars, moved={"off"}, missing={ODD})


# ── BCF ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def schema(name: str) -> Any:
    return etree.XMLSchema(etree.parse(str(SCHEMAS / name)))


SCHEMA_OF = {"bcf.version": "version.xsd", "markup.bcf": "markup.xsd", "viewpoint.bcfv": "visinfo.xsd"}


def checked(path: Path) -> dict[str, dict[str, Any]]:
    """The topics of a BCF file by title: the document of each of their files; all are held against the schemas."""
    with ZipFile(path) as archive:
        assert archive.testzip() is None
        files = {name: archive.read(name) for name in archive.namelist()}
    assert "bcf.version" in files
    topics: dict[str, dict[str, Any]] = {}
    for name, data in files.items():
        folder, _, file = name.rpartition("/")
        if file in SCHEMA_OF:
            document = etree.fromstring(data)
            schema(SCHEMA_OF[file]).assertValid(document)
            topics.setdefault(folder, {})[file] = document
        if folder:
            assert f"{folder}/" in files  # BCF wants an entry for each folder
            assert folder == etree.fromstring(files[f"{folder}/markup.bcf"]).find("Topic").get("Guid")
            topics.setdefault(folder, {})["snapshot.png"] = files[f"{folder}/snapshot.png"]
    return {topic["markup.bcf"].findtext("Topic/Title"): topic for folder, topic in topics.items() if folder}


def test_a_topic_for_every_finding_as_the_schemas_want_it(inspected: Path, bars: Path, tmp_path: Path) -> None:
    assert write_bcf(inspected, tmp_path / "findings.bcf") == 2
    topics = checked(tmp_path / "findings.bcf")
    assert len(topics) == 2
    [off] = [topic for title, topic in topics.items() if title.startswith("off: installed, ")]
    [lost] = [topic for title, topic in topics.items() if title.endswith(": not found")]
    assert "Allowed: 10 mm." in off["markup.bcf"].findtext("Topic/Description")
    ids = {p.name: p.global_id for mesh in read_models(bars) if isinstance(mesh, Mesh) for p in mesh.placements}
    for topic, name in ((off, "off"), (lost, ODD)):
        view = topic["viewpoint.bcfv"]
        assert view.get("Guid") == topic["markup.bcf"].find("Viewpoints").get("Guid")
        assert [each.get("IfcGuid") for each in view.findall("Components/Selection/Component")] == [ids[name]]
        assert [each.get("IfcGuid") for each in view.findall("Components/Coloring/Color/Component")] == [ids[name]]


def test_the_same_result_gives_the_same_bytes(inspected: Path, tmp_path: Path) -> None:
    for name in ("one.bcf", "two.bcf"):
        write_bcf(inspected, tmp_path / name)
    assert (tmp_path / "one.bcf").read_bytes() == (tmp_path / "two.bcf").read_bytes()


def test_the_camera_sees_the_element_where_the_ifc_file_has_it(inspected: Path, bars: Path, tmp_path: Path) -> None:
    from PIL import Image

    write_bcf(inspected, tmp_path / "findings.bcf")
    placed = {p.name: (mesh, p) for mesh in read_models(bars) if isinstance(mesh, Mesh) for p in mesh.placements}
    for title, topic in checked(tmp_path / "findings.bcf").items():
        mesh, placement = placed["off" if title.startswith("off: ") else ODD]
        camera = topic["viewpoint.bcfv"].find("PerspectiveCamera")
        position, direction, up = (
            np.array([float(camera.findtext(f"{tag}/{axis}")) for axis in "XYZ"])
            for tag in ("CameraViewPoint", "CameraDirection", "CameraUpVector")
        )
        right = np.cross(direction, up)
        np.testing.assert_allclose([direction @ direction, up @ up, direction @ up], [1, 1, 0], atol=1e-12)
        toward = placement.design_from_model.move(mesh.vertices) - position
        deep = toward @ direction
        half = np.tan(np.radians(float(camera.findtext("FieldOfView")) / 2))
        across, high = toward @ right / deep / half, toward @ up / deep / half / 0.75
        assert deep.min() > 0.0
        assert max(np.abs(across).max(), np.abs(high).max()) < 1.0
        assert np.abs(high).max() > 0.2 or np.abs(across).max() > 0.2
        picture = np.asarray(Image.open(BytesIO(topic["snapshot.png"])).convert("RGB"), np.float64)
        height, width, _ = picture.shape
        red = (picture[..., 0] > 1.3 * picture[..., 2]) & (picture[..., 0] > 60)  # both colours here are warm
        rows, columns = np.nonzero(red)
        assert len(rows) > 0.005 * red.size
        # The coloured pixels are where the camera of the viewpoint file has the corners.
        assert abs(columns.min() / width - (across.min() + 1) / 2) < 0.03
        assert abs(rows.max() / height - (1 - high.min()) / 2) < 0.04


def test_a_camera_is_taken_that_walls_do_not_block() -> None:
    thing, wall = box(0.5, 0.5, 0.5), box(0.1, 6.0, 6.0)
    walls = [Pose(np.eye(3), np.array([x, -3.0, -3.0])) for x in (-1.0, 1.0)]
    views = Views([Shown(thing, Pose.identity(), None), *(Shown(wall, place, None) for place in walls)])
    assert -0.9 < views.camera(0).position[0] < 1.0


def test_what_was_allowed_may_be_changed_afterwards(inspected: Path, tmp_path: Path) -> None:
    (tmp_path / "wide.toml").write_text("[[rule]]\noff_mm = 100.0\n")
    assert write_bcf(inspected, tmp_path / "wide.bcf", tolerance=tmp_path / "wide.toml") == 1
    assert list(checked(tmp_path / "wide.bcf")) == [f"{plain(ODD)}: not found"]


def test_elements_without_a_global_id_are_shown_and_not_selected(tmp_path: Path) -> None:
    mesh = replace(box(1.0, 0.2, 0.2), name="spool")
    with ModelLibrary.in_memory() as library:
        library.add(mesh, SMALL)
        findings = Findings()
        findings.elements = [an_element(Placement("", "", "spool", PLACE), "spool", None)]
        write_results(findings, tmp_path / "r", models=library, parameters=scanfind.PRESETS["default"])
    assert write_bcf(tmp_path / "r", tmp_path / "a.bcf") == 1
    assert checked(tmp_path / "a.bcf")["spool: not found"]["viewpoint.bcfv"].find("Components") is None


# ── IFC ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def world(path: Path) -> dict[str, np.ndarray]:
    """GlobalId → vertices (V, 3) of every product with a shape, metres, as ifcopenshell places them."""
    import ifcopenshell
    import ifcopenshell.geom

    settings = ifcopenshell.geom.settings()
    settings.set("weld-vertices", False)
    file, found = ifcopenshell.open(str(path)), {}
    for product in file.by_type("IfcProduct"):
        if product.Representation and not product.is_a("IfcFeatureElement"):
            shape: Any = ifcopenshell.geom.create_shape(settings, product)
            matrix = np.array(shape.transformation.matrix).reshape(4, 4, order="F")
            vertices = np.array(shape.geometry.verts).reshape(-1, 3)
            found[product.GlobalId] = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    return found


def complaints(path: Path) -> list[str]:
    """What ifcopenshell's validator says of a file."""
    import ifcopenshell.validate

    logger = ifcopenshell.validate.json_logger()
    ifcopenshell.validate.validate(str(path), logger)
    return [str(each["message"]) for each in logger.statements]


def properties(path: Path) -> dict[str, dict[str, Any]]:
    """Name of the product → our properties of it."""
    import ifcopenshell
    from ifcopenshell.util.element import get_psets

    file = ifcopenshell.open(str(path))  # a product whose file is gone has no properties
    psets = {each.Name: get_psets(each, psets_only=True).get(PROPERTY_SET) for each in file.by_type("IfcProduct")}
    return {name: pset for name, pset in psets.items() if pset is not None}


def in_feet(path: Path) -> None:
    """Say of a file that its lengths are feet."""
    import ifcopenshell

    file = ifcopenshell.open(str(path))
    [metre], [units] = file.by_type("IfcSIUnit"), file.by_type("IfcUnitAssignment")
    length = file.create_entity("IfcDimensionalExponents", 1, 0, 0, 0, 0, 0, 0)
    value = file.create_entity("IfcMeasureWithUnit", file.create_entity("IfcLengthMeasure", FOOT), metre)
    units.Units = [file.create_entity("IfcConversionBasedUnit", length, "LENGTHUNIT", "FOOT", value)]
    file.write(str(path))


def assert_moved(inspected: Path, design: Path, out: Path) -> None:
    """Every element stands in `out` where its motion puts it, to 0.01 mm, and all other shapes where they stood."""
    motions = {
        each.global_id: Pose.from_matrix(each.built_from_design)
        for each in scanfind.read_results(inspected).elements if each.built_from_design is not None
    }  # fmt: skip
    before, after = world(design), world(out)
    assert before.keys() == after.keys()
    for number, vertices in before.items():
        np.testing.assert_allclose(after[number], motions.get(number, Pose.identity()).move(vertices), atol=1e-5)


@pytest.mark.parametrize("schema", ["IFC2X3", "IFC4", "IFC4X3"])
@pytest.mark.parametrize("scale", [1e-3, FOOT, 1.0])
def test_a_moved_element_has_moved_by_what_was_measured(tmp_path: Path, schema: str, scale: float) -> None:
    names = [("IfcColumn", "a", PLACE), ("IfcBeam", "b", FAR), ("IfcBeam", ODD, FAR @ PLACE)]
    design = write(tmp_path / "a.ifc", names, scale=scale, schema=schema)
    if scale == FOOT:
        in_feet(design)
    inspected = result(tmp_path / "r", design, moved={"a", ODD}, missing={"b"})
    before = design.read_bytes()
    told = write_as_built(inspected, design, tmp_path / "built.ifc", move=True)
    assert (told.described, told.moved, told.unmoved) == (3, 2, ())
    assert design.read_bytes() == before
    assert_moved(inspected, design, tmp_path / "built.ifc")
    assert set(complaints(tmp_path / "built.ifc")) <= set(complaints(design))
    told_of = properties(tmp_path / "built.ifc")
    assert told_of["b"]["Status"] == "not_found"
    assert told_of["b"]["PlacementMoved"] is False
    assert told_of["a"]["Verdict"] == "out_of_tolerance"
    assert told_of["a"]["LargestDisplacement"] * scale == pytest.approx(np.linalg.norm(OFF.translation))
    assert told_of[ODD]["PlacementMoved"] is True


def test_without_move_only_properties_are_new(inspected: Path, bars: Path, tmp_path: Path) -> None:
    assert write_as_built(inspected, bars, tmp_path / "told.ifc").moved == 0
    for number, vertices in world(bars).items():
        np.testing.assert_array_equal(world(tmp_path / "told.ifc")[number], vertices)
    first = properties(tmp_path / "told.ifc")
    assert set(first) == {"as designed", "off", ODD}
    # Told again of what was told already, a file has the new description alone.
    (tmp_path / "wide.toml").write_text("[[rule]]\noff_mm = 100.0\n")
    write_as_built(inspected, tmp_path / "told.ifc", tmp_path / "again.ifc", tolerance=tmp_path / "wide.toml")
    second = properties(tmp_path / "again.ifc")
    assert (first["off"]["Verdict"], second["off"]["Verdict"]) == ("out_of_tolerance", "not_judged")  # no detection
    assert (tmp_path / "again.ifc").read_text().count("IFCPROPERTYSET(") == 3


def test_the_same_result_gives_the_same_file(inspected: Path, bars: Path, tmp_path: Path) -> None:
    for name in ("one.ifc", "two.ifc"):
        write_as_built(inspected, bars, tmp_path / name, move=True)
    assert (tmp_path / "one.ifc").read_bytes() == (tmp_path / "two.ifc").read_bytes()


def test_openings_parts_and_what_hangs_on_placements(tmp_path: Path) -> None:
    """A moved beam takes its opening along, but no column that hangs on its placement; parts go with a whole."""
    import ifcopenshell
    from ifcopenshell.guid import compress

    design = write(tmp_path / "a.ifc", [("IfcBeam", "beam", PLACE), ("IfcColumn", "column", FAR)], scale=1e-3)
    file = ifcopenshell.open(str(design))
    [beam], [column] = file.by_type("IfcBeam"), file.by_type("IfcColumn")
    column.ObjectPlacement.PlacementRelTo = beam.ObjectPlacement
    hole = file.create_entity(
        "IfcOpeningElement", compress("1" * 32), Name="hole", Representation=half_of(file, beam),
        ObjectPlacement=file.create_entity("IfcLocalPlacement", beam.ObjectPlacement, origin(file)),
    )  # fmt: skip
    file.create_entity("IfcRelVoidsElement", compress("2" * 32), None, None, None, beam, hole)
    file.write(str(design))
    assert np.ptp(world(design)[beam.GlobalId], axis=0).max() < 2.1
    inspected = result(tmp_path / "r", design, moved={"beam"})
    assert write_as_built(inspected, design, tmp_path / "built.ifc", move=True).moved == 2
    assert_moved(inspected, design, tmp_path / "built.ifc")

    whole = write(tmp_path / "w.ifc", [("IfcBeam", "p", PLACE), ("IfcBeam", "q", FAR)], whole="SPOOL", scale=1e-3)
    [mesh] = [m for m in read_models(whole, select=["SPOOL"]) if isinstance(m, Mesh)]
    motion = Pose.from_rotation_vector((0.0, 0.0, 0.001), (0.01, 0.02, 0.03))
    with ModelLibrary.in_memory() as library:
        library.add(mesh, SMALL)
        findings = Findings()
        findings.elements = [an_element(mesh.placements[0], mesh.name, motion)]
        write_results(findings, tmp_path / "w", models=library, parameters=scanfind.PRESETS["default"])
    write_as_built(tmp_path / "w", whole, tmp_path / "whole.ifc", move=True)
    before, after = world(whole), world(tmp_path / "whole.ifc")
    for number, vertices in before.items():
        np.testing.assert_allclose(after[number], motion.move(vertices), atol=1e-5)


def origin(file: Any) -> Any:
    return file.create_entity("IfcAxis2Placement3D", file.create_entity("IfcCartesianPoint", [0.0, 0.0, 0.0]))


def half_of(file: Any, beam: Any) -> Any:
    """A box of 100 × 150 × 1000 mm in a corner of the beam."""
    profile = file.create_entity("IfcRectangleProfileDef", "AREA", None, None, 100.0, 150.0)
    up = file.create_entity("IfcDirection", [0.0, 0.0, 1.0])
    solid = file.create_entity("IfcExtrudedAreaSolid", profile, origin(file), up, 1000.0)
    context = beam.Representation.Representations[0].ContextOfItems
    shape = file.create_entity("IfcShapeRepresentation", context, "Body", "SweptSolid", [solid])
    return file.create_entity("IfcProductDefinitionShape", None, None, [shape])


@pytest.mark.slow
def test_a_real_design_as_built(shared_data: Path, tmp_path: Path) -> None:
    """Its beams share geometry by mapped items, and are placed in storeys of a building of a site."""
    design = shared_data / "ifc" / "schependomlaan" / "ROOT-staal" / "IFC-staal.ifc"
    names = {p.name for mesh in read_models(design) if isinstance(mesh, Mesh) for p in mesh.placements}
    moved = set(sorted(names)[::3])
    inspected = result(tmp_path / "r", design, moved=moved)
    told = write_as_built(inspected, design, tmp_path / "built.ifc", move=True)
    assert told.described == told.moved > 70
    assert_moved(inspected, design, tmp_path / "built.ifc")
    assert len(complaints(tmp_path / "built.ifc")) == len(complaints(design))
    assert write_bcf(inspected, tmp_path / "findings.bcf") >= len(moved)
    checked(tmp_path / "findings.bcf")


# ── what may go wrong ─────────────────────────────────────────────────────────────────────────────────────────────


def test_the_design_is_never_written_to(inspected: Path, bars: Path, tmp_path: Path) -> None:
    design = Path(shutil.copy(bars, tmp_path / "design.ifc"))
    (tmp_path / "link.ifc").symlink_to(design)
    for out in (design, tmp_path / "link.ifc"):
        with pytest.raises(OutputError, match="is the design itself"):
            write_as_built(inspected, design, out, overwrite=True)
    assert design.read_bytes() == bars.read_bytes()


def test_what_cannot_be_is_one_line_and_leaves_nothing(
    inspected: Path, bars: Path, tmp_path: Path, shared_data: Path
) -> None:
    other = write(tmp_path / "other.ifc", [("IfcBeam", "b", PLACE)])
    (tmp_path / "no.ifc").write_text("ISO-10303-21; nonsense")
    write_as_built(inspected, bars, tmp_path / "moved.ifc", move=True)
    (tmp_path / "taken.bcf").write_text("mine")
    there = sorted(tmp_path.iterdir())
    damaged = shared_data / "ifc" / "web-ifc" / "malformed" / "cyclic-placement.ifc"
    for design, error, line in (
        (other, UsageError, "none of the elements that were inspected"),
        (damaged, UsageError, "none of the elements that were inspected"),
        (tmp_path / "no.ifc", UnreadableFileError, "no.ifc cannot be read"),
        (tmp_path / "nowhere.ifc", UnreadableFileError, "no such file"),
        (tmp_path / "moved.ifc", UsageError, "were moved to where they stand already"),
    ):
        with pytest.raises(error, match=line) as caught:
            write_as_built(inspected, design, tmp_path / "out.ifc", move=True)
        assert "\n" not in str(caught.value)
    with pytest.raises(OutputError, match="is there already"):
        write_bcf(inspected, tmp_path / "taken.bcf")
    with pytest.raises(UnreadableFileError, match="no result to read"):
        write_bcf(tmp_path / "nothing", tmp_path / "out.bcf")
    assert sorted(tmp_path.iterdir()) == there


def test_the_command_says_what_is_missing(inspected: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for flags, words in (
        ([], "nothing to write"), (["--ifc", str(tmp_path / "a.ifc")], "give both"), (["--move"], "nothing to write"),
        (["--bcf", str(tmp_path / "a.bcf"), "--move"], "give both"),
        (["--bcf", str(tmp_path / "a.bcf"), "--tolerance", "steal"], "neither a TOML file nor"),
    ):  # fmt: skip
        assert main(["bim", str(inspected), *flags]) == 2
        assert words in capsys.readouterr().err
    assert main(["bim", str(inspected), "--bcf", str(tmp_path / "a.bcf")]) == 0
    assert "2 topics" in capsys.readouterr().err
