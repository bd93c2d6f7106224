"""Where a design lies in the frame of a scan: found from elements, as uncertain as told, or refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scanfind
from scanfind.bim.wording import inspected as in_bim
from scanfind.cli.tables import alignment_in_words
from scanfind.design.alignment import CELL_M, Alignment, fitted, lies_at
from scanfind.design.elements import INSTALLED
from scanfind.design.thinned import Thinned
from scanfind.detection import Detection
from scanfind.errors import AlignmentError
from scanfind.fit.refine import triple
from scanfind.library.model import Model, ModelParameters, build_model
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh, Placement
from scanfind.pose import Pose, random_rotation, rotation_from_vector, rotation_vector
from scanfind.results.document import findings_of
from scanfind.simulate.parts import blocks, box, cylinder
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject

SMALL = ModelParameters(SurfaceParameters(samples=100))
ODD = blocks("odd", [((0, 0, 0), (1, 0.3, 0.1)), ((0, 0, 0), (0.1, 0.3, 0.7)), ((0.5, 0, 0), (0.6, 0.1, 0.4))])
BEAM = replace(box(3.0, 0.2, 0.2), name="beam")
ROD = replace(cylinder(0.1, 2.0), name="rod")


@cache
def prepared(mesh: Mesh) -> Model:
    return build_model(mesh, SMALL)


def design(rng: np.random.Generator, *counted: tuple[Mesh, int]) -> list[Model]:
    """So many placements of each mesh, anywhere in a hall of 20 × 20 × 6 m."""
    models = []
    for mesh, count in counted:
        poses = [Pose(random_rotation(rng), rng.uniform((0, 0, 0), (20, 20, 6))) for _ in range(count)]
        places = tuple(Placement(f"{mesh.name}{k}", "IfcPlate", mesh.name, pose) for k, pose in enumerate(poses))
        models.append(replace(prepared(mesh), placements=places))
    return models


def found(
    models: list[Model], scene_from_design: Pose, rng: np.random.Generator, *, off: float = 0.0, left_out: float = 0.0
) -> tuple[list[Detection], np.ndarray]:
    """The elements as found in the scene, each somewhat off, some not at all, any way round; and its points (N, 3)."""
    detections: list[Detection] = []
    points = [np.empty((0, 3))]
    for model in models:
        centre, radius = model.symmetry.centre, 0.5 * model.diameter
        for placement in model.placements:
            if rng.random() < left_out:
                continue
            motions = model.symmetry.motions()
            turn = motions[rng.integers(len(motions))]
            jolt = rotation_from_vector(rng.normal(size=3) * off / radius)
            shift = centre + rng.normal(size=3) * off - jolt @ centre
            pose = scene_from_design @ placement.design_from_model @ turn @ Pose(jolt, shift)
            detections.append(detection(len(detections) + 1, model.name, pose, triple(pose.move(centre[None])[0])))
            points.append(pose.move(model.samples.points))
    return detections, np.concatenate(points)


def aligned(models: list[Model], seen: tuple[list[Detection], np.ndarray], *, upright: bool = False) -> Alignment:
    detections, points = seen
    return fitted(models, detections, lies_at(models, detections, Thinned([points], CELL_M), upright=upright))


def detection(number: int, model: str, pose: Pose, pivot: tuple[float, float, float] | None = None) -> Detection:
    return Detection(number, model, pose, 0.95, 0.5, 0.9, 0.0, 0.5, 0.001, covariance=1e-8 * np.eye(6), pivot=pivot)


def anywhere(rng: np.random.Generator, far: float = 1.0) -> Pose:
    return Pose(random_rotation(rng), rng.normal(size=3) * 50.0 * far)


def error(told: Alignment, truth: Pose) -> np.ndarray:
    """(6,) of (rotation vector, translation of the pivot), as the covariance is about."""
    turn = truth.rotation @ told.scene_from_design.rotation.T
    drawn = told.scene_from_design.inverse().move(np.array(told.pivot)[None])
    return np.concatenate([rotation_vector(turn), truth.move(drawn)[0] - told.pivot])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=5, deadline=None)
def test_it_moves_with_the_scan(seed: int) -> None:
    rng = np.random.default_rng(seed)
    models = design(rng, (ODD, 3), (BEAM, 8))
    truth, move = anywhere(rng), anywhere(rng)
    detections, points = found(models, truth, rng, off=0.005, left_out=0.2)
    if len(detections) < 6:
        return
    one = aligned(models, (detections, points))
    moved = [
        replace(
            each, scene_from_model=move @ each.scene_from_model, pivot=triple(move.move(np.array(each.pivot)[None])[0])
        )
        for each in detections
    ]
    other = aligned(models, (moved, move.move(points)))
    expected = (move @ one.scene_from_design).matrix()
    np.testing.assert_allclose(other.scene_from_design.matrix(), expected, atol=1e-5)
    assert (one.agreeing, one.found) == (other.agreeing, other.found)
    assert one.sigma_m == pytest.approx(other.sigma_m, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_far_from_everything_with_false_ones_among_the_instances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    models = design(rng, (ODD, 2), (BEAM, 12), (ROD, 3))
    truth = anywhere(rng, far=1e4)
    detections, points = found(models, truth, rng, off=0.004, left_out=0.2)
    good = len(detections)
    for k in range(20):
        detections.append(detection(1000 + k, "beam", truth @ anywhere(rng, far=0.2)))
    told = aligned(models, (detections, points))
    assert good - 1 <= told.agreeing <= good + 1
    assert told.found == len(detections)
    assert np.abs(error(told, truth)[3:]).max() < 0.01
    assert np.abs(error(told, truth)[:3]).max() < 0.002
    assert 0.002 < told.rms_m < 0.008


def test_it_is_as_uncertain_as_told() -> None:
    scores = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        models = design(rng, (ODD, 4), (BEAM, 10))
        truth = anywhere(rng)
        told = aligned(models, found(models, truth, rng, off=0.005))
        off = error(told, truth)
        scores.append(off @ np.linalg.solve(told.covariance, off))
    # The squared error over its covariance has six degrees of freedom, some more since the spread is measured too.
    assert 4.0 < np.mean(scores) < 9.0


def test_what_slides_along_itself_does_not_carry_the_design_off() -> None:
    rng = np.random.default_rng(7)
    models = design(rng, (BEAM, 12), (ODD, 2))
    truth = anywhere(rng)
    detections, points = found(models, truth, rng, off=0.002)
    slid = []
    for each in detections:
        if each.model != "beam":
            slid.append(each)
            continue
        along = each.scene_from_model.rotation[:, 0]
        covariance = 1e-8 * np.eye(6)
        covariance[3:, 3:] += 1e-2 * np.outer(along, along)
        shift = 0.06 * along
        pose = Pose(each.scene_from_model.rotation, each.scene_from_model.translation + shift)
        pivot = triple(np.array(each.pivot) + shift)
        slid.append(replace(each, scene_from_model=pose, pivot=pivot, covariance=covariance))
    told = aligned(models, (slid, points))
    assert told.agreeing == 14
    assert np.abs(error(told, truth)[3:]).max() < 0.004


def frame() -> list[Model]:
    """Four beams and four posts: a frame that looks the same when turned by half about its middle."""
    up = Pose.from_rotation_vector((0.0, -np.pi / 2, 0.0))
    posts = [Pose(up.rotation, np.array([x, y, 0.0])) for x in (0.2, 6.2) for y in (0.0, 4.0)]
    beams = [Pose(np.eye(3), np.array([x, y, 3.0])) for x in (0.0, 3.2) for y in (0.0, 4.0)]
    places = tuple(Placement(f"{k}", "IfcBeam", f"{k}", pose) for k, pose in enumerate([*posts, *beams]))
    return [replace(prepared(BEAM), placements=places)]


def test_a_symmetric_building_is_refused_unless_something_in_it_is_not() -> None:
    rng = np.random.default_rng(3)
    models, truth = frame(), anywhere(rng)
    with pytest.raises(AlignmentError, match=r"two ways: 8 elements lie on the scan in one, 8 in one turned by 180°"):
        aligned(models, found(models, truth, rng, off=0.003))
    odd = [Pose(random_rotation(rng), np.array(at)) for at in ((1.0, 0.5, 0.0), (4.0, 1.5, 1.0), (2.0, 3.3, 2.0))]
    places = tuple(Placement(f"odd{k}", "IfcPlate", "odd", pose) for k, pose in enumerate(odd))
    models.append(replace(prepared(ODD), placements=places))
    told = aligned(models, found(models, truth, rng, off=0.003))
    assert told.agreeing == 11
    assert np.abs(error(told, truth)).max() < 0.01


def test_upright_tells_what_is_upside_down() -> None:
    """Joists across one line look the same from above and from below."""
    rng = np.random.default_rng(5)
    flat = [Pose.from_rotation_vector((0.0, 0.0, np.pi / 2), (x, 0.0, 0.0)) for x in rng.uniform(0, 20, 6)]
    places = tuple(Placement(f"{k}", "IfcBeam", f"{k}", pose) for k, pose in enumerate(flat))
    centred = replace(BEAM, vertices=BEAM.vertices - BEAM.vertices.mean(axis=0), placements=places)
    models = [build_model(centred, SMALL)]
    truth = Pose.from_rotation_vector((0.0, 0.0, 2.0), (30.0, -4.0, 1.0))
    seen = found(models, truth, rng, off=0.002)
    with pytest.raises(AlignmentError, match="in two ways"):
        aligned(models, seen)
    told = aligned(models, seen, upright=True)
    assert told.agreeing == 6
    assert np.abs(error(told, truth)).max() < 0.01


def test_of_instances_that_are_wrong_but_one_the_surface_tells() -> None:
    """Of one section every piece looks like part of every longer one: where they are says little, what fits does."""
    rng = np.random.default_rng(11)
    models = design(rng, (ODD, 3), (BEAM, 15))
    truth = anywhere(rng)
    detections, points = found(models, truth, rng)
    wrong = [detection(100 + k, "beam", truth @ anywhere(rng, far=0.2)) for k in range(30)]
    start = lies_at(models, [*wrong, detections[0]], Thinned([points], CELL_M))
    shift, angle = start.difference(truth)
    assert shift < 0.02
    assert angle < 0.002


def test_thinned_points_are_what_is_near() -> None:
    rng = np.random.default_rng(2)
    far = np.array([5e5, -5e6, 0.0])
    points = rng.uniform(0, 2, (4000, 3)) + far
    one = Thinned([points], 0.1)
    other = Thinned([points[:7], np.empty((0, 3)), points[7:]], 0.1)
    np.testing.assert_allclose(other.means, one.means, atol=1e-9)
    asked = rng.uniform(-0.5, 2.5, (300, 3)) + far
    distance, which = one.nearest(asked)
    exact = np.linalg.norm(asked[:, None] - one.means[None], axis=2)
    near = exact.min(axis=1) < 0.1
    np.testing.assert_allclose(distance[near], exact.min(axis=1)[near], rtol=1e-6)
    np.testing.assert_array_equal(which[near], exact.argmin(axis=1)[near])
    assert (distance[~near] >= 0.1).all()
    assert np.isinf(Thinned([], 0.1).nearest(asked)[0]).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_are_no_alignment(count: int) -> None:
    rng = np.random.default_rng(count)
    models = design(rng, (ODD, 4))
    truth = anywhere(rng)
    detections, points = found(models, truth, rng)
    with pytest.raises(AlignmentError, match="the design cannot be aligned") as caught:
        aligned(models, (detections[:count], points[: 100 * count]))
    assert "\n" not in str(caught.value)
    with pytest.raises(AlignmentError, match=f"{count} of {count} instances found agree") as caught:
        fitted(models, detections[:count], truth)
    assert "\n" not in str(caught.value)


def test_many_alike_come_to_an_end() -> None:
    rng = np.random.default_rng(1)
    models = design(rng, (BEAM, 80), (ODD, 3))
    truth = anywhere(rng)
    told = aligned(models, found(models, truth, rng, off=0.003, left_out=0.5))
    assert np.abs(error(told, truth)).max() < 0.01


# ── a scene ───────────────────────────────────────────────────────────────────────────────────────────────────────

BRACKET = blocks("bracket", [((0, 0, 0), (1, 0.3, 0.1)), ((0, 0, 0), (0.1, 0.3, 0.7))])
PLACES = tuple(
    Placement(f"{k}", "IfcPlate", f"P{k}", Pose.from_rotation_vector((0.0, 0.0, turn), (x, y, 0.0)))
    for k, (x, y, turn) in enumerate([(-2.0, 0.0, 0.0), (0.0, 0.5, 1.0), (2.0, 0.0, 2.5), (0.3, 2.0, -0.7)])
)
SCENE_FROM_DESIGN = Pose.from_rotation_vector((0.1, -0.2, 2.2), (100.0, -50.0, 7.0))


@pytest.fixture(scope="module")
def inspected() -> scanfind.Findings:
    """Four brackets in a scan whose frame is not the design's; the second is 30 mm off, all else as designed."""
    off = Pose(np.eye(3), np.array([0.02, 0.02, 0.01]))
    built = [
        SceneObject("floor", blocks("floor", [((-5, -5, -0.1), (5, 6, 0))]), Pose.identity()),
        *(SceneObject(each.name, BRACKET, each.design_from_model) for each in PLACES if each.name != "P1"),
        SceneObject("P1", BRACKET, off @ PLACES[1].design_from_model),
    ]
    stations = np.array([[0.3, -3.5, 1.5], [-3.5, 1.5, 1.5], [3.8, 3.0, 1.6]])
    scans = [
        replace(each, xyz=SCENE_FROM_DESIGN.move(each.xyz), origin=SCENE_FROM_DESIGN.move(each.origin[None])[0])
        for each in scan(Scene(tuple(built), stations), scanner=Scanner(step=0.003), seed=3).stations
        if each.origin is not None
    ]
    return scanfind.inspect(scans, replace(BRACKET, placements=PLACES))


