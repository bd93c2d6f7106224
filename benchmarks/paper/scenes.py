"""Scanned scenes, one a seed and target, made once; every row of a table is cut from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.common import Floats
from benchmarks.paper.targets import Target
from scanfind.cloud import PointCloud
from scanfind.errors import UsageError
from scanfind.library.near_surface import near_triangles, signed_distances
from scanfind.pose import Pose
from scanfind.simulate import furniture
from scanfind.simulate.layout import Layout
from scanfind.simulate.parts import assemble
from scanfind.simulate.scanner import Scanner, scan, shares
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.simulate.scenes import OFFICE_M, PILOT, SHOP_M, shop
from scanfind.simulate.scenes import bay as bay_of
from scanfind.simulate.stations import SCANNER_HEIGHT_M, scanner_fits

Ints = NDArray[np.int64]

# Table 3, FARO LS 840-HE: "± 3 mm at 25 m" read as the standard deviation at every range, which is the hardest reading.
FARO = Scanner(noise=0.003, nearest=0.6, farthest=40.0)
# Chance of a seed's scene: of the scan, of thinning, of the branches removed.
SCAN, THIN = 0, 1
# A scan has this much more than the row that needs most of it, for mixed pixels and dropouts take some.
SPARE = 1.15
# A shop of at most this clutter shows the target as densely as the paper's scan did with 1.1 million points at most.
MOST_RAW_CLUTTER = 180.0
# 3 stations that give the target one point in 60, and 2 in each of the 19 other bays: a clutter ratio of 800.
HALL_BAYS, STATIONS_A_BAY = (5, 4), 2
LEAST_BAY_CLUTTER = 60.0
# Furnished bays that are made; the hall has each of them several times.
BAYS_MADE = 4


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a scene with what is known of them.

    xyz : (N, 3) metres; station : (N,) which scanner saw each; on_object : (N,) whether it is on the target
    order : (N,) a random rank, the same for all cuts of a scene: thinned scenes are subsets of one another
    distance : (N,) to the target's surface, metres; branch : (N,) of the target, -1 for clutter
    origins : (S, 3) where the scanners stood, None where nobody knows; truth : scene_from_model
    """

    xyz: Floats
    station: Ints
    on_object: NDArray[np.bool_]
    order: Ints
    distance: Floats
    branch: Ints
    origins: Floats | None
    truth: Pose

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, chosen: NDArray[np.bool_] | Ints) -> Cloud:
        """Only the chosen points."""
        return replace(
            self, xyz=self.xyz[chosen], station=self.station[chosen], on_object=self.on_object[chosen],
            order=self.order[chosen], distance=self.distance[chosen], branch=self.branch[chosen],
        )  # fmt: skip

    def object_points(self) -> int:
        """|s|."""
        return int(self.on_object.sum())

    def marked(self, on_object: NDArray[np.bool_], truth: Pose) -> Cloud:
        """The same scene with another object to be found."""
        return replace(self, on_object=on_object, truth=truth)

    def stations(self) -> list[PointCloud]:
        """As scanfind takes them; attribute `point` is a point's number here."""
        clouds = []
        for k in range(int(self.station.max(initial=0)) + 1):
            row = np.flatnonzero(self.station == k)
            if len(row):
                at = None if self.origins is None else self.origins[k]
                clouds.append(PointCloud(self.xyz[row], {"point": row}, at))
        return clouds


def thinned(cloud: Cloud, count: int) -> Cloud:
    """4.2.1: down-sampled to `count` points at random, so that what the scanner saw densely stays dense."""
    return cloud.take(np.sort(np.argsort(cloud.order)[:count]))


def cropped(cloud: Cloud, ratio: float) -> Cloud:
    """4.2.2: of the clutter only what is nearest to the target, `ratio` points for each one on it."""
    clutter = np.flatnonzero(~cloud.on_object)
    count = round(ratio * cloud.object_points())
    if count > len(clutter):
        msg = f"a clutter ratio of {ratio} needs {count} points of clutter, the scene has {len(clutter)}"
        raise UsageError(msg)
    nearest = clutter[np.argsort(cloud.distance[clutter], kind="stable")[:count]]
    return cloud.take(np.sort(np.concatenate([np.flatnonzero(cloud.on_object), nearest])))


def sized(cloud: Cloud, ratio: float, scene_points: int) -> Cloud:
    """So many points at a clutter ratio: thinned until the object has its share, then cropped."""
    wanted = round(scene_points / (1.0 + ratio))
    ranks = np.sort(cloud.order[cloud.on_object])
    if wanted > len(ranks):
        msg = f"{wanted} points on the target are asked for, the scan has {len(ranks)}"
        raise UsageError(msg)
    return cropped(cloud.take(cloud.order <= ranks[wanted - 1]), (scene_points - wanted) / wanted)


