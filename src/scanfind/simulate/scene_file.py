"""Scenes from TOML: objects (a model file, or a part by its sizes) where they stand, stations, the scanner.

    [[object]]
    file = "spool.stl"
    units = "mm"
    position = [1.0, 2.0, 0.8]
    yaw_deg = 30
    target = true

Lengths are metres; keys that end in _deg are degrees. A part takes the arguments of the function that makes it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scanfind.cloud import CloudModel
from scanfind.config import checked, did_you_mean, read_toml
from scanfind.errors import (
    InvalidGeometryError,
    MissingExtraError,
    UnreadableFileError,
    UnsupportedFormatError,
    UsageError,
)
from scanfind.mesh import Mesh
from scanfind.models import read_models
from scanfind.pose import Pose
from scanfind.simulate import equipment, furniture, objects, parts
from scanfind.simulate.instruments import SCANNERS, Instrument
from scanfind.simulate.layout import Floor
from scanfind.simulate.placement import Occupancy, surface_points
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.simulate.stations import best_stations, free_spots

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]
Row = tuple[float, float, float, float]
T = TypeVar("T")

# Fields that are radians in Python and degrees, as <name>_deg, where a person types them.
ANGLES = ("angle", "step", "lowest", "highest", "view_width", "view_height", "beam_divergence")
# Room around a scene without a floor in which a station may be placed, metres.
AROUND_M = 4.0
# Above the floor only this is looked at, and beyond this area, whose voxels take 0.2 GB, nothing is.
TRIPOD_M, LARGEST_M2 = 2.2, 1e5


def wall(length: float, height: float, thickness: float = 0.2) -> Mesh:
    """A wall along x from the origin on, `thickness` along y."""
    return parts.box(length, thickness, height)


def floor(x: float, y: float, thickness: float = 0.2) -> Mesh:
    """A floor from the origin to (x, y), its surface at z = 0."""
    parts.box(x, y, thickness)
    return parts.blocks("floor", [((0.0, 0.0, -thickness), (x, y, 0.0))])


def rack(length: float = 3.0, depth: float = 0.8, height: float = 2.4, load: Annotated[int, Field(ge=0)] = 0) -> Mesh:
    """A rack of four levels with pipes and boxes, another load for each number."""
    return furniture.rack(np.random.default_rng(load), length, depth, height)


def valve(radius: float) -> Mesh:
    """A flanged gate valve along z, its handwheel towards +x."""
    return equipment.valve(radius)[0]


def pipe_spool() -> Mesh:
    """The paper's pipe spool, 3 x 2 x 0.5 m."""
    return objects.pipe_spool()


# What surrounds the rest is one object, number 0, as in the generated scenes.
BACKGROUND: Mapping[str, Callable[..., Mesh]] = {"room": furniture.hall, "floor": floor, "wall": wall}
PARTS: Mapping[str, Callable[..., Mesh]] = {
    **BACKGROUND,
    "pipe": parts.pipe,
    "elbow": parts.elbow,
    "tee": parts.tee,
    "flange": parts.flange,
    "valve": valve,
    "cylinder": parts.cylinder,
    "box": parts.box,
    "plate": parts.plate,
    "hss": parts.hollow_section,
    "i_section": parts.i_section,
    "column": furniture.column,
    "table": furniture.table,
    "rack": rack,
    "trestle": furniture.saw_horse,
    "goalpost": furniture.goalpost,
    "drum": furniture.drum,
    "stairs": furniture.stairs,
    "cable_tray": furniture.cable_tray,
    "pipe_spool": pipe_spool,
    "box_frame": objects.box_frame,
}


@dataclass(frozen=True)
class SceneFile:
    """What a scene file says, besides where the stations are, which is in the scene.

    points : about how many to bring home; None: as the scanner's step gives
    """

    scene: Scene
    scanner: Instrument
    points: int | None
    seed: int


