"""Mesh files, STEP and pieces of scan: what is in them comes out, in metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from scanfind.cloud import CloudModel, PointChunk
from scanfind.errors import MissingExtraError, ScanfindError, UnreadableFileError, UnsupportedFormatError, UsageError
from scanfind.mesh import Mesh
from scanfind.models import MODEL_READERS, STATES_UNITS, clouds, model_info, read_models
from scanfind.models.wanted import Wanted

# Triangles as trimesh counts them; of wallhole's 66, 11 have no area.
TRIANGLES = {
    "BREP/base_interface_AP203.STEP": 2008, "BREP/base_interface_AP214.STEP": 2008, "ballA.off": 3796,
    "counterX.3MF": 8080, "counterXP.3MF": 8080 + 5 * 15134, "featuretype.3MF": 2208, "featuretype.STEP": 4118,
    "featuretype.STL": 3476, "featuretype.ply": 3476, "fixed_top.ply": 4772, "nancolor.obj": 12, "plane.ply": 2,
    "quadknot.obj": 2880, "soup.stl": 100, "tube.obj": 120, "two_objects_mixed_case_names.stl": 24,
    "unit_cube.STL": 12, "unit_sphere.STL": 1280, "wallhole.obj": 55,
}  # fmt: skip
POINTS = {
    "emptyIO/ply_points_ascii.ply": 8, "emptyIO/ply_points_bin.ply": 8, "points_ascii.ply": 5, "points_bin.ply": 5,
    "points_ascii_with_lists.ply": 5, "points_emptyascii.ply": 12, "points_emptyface.ply": 1024,
}  # fmt: skip
REFUSED = (
    "empty.obj", "empty.ply", "empty.stl", "empty_nodes.glb", "emptyIO/obj_empty.obj", "emptyIO/obj_points.obj",
    "emptyIO/obj_wireframe.obj", "emptyIO/ply_empty_ascii.ply", "emptyIO/ply_empty_bin.ply",
    "emptyIO/ply_empty_header.ply", "emptyIO/stl_empty_ascii.stl", "emptyIO/stl_empty_bin.stl",
)  # fmt: skip


def only_mesh(path: Path, units: str | None = None) -> Mesh:
    [mesh] = read_models(path, units=units)
    assert isinstance(mesh, Mesh)
    return mesh


def size(mesh: Mesh) -> list[float]:
    extent: list[float] = np.ptp(mesh.vertices, axis=0).tolist()
    return extent


@pytest.fixture(scope="module")
def assembly() -> trimesh.Scene:
    """Two boxes and one of them again, elsewhere: 36 triangles, metres."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1, 2, 3)), geom_name="tall")
    flat = trimesh.creation.box((4, 1, 0.5))
    move = trimesh.transformations.rotation_matrix(0.3, (1, 2, 3))
    move[:3, 3] = 5, 0, 0
    scene.add_geometry(flat, geom_name="flat", transform=move)
    scene.graph.update(frame_to="again", geometry="flat", matrix=trimesh.transformations.translation_matrix((0, 9, 0)))
    return scene


# Those that are read in a child process are slow, except one of each kind.
FAST = [name for name in TRIANGLES if name.islower() or name == "featuretype.3MF" or "STL" in name]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in TRIANGLES]
)
def test_triangles(shared_data: Path, name: str) -> None:
    mesh = only_mesh(shared_data / "formats/trimesh/models" / name)
    assert len(mesh.faces) == TRIANGLES[name]
    assert mesh.name == Path(name).stem
    bounds = [(first, last) for _, first, last in mesh.notes["parts"]]
    assert [0, *(last for _, last in bounds)] == [*(first for first, _ in bounds), len(mesh.faces)]


@pytest.mark.parametrize("name", POINTS)
def test_a_ply_without_faces_is_a_piece_of_scan(shared_data: Path, name: str) -> None:
    [cloud] = read_models(shared_data / "formats/trimesh/models" / name)
    assert isinstance(cloud, CloudModel)
    assert cloud.points.shape == (POINTS[name], 3)


@pytest.mark.parametrize("name", REFUSED)
def test_an_empty_file_is_one_clear_line(shared_data: Path, name: str) -> None:
    with pytest.raises(ScanfindError, match=Path(name).name) as error:
        read_models(shared_data / "formats/trimesh/models" / name)
    assert "\n" not in str(error.value)


def test_one_part_in_four_formats_has_one_size(shared_data: Path) -> None:
    folder = shared_data / "formats/trimesh/models"
    sizes = [
        size(only_mesh(folder / "featuretype.STEP")),
        size(only_mesh(folder / "featuretype.3MF")),
        size(only_mesh(folder / "featuretype.STL", "in")),
        size(only_mesh(folder / "featuretype.ply", "in")),
    ]
    np.testing.assert_allclose(sizes, [[0.127, 0.0635, 0.034925]] * 4, atol=1e-6)


