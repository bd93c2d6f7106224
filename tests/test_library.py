"""Laws of the model library: what is put in comes out; all or nothing; one clear line for every other file."""

from __future__ import annotations

import os
import pickle
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import CloudModel, OrientedCloud
from scanfind.errors import LibraryError
from scanfind.library import Model, ModelLibrary, ModelParameters
from scanfind.library.joint import joint_table
from scanfind.library.model import build_model, model_hash
from scanfind.library.pairs import PairParameters, key_count
from scanfind.library.self_similar import Similar
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh, Placement
from scanfind.pose import Pose
from scanfind.symmetry import Symmetry, parse_axes
from test_surface import box, tube

SMALL = ModelParameters(SurfaceParameters(samples=60), PairParameters(angle_cell_deg=30.0))
ALONE = replace(SMALL, symmetry="none")
PLACED = Placement("2O2Fr$t4X7Zf8NOew3FLOH", "IfcBeam", "Träger ①", Pose.from_rotation_vector([0.1, 2, 3], [1, 2, 1e6]))


def assert_same(one: Any, two: Any) -> None:
    """Equal in every bit, dtype and type, all the way down."""
    assert type(one) is type(two)
    if isinstance(one, np.ndarray):
        assert one.dtype == two.dtype
        np.testing.assert_array_equal(one, two)
    elif is_dataclass(one):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(two, field.name))
    elif isinstance(one, tuple):
        assert len(one) == len(two)
        for a, b in zip(one, two, strict=True):
            assert_same(a, b)
    else:
        assert one == two


def placed(mesh: Mesh, *placements: Placement) -> Mesh:
    return replace(mesh, placements=placements)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "parts of ö%20#?.scanfind"


@pytest.fixture
def filled(path: Path) -> Path:
    """A library of two models."""
    with ModelLibrary.open(path, create=True) as library:
        library.add(placed(box(1, 2, 3, name="crate"), PLACED), SMALL)
        library.add(tube(0.2, 1.0), SMALL)
    return path


# ── what is put in comes out ──────────────────────────────────────────────────────────────────────────────────────

floats = st.floats(allow_nan=False, allow_infinity=False)
sizes = st.floats(1e-6, 1e6)
# What file names and IFC names may hold; half a surrogate pair is a byte of a file name that is no UTF-8.
names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20)
raw_texts = st.text(max_size=10)


def rows(count: int, width: int) -> st.SearchStrategy[NDArray[np.float64]]:
    return st.lists(floats, min_size=count * width, max_size=count * width).map(
        lambda values: np.array(values, np.float64).reshape(count, width)
    )


@st.composite
def models(draw: st.DrawFn) -> Model:
    """Any model there can be, whether or not it has a sensible shape."""
    n = draw(st.integers(2, 5))
    parameters = draw(st.sampled_from([SMALL, ModelParameters()]))
    name, source = draw(names), draw(raw_texts)
    placements: list[Placement] = []
    mesh = cloud = None
    if draw(st.booleans()):
        pose = Pose(draw(rows(3, 3)), draw(rows(1, 3))[0])
        placements = draw(st.lists(st.builds(Placement, raw_texts, raw_texts, raw_texts, st.just(pose)), max_size=2))
        faces = np.array(draw(st.lists(st.integers(0, 3), min_size=6, max_size=6)), np.int32).reshape(2, 3)
        mesh = Mesh(name, draw(rows(4, 3)), faces, source, tuple(placements))
    else:
        origin = draw(st.none() | rows(1, 3).map(lambda row: row[0]))
        cloud = CloudModel(name, draw(rows(n, 3)), source, origin)
    signed = draw(st.booleans())
    axes = draw(st.sampled_from(["none", "x2", "x2,y2,z2", "z*,y2", "x*,z*"]))
    similar = draw(st.lists(st.builds(Similar, floats, st.builds(Pose, rows(3, 3), rows(1, 3).map(lambda r: r[0])))))
    return Model(
        name=name,
        sha256=draw(st.text("0123456789abcdef", min_size=64, max_size=64)),
        source=source,
        diameter=draw(sizes),
        spacing=draw(sizes),
        area=draw(sizes),
        signed=signed,
        samples=OrientedCloud(draw(rows(n, 3)), draw(rows(n, 3)), signed),
        mesh=mesh,
        cloud=cloud,
        pair_count=draw(st.integers(0, 10**6)),
        symmetry=Symmetry(draw(rows(1, 3))[0], parse_axes(axes)),
        similar=tuple(similar),
        placements=tuple(placements),
        parameters=parameters,
    )


