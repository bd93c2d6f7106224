"""Finding, whole: what is there is found, what is not is not; it moves with the scan and depends on nothing else."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import scanfind.scans.sources
from scanfind.clock import Clock
from scanfind.cloud import PointCloud
from scanfind.detection import Findings
from scanfind.errors import InvalidGeometryError, ScanfindError, UnreadableFileError, UsageError
from scanfind.evidence.confidence import CURVES, SEEN
from scanfind.find import begin, find
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import GridParameters
from scanfind.library import ModelLibrary
from scanfind.library.model import ModelParameters
from scanfind.library.pairs import PairParameters
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh
from scanfind.parameters import PRESETS, Parameters
from scanfind.pose import Pose, random_rotation
from scanfind.recognition.sizes import Sizes
from scanfind.scans import open_writer
from scanfind.scans.sources import Sources
from scanfind.simulate.furniture import hall
from scanfind.simulate.objects import pipe_spool
from scanfind.simulate.parts import blocks, box, cylinder
from scanfind.simulate.scanner import Scanner, SimulatedScan, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.simulate.scenes import shop

Floats = NDArray[np.float64]

# Right to 10 mm and half a degree, however few points and whatever the draws.
RIGHT = 0.010, np.radians(0.5)
# Cells of 20 mm, 1,000 samples, small rounds: a scene takes about a second.
QUICK = Parameters(
    grid=GridParameters(cell_m=0.02),
    surface=SurfaceParameters(samples=1000),
    search=replace(
        PRESETS["default"].search, time_limit_s=None, pairs_a_round=8000, hypotheses_a_round=60_000, kept=24
    ),
)
ONE = replace(QUICK, search=replace(QUICK.search, max_instances=1))

BRACKET = blocks(
    "bracket",
    [
        ((0, 0, 0), (1.0, 0.6, 0.15)),
        ((0, 0, 0.15), (0.15, 0.15, 0.9)),
        ((0.6, 0.3, 0.15), (0.9, 0.6, 0.4)),
        ((0, 0.15, 0.75), (0.15, 0.5, 0.9)),
    ],
)
PLACE = Pose.from_rotation_vector([0.0, 0.0, 0.7], [2.2, 1.6, 0.0])
OTHER_PLACE = Pose.from_rotation_vector([0.0, 0.0, 0.3], [1.2, 2.8, 0.0])


@cache
def library() -> ModelLibrary:
    brackets = ModelLibrary.in_memory()
    brackets.add(BRACKET, ModelParameters(QUICK.surface))
    return brackets


@cache
def scanned(places: tuple[Pose, ...] = (PLACE,)) -> SimulatedScan:
    """A room of 4 × 4 × 2.5 m with brackets at some places, seen from two corners."""

    def at(x: float, y: float, z: float = 0.0) -> Pose:
        return Pose(np.eye(3), np.array([x, y, z]))

    objects = [
        SceneObject("hall", hall(4.0, 4.0, 2.5), Pose.identity()),
        SceneObject("crate", box(0.7, 0.5, 0.6), at(0.5, 3.5, 0.3)),
        SceneObject("table", box(1.2, 0.6, 0.05), at(3.2, 3.4, 0.75)),
        SceneObject("drum", cylinder(0.25, 0.8), at(0.5, 0.5)),
        SceneObject("locker", box(0.5, 0.5, 1.0), at(3.5, 0.4, 0.5)),
        *(SceneObject("bracket", BRACKET, place, target=True) for place in places),
    ]
    room = Scene(tuple(objects), np.array([[1.0, 1.4, 1.6], [3.3, 2.7, 1.5]]))
    return scan(room, seed=3, scanner=Scanner(step=0.008))


def clouds(move: Pose | None = None, places: tuple[Pose, ...] = (PLACE,)) -> list[PointCloud]:
    pose = move or Pose.identity()
    return [
        replace(c, xyz=pose.move(c.xyz), origin=None if c.origin is None else pose.move(c.origin))
        for c in scanned(places).stations
    ]


def seek(scans: Any, parameters: Parameters = ONE, **rest: Any) -> Findings:
    return find(scans, library(), parameters=parameters, **rest)


def assert_right(found: Pose, truth: Pose, tolerance: tuple[float, float] = RIGHT) -> None:
    metres, radians = found.difference(truth)
    assert (metres, radians) <= (tolerance[0], np.inf)
    assert radians <= tolerance[1]


def assert_identical(one: Findings, other: Findings) -> None:
    """To the last bit, the points and the refused included."""
    assert len(one) == len(other)
    for mine, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine.scene_from_model.matrix(), theirs.scene_from_model.matrix())
        assert facts(mine) == facts(theirs)
        np.testing.assert_array_equal(np.array(mine.covariance), np.array(theirs.covariance))
        assert (mine.isolated is None) == (theirs.isolated is None)
        if mine.isolated and theirs.isolated:
            np.testing.assert_array_equal(mine.isolated.xyz, theirs.isolated.xyz)
            np.testing.assert_array_equal(mine.isolated.scan_id, theirs.isolated.scan_id)
            np.testing.assert_array_equal(mine.isolated.source_index, theirs.isolated.source_index)
            np.testing.assert_array_equal(mine.isolated.deviation, theirs.isolated.deviation)
    assert [(r.model, r.score, r.reason) for r in one.refused] == [(r.model, r.score, r.reason) for r in other.refused]
    assert one.notes == other.notes


def facts(found: Any) -> tuple[Any, ...]:
    return tuple(
        getattr(found, name)
        for name in (
            "id",
            "model",
            "score",
            "support",
            "visible_support",
            "penalty",
            "rms_m",
            "unobservable",
            "deviation",
        )
    )


TOLD: list[tuple[str, float, float]] = []


@pytest.fixture(scope="module")
def plain() -> Findings:
    TOLD.clear()
    return seek(clouds(), progress=lambda *news: TOLD.append(news))


@pytest.fixture(scope="module")
def two() -> Findings:
    return seek(clouds(places=(PLACE, OTHER_PLACE)), QUICK)


# ── what is there is found ──


def test_the_object_is_found_where_it_is(plain: Findings) -> None:
    (found,) = plain
    assert_right(found.scene_from_model, PLACE)
    assert (found.id, found.model) == (1, "bracket")
    assert 0.85 <= found.score <= 1.0
    assert 0.0 < found.support <= found.visible_support <= 1.0
    assert found.rms_m < 0.01
    assert found.unobservable == ()
    assert found.deviation is not None
    assert found.deviation.rms_m < 0.005


def test_its_points_are_those_that_were_measured_on_it(plain: Findings) -> None:
    cut = plain[0].isolated
    assert cut is not None
    assert plain.tolerance_m is not None
    owner = np.concatenate([c.attributes["object_id"] for c in scanned().stations])
    first = np.cumsum([0, *map(len, scanned().stations)])
    taken = first[cut.scan_id] + cut.source_index
    assert len(np.unique(taken)) == len(taken)
    target = len(owner) and owner.max()  # the bracket is the last object
    assert (owner[taken] == target).mean() > 0.9
    assert np.isin(np.flatnonzero(owner == target), taken).mean() > 0.9
    np.testing.assert_array_equal(cut.xyz, np.concatenate([c.xyz for c in scanned().stations])[taken])
    assert set(cut.attributes) == set(scanned().stations[0].attributes)
    # Distances are told from where the last fit put it, after points were cut out to four times their noise.
    assert np.abs(cut.deviation).max() <= 1.25 * plain.tolerance_m


def test_what_is_not_there_is_not_found_and_it_is_said_why() -> None:
    found = seek(clouds(places=()), QUICK)
    assert list(found) == []
    for refused in found.refused:
        assert refused.model == "bracket"
        assert refused.reason
        assert refused.score <= 1.0


def test_two_are_found_as_two(two: Findings) -> None:
    places, found = (PLACE, OTHER_PLACE), two
    assert len(found) == 2
    for place in places:
        assert_right(min((f.scene_from_model for f in found), key=lambda p: p.difference(place)[0]), place)
    assert [f.id for f in found] == [1, 2]
    assert found[0].score >= found[1].score - 5e-4  # ranked by the score to three digits
    owners = [
        set(zip(f.isolated.scan_id.tolist(), f.isolated.source_index.tolist(), strict=True))
        for f in found
        if f.isolated
    ]
    assert len(owners) == 2
    assert not owners[0] & owners[1]


def test_parts_that_are_alike_have_their_hypotheses_each() -> None:
    """What leads to one of two like parts leads to the other too: noise does not choose between them before a fit."""
    (bracket,) = library().models()
    sizes = Sizes([bracket, replace(bracket, name="twin")], QUICK)
    grid = MomentGrid(sizes.finest_cell())
    for chunk in Sources(clouds(), None).chunks():
        grid.add(chunk)
    grid.release()
    drawn = begin(next(iter(sizes.groups())), grid, [], QUICK, 0, 1, Clock()).round()
    one, other = (drawn.take(np.flatnonzero(drawn.models == number)) for number in (0, 1))
    assert len(one.models) > 10
    np.testing.assert_array_equal(one.rotations, other.rotations)
    np.testing.assert_array_equal(one.translations, other.translations)


def test_what_is_left_is_not_told_where_nothing_was_cut(tmp_path: Path) -> None:
    with (
        open_writer(tmp_path / "rest.ply", {"scan_id": np.dtype(np.int32)}) as rest,
        pytest.raises(UsageError, match="remainder"),
    ):
        find(clouds(), library(), isolate=False, remainder=rest)


def test_one_is_found_once() -> None:
    found = seek(clouds(), QUICK)
    assert len(found) == 1
    assert_right(found[0].scene_from_model, PLACE)


def test_a_symmetric_part_is_reported_alike_by_every_seed() -> None:
    """A drum stands where it was drawn, though any roll of it fits as well, and either end up."""
    drum = Mesh.of("drum", (mesh := cylinder(0.25, 0.8)).vertices, mesh.faces)
    place = Pose(np.eye(3), np.array([0.5, 0.5, 0.0]))
    for seed in (1, 2):
        (found,) = find(clouds(), drum, parameters=ONE, seed=seed, isolate=False)
        assert_right(found.scene_from_model, place)


def test_every_detection_is_believed_for_a_reason(two: Findings) -> None:
    for one in two:
        assert one.score >= QUICK.verify.min_score
        assert one.support >= QUICK.verify.min_support
        assert one.probability == CURVES[SEEN].at(one.score)


def test_it_is_found_without_a_scanner_s_position() -> None:
    found = seek([np.asfortranarray(c.xyz) for c in clouds()], isolate=False)
    assert_right(found[0].scene_from_model, PLACE)
    assert found[0].penalty == 0.0
    assert any("no scanner position" in note for note in found.notes)
    assert [s.stations for s in found.scans] == [(None,), (None,)]
    assert found[0].isolated is None
    assert found[0].covariance is not None
    assert 0.0 < found[0].sigma_m < 0.002
    assert found.tolerance_m is None


def test_an_origin_given_is_the_scan_s_own(plain: Findings) -> None:
    one = clouds()[0]
    assert one.origin is not None
    assert_identical(seek(one), seek(PointCloud(one.xyz, one.attributes), origin=one.origin))


# ── it moves with the scan ──


@pytest.mark.parametrize("seed", range(2))
def test_finding_moves_with_the_scan(seed: int) -> None:
    rng = np.random.default_rng(seed)
    move = Pose(random_rotation(rng), rng.uniform(-20, 20, 3))
    (found,) = seek(clouds(move))
    assert_right(found.scene_from_model, move @ PLACE)


def test_far_from_zero_it_is_found_in_the_same_place(plain: Findings) -> None:
    # A lattice of 2^-20 m holds both places exactly: then so does every step of the method, to the last bit, but the
    # last: it fits the pose where it is told, and 5,000 km from zero a number holds a nanometre.
    near = [replace(c, xyz=on_lattice(c.xyz), origin=on_lattice(c.origin)) for c in clouds()]
    shift = np.array([5e6, -4e5, 200.0])
    far = [replace(c, xyz=c.xyz + shift, origin=c.origin + shift) for c in near if c.origin is not None]
    (here,), there = seek(near), seek(far)
    assert_right(there[0].scene_from_model, Pose(PLACE.rotation, PLACE.translation + shift))
    np.testing.assert_allclose(there[0].scene_from_model.rotation, here.scene_from_model.rotation, rtol=0, atol=2e-9)
    np.testing.assert_allclose(
        there[0].scene_from_model.translation - shift, here.scene_from_model.translation, rtol=0, atol=2e-9
    )
    assert there.shift == (5e6, -4e5, 0.0)
    assert here.isolated is not None
    assert there[0].isolated is not None
    np.testing.assert_array_equal(here.isolated.source_index, there[0].isolated.source_index)


def on_lattice(points: Any) -> Floats:
    rounded: Floats = np.round(np.asarray(points) * 2.0**20) / 2.0**20
    return rounded


# ── and depends on nothing else ──


@pytest.mark.parametrize("jobs", [1, 4])
def test_threads_change_nothing(plain: Findings, jobs: int) -> None:
    assert_identical(plain, seek(clouds(), jobs=jobs))


def test_chunks_change_nothing(plain: Findings, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = scanfind.scans.sources.chunks_of
    monkeypatch.setattr(scanfind.scans.sources, "chunks_of", lambda cloud: whole(cloud, 17_001))
    assert_identical(plain, seek(clouds()))


def test_the_same_seed_gives_the_same_and_another_the_same_pose(plain: Findings) -> None:
    assert_identical(plain, seek(clouds(), seed=0))
    assert_right(seek(clouds(), seed=1)[0].scene_from_model, plain[0].scene_from_model, (0.001, np.radians(0.1)))


def test_nothing_the_caller_gave_is_changed() -> None:
    given = clouds()
    before = [(c.xyz.copy(), {k: v.copy() for k, v in c.attributes.items()}) for c in given]
    seek(given)
    for cloud, (xyz, attributes) in zip(given, before, strict=True):
        np.testing.assert_array_equal(cloud.xyz, xyz)
        for name, values in attributes.items():
            np.testing.assert_array_equal(cloud.attributes[name], values)


def test_broken_points_among_good_ones_are_dropped_and_counted(plain: Findings) -> None:
    broken = []
    for cloud in clouds():
        xyz = np.repeat(cloud.xyz, 2, axis=0)
        xyz[1::2] = np.resize([[np.nan, 0, 0], [np.inf, -np.inf, 0], [0, 0, -np.inf]], (len(cloud), 3))
        broken.append(PointCloud(xyz, origin=cloud.origin))
    found = seek(broken)
    np.testing.assert_array_equal(found[0].scene_from_model.matrix(), plain[0].scene_from_model.matrix())
    assert [s.dropped for s in found.scans] == [len(c) for c in clouds()]
    assert [s.points for s in found.scans] == [len(c) for c in clouds()]


# ── limits ──


def test_max_instances_is_a_limit() -> None:
    assert len(seek(clouds(places=(PLACE, OTHER_PLACE)))) == 1


def test_a_time_limit_ends_the_search_and_is_told() -> None:
    short = replace(QUICK, search=replace(QUICK.search, time_limit_s=0.0, miss_probability=1e-30))
    found = seek(clouds(), short)
    assert list(found) == []
    assert any("time limit" in note for note in found.notes)
    assert found.timings_s["search"] < 1.0


def test_the_paper_s_settings_use_all_of_the_time_and_give_one() -> None:
    paper = PRESETS["sharif2017"]
    short = replace(
        paper, grid=QUICK.grid, surface=QUICK.surface, search=replace(paper.search, time_limit_s=0.5, pairs_a_round=500)
    )
    found = find(clouds(), BRACKET, parameters=short)
    assert len(found) <= 1
    assert sum(found.timings_s[stage] for stage in ("search", "refine", "verify")) >= 0.5


@pytest.mark.slow
def test_the_paper_s_settings_find_the_object(monkeypatch: pytest.MonkeyPatch) -> None:
    # All of the limit is used, so it is processor time here: what the machine does beside us is not the paper's fault.
    monkeypatch.setattr("scanfind.clock.time.perf_counter", time.process_time)
    paper = PRESETS["sharif2017"]
    short = replace(paper, grid=QUICK.grid, surface=QUICK.surface, search=replace(paper.search, time_limit_s=8.0))
    (found,) = find(clouds(), BRACKET, parameters=short)
    assert_right(found.scene_from_model, PLACE)


def test_progress_is_told(plain: Findings) -> None:
    assert {"read", "search", "isolate"} <= {stage for stage, _, _ in TOLD}
    assert [done for stage, done, _ in TOLD if stage == "read"][-1] == sum(scan.points for scan in plain.scans)
    for stage in ("read", "search"):
        done = [d for s, d, _ in TOLD if s == stage]
        assert done == sorted(done)


# ── next to nothing, and nonsense ──


@pytest.mark.parametrize("origin", [None, (5.0, 5.0, 5.0)], ids=["blind", "seen"])
@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.array([[0.0, 0, 0], [1, 1, 1]]),
        np.full((5000, 3), 7.25),
        np.random.default_rng(0).uniform(0, 1e-6, (1000, 3)),
        np.column_stack([np.linspace(0, 5, 5000), np.zeros((5000, 2))]),
        np.array([[0.0, 0, 0], [1e300, 0, 0], [0, -1e300, 0]]),
    ],
    ids=["one", "two", "all equal", "a dot", "a line", "a world apart"],
)
def test_scans_of_next_to_nothing_hold_nothing(points: Floats, origin: Sequence[float] | None) -> None:
    assert list(seek(points, QUICK, origin=origin)) == []


@pytest.mark.parametrize("preset", ["default", "sharif2017"])
def test_a_scan_smaller_than_the_object_is_soon_given_up(preset: str) -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(0, 0.3, (20_000, 2)), rng.normal(scale=0.001, size=20_000)])
    base = PRESETS[preset]
    parameters = replace(
        base, grid=QUICK.grid, surface=QUICK.surface, search=replace(base.search, time_limit_s=2.0, pairs_a_round=8000)
    )
    found = find(floor, BRACKET, parameters=parameters, origin=[0.1, 0.1, 2.0])
    assert list(found) == []
    if preset == "default":
        assert not any("time limit" in note for note in found.notes)


def test_cells_larger_than_the_object_find_nothing_and_break_nothing() -> None:
    for cell in (0.5, 5.0):
        seek(clouds(), replace(QUICK, grid=GridParameters(cell_m=cell), search=replace(QUICK.search, time_limit_s=0.3)))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((10, 3), np.nan)], ids=["none", "nan"])
def test_a_scan_without_a_point_is_an_error(points: Floats) -> None:
    with pytest.raises(UnreadableFileError, match="no valid point"):
        seek(points)


@pytest.mark.parametrize(
    ("scans", "rest", "kind"),
    [
        ([], {}, UsageError),
        (np.zeros((4, 2)), {}, InvalidGeometryError),
        (PointCloud(np.zeros((4, 2))), {}, InvalidGeometryError),
        (np.zeros((4, 3)), {"origin": [1.0, 2.0]}, UsageError),
        (np.zeros((4, 3)), {"origin": [1.0, 2.0, np.nan]}, UsageError),
        ("no/such/file.e57", {}, ScanfindError),
    ],
)
def test_nonsense_is_refused_at_the_door(scans: Any, rest: Any, kind: type[Exception]) -> None:
    with pytest.raises(kind):
        seek(scans, **rest)


def test_no_models_are_refused() -> None:
    empty: list[Any] = [[], ModelLibrary.in_memory()]
    for models in empty:
        with pytest.raises(UsageError, match="no model"):
            find(np.zeros((4, 3)), models)


def test_models_of_different_layouts_are_refused() -> None:
    other = replace(ONE, pairs=PairParameters(angle_cell_deg=10.0))
    with pytest.raises(ScanfindError, match="layout"):
        find(clouds(), [library(), box(0.5, 0.5, 0.5)], parameters=other)


# ── whole shops ──


@pytest.fixture(scope="module")
def spools() -> tuple[Mesh, ModelLibrary]:
    kept = ModelLibrary.in_memory()
    kept.add(mesh := pipe_spool())
    return mesh, kept


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_the_spool_of_a_shop_is_found_and_no_other(spools: tuple[Mesh, ModelLibrary], seed: int) -> None:
    mesh, kept = spools
    measured = scan(shop(seed, mesh), seed=seed, points=1_500_000)
    found = find(measured.stations, kept)
    assert len(found) == 1
    assert_right(found[0].scene_from_model, measured.truth[mesh.name][0], (0.003, np.radians(0.1)))


@pytest.mark.slow
def test_three_copies_in_a_shop_are_three(spools: tuple[Mesh, ModelLibrary]) -> None:
    mesh, kept = spools
    measured = scan(shop(8, mesh, copies=3), seed=8, points=2_000_000)
    found = find(measured.stations, kept)
    truth = measured.truth[mesh.name]
    assert len(found) == 3
    for place in truth:
        assert_right(min((f.scene_from_model for f in found), key=lambda p: p.difference(place)[0]), place)


@pytest.mark.slow
@pytest.mark.parametrize("points", [200_000, 400_000])
def test_sparse_scans_of_a_shop_have_no_ghosts(spools: tuple[Mesh, ModelLibrary], points: int) -> None:
    mesh, kept = spools
    measured = scan(shop(3, mesh), seed=3, points=points)
    found = find(measured.stations, kept)
    assert_right(found[0].scene_from_model, measured.truth[mesh.name][0])
    assert len(found) == 1


def test_a_part_on_a_floor_is_never_found_sunk_into_it() -> None:
    """Flush with the floor, half of the part lies on the scan and the other half is hidden: no evidence for it."""
    part = blocks("angle", [((-0.5, -0.3, 0), (0.5, 0.3, 0.1)), ((-0.5, -0.3, 0.1), (-0.4, 0.3, 0.75))])
    place = Pose.from_rotation_vector([0.0, 0.0, 0.6], [1.5, -0.8, 0.0])
    floor = SceneObject("floor", box(8.0, 8.0, 0.2), Pose(np.eye(3), np.array([-4.0, -4.0, -0.2])))
    for station in ([-0.5, -2.5, 2.0], [3.5, 1.0, 2.0]):
        seen = scan(Scene((floor, SceneObject("angle", part, place, target=True)), np.array([station])), points=100_000)
        for found in find(seen.stations, part, parameters=QUICK):
            metres, radians = found.scene_from_model.difference(place)
            assert metres < 0.02, found
            assert radians < np.radians(1.0), found


def test_a_bare_floor_holds_nothing() -> None:
    """What of a model lies flush with the only surface there is tells nothing."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-2, 2, (200_000, 2)), rng.normal(0.0, 0.002, 200_000)])
    # It is long until nothing can have been missed; without telling shapes some were found at once.
    soon = replace(ONE, search=replace(ONE.search, time_limit_s=3.0))
    assert not seek(PointCloud(floor, origin=np.array([0.0, 0.0, 1.5])), soon)
