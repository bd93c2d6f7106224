"""IFC: every product in its place, equal ones as one model, and nothing that a damaged file can do to us."""

from __future__ import annotations

import re
import uuid
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanfind.errors import MissingExtraError, ScanfindError, UnreadableFileError, UnsupportedFormatError, UsageError
from scanfind.mesh import Mesh
from scanfind.models import model_info, read_models
from scanfind.pose import Pose, rotation_from_vector


def meshes(path: Path, *select: str) -> list[Mesh]:
    """All models of a file, under names of their own."""
    found = [model for model in read_models(path, select=select) if isinstance(model, Mesh)]
    assert len({mesh.name for mesh in found}) == len(found)
    return found


@cache
def once(path: Path, *select: str) -> list[Mesh]:
    """The models of a file, read once for all tests: one file takes the reader 34 s."""
    return meshes(path, *select)


def products(found: list[Mesh]) -> dict[str, np.ndarray]:
    """GlobalId → triangles (F, 3, 3) where the design puts them."""
    return {
        placed.global_id: placed.design_from_model.move(mesh.vertices)[mesh.faces]
        for mesh in found for placed in mesh.placements
    }  # fmt: skip


def checked(text: str) -> dict[str, tuple[int, int]]:
    """CHECK.txt, made independently: file → elements, triangles."""
    rows = re.findall(r"^ifc/(\S.*\.ifc) \|.* elems (\d+) tris (\d+) bbox", text, re.MULTILINE)
    return {name: (int(elements), int(triangles)) for name, elements, triangles in rows}


# All their products are built things, so that the counts are those of CHECK.txt.
WHOLE = (
    "schependomlaan/ROOT-staal/IFC-staal.ifc", "schependomlaan/ROOT-traphekken/IFC-traphekken.ifc",
    "schependomlaan/ROOT-prefab_trappen/IFC-prefab_trappen.ifc", "schependomlaan/ROOT-Vebo/IFC-Vebo.ifc",
    "schependomlaan/ROOT-kalkzandsteen/IFC-kalkzandsteen.ifc",
    "schependomlaan/ROOT-prefab_balkons/IFC-prefab_balkons.ifc",
    "schependomlaan/ROOT-kanaalplaatvloer/IFC-kanaalplaatvloer.ifc",
    "schependomlaan/ROOT-lateien_en_geveldragers/IFC-lateien_en_geveldragers.ifc",
    "schependomlaan/ROOT-kapconstructie_dakkapellen_platdak/IFC-kapconstructie_dakkapellen_platdak.ifc",
    "schependomlaan/ROOT-prefab_vloer_lifttop/IFC-prefab_vloer_lifttop.ifc",
    "web-ifc/ISSUE_021_Mini_Project.ifc", "web-ifc/ISSUE_044_test_IFCCOMPOSITEPROFILEDEF.ifc",
    "web-ifc/Sample_entities.ifc",
)  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == WHOLE[0] else pytest.mark.slow) for n in WHOLE])
def test_every_product_is_placed_once(shared_data: Path, name: str) -> None:
    elements, triangles = checked((shared_data / "ifc/CHECK.txt").read_text())[name]
    found = once(shared_data / "ifc" / name)
    assert len(products(found)) == sum(len(mesh.placements) for mesh in found) == elements
    assert sum(len(mesh.faces) * len(mesh.placements) for mesh in found) == triangles


# Windows of 1,438 products: the reader takes 50 s for all of them, and 5 for these 328.
PART = {"002.ifc": ("IfcColumn", "IfcPlate")}


@pytest.mark.slow
def test_every_file_is_read_or_one_clear_line(shared_data: Path) -> None:
    refused = {}
    for path in sorted((shared_data / "ifc").rglob("*.ifc")):
        try:
            assert once(path, *PART.get(path.name, ()))
        except ScanfindError as error:
            refused[path.name] = str(error)
    assert sorted(refused) == [
        "KIT-Simple-Road-Test-Web-IFC4x3_RC2.ifc", "cyclic-placement.ifc", "invalid-index.ifc",
        "unterminated-string.ifc",
    ]  # fmt: skip
    assert not any("\n" in line for line in refused.values())