@dataclass(frozen=True)
class _Top:
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    stations: Annotated[int, Field(ge=1)] | None = None


@dataclass(frozen=True)
class _Where:
    """What any [[object]] may say."""

    name: str | None = None
    file: str | None = None
    units: Literal["mm", "cm", "m", "in", "ft"] | None = None
    part: str | None = None
    position: Triple = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    scene_from_model: tuple[Row, Row, Row, Row] | None = None
    reflectance: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    target: bool = False

    def pose(self) -> Pose:
        """Roll about x, then pitch about y, then yaw about z, then the move; or the matrix."""
        if self.scene_from_model is not None:
            return Pose.from_matrix(self.scene_from_model)
        turns = ((0.0, 0.0, self.yaw_deg), (0.0, self.pitch_deg, 0.0), (self.roll_deg, 0.0, 0.0))
        yaw, pitch, roll = (Pose.from_rotation_vector(np.radians(turn)) for turn in turns)
        return Pose((yaw @ pitch @ roll).rotation, np.array(self.position))


@dataclass(frozen=True)
class _Station:
    position: Triple = (0.0, 0.0, 0.0)
    look_at: Triple | None = None


def read_scene(path: str | Path) -> SceneFile:
    """The scene, the scanner and the seed of a TOML file. Model files are named from the file's own folder.

    Raises UsageError, in one line with the table and the key, and what the model files raise.
    """
    path = Path(path)
    tables = read_toml(path)
    scanner_table = _table(tables.pop("scanner", {}), path, "[scanner]")
    stations = _tables(tables, "station", path)
    listed = _tables(tables, "object", path)
    top = _read(_Top, tables, str(path), (*_keys(_Top), "scanner", "station", "object"))
    if stations and top.stations is not None:
        msg = f"{path}: stations = {top.stations} has that many places chosen: leave out [[station]], or the number"
        raise UsageError(msg)
    if not listed:
        msg = f"{path}: nothing to scan: give at least one [[object]]"
        raise UsageError(msg)
    things: list[SceneObject] = []
    around: list[SceneObject] = []
    for number, values in enumerate(listed, 1):
        where = f"{path}: object {number}"
        things_here, is_background = _objects(values, where, path.parent)
        (around if is_background else things).extend(things_here)
    scene = Scene((_background(around), *things), np.zeros((0, 3)))
    scanner, points = _scanner(scanner_table, f"{path}: scanner")
    if stations:
        keys = _keys(_Station)
        told = [
            _read(_Station, values, f"{path}: station {k}", keys, ("position",)) for k, values in enumerate(stations, 1)
        ]
        scene = _with(scene, told)
    else:
        scene = with_best_stations(scene, top.stations or 1, top.seed)
    return SceneFile(scene, scanner, points, top.seed)


def with_best_stations(scene: Scene, count: int, seed: int) -> Scene:
    """The scene with `count` stations on its floor, z = 0, where they see most of the targets."""
    around, *things = scene.objects
    has_floor = around.name != "nothing"
    shown = [around, *things] if has_floor else things
    corners = np.concatenate([thing.pose.move(thing.mesh.vertices) for thing in shown])
    margin = 0.0 if has_floor else AROUND_M
    low, high = corners.min(axis=0)[:2] - margin, corners.max(axis=0)[:2] + margin
    x, y = np.maximum(high - low, 2.0).tolist()
    if x * y > LARGEST_M2:
        msg = f"no station is chosen in a scene of {x:.0f} x {y:.0f} m: give positions, [[station]] or --station"
        raise UsageError(msg)
    room = Occupancy((x, y, TRIPOD_M), (low[0], low[1], 0.0))
    for thing in shown:
        surface = thing.pose.move(surface_points(thing.mesh, np.random.default_rng(0)))
        # The floor itself takes no room.
        room.take(surface[(surface[:, 2] > 0.03) & (surface[:, 2] < TRIPOD_M)])
    spots = free_spots(room, [Floor(0.0, (low[0], low[1]), (high[0], high[1]))], np.random.default_rng([seed, 1]))
    return replace(scene, stations=best_stations(scene, spots, count)[0], look_at=None)


