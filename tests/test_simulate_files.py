"""Scene files: what they say is what stands there, and what is wrong with one is said in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scanfind.cli import main
from scanfind.errors import ScanfindError, UnreadableFileError, UsageError
from scanfind.pose import Pose
from scanfind.scans import read_scan
from scanfind.simulate import SCANNERS, FrameSensor, Scanner, SceneObject, read_scene
from scanfind.simulate.scene_file import PARTS

EXAMPLES = Path(__file__).parents[1] / "examples" / "simulate"
BOX = '[[object]]\npart = "box"\nx = 1.0\ny = 1.0\nz = 1.0\n'
STATION = "[[station]]\nposition = [-2.0, 0.5, 0.5]\n"


def scene_file(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("example", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_example_runs(example: Path, tmp_path: Path) -> None:
    out = tmp_path / "sim"
    assert main(["simulate", str(example), "--out", str(out), "--points", "2e4"]) == 0
    truth = json.loads((out / "truth.json").read_text())
    assert sum(len(chunk) for chunk in read_scan(out / "scan.e57")) == pytest.approx(2e4, rel=0.1)
    targets = [thing for thing in truth["objects"] if thing["target"]]
    assert targets
    for thing in targets:
        assert thing["together"] > 0.3
        assert (out / thing["model"]).is_file()
    assert main(["simulate", str(example), "--plan", "--points", "2e4"]) == 0


def test_objects_stand_where_the_file_says(tmp_path: Path) -> None:
    trimesh.creation.box((100.0, 200.0, 300.0)).export(tmp_path / "block.stl")
    pose = Pose.from_rotation_vector([0.3, -0.2, 0.9], [1.0, 2.0, 3.0])
    text = (
        f"{STATION}look_at = [5.0, 0.0, 0.5]\n{BOX}position = [3.0, 0.0, 1.0]\nyaw_deg = 90\nroll_deg = 180\n"
        'reflectance = 0.25\n[[object]]\nfile = "block.stl"\nunits = "mm"\ntarget = true\nname = "brick"\n'
        f"scene_from_model = {pose.matrix().tolist()}\n"
    )
    read = read_scene(scene_file(tmp_path, text))
    nothing, box, brick = read.scene.objects
    # Rolled over about x, the box hangs at y = -1 … 0, z = -1 … 0; a quarter turn about z brings that to x = 0 … 1.
    corners = box.pose.move(box.mesh.vertices)
    assert corners.min(axis=0) == pytest.approx([3.0, 0.0, 0.0], abs=1e-12)
    assert corners.max(axis=0) == pytest.approx([4.0, 1.0, 1.0], abs=1e-12)
    assert (nothing.name, box.name, box.reflectance, box.target) == ("nothing", "box", 0.25, False)
    assert (brick.name, brick.target) == ("brick", True)
    assert np.ptp(brick.mesh.vertices, axis=0) == pytest.approx([0.1, 0.2, 0.3])
    assert brick.pose.difference(pose)[0] < 1e-12
    assert read.scene.stations.tolist() == [[-2.0, 0.5, 0.5]]
    assert read.scene.looked_at(read.scene.stations).tolist() == [[5.0, 0.0, 0.5]]


def test_the_scanner_is_the_preset_changed_as_the_table_says(tmp_path: Path) -> None:
    table = '[scanner]\npreset = "phase"\nstep_deg = 0.5\nnoise = 0.001\nlowest_deg = -45\npoints = 1000\n'
    read = read_scene(scene_file(tmp_path, table + STATION + BOX))
    assert isinstance(read.scanner, Scanner)
    assert read.points == 1000
    assert (read.scanner.step, read.scanner.lowest) == pytest.approx(np.radians([0.5, -45.0]))
    assert (read.scanner.noise, read.scanner.farthest) == (0.001, SCANNERS["phase"].farthest)
    frame = read_scene(scene_file(tmp_path, '[scanner]\npreset = "structured-light"\nbaseline = 0.2\n' + STATION + BOX))
    assert isinstance(frame.scanner, FrameSensor)
    assert frame.scanner.baseline == 0.2


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("sead = 1\n" + BOX, r"unknown key 'sead': did you mean 'seed'"),
        (BOX + "positoin = [0, 0, 0]\n", r"object 1: unknown key 'positoin' for a box: did you mean 'position'"),
        (BOX.replace('"box"', '"bix"'), r"object 1: there is no part 'bix': did you mean 'box'"),
        (BOX.replace("x = 1.0\n", ""), r"object 1: a box needs x"),
        (BOX.replace("x = 1.0", "x = -1.0"), r"object 1: x: must be above 0, got -1"),
        (BOX.replace("x = 1.0", "x = nan"), r"object 1: x: must be a number"),
        (BOX.replace("x = 1.0", "x = inf"), r"object 1: x: must be finite"),
        (BOX.replace("x = 1.0", 'x = "wide"'), r"object 1: x: input should be a valid number"),
        (BOX + "position = [1.0, 2.0]\n", r"object 1: position: takes 3 values"),
        (BOX + "position = [1.0, 2.0, inf]\n", r"object 1: position.* finite"),
        (BOX + "position = [1e5, 0.0, 0.0]\n" + BOX, r"no station is chosen in a scene of 100009 x 9 m"),
        (BOX + "reflectance = 2.0\n", r"object 1: reflectance: input should be less than or equal to 1"),
        (BOX + 'file = "a.stl"\n', r"object 1: give either file"),
        ("[[object]]\ntarget = true\n", r"object 1: give either file"),
        ('[[object]]\nfile = "no.stl"\n', r"object 1: .*no\.stl: no such file"),
        ('[[object]]\nfile = "x.stl"\nradius = 1\n', r"object 1: unknown key 'radius'"),
        (BOX + "scene_from_model = [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n", r"object 1: a pose is a rigid motion"),
        ('[[object]]\npart = "elbow"\nradius = 0.1\nbend_radius = 0.05\nangle_deg = 90\n', r"object 1: clearance"),
        ("seed = 1\n", r"give at least one \[\[object\]\]"),
        ('[object]\npart = "box"\n', r"write \[\[object\]\]"),
        (BOX + "[[station]]\nlook_at = [0, 0, 0]\n", r"station 1: needs position"),
        ("stations = 2\n" + BOX + STATION, r"leave out \[\[station\]\], or the number"),
        ("stations = 0\n" + BOX, r"stations: input should be greater than or equal to 1"),
        (BOX + '[scanner]\npreset = "fase"\n', r"there is no scanner 'fase': did you mean 'phase'"),
        (BOX + "[scanner]\nstepp_deg = 1\n", r"scanner: unknown key 'stepp_deg': did you mean 'step_deg'"),
        (BOX + "[scanner]\nstep = 1\n", r"scanner: unknown key 'step': did you mean 'step_deg'"),
        (BOX + '[scanner]\npreset = "phase"\nstep_deg = 0.001\n', r"scanner: .*finest step is 0.009 degrees"),
        (BOX + "[scanner]\nnearest = 9.0\nfarthest = 3.0\n", r"scanner: .*nearest < farthest"),
        (BOX + "[scanner]\nnoise = -0.1\n", r"scanner: a scanner's noise must be at least 0"),
        ("scanner = 3\n" + BOX, r"\[scanner\] is a table"),
        ("not toml", r"cannot be read as a TOML"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises((UsageError, UnreadableFileError), match=says) as caught:
        read_scene(scene_file(tmp_path, text))
    assert "\n" not in str(caught.value)
    assert "scene.toml" in str(caught.value) or "no station" in str(caught.value)


KEYS = st.sampled_from(["part", "x", "radius", "angle_deg", "position", "target", "file", "name", "yaw_deg", "spam"])
VALUES = st.one_of(
    st.floats(), st.integers(-3, 3), st.booleans(), st.sampled_from(sorted(PARTS)), st.lists(st.floats(), max_size=4)
)


@given(st.dictionaries(KEYS, VALUES, max_size=6))
@settings(max_examples=60, deadline=None)
def test_any_table_is_a_scene_or_one_line(tmp_path_factory: pytest.TempPathFactory, table: dict[str, object]) -> None:
    lines = [f"{key} = {json.dumps(value)}" for key, value in table.items()]
    text = "\n".join(lines).replace("NaN", "nan").replace("Infinity", "inf")
    path = scene_file(tmp_path_factory.mktemp("any"), f"{STATION}[[object]]\n{text}")
    said, objects = "", tuple[SceneObject, ...]()
    try:
        objects = read_scene(path).scene.objects
    except ScanfindError as error:
        said = str(error)
    assert "\n" not in said
    assert all(np.isfinite(thing.pose.move(thing.mesh.vertices)).all() for thing in objects)


@pytest.mark.parametrize("part", sorted(PARTS))
def test_every_part_can_be_made_from_a_file(tmp_path: Path, part: str) -> None:
    sizes = {
        "elbow": "radius = 0.1\nbend_radius = 0.3\nangle_deg = 90",
        "tee": "radius = 0.1\nbranch_radius = 0.05\nlength = 0.4\nheight = 0.2",
        "flange": "pipe_radius = 0.1\nflange_radius = 0.2\nthickness = 0.03",
        "i_section": "width = 0.2\ndepth = 0.3\nflange_thickness = 0.02\nweb_thickness = 0.01\nlength = 3.0",
        "hss": "width = 0.1\ndepth = 0.1\nlength = 2.0",
        "valve": "radius = 0.1",
        **dict.fromkeys(("pipe", "cylinder"), "radius = 0.1\nlength = 1.0"),
        **dict.fromkeys(("box", "room"), "x = 3.0\ny = 2.0\nz = 1.0"),
        **dict.fromkeys(("plate",), "x = 3.0\ny = 2.0\nthickness = 0.01"),
        "floor": "x = 3.0\ny = 2.0",
        "wall": "length = 3.0\nheight = 2.0",
        "table": "length = 2.0\nwidth = 0.9",
        **dict.fromkeys(("trestle", "goalpost"), "width = 1.0\nheight = 0.9"),
        "cable_tray": "length = 5.0",
        "column": "height = 3.0",
    }
    text = f'{STATION}[[object]]\npart = "{part}"\ntarget = true\n{sizes.get(part, "")}\n'
    _, thing = read_scene(scene_file(tmp_path, text)).scene.objects
    assert thing.name == part
    assert thing.mesh.area() > 0.01