def test_a_step_assembly_is_one_model_of_named_parts(shared_data: Path) -> None:
    mesh = only_mesh(shared_data / "cad/box_sides.STEP")
    assert mesh.notes["watertight"]
    names = [name for name, _, _ in mesh.notes["parts"]]
    assert len(names) == 10
    assert {"box_base", "box_top", "gusset", "side_long"} <= set(names)
    np.testing.assert_allclose(size(mesh), [0.18415, 0.1143, 0.09525], atol=1e-6)


def test_industrial_stl(shared_data: Path) -> None:
    files = sorted((shared_data / "cad/ilspr").rglob("*.stl"))
    assert len(files) == 80
    for path in files:
        mesh = only_mesh(path, "mm")
        data = path.read_bytes()
        declared = (len(data) - 84) // 50 if not data.startswith(b"solid") else data.count(b"endfacet")
        # A few have needles of no width.
        assert declared - 10 <= len(mesh.faces) <= declared
        assert "hint" not in mesh.notes


@pytest.mark.parametrize("suffix", ["stl", "stl_ascii", "off", "obj", "ply", "glb", "gltf", "3mf"])
def test_what_is_written_is_read(tmp_path: Path, assembly: trimesh.Scene, suffix: str) -> None:
    whole = assembly.to_mesh()
    path = tmp_path / f"a.{suffix.removesuffix('_ascii')}"
    if suffix == "gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(assembly).items():
            (tmp_path / ("a.gltf" if name == "model.gltf" else name)).write_bytes(data)
    else:
        keeps_scene = suffix in ("glb", "3mf")
        (assembly if keeps_scene else whole).export(path, file_type=suffix)
    mesh = only_mesh(path)
    # Our 3MF writer states no unit, which means millimetres.
    scale = 1e-3 if suffix == "3mf" else 1.0
    assert len(mesh.faces) == 36
    assert mesh.area() / scale**2 == pytest.approx(whole.area, rel=1e-6)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0) / scale, whole.extents, rtol=1e-6)
    assert mesh.notes["watertight"]
    if suffix in ("glb", "gltf", "3mf"):
        assert sorted(name for name, _, _ in mesh.notes["parts"]) == ["flat", "flat", "tall"]


PLY_KINDS = [("ascii", ""), ("binary_little_endian", "<"), ("binary_big_endian", ">")]