@pytest.mark.parametrize(("name", "error", "line"), [
    ("malformed/cyclic-placement.ifc", UnreadableFileError, "crashes its reader .*the file is damaged"),
    ("malformed/invalid-index.ifc", UnreadableFileError, "no product whose shape could be built"),
    ("malformed/unterminated-string.ifc", UnreadableFileError, "not a readable IFC file"),
    ("KIT-Simple-Road-Test-Web-IFC4x3_RC2.ifc", UnsupportedFormatError, "IFC4X3_RC2; scanfind reads IFC2X3"),
])  # fmt: skip
def test_a_damaged_file_is_one_clear_line(shared_data: Path, name: str, error: type[ScanfindError], line: str) -> None:
    with pytest.raises(error, match=line):
        read_models(shared_data / "ifc/web-ifc" / name)


def test_design_placements_agree_with_world_coordinates(shared_data: Path) -> None:
    import ifcopenshell
    import ifcopenshell.geom

    path = shared_data / "ifc/schependomlaan/ROOT-staal/IFC-staal.ifc"
    found = products(meshes(path, "IfcColumn", "IfcBeam"))
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    file = ifcopenshell.open(str(path))
    assert set(found) == {each.GlobalId for kind in ("IfcColumn", "IfcBeam") for each in file.by_type(kind)}
    for each in [*file.by_type("IfcColumn"), *file.by_type("IfcBeam")[:10]]:
        geometry: Any = ifcopenshell.geom.create_shape(settings, each).geometry
        vertices, faces = np.array(geometry.verts).reshape(-1, 3), np.array(geometry.faces).reshape(-1, 3)
        ours = found[each.GlobalId]
        # Welding renumbers vertices, and shapes 0.01 mm apart are one; the triangles keep their order.
        np.testing.assert_allclose(ours.mean(axis=1), vertices[faces].mean(axis=1), atol=5e-5)


def test_reading_twice_gives_the_same(shared_data: Path) -> None:
    path = shared_data / "ifc/schependomlaan/ROOT-traphekken/IFC-traphekken.ifc"
    first, second = meshes(path), meshes(path)
    assert [mesh.name for mesh in first] == [mesh.name for mesh in second]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.triangles(), b.triangles())