@settings(max_examples=50, deadline=None)
@given(model=models())
def test_load_undoes_save(model: Model) -> None:
    with ModelLibrary.in_memory() as library:
        library.put(model)
        assert_same(library.get(model.name), model)
        (summary,) = library.show()
        assert summary.name == model.name
        assert summary.pairs == model.pair_count


def test_a_file_keeps_what_was_built(filled: Path) -> None:
    with ModelLibrary.open(filled) as library:
        assert_same(library.get("crate"), build_model(placed(box(1, 2, 3, name="crate"), PLACED), SMALL))
        assert [model.name for model in library.models()] == library.names() == list(library) == ["crate", "tube"]
        assert len(library) == 2
        assert "tube" in library
        assert "spool" not in library
        crate, tubular = library.show()
        assert (crate.triangles, crate.samples, crate.placements, tubular.placements) == (12, 60, 1, 0)
        assert crate.diameter == library.get("crate").diameter
    assert sorted(file.name for file in filled.parent.iterdir()) == [filled.name]


def test_a_piece_of_scan_is_a_model_too(path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (20_000, 3))
    points[np.arange(20_000), rng.integers(0, 3, 20_000)] = rng.choice([-0.5, 0.5], 20_000)
    with ModelLibrary.open(path, create=True) as library:
        for origin in (None, np.array([1.0, 2.0, 3.0])):
            name = "known side" if origin is not None else "no side"
            piece = library.add(CloudModel(name, points, "scan.e57", origin), SMALL)
            assert_same(piece, library.get(name))
            assert piece.signed == (origin is not None)
            assert piece.diameter == pytest.approx(np.sqrt(3.0), rel=0.1)
        assert library.show()[0].triangles == 0