@pytest.mark.parametrize(("encoding", "order"), PLY_KINDS)
@given(polygons=st.lists(st.integers(3, 6), min_size=1, max_size=8))
def test_ply_faces_of_any_corners(
    tmp_path_factory: pytest.TempPathFactory, encoding: str, order: str, polygons: list[int]
) -> None:
    rng = np.random.default_rng(sum(polygons))
    vertices = rng.uniform(-1, 1, (10, 3)).astype(np.float32)
    faces = [rng.permutation(10)[:n] for n in polygons]
    header = (
        f"ply\nformat {encoding} 1.0\ncomment made here\nelement vertex 10\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\n"
        f"element face {len(faces)}\nproperty short material\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if encoding == "ascii":
        rows = [f"{x!r} {y!r} {z!r} 7" for x, y, z in vertices.tolist()]
        body = "\n".join([*rows, *(f"3 {len(f)} {' '.join(map(str, f))}" for f in faces)]).encode()
    else:
        points = np.zeros(10, [("xyz", order + "f4", 3), ("red", "u1")])
        points["xyz"] = vertices
        body = points.tobytes() + b"".join(
            np.array(3, order + "i2").tobytes() + bytes([len(f)]) + f.astype(order + "i4").tobytes() for f in faces
        )
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    path.write_bytes(header.encode() + body)
    mesh = only_mesh(path)
    expected = [[f[0], f[k], f[k + 1]] for f in faces for k in range(1, len(f) - 1)]
    np.testing.assert_array_equal(mesh.triangles(), vertices.astype(np.float64)[expected])
    path.write_bytes(path.read_bytes()[:-2])
    with pytest.raises(UnreadableFileError, match=r"a\.ply"):
        read_models(path)


def test_obj_speaks_all_its_dialects(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(
        "mtllib /etc/passwd\no first\nv 0 0 0 1 0.5 0.5 0.5\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 \\\n"
        "3//1 4//1\no second\r\ng group\nusemtl steel\nv 0 0 1\nv 1 0 1\nv 0 1 1\nf -3 -2 -1\n"
        "f 1/2/3 2/3/4 5/6/7\n# f 9 9 9\n"
    )
    mesh = only_mesh(path)
    assert mesh.notes["parts"] == (("first", 0, 2), ("second", 2, 4))
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    np.testing.assert_array_equal(mesh.triangles(), corners[[[0, 1, 2], [0, 2, 3], [4, 5, 6], [0, 1, 4]]])


def test_a_binary_stl_that_begins_with_solid(tmp_path: Path) -> None:
    data = trimesh.creation.box().export(file_type="stl")
    path = tmp_path / "a.stl"
    path.write_bytes(b"solid facet endsolid"[:20] + data[20:])
    assert len(only_mesh(path).faces) == 12
    path.write_bytes(data + b"COLOR=" * 9)
    assert len(only_mesh(path).faces) == 12


def test_an_inside_out_file_is_turned(tmp_path: Path) -> None:
    box = trimesh.creation.box((1, 2, 3))
    box.invert()
    box.export(tmp_path / "a.stl")
    mesh = only_mesh(tmp_path / "a.stl")
    assert mesh.notes["turned"] == 1
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume == pytest.approx(6.0)


def test_an_implausible_size_is_asked_about(tmp_path: Path) -> None:
    path = tmp_path / "spool.stl"
    trimesh.creation.box((3000, 1700, 500)).export(path)
    assert only_mesh(path).notes["hint"] == "the model is 3,484 m across: are its units mm? (--units mm)"
    assert "hint" not in only_mesh(path, "mm").notes
    assert model_info(path).hints == ("the model is 3,484 m across: are its units mm? (--units mm)",)


def test_units_are_refused_where_the_file_states_them(shared_data: Path) -> None:
    with pytest.raises(UsageError, match="states its own units"):
        read_models(shared_data / "formats/trimesh/models/featuretype.3MF", units="mm")
    assert set(STATES_UNITS) <= set(MODEL_READERS)


def test_info(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    trimesh.creation.box((1, 2, 3)).export(path)
    info = model_info(path)
    assert (info.format, info.units) == ("stl", "not stated by the file, metres assumed (--units)")
    [facts] = info.models
    assert (facts.name, facts.triangles, facts.points, facts.extent_m) == ("a", 12, 0, (1.0, 2.0, 3.0))
    assert facts.area_m2 == pytest.approx(22.0)
    assert facts.watertight


def test_no_such_file_or_format(tmp_path: Path) -> None:
    with pytest.raises(UnreadableFileError, match="no such file"):
        read_models(tmp_path / "a.stl")
    (tmp_path / "b.stl").mkdir()
    with pytest.raises(UnreadableFileError, match="not a file"):
        read_models(tmp_path / "b.stl")
    with pytest.raises(UnsupportedFormatError, match=r"\.dwg is not a model format"):
        read_models(tmp_path / "a.dwg")


def test_a_missing_library_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, shared_data: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r'pip install "scanfind\[step\]"'):
        read_models(shared_data / "cad/box_sides.STEP")


def test_a_piece_of_scan_knows_its_scanner(tmp_path: Path) -> None:
    path = tmp_path / "valve.xyz"
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)).round(4)
    np.savetxt(path, points, fmt="%.4f")
    [cloud] = read_models(path, units="ft", origin=(1, 2, 3))
    assert isinstance(cloud, CloudModel)
    np.testing.assert_allclose(cloud.points, points * 0.3048)
    assert (cloud.name, cloud.origin is not None and cloud.origin.tolist()) == ("valve", [1.0, 2.0, 3.0])
    with pytest.raises(UsageError, match="three finite numbers"):
        read_models(path, origin=(1, 2))
    with pytest.raises(UnreadableFileError, match="more than 49 points: cut the object out"):
        clouds.read(path, Wanted(), most_points=49)


@pytest.mark.parametrize(("origins", "expected"), [
    ([None, None], [9.0, 9.0, 9.0]), ([[1.0, 2.0, 3.0]] * 2, [1.0, 2.0, 3.0]),
    ([[1.0, 2.0, 3.0], [1.0, 2.0, 4.0]], None), ([None, [1.0, 2.0, 3.0]], None),
])  # fmt: skip
def test_several_scanners_have_no_common_side(
    monkeypatch: pytest.MonkeyPatch, origins: list[list[float] | None], expected: list[float] | None
) -> None:
    chunks = [
        PointChunk(np.zeros((1, 3)), {}, np.zeros(1, np.int64), k, None if origin is None else np.array(origin))
        for k, origin in enumerate(origins)
    ]
    monkeypatch.setattr("scanfind.scans.read_scan", lambda _: iter(chunks))
    [cloud] = clouds.read(Path("a.e57"), Wanted(origin=np.full(3, 9.0)))
    assert (None if cloud.origin is None else cloud.origin.tolist()) == expected