def _objects(values: Mapping[str, Any], where: str, folder: Path) -> tuple[list[SceneObject], bool]:
    """The objects of one [[object]] table, and whether they are background."""
    common = {key: value for key, value in values.items() if key in _keys(_Where)}
    sizes = {key: value for key, value in values.items() if key not in common}
    entry = _read(_Where, common, where, _keys(_Where))
    if (entry.file is None) == (entry.part is None):
        msg = f"{where}: give either file = 'model.stl' or part = 'pipe', one of the two"
        raise UsageError(msg)
    try:
        pose = entry.pose()
        if entry.part is not None:
            meshes: list[Mesh] = [_part(entry.part, sizes, where)]
        else:
            if sizes:
                unknown = next(iter(sizes))
                msg = f"{where}: unknown key {unknown!r}: {did_you_mean(unknown, _keys(_Where))}"
                raise UsageError(msg)
            file = folder / str(entry.file)
            meshes = surfaces(file, read_models(file, units=entry.units))
    except InvalidGeometryError as error:
        msg = f"{where}: {error}"
        raise UsageError(msg) from error
    except (UnreadableFileError, UnsupportedFormatError, MissingExtraError) as error:
        msg = f"{where}: {error}"
        raise type(error)(msg) from error
    named = [replace_name(mesh, entry.name) if entry.name and len(meshes) == 1 else mesh for mesh in meshes]
    return [
        SceneObject(mesh.name, mesh, pose, entry.reflectance, entry.target) for mesh in named
    ], entry.part in BACKGROUND and not entry.target


def replace_name(mesh: Mesh, name: str) -> Mesh:
    """The same mesh under another name."""
    return Mesh(name, mesh.vertices, mesh.faces, mesh.source)


def surfaces(path: Path, models: Sequence[Mesh | CloudModel]) -> list[Mesh]:
    """The models of a file if they can be seen, which a piece of scan cannot; raises InvalidGeometryError."""
    meshes = [model for model in models if isinstance(model, Mesh)]
    if len(meshes) < len(models):
        msg = f"{path.name} is a piece of scan: the simulator needs surfaces: give a mesh, STEP or IFC file"
        raise InvalidGeometryError(msg)
    return meshes


def _part(name: str, sizes: Mapping[str, Any], where: str) -> Mesh:
    """A part made by its function, whose arguments are the keys."""
    if name not in PARTS:
        msg = f"{where}: there is no part {name!r}: {did_you_mean(name, list(PARTS))}"
        raise UsageError(msg)
    make = PARTS[name]
    hints = get_type_hints(make, include_extras=True)
    arguments = inspect.signature(make).parameters
    spelled = {f"{key}_deg" if key in ANGLES else key: key for key in arguments}
    given: dict[str, Any] = {}
    for key, value in sizes.items():
        if key not in spelled:
            msg = f"{where}: unknown key {key!r} for a {name}: {did_you_mean(key, [*spelled, *_keys(_Where)])}"
            raise UsageError(msg)
        number = _finite(value, hints[spelled[key]], where, key)
        given[spelled[key]] = float(np.radians(number)) if spelled[key] in ANGLES else number
    required = [word for word, key in spelled.items() if arguments[key].default is inspect.Parameter.empty]
    missing = [word for word in required if word not in sizes]
    if missing:
        msg = f"{where}: a {name} needs {', '.join(missing)}"
        raise UsageError(msg)
    for key, value in given.items():
        if isinstance(value, float) and value <= 0.0:
            msg = f"{where}: {key}: must be above 0, got {value:g}"
            raise UsageError(msg)
    mesh = make(**given)
    return replace_name(mesh, name)