def test_what_is_there_already_costs_no_work(filled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_work(*_: object) -> None:
        pytest.fail("built a model that was there")

    monkeypatch.setattr("scanfind.library.build_model", no_work)
    with ModelLibrary.open(filled) as library:
        before = library.get("crate")
        assert_same(library.add(box(1, 2, 3, name="crate"), SMALL), before)
        assert_same(library.add(box(1, 2, 3, name="known by another name"), SMALL), before)
        assert library.names() == ["crate", "tube"]


def test_several_prepared_side_by_side_are_as_added_one_by_one(filled: Path, path: Path) -> None:
    more = [
        replace(tube(0.3, 1.0), name="new"),
        box(1, 2, 3, name="crate"),  # there already
        placed(replace(tube(0.1, 2.0), name="thin"), PLACED),
        placed(replace(tube(0.1, 2.0), name="thin again"), replace(PLACED, global_id="other")),
    ]
    with ModelLibrary.open(filled) as one, ModelLibrary.open(path.with_suffix(".2"), create=True) as other:
        for model in one.models():
            other.put(model)
        added = [one.add(model, SMALL) for model in more]
        for mine, theirs in zip(added, other.add_all(more, SMALL, jobs=2), strict=True):
            assert_same(theirs, mine)
        assert_same(tuple(other.models()), tuple(one.models()))
        with pytest.raises(LibraryError, match="'crate' is there already"):
            list(other.add_all([replace(tube(0.7, 1.0), name="wide"), box(1, 1, 1, name="crate")], SMALL, jobs=2))
        assert other.names() == one.names()


def test_new_placements_join_those_known(filled: Path) -> None:
    moved, other = replace(PLACED, design_from_model=Pose.identity()), replace(PLACED, global_id="other")
    with ModelLibrary.open(filled) as library:
        model = library.add(placed(box(1, 2, 3, name="crate"), moved, other), SMALL)
        assert_same(model.placements, (moved, other))
        assert_same(library.get("crate"), model)
        assert library.show()[0].placements == 2


def test_the_hash_tells_geometry_and_parameters_apart_but_not_names() -> None:
    mesh = box(1, 2, 3)
    points, origin = mesh.vertices, np.zeros(3)
    finer = replace(SMALL, surface=replace(SMALL.surface, samples=61))
    coarser = replace(SMALL, pairs=replace(SMALL.pairs, angle_cell_deg=15.0))
    hashes = [
        model_hash(mesh, SMALL),
        model_hash(mesh, finer),
        model_hash(mesh, coarser),
        model_hash(mesh.scaled(0.001), SMALL),
        model_hash(Mesh.of("turned", mesh.vertices, mesh.faces[:, [1, 2, 0]]), SMALL),
        model_hash(CloudModel("box", points), SMALL),
        model_hash(CloudModel("box", points, origin=origin), SMALL),
        model_hash(CloudModel("box", np.vstack([points, origin])), SMALL),
    ]
    assert len(set(hashes)) == len(hashes)
    assert model_hash(box(1, 2, 3, name="other"), SMALL) == hashes[0]


@pytest.mark.parametrize(
    "name", ["'; DROP TABLE records; --", "a\nb", "%", "日本語", "nul\0nul", "n\u00e9e", "ne\u0301e"]
)
def test_any_text_is_a_name(filled: Path, name: str) -> None:
    with ModelLibrary.open(filled) as library:
        library.add(box(1, 1, 1, name=name), SMALL)
        assert library.get(name).name == name
        library.remove(name)
        assert library.names() == ["crate", "tube"]


@pytest.mark.parametrize("name", ["", "broken \udcff"])
def test_what_is_no_text_is_no_name(filled: Path, name: str) -> None:
    with ModelLibrary.open(filled) as library:
        with pytest.raises(LibraryError, match="needs a name"):
            library.add(box(1, 1, 1, name=name), SMALL)
        with pytest.raises(LibraryError, match="no model"):
            library.get(name)


def test_one_name_one_model(filled: Path) -> None:
    with ModelLibrary.open(filled) as library:
        with pytest.raises(LibraryError, match=r"'crate' is there already.*remove it or rename"):
            library.add(box(1, 2, 4, name="crate"), SMALL)
        library.remove("crate")
        assert library.add(box(1, 2, 4, name="crate"), SMALL).sha256 == library.get("crate").sha256


@pytest.mark.parametrize("verb", ["get", "remove"])
def test_a_model_that_is_not_there_is_named_with_those_that_are(filled: Path, verb: str) -> None:
    with ModelLibrary.open(filled) as library, pytest.raises(LibraryError, match=r"no model 'spool'.*'crate', 'tube'"):
        getattr(library, verb)("spool")


def test_a_removed_model_gives_its_room_back(filled: Path) -> None:
    with ModelLibrary.open(filled) as library:
        before = filled.stat().st_size
        for name in library.names():
            library.remove(name)
        assert not library.models()
        assert not library.show()
        assert filled.stat().st_size < min(before, 50_000)


# ── other files ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_reading_never_makes_a_file(path: Path) -> None:
    with pytest.raises(LibraryError, match="does not exist"):
        ModelLibrary.open(path)
    assert not path.exists()


def other_application(path: Path) -> None:
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE records (name TEXT)")
    database.close()


def other_version(path: Path) -> None:
    ModelLibrary.open(path, create=True).close()
    with sqlite3.connect(path) as database:
        database.execute("PRAGMA user_version = 99")
    database.close()


def never_ending_view(path: Path) -> None:
    """A hostile library: reading `content` would never return."""
    ModelLibrary.open(path, create=True).close()
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE content")
        database.execute(
            "CREATE VIEW content AS WITH RECURSIVE n (crcs) AS (SELECT 0 UNION ALL SELECT crcs + 1 FROM n) "
            "SELECT crcs FROM n"
        )
    database.close()


@pytest.mark.parametrize("create", [False, True])
@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: path.mkdir(), "is a folder"),
        (lambda path: path.write_bytes(b"solid box\n" * 1000), "is not a model library"),
        (lambda path: path.write_bytes(b"SQLite format 3\0" + bytes(5000)), "is (not a model library|damaged)"),
        (other_application, "is not a model library"),
        (other_version, "has version 99, this scanfind reads 3"),
        (never_ending_view, "is damaged"),
    ],
)
def test_another_file_is_refused_and_left_as_it_is(
    path: Path, make: Callable[[Path], object], says: str, create: bool
) -> None:
    make(path)
    before = None if path.is_dir() else path.read_bytes()
    with pytest.raises(LibraryError, match=says) as caught:
        ModelLibrary.open(path, create=create)
    assert "\n" not in str(caught.value)
    assert before is None or path.read_bytes() == before


def test_an_empty_file_is_no_library_but_can_become_one(path: Path) -> None:
    path.touch()
    with pytest.raises(LibraryError, match="is not a model library"):
        ModelLibrary.open(path)
    with ModelLibrary.open(path, create=True) as library:
        assert library.names() == []


def test_a_folder_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(LibraryError, match="cannot be opened"):
        ModelLibrary.open(tmp_path / "none" / "lib", create=True)


def read_all(path: Path) -> list[Model]:
    with ModelLibrary.open(path) as library:
        assert len(library.show()) == len(library)
        return library.models()


def assert_noticed_or_harmless(path: Path, damaged: bytes, whole: list[Model]) -> None:
    path.write_bytes(damaged)
    try:
        found = read_all(path)
    except LibraryError:
        return
    for one, two in zip(found, whole, strict=True):
        assert_same(one, two)