def paper_scene(target: Target, seed: int) -> Cloud:
    """The paper's fully cluttered scene: a shop at the points and clutter ratio of the first row of Tables 7 and 8."""
    least = (target.clutter_ratio * 1.05, MOST_RAW_CLUTTER)
    scene = shop(seed, target.mesh, clutter=least)
    on_object = target.object_points(target.clutter_ratio, target.scene_points)
    share = float(shares(scene.caster(), scene.stations, PILOT)[scene.target_ids()[0]])
    return sized(scanned(target, scene, seed, on_object, share), target.clutter_ratio, target.scene_points)


def hall_scene(target: Target, seed: int, least_ratio: float, object_points: int) -> Cloud:
    """The shop in the middle of a hall of 20 bays, each furnished and scanned, for clutter beyond the paper's.

    The hall is scanned until it has `object_points` on the target; stations are added, bay after bay, until the clutter
    ratio is at least `least_ratio`.
    """
    bay = shop(seed, target.mesh, clutter=(LEAST_BAY_CLUTTER, MOST_RAW_CLUTTER))
    scene = hall(bay, seed)
    caster, target_id = scene.caster(), scene.target_ids()[0]
    seen: list[float] = []
    for at in scene.stations:
        # Each meets a wall with nearly every beam, so that their shares have equal weight.
        seen.append(float(shares(caster, at[None], PILOT)[target_id]))
        if len(seen) >= len(bay.stations) and np.mean(seen) * (1.0 + least_ratio) * SPARE <= 1.0:
            break
    used = Scene(scene.objects, scene.stations[: len(seen)])
    return scanned(target, used, seed, object_points, float(np.mean(seen)))


def scanned(target: Target, scene: Scene, seed: int, object_points: int, share: float) -> Cloud:
    """A scan with at least `object_points` on the target, which gets about `share` of all."""
    target_id = scene.target_ids()[0]
    points = round(SPARE * object_points / share)
    taken = scan(scene, scanner=FARO, seed=seed, points=points)
    while (had := len(taken.points_on(target_id))) < object_points:
        points = round(points * 1.05 * object_points / had)
        taken = scan(scene, scanner=FARO, seed=seed, points=points)
    xyz = np.concatenate([station.xyz for station in taken.stations])
    owner = np.concatenate([station.attributes["object_id"] for station in taken.stations])
    truth = taken.truth[target.mesh.name][0]
    local = truth.inverse().move(xyz)
    reach = float(np.linalg.norm(np.ptp(xyz, axis=0)))
    distance = np.abs(signed_distances(near_triangles(target.mesh.triangles(), reach), local)[0])
    on_object = owner == target_id
    return Cloud(
        xyz=xyz,
        station=np.repeat(np.arange(len(taken.stations)), [len(station) for station in taken.stations]),
        on_object=on_object,
        order=np.random.default_rng([seed, THIN]).permutation(len(xyz)),
        distance=distance.astype(np.float64),
        branch=np.where(on_object, target.branch_of(local), -1),
        origins=scene.stations,
        truth=truth,
    )


def hall(bay: Scene, seed: int) -> Scene:
    """A hall of HALL_BAYS shops with `bay` in one of the middle ones and other furniture and spools in the others.

    The bay's own stations come first, then those of the others, in random order.
    """
    rng = np.random.default_rng([seed, 2])
    across, along = HALL_BAYS
    places = [(i, j) for i in range(across) for j in range(along)]
    middle = (across // 2, along // 2)
    made = [bay_of((seed, 1000 + k), spools=6) for k in range(BAYS_MADE)]
    offices = [(furniture.office(*OFFICE_M, SHOP_M[2]), _at(place, SHOP_M[:2])) for place in places]
    walls = furniture.hall(SHOP_M[0] * across, SHOP_M[1] * along, SHOP_M[2])
    room = assemble("room", [(walls, Pose.identity()), *offices])
    objects = [SceneObject("room", room, Pose.identity(), bay.objects[0].reflectance)]
    objects += [replace(thing, pose=_at(middle) @ thing.pose) for thing in bay.objects[1:]]
    standings = []
    for place in places:
        if place == middle:
            continue
        layout = made[int(rng.integers(len(made)))]
        objects += [replace(thing, pose=_at(place) @ thing.pose) for thing in layout.objects[1:]]
        standings += [standing(layout, rng) + _shift(place) for _ in range(STATIONS_A_BAY)]
    return Scene(tuple(objects), np.concatenate([bay.stations + _shift(middle), rng.permutation(standings)]))


def standing(layout: Layout, rng: np.random.Generator) -> Floats:
    """A free place (3,) for a scanner in a bay."""
    while True:
        foot = np.array([*rng.uniform([1.0, 1.0], [SHOP_M[0] - 1.0, SHOP_M[1] - 1.0]), 0.0])
        if scanner_fits(layout.room, foot):
            foot[2] = SCANNER_HEIGHT_M
            return foot


def _shift(place: tuple[int, int]) -> Floats:
    return np.array([place[0] * SHOP_M[0], place[1] * SHOP_M[1], 0.0])


def _at(place: tuple[int, int], corner: tuple[float, ...] = (0.0, 0.0)) -> Pose:
    return Pose(np.eye(3), _shift(place) + np.array([*corner, 0.0]))
