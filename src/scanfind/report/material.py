"""What a report shows in three dimensions: points of instances, models, and the scan around them, all thinned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.library import ModelLibrary
from scanfind.results import MODELS
from scanfind.results.document import fingerprint
from scanfind.scans import read_scan

if TYPE_CHECKING:
    from scanfind.cloud import PointChunk
    from scanfind.library.model import Model
    from scanfind.results.schema import Matrix, Results

Floats = NDArray[np.float64]

AROUND_M = 2.0  # of what lies about all items so much is shown, or half of their extent where that is more
MOST_FACES = 40_000  # of one model; what has more is drawn coarser
OF_SCAN = 0.4  # of all points shown, those of the scan around


@dataclass(frozen=True, eq=False)
class Points:
    """Points (N, 3), scan frame, metres, and a value each (N,): a deviation, metres, or how light it is, 0 to 1."""

    xyz: Floats
    values: Floats


@dataclass(frozen=True, eq=False)
class Shape:
    """A model to be drawn, its own frame, metres: vertices (V, 3), faces (F, 3); no faces: a piece of scan."""

    vertices: Floats
    faces: NDArray[np.int64]

    def placed(self, matrix: Matrix) -> Floats:
        """Its triangles (F, 3, 3) at a pose, or its points as triangles of no size."""
        pose = np.array(matrix)
        at = self.vertices @ pose[:3, :3].T + pose[:3, 3]
        return at[self.faces] if len(self.faces) else np.repeat(at[:, None], 3, axis=1)


@dataclass(frozen=True, eq=False)
class Material:
    """Of instances their points by id, of models their shapes by name, the scan around, and what is amiss, in words."""

    points: Mapping[int, Points]
    shapes: Mapping[str, Shape]
    around: Points
    notes: tuple[str, ...]

    @cached_property
    def all_points(self) -> Points:
        """The scan around and all found points, each with how light it is."""
        found = [Points(cloud.xyz, np.full(len(cloud.xyz), 0.5)) for cloud in self.points.values()]
        clouds = [self.around, *found]
        return Points(np.concatenate([c.xyz for c in clouds]), np.concatenate([c.values for c in clouds]))


def gather(folder: Path, results: Results, models: Sequence[Model], scans: Sequence[Path], most: int) -> Material:
    """Read what a report shows.

    folder : of the result
    scans : files to show around; none: those the result names, where they are there and unchanged
    most : points in all

    Raises UnreadableFileError for a point file or scan that is damaged.
    """
    notes: list[str] = []
    cut = [found for found in results.detections if found.isolated]
    each = _level([found.points for found in cut], int((1.0 - OF_SCAN) * most))
    # Thinned one by one, since all together may be more than memory holds.
    clouds = {found.id: _thinned(_isolated(folder, str(found.isolated), notes), each, found.id) for found in cut}
    points = {number: cloud for number, cloud in clouds.items() if len(cloud.xyz)}
    shapes = {model.name: shape_of(model) for model in models}
    wanted = {each.model for each in results.elements} | {one.model for one in results.detections}
    if missing := wanted - set(shapes):
        notes.append(f"{len(missing)} models are not kept in the result and not drawn, such as {min(missing)!r}.")
    box = _box(results, points, shapes)
    files = list(scans) or list(_unchanged(results, notes))
    scale = results.scan_scale.metres if results.scan_scale else 1.0
    around = _around(files, box, int(OF_SCAN * most), scale) if files and box is not None else _NOTHING
    return Material(points, shapes, around, tuple(notes))


def models_of(folder: Path) -> list[Model]:
    """The models a result has kept; none where it kept none. Raises LibraryError where they are damaged."""
    path = folder / MODELS
    if not path.is_file():
        return []
    with ModelLibrary.open(path) as library:
        return library.models()


def shape_of(model: Model) -> Shape:
    """A model as it is drawn: its triangles, or the samples of a piece of scan; coarser where there are very many."""
    if model.mesh is None:
        return Shape(model.samples.points, np.empty((0, 3), np.int64))
    vertices, faces = model.mesh.vertices, model.mesh.faces.astype(np.int64)
    cells = 256.0
    while len(faces) > MOST_FACES and cells > 4.0:
        vertices, faces = _clustered(model.mesh.vertices, model.mesh.faces.astype(np.int64), model.diameter / cells)
        cells /= 1.5
    return Shape(vertices, faces)


_NOTHING = Points(np.empty((0, 3)), np.empty(0))


def _isolated(folder: Path, name: str, notes: list[str]) -> Points:
    """The points of an instance with their deviations; none, and a note, where the file has gone."""
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()) or not path.is_file():
        notes.append(f"{name} is not in the result folder: its points are not shown.")
        return _NOTHING
    chunks = list(read_scan(path))
    xyz = np.concatenate([chunk.xyz for chunk in chunks]) if chunks else np.empty((0, 3))
    deviations = [np.asarray(chunk.attributes.get("deviation", np.full(len(chunk.xyz), np.nan))) for chunk in chunks]
    values = np.concatenate(deviations).astype(np.float64) if chunks else np.empty(0)
    return Points(xyz, values)


def _level(sizes: Sequence[int], most: int) -> int:
    """At most so many points of each, that there are no more than `most` in all: small ones keep theirs."""
    left, level = most, most
    for rank, size in enumerate(sorted(sizes)):
        level = left // (len(sizes) - rank)
        if size > level:
            return level
        left -= size
    return max(level, max(sizes, default=0))


def _thinned(cloud: Points, most: int, seed: int) -> Points:
    """At most so many points of a cloud, in an order drawn by chance: the first of them show all of it."""
    kept = np.random.default_rng(seed).permutation(len(cloud.xyz))[:most]
    return Points(cloud.xyz[kept], cloud.values[kept])


def _clustered(vertices: Floats, faces: NDArray[np.int64], cell: float) -> tuple[Floats, NDArray[np.int64]]:
    """A mesh of which vertices in one cell are one, at their mean, and what has no area left is gone."""
    _, at = np.unique(np.floor(vertices / cell).astype(np.int64), axis=0, return_inverse=True)
    at = at.ravel()
    count = np.bincount(at)
    means = np.column_stack([np.bincount(at, column) / count for column in vertices.T])
    joined = at[faces]
    a, b, c = joined.T
    return means, joined[(a != b) & (b != c) & (c != a)]


def _box(results: Results, points: Mapping[int, Points], shapes: Mapping[str, Shape]) -> tuple[Floats, Floats] | None:
    """The corners of what is to be seen: all items, and some of what stands about them."""
    corners = [cloud.xyz[[0, -1]] for cloud in points.values()] + [
        cloud.xyz.min(axis=0)[None] for cloud in points.values()
    ]
    corners += [cloud.xyz.max(axis=0)[None] for cloud in points.values()]
    for each in results.elements:
        pose = np.array(each.design_from_model)
        shape = shapes.get(each.model)
        corners.append(pose[None, :3, 3] if shape is None else shape.vertices @ pose[:3, :3].T + pose[:3, 3])
    corners += [np.array(found.translation_m)[None] for found in results.detections]
    if not corners:
        return None
    low, high = np.min([c.min(axis=0) for c in corners], axis=0), np.max([c.max(axis=0) for c in corners], axis=0)
    margin = max(AROUND_M, 0.25 * float(np.linalg.norm(high - low)))
    return low - margin, high + margin


def _unchanged(results: Results, notes: list[str]) -> Iterator[Path]:
    """Those scan files of a result that are still what was searched."""
    for scan in results.scans:
        path = Path(scan.path)
        if scan.fingerprint is not None and fingerprint(path) == scan.fingerprint:
            yield path
        elif scan.fingerprint is not None:
            notes.append(f"The scan {scan.path} is not there or has changed: it is not shown around the found points.")


def _around(files: Sequence[Path], box: tuple[Floats, Floats], most: int, scale: float) -> Points:
    """About `most` points of the scans within a box, drawn by chance in one pass, and how light each is.

    scale : metres a unit of the scans
    """
    kept: list[Points] = []
    rng, chance = np.random.default_rng(0), 1.0
    for chunk in (chunk.scaled(scale) for file in files for chunk in read_scan(file)):
        inside = ((chunk.xyz >= box[0]) & (chunk.xyz <= box[1])).all(axis=1) & (rng.random(len(chunk.xyz)) < chance)
        kept.append(Points(chunk.xyz[inside], _light(chunk)[inside]))
        # How many there will be nobody knows: whenever there are twice too many, half of them go.
        while sum(len(points.xyz) for points in kept) > 2 * most:
            chance /= 2.0
            halves = [rng.random(len(points.xyz)) < 0.5 for points in kept]
            kept = [Points(p.xyz[half], p.values[half]) for p, half in zip(kept, halves, strict=True)]
    if not kept:
        return _NOTHING
    joined = Points(np.concatenate([p.xyz for p in kept]), np.concatenate([p.values for p in kept]))
    return _thinned(joined, most, 0)


def _light(chunk: PointChunk) -> Floats:
    """How light each point is, 0 to 1: its colour or intensity, stretched; a half where it has none."""
    columns = chunk.attributes
    if {"red", "green", "blue"} <= set(columns):
        light = sum(w * np.asarray(columns[c], np.float64) for c, w in (("red", 0.3), ("green", 0.6), ("blue", 0.1)))
    elif "intensity" in columns:
        light = np.asarray(columns["intensity"], np.float64)
    else:
        return np.full(len(chunk.xyz), 0.5)
    light = np.nan_to_num(np.asarray(light))
    low, high = np.percentile(light, [2.0, 98.0]) if len(light) else (0.0, 1.0)
    stretched: Floats = np.clip((light - low) / max(high - low, 1e-9), 0.0, 1.0)
    return stretched