def test_a_file_cut_short_is_noticed(filled: Path) -> None:
    whole, content = read_all(filled), filled.read_bytes()
    for end in (0, 50, 100, 4096, 5000, len(content) // 2, len(content) - 4096, len(content) - 1):
        assert_noticed_or_harmless(filled, content[:end], whole)


def test_changed_bytes_are_noticed(filled: Path) -> None:
    """Wherever they are: in the header, the schema, a page's own tables, a name or an array."""
    whole, content = read_all(filled), filled.read_bytes()
    rng = np.random.default_rng(0)
    for place in [*range(0, 110, 3), *rng.integers(0, len(content), 150).tolist()]:
        changed = bytearray(content)
        changed[place] ^= 1 << int(rng.integers(8))
        assert_noticed_or_harmless(filled, bytes(changed), whole)
    for place in [*rng.integers(100, 4096, 50).tolist(), *rng.integers(0, len(content), 50).tolist()]:
        changed = bytearray(content)
        changed[place : place + 64] = rng.bytes(64)
        assert_noticed_or_harmless(filled, bytes(changed), whole)


@pytest.mark.parametrize("column", ["dtype = '|O'", "dtype = '<f8'", "shape = '[-1, 3]'", "shape = '['", "data = NULL"])
def test_a_changed_array_is_damage(filled: Path, column: str) -> None:
    with sqlite3.connect(filled) as database:
        database.execute(f"UPDATE arrays SET {column} WHERE role = 'faces'")
    database.close()
    with ModelLibrary.open(filled) as library:
        assert library.names() == ["crate", "tube"]
        with pytest.raises(LibraryError, match=r"is damaged.*array 'faces' of 'crate'"):
            library.get("crate")


@pytest.mark.parametrize(
    "change",
    [
        lambda m: replace(m, area=inf),
        lambda m: replace(m, spacing=0.0),
        lambda m: replace(m, mesh=replace(m.mesh, faces=m.mesh.faces - 1)),
        lambda m: replace(m, samples=OrientedCloud(m.samples.points[:, :2], m.samples.normals)),
    ],
)
def test_what_no_kernel_should_meet_reaches_none(change: Callable[[Model], Model]) -> None:
    """A library made by someone else, with sound checksums over wrong content."""
    with ModelLibrary.in_memory() as library:
        library.put(change(build_model(box(1, 2, 3), SMALL)))
        with pytest.raises(LibraryError, match="is damaged"):
            library.get("box")


# ── all or nothing, and two at once ───────────────────────────────────────────────────────────────────────────────

SCRIPT = """
import os, pickle, signal, sys
from pathlib import Path
from scanfind.library import ModelLibrary
from scanfind.library.store import Store
path, job, models = Path(sys.argv[1]), sys.argv[2], pickle.load(sys.stdin.buffer)
if job == "die":
    insert = Store.insert
    def insert_and_die(store, record, arrays):
        store._connection.execute("PRAGMA cache_size = 1")  # so that half the transaction is in the file already
        insert(store, record, arrays)
        print(path.stat().st_size, flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    Store.insert = insert_and_die
print("ready", flush=True)
sys.stdin.readline()
with ModelLibrary.open(path, create=True) as library:
    for model in models:
        library.put(model)
        if job == "remove":
            library.remove(model.name)
"""


def numbered(number: int) -> Model:
    """A model of so many bytes that a transaction with it does not stay in memory."""
    return build_model(box(1, 1, number, name=f"box {number}"), replace(SMALL, surface=SurfaceParameters(samples=900)))


def start(path: Path, job: str, *numbers: int) -> subprocess.Popen[bytes]:
    """Another process, ready to go at a line on its stdin."""
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(path), job], stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0
    )
    assert process.stdin
    assert process.stdout
    process.stdin.write(pickle.dumps([numbered(number) for number in numbers]))
    assert process.stdout.readline() == b"ready\n"
    return process