def _scanner(values: Mapping[str, Any], where: str) -> tuple[Instrument, int | None]:
    """The preset, changed as the table says, and the number of points."""
    preset = checked(values.get("preset", "plain"), str, where, "preset")
    base = scanner_preset(preset, where)
    hints = get_type_hints(type(base), include_extras=True)
    settable = [field.name for field in fields(base) if field.name != "finest"]
    spelled = {f"{key}_deg" if key in ANGLES else key: key for key in settable}
    changes: dict[str, Any] = {}
    points = None
    for key, value in values.items():
        if key == "points":
            points = checked(value, Annotated[int, Field(ge=1)], where, key)
        elif key in spelled:
            number = _finite(value, hints[spelled[key]], where, key)
            changes[spelled[key]] = float(np.radians(number)) if spelled[key] in ANGLES else number
        elif key != "preset":
            msg = f"{where}: unknown key {key!r}: {did_you_mean(key, ['preset', 'points', *spelled])}"
            raise UsageError(msg)
    try:
        return replace(base, **changes), points
    except UsageError as error:
        msg = f"{where}: {error}"
        raise UsageError(msg) from error


def scanner_preset(name: str, where: str) -> Instrument:
    """The instrument of that name; UsageError with the nearest name where there is none."""
    if name not in SCANNERS:
        msg = f"{where}: there is no scanner {name!r}: {did_you_mean(name, list(SCANNERS))}"
        raise UsageError(msg)
    return SCANNERS[name]


def _background(around: list[SceneObject]) -> SceneObject:
    """Rooms, floors and walls as one; where there are none, a speck far below stands for nothing."""
    if not around:
        speck = Mesh.of("nothing", [[0, 0, -1e3], [1e-3, 0, -1e3], [0, 1e-3, -1e3]], [[0, 1, 2]])
        return SceneObject("nothing", speck, Pose.identity())
    mesh = parts.assemble("background", [(thing.mesh, thing.pose) for thing in around])
    return SceneObject("background", mesh, Pose.identity(), float(np.mean([t.reflectance for t in around])))


def _with(scene: Scene, stations: list[_Station]) -> Scene:
    where = np.array([station.position for station in stations])
    default = scene.looked_at(where)
    look = [default[k] if s.look_at is None else np.array(s.look_at) for k, s in enumerate(stations)]
    return replace(scene, stations=where, look_at=np.array(look))


def _keys(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def _table(value: Any, path: Path, name: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        msg = f"{path}: {name} is a table of settings, got {value!r}"
        raise UsageError(msg)
    return value


def _tables(tables: dict[str, Any], key: str, path: Path) -> list[Mapping[str, Any]]:
    """The [[key]] tables, taken out of `tables`."""
    listed = tables.pop(key, [])
    if not isinstance(listed, list):
        msg = f"{path}: [{key}] is one of several: write [[{key}]]"
        raise UsageError(msg)
    return [_table(entry, path, f"[[{key}]]") for entry in listed]


def _read(
    kind: type[T], values: Mapping[str, Any], where: str, known: tuple[str, ...], needed: tuple[str, ...] = ()
) -> T:
    """A dataclass filled from a table, every value checked against its field's type."""
    hints = get_type_hints(kind, include_extras=True)
    for key in values:
        if key not in hints:
            msg = f"{where}: unknown key {key!r}: {did_you_mean(key, known)}"
            raise UsageError(msg)
    for key in needed:
        if key not in values:
            msg = f"{where}: needs {key}"
            raise UsageError(msg)
    return kind(**{key: _finite(value, hints[key], where, key) for key, value in values.items()})


def _finite(value: object, hint: Any, where: str, key: str) -> Any:
    """The value as its type, all numbers in it finite."""
    found = checked(value, hint, where, key)
    if isinstance(found, (float, tuple)) and not np.isfinite(np.array(found, dtype=np.float64)).all():
        msg = f"{where}: {key}: must be finite, got {value!r}"
        raise UsageError(msg)
    return found