def test_a_file_of_damaged_shapes_says_how_many(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ifc", [("IfcBeam", "good", Pose.identity()), ("IfcBeam", "bad", Pose.identity())])
    # The second bar gets a profile of no width.
    head, profile, tail = path.read_text().rpartition("IFCRECTANGLEPROFILEDEF(")
    path.write_text(head + profile + re.sub(r",[\d.]+,([\d.]+)\)", r",0.,\1)", tail, count=1))
    [mesh] = meshes(path)
    assert mesh.notes["hint"] == "1 of 2 products of a.ifc have no usable shape and are left out"


def write(
    path: Path, elements: list[tuple[str, str, Pose]], *, whole: str = "", scale: float = 1.0, schema: str = "IFC4"
) -> Path:
    """An IFC file of 200 × 300 × 2000 mm bars, each under its class, name and place; `whole` assembles them."""
    import ifcopenshell
    import ifcopenshell.guid

    file = ifcopenshell.file(schema=schema)

    def new_id() -> str:
        return str(ifcopenshell.guid.compress(uuid.uuid4().hex))

    def point(*xyz: float) -> Any:
        return file.create_entity("IfcCartesianPoint", [float(c) / scale for c in xyz])

    def axes(pose: Pose) -> Any:
        z, x = (file.create_entity("IfcDirection", pose.rotation[:, k].tolist()) for k in (2, 0))
        return file.create_entity("IfcAxis2Placement3D", point(*pose.translation), z, x)

    unit = file.create_entity("IfcSIUnit", None, "LENGTHUNIT", "MILLI" if scale == 1e-3 else None, "METRE")
    context = file.create_entity("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, axes(Pose.identity()))
    file.create_entity(
        "IfcProject", new_id(), RepresentationContexts=[context],
        UnitsInContext=file.create_entity("IfcUnitAssignment", [unit]),
    )  # fmt: skip
    made = []
    for kind, name, pose in elements:
        profile = file.create_entity(
            "IfcRectangleProfileDef", "AREA", None,
            file.create_entity("IfcAxis2Placement2D", file.create_entity("IfcCartesianPoint", [0.0, 0.0])),
            0.2 / scale, 0.3 / scale,
        )  # fmt: skip
        up = file.create_entity("IfcDirection", [0.0, 0.0, 1.0])
        solid = file.create_entity("IfcExtrudedAreaSolid", profile, axes(Pose.identity()), up, 2.0 / scale)
        shape = file.create_entity("IfcShapeRepresentation", context, "Body", "SweptSolid", [solid])
        made.append(file.create_entity(
            kind, new_id(), Name=name, ObjectPlacement=file.create_entity("IfcLocalPlacement", None, axes(pose)),
            Representation=file.create_entity("IfcProductDefinitionShape", None, None, [shape]),
        ))  # fmt: skip
    if whole:
        place = file.create_entity("IfcLocalPlacement", None, axes(Pose(np.eye(3), np.array([10.0, 0.0, 0.0]))))
        assembly = file.create_entity("IfcElementAssembly", new_id(), Name=whole, ObjectPlacement=place)
        file.create_entity("IfcRelAggregates", new_id(), RelatingObject=assembly, RelatedObjects=made)
    file.write(str(path))
    return path


TURNED = Pose(rotation_from_vector((0.3, -0.2, 0.9)), np.array([4.0, 5.0, 6.0]))
ELEMENTS = [("IfcColumn", "pillar 1", Pose.identity()), ("IfcBeam", "beam", TURNED), ("IfcSpace", "room", TURNED)]


@pytest.fixture(scope="module")
def bars(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A column, a beam and a room, all of one geometry; column, beam and room make an assembly; millimetres."""
    return write(tmp_path_factory.mktemp("ifc") / "bars.ifc", ELEMENTS, whole="SPOOL-01", scale=1e-3)


def test_equal_products_are_one_model_in_metres(bars: Path) -> None:
    [mesh] = meshes(bars)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.2, 0.3, 2.0], atol=1e-6)
    assert [(p.ifc_class, p.name) for p in mesh.placements] == [("IfcColumn", "pillar 1"), ("IfcBeam", "beam")]
    np.testing.assert_allclose(mesh.placements[1].design_from_model.matrix(), TURNED.matrix(), atol=1e-6)
    [facts] = model_info(bars).models
    assert (facts.name, facts.placements, facts.triangles, facts.watertight) == ("pillar 1", 2, 12, True)


@pytest.mark.parametrize(("select", "expected"), [
    (["ifcbeam"], ["beam"]), (["IfcElement"], ["pillar 1", "beam"]), (["PILLAR*"], ["pillar 1"]),
    (["IfcSpace"], ["room"]), (["IfcBeam", "pillar ?"], ["pillar 1", "beam"]), (["IfcElementAssembly"], ["SPOOL-01"]),
])  # fmt: skip
def test_selecting(bars: Path, select: list[str], expected: list[str]) -> None:
    found = meshes(bars, *select)
    assert [placed.name for mesh in found for placed in mesh.placements] == expected


def test_a_selected_assembly_is_one_model_of_its_parts(bars: Path) -> None:
    [mesh] = meshes(bars, "spool-*")
    assert [part for part, _, _ in mesh.notes["parts"]] == ["pillar 1", "beam", "room"]
    [placed] = mesh.placements
    np.testing.assert_allclose(placed.design_from_model.translation, [10.0, 0.0, 0.0], atol=1e-9)
    [single] = meshes(bars, "pillar 1", "beam", "IfcSpace")
    np.testing.assert_allclose(
        np.sort(products([mesh])[placed.global_id].mean(axis=1), axis=0),
        np.sort(np.concatenate(list(products([single]).values())).mean(axis=1), axis=0),
        atol=1e-6,
    )


def test_selecting_by_global_id(bars: Path) -> None:
    [mesh] = meshes(bars)
    for placed in mesh.placements:
        assert list(products(meshes(bars, placed.global_id))) == [placed.global_id]


def test_a_selector_that_means_nothing_says_what_there_is(bars: Path) -> None:
    with pytest.raises(UsageError, match="matches 'IfcPipeSegment'; it has IfcColumn 1, IfcBeam 1, IfcSpace 1: select"):
        meshes(bars, "IfcBeam", "IfcPipeSegment")


def test_ifc_without_ifcopenshell_says_how_to_get_it(bars: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r'pip install "scanfind\[ifc\]"'):
        meshes(bars)