def test_killed_in_the_middle_leaves_the_library_as_before(filled: Path) -> None:
    whole, size = read_all(filled), filled.stat().st_size
    process = start(filled, "die", 7)
    out, _ = process.communicate(b"go\n", timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert int(out) > size  # it was in the middle
    assert filled.with_name(filled.name + "-journal").exists()
    for one, two in zip(read_all(filled), whole, strict=True):
        assert_same(one, two)
    assert filled.stat().st_size == size
    with ModelLibrary.open(filled) as library:
        library.put(numbered(7))


def test_two_processes_add_to_one_file(path: Path) -> None:
    """Neither has it at first; they share some models and not others; one takes its own out again."""
    both = [start(path, "add", 1, 2, 3, 4), start(path, "add", 3, 4, 5, 6), start(path, "remove", 8, 9)]
    for process in both:
        assert process.stdin
        process.stdin.write(b"go\n")
    for process in both:
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
    with ModelLibrary.open(path) as library:
        assert library.names() == [f"box {n}" for n in range(1, 7)]
        assert_same(library.get("box 3"), numbered(3))


def test_one_that_never_lets_go_is_waited_for_and_named(filled: Path) -> None:
    other = sqlite3.connect(filled, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with ModelLibrary.open(filled, timeout_s=0.1) as library:
        assert len(library.models()) == 2  # readers go on
        with pytest.raises(LibraryError, match=r"another process and was not free within 0\.1 s; try again"):
            library.remove("crate")
        other.execute("ROLLBACK")
        library.remove("crate")
    other.close()


def test_an_error_in_the_middle_changes_nothing(filled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with ModelLibrary.open(filled) as library:
        with monkeypatch.context() as patch:
            patch.setattr("scanfind.library._facts", interrupted)
            with pytest.raises(KeyboardInterrupt):
                library.add(box(1, 1, 1), SMALL)
        assert library.names() == ["crate", "tube"]
        library.add(box(1, 1, 1), SMALL)


def test_a_library_on_a_read_only_medium_can_be_read(filled: Path) -> None:
    filled.chmod(0o444)
    filled.parent.chmod(0o555)
    try:
        with ModelLibrary.open(filled) as library:
            assert len(library.models()) == 2
            assert_same(library.add(box(1, 2, 3), SMALL), library.get("crate"))  # no work, nothing to write
            if os.geteuid() != 0:  # nothing is read-only to root
                with pytest.raises(LibraryError, match="cannot be written to"):
                    library.remove("crate")
    finally:
        filled.parent.chmod(0o755)


# ── one table for all models ──────────────────────────────────────────────────────────────────────────────────────


@cache
def crate_of_sixty() -> Model:
    return build_model(box(1, 2, 3), SMALL)


def scattered(seed: int) -> Model:
    """A model with a few samples anywhere, turned any way."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((int(rng.integers(2, 12)), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    samples = OrientedCloud(rng.uniform(0.0, 1.0, normals.shape), normals)
    return replace(crate_of_sixty(), samples=samples, diameter=1.0, spacing=0.3)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 4), jobs=st.integers(1, 3), data=st.data())
def test_the_joint_table_equals_its_naive_twin(seed: int, count: int, jobs: int, data: st.DataObject) -> None:
    several = [scattered(seed + k) for k in range(count)]
    among = np.array(data.draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    table = joint_table(several, among, jobs=jobs)
    cells: dict[int, list[tuple[int, int, int]]] = {}
    for number in np.flatnonzero(among).tolist():
        model = several[number]
        for key, first, second in zip(*(column.tolist() for column in model.pairs), strict=True):
            cells.setdefault(key, []).append((number, first, second))
    assert (
        table.offsets.tolist()
        == np.cumsum([0, *(len(cells.get(key, [])) for key in range(key_count(SMALL.pairs)))]).tolist()
    )
    for key, pairs in cells.items():
        at = slice(table.offsets[key], table.offsets[key + 1])
        assert list(zip(*(column[at].tolist() for column in table[1:]), strict=True)) == pairs


def test_pairs_that_a_symmetry_makes_of_others_are_looked_up_once() -> None:
    bar, crate = build_model(box(1, 0.2, 0.2), SMALL), build_model(box(1, 2, 3, name="crate"), ALONE)
    assert bar.symmetry.words() == "4-fold about x; 2-fold about y"
    assert crate.pair_count == len(crate.pairs.keys)
    assert len(joint_table([crate], each_once=True).first) == len(crate.pairs.first)
    all_of_them, once = joint_table([bar]), joint_table([bar], each_once=True)
    assert 0.5 < 8 * len(once.first) / len(all_of_them.first) < 2.0
    assert set(zip(*map(list, once[1:]), strict=True)) <= set(zip(*map(list, all_of_them[1:]), strict=True))


def test_models_whose_keys_differ_are_not_joined() -> None:
    fine = replace(SMALL, pairs=PairParameters(angle_cell_deg=12.0))
    different = [build_model(box(1, 1, 1), parameters) for parameters in (SMALL, fine)]
    with pytest.raises(LibraryError, match="must share one layout of keys"):
        joint_table(different)
    with pytest.raises(LibraryError, match="no models"):
        joint_table([])