@pytest.mark.slow
def test_a_scan_in_another_frame_is_aligned_and_inspected(inspected: scanfind.Findings) -> None:
    alignment = inspected.alignment
    assert alignment is not None
    assert alignment.agreeing >= 3
    shift, angle = alignment.scene_from_design.difference(SCENE_FROM_DESIGN)
    assert shift < 0.05
    assert angle < 0.005
    assert [element.status for element in inspected.elements] == [INSTALLED] * 4


@pytest.mark.slow
def test_an_alignment_survives_the_result_folder_and_leads_back_into_the_design(
    inspected: scanfind.Findings, tmp_path: Path
) -> None:
    with scanfind.ModelLibrary.in_memory() as library:
        library.add(replace(BRACKET, placements=PLACES))
        scanfind.write_results(inspected, tmp_path / "r", models=library, parameters=scanfind.PRESETS["default"])
    results, _ = in_bim(tmp_path / "r")
    before = {each.name: each.design_from_model for each in PLACES}
    for element in results.elements:
        np.testing.assert_allclose(element.design_from_model, before[element.name].matrix(), atol=1e-9)
        assert element.built_from_design is not None
        motion = Pose.from_matrix(element.built_from_design)
        stands = motion.move(np.array([before[element.name].translation]))[0]
        built = before[element.name].translation + (0.02, 0.02, 0.01) * np.array(element.name == "P1")
        np.testing.assert_allclose(stands, built, atol=0.03)  # the alignment takes its share of what is off
    told = scanfind.read_results(tmp_path / "r").alignment
    assert told is not None
    assert "the design's origin is at 100.0" in alignment_in_words(told)
    again = findings_of(scanfind.read_results(tmp_path / "r")).alignment
    assert again is not None
    assert inspected.alignment is not None
    np.testing.assert_array_equal(again.covariance, inspected.alignment.covariance)
