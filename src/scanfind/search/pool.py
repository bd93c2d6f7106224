"""Where pairs are drawn from: surfels whose surroundings look as the models' do.

Most of a scan is walls and floors, of a library of pipes next to nothing is flat. How the surface around a point is
shaped is asked twice: how bent it is on the scale of a model's branch, of every cell, for it costs nothing; and of the
surfels chosen by that how far it bulges on the scale of a pipe (decisions/0029-what-pairs-are-drawn-from.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.grid.scene import flatness_above
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.grid.scene import Scene
    from scanfind.library.model import Model

Floats = NDArray[np.float64]
Classes = NDArray[np.int8]

# Surfels bulges are asked of: fewer make pairs that repeat each other, more cost more to fit than they add.
LEAST_POOL, MOST_POOL = 20_000, 60_000
SHAPED = 1000  # samples whose shape tells that of a model, each against all of them
# Borders between classes of bend, in shares of the window: range noise of 2 mm on a plane is below the first for
# windows over 0.1 m, a pipe as wide as the window above the last.
BEND_BORDERS = (0.02, 0.05, 0.1)
# Borders between classes of bulge, in shares of its reach: a pipe as wide as that bulges by 0.15, a plane by 0.
BULGE_BORDERS, BULGE_CELLS = (-0.12, -0.04, 0.02), 4.0
# However little it tells, a class keeps so much: near edges and under noise a scan shows another bulge than the model.
LEAST_KEPT = 0.03
UNLIKE_BEND, UNLIKE_BULGE = 0.02, 0.01  # no share is quite zero: scan and model are not sampled alike
# A surfel's normal counts as clean below so much of a cell, noise apart; but never fewer than this share of a shape's.
# Drawing only those doubled the right poses a round finds, on spools and frames.
CLEAN_CELLS, CLEAN_SHARE = 0.1, 0.3


class Pool:
    """The surfels of a scene that pairs are drawn from, chosen anew when it is asked to be.

    surfels : (W,) of the scene's fine ones
    """

    def __init__(self, scene: Scene, models: Sequence[Model], *, by_shape: bool, seed: int, jobs: int) -> None:
        """Choose a first time; by_shape : False: any surfel is as good as another."""
        self.scene, self.models = scene, models
        self._by_shape, self._seed, self._jobs = by_shape, seed, jobs
        self.signed = scene.fine.signed and all(model.signed for model in models)
        window, reach = 3.0 * scene.around.cell, BULGE_CELLS * scene.fine.cell
        self._bends = bend_classes(flatness_above(scene.fine, 2, scene.around), window)
        self._model_bends = [bends_of(model, window) for model in models]
        self._model_bulges = [bulges_of(model, reach, signed=self.signed) for model in models]
        self._likely = np.mean([shares(one, BEND_BORDERS, UNLIKE_BEND) for one in self._model_bends], axis=0)
        self._likely_bulges = np.mean([shares(one, BULGE_BORDERS, UNLIKE_BULGE) for one in self._model_bulges], axis=0)
        # A surface that is scanned densely fills sixteen cells for each of those four times as large; by class, since
        # what is bent is seldom as near to the scanner as the floor is.
        around = bend_classes(scene.around.flatness[scene.around.first_surfel[scene.around.cells.rows]], window)
        densely = np.maximum(16 * counts(around, BEND_BORDERS), 1)
        self._filled = np.minimum(1.0, counts(self._bends, BEND_BORDERS) / densely)
        self._free, self._stale = np.ones(len(scene.fine.cells), np.bool_), False
        self.fill(0)

    def __len__(self) -> int:
        return len(self.surfels)

    def left(self) -> bool:
        """Is there a pair left to draw?"""
        return len(self) > 1 and bool(np.count_nonzero(self._free) > 1)

    def withdraw(self, cells: NDArray[np.bool_]) -> None:
        """Draw no more from these cells (V,): they are explained."""
        self._free &= ~cells
        self._stale = True

    def refilled(self, number: int) -> bool:
        """Choose again where cells were withdrawn since the last time, or for another number, see `fill`."""
        if stale := self._stale or number != self._number:
            self.fill(number)
        return stale

    def fill(self, number: int) -> None:
        """Choose the surfels that may be drawn, each with a chance by the likelihood ratio of its shape.

        number : of the choice; the same one chooses the same
        """
        fine, there = self.scene.fine, counts(self._bends[self._free], BEND_BORDERS)
        kept = self._likelihood(there)
        kept = kept * min(1.0, MOST_POOL / max(float(kept @ there), 1.0))
        # Where the telling cells are few, the others fill up: they may be all there is to draw from.
        while 0 < np.minimum(kept, 1.0) @ there < min(LEAST_POOL, 0.9 * there.sum()):
            kept = kept * 1.25
        kept = np.minimum(kept, 1.0)
        luck = np.random.default_rng([self._seed, number]).random(len(self._bends), np.float32)
        chosen = np.flatnonzero(self._free & (luck < kept.astype(np.float32)[self._bends]))
        surfels = fine.of(chosen)
        surfels = surfels[fine.has_normal()[surfels]]
        surfels = surfels[self._clean(surfels)]
        # Of the cells of each class, so many are in the pool before bulges are asked for.
        usable = counts(self._bends[fine.cell_of[surfels]], BEND_BORDERS)
        self._kept = np.minimum(1.0, usable / np.maximum(there, 1))
        self._kept_bulges = np.ones(len(BULGE_BORDERS) + 1)
        self.surfels = self._thinned(surfels, number) if self._by_shape else surfels
        self._stale, self._number = False, number

    def points(self) -> OrientedCloud:
        """The surfels as oriented points, relative to the grid's offset."""
        fine = self.scene.fine
        return OrientedCloud(fine.means[self.surfels], fine.normals[self.surfels], self.signed)

    def on(self, model: int) -> float:
        """About how many of the pool lie on an instance of a model all of which is in sight."""
        bends, bulges = self._model_bends[model], self._model_bulges[model]
        in_pool = (self._filled * self._kept)[bends] * self._kept_bulges[bulges]
        return self.models[model].area / self.scene.fine.cell**2 * float(in_pool.mean())

    def telling(self) -> tuple[Floats, Floats]:
        """How much the surfels of each fine and of each coarse cell tell, (V,), 0 … 1: the root of the likelihood ratio
        of their bend, model against scene.

        A plate flush with a floor lies on the scene with all of its samples, and that means nothing.
        """
        # What is absent tells as much as what is rare: a bare floor, or a tile of one, tells nothing.
        scene, tells = self.scene, np.sqrt(self._likelihood(np.maximum(counts(self._bends, BEND_BORDERS), 1)))
        coarse = bend_classes(flatness_above(scene.coarse, 1, scene.around), 3.0 * scene.around.cell)
        return tells[self._bends], tells[coarse]

    def _likelihood(self, there: NDArray[np.intp]) -> Floats:
        """Of the classes of bend that so many cells are in, the likelihood ratio of each over the largest, (C,)."""
        return ratios(self._likely, there) if self._by_shape else np.ones(len(there))

    def _clean(self, surfels: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which surfels have a normal to rely on: flat but for noise, or among the flatter ones of their bend.

        Across an edge a normal is of neither face, and near edges is where most of the telling surfels are.
        """
        fine, bends = self.scene.fine, self._bends[self.scene.fine.cell_of[surfels]]
        flatness = fine.flatness[surfels]
        clean: NDArray[np.bool_] = flatness <= np.hypot(self.scene.noise, CLEAN_CELLS * fine.cell)
        for bend in np.unique(bends):
            alike = bends == bend
            clean[alike] |= flatness[alike] <= np.quantile(flatness[alike], CLEAN_SHARE)
        return clean

    def _thinned(self, surfels: NDArray[np.intp], number: int) -> NDArray[np.intp]:
        """Of some surfels those whose bulge is likely on a model: of pairs drawn ten times as many are right."""
        bulges = self._bulges(surfels)
        likely = ratios(self._likely_bulges, counts(bulges, BULGE_BORDERS))
        self._kept_bulges = np.maximum(likely, LEAST_KEPT)
        luck = np.random.default_rng([self._seed, number, 1]).random(len(surfels))
        return surfels[luck < self._kept_bulges[bulges]]

    def _bulges(self, surfels: NDArray[np.intp]) -> Classes:
        """Class of each of some surfels by how far the surface around it bulges."""
        from scanfind.kernels.shape import bulge_of_surfels

        fine, coarse = self.scene.fine, self.scene.coarse
        points, normals, at = fine.means[surfels], fine.normals[surfels], coarse.cells
        bulges = np.empty(len(surfels))
        in_threads(
            self._jobs, len(surfels),
            lambda start, stop: bulge_of_surfels(
                start, stop, points, normals, coarse.means, coarse.normals, self.signed, coarse.first_surfel,
                coarse.sides, coarse.cell, at.hash_keys, at.hash_values, at.block_rows, BULGE_CELLS * fine.cell, bulges,
            ),
        )  # fmt: skip
        return bulge_classes(bulges, signed=self.signed)


def bend_classes(bends: NDArray[np.floating], window: float) -> Classes:
    """Class of each point by how bent the surface around it is, (N,); bends : (N,), window : both metres."""
    return np.asarray(np.digitize(bends, np.array(BEND_BORDERS) * window), np.int8)


def bulge_classes(bulges: Floats, *, signed: bool) -> Classes:
    """Class of each point by how far the surface around it bulges, (N,); not signed : nobody knows which way."""
    return np.asarray(np.digitize(bulges if signed else -np.abs(bulges), BULGE_BORDERS), np.int8)


def bends_of(model: Model, window: float) -> Classes:
    """Class of a model's first samples by how bent the surface around them is."""
    from scanfind.kernels.shape import bend_of_samples

    # The first ones lie as evenly over the model as all of them.
    bends = np.empty(min(len(model.samples), SHAPED))
    bend_of_samples(model.samples.points, model.samples.normals, window, bends)
    return bend_classes(bends, window)


def bulges_of(model: Model, reach: float, *, signed: bool) -> Classes:
    """Class of a model's first samples by how far the surface within `reach` metres of them bulges."""
    from scanfind.kernels.shape import bulge_of_samples

    points = model.samples.points
    bulges = np.empty(min(len(points), SHAPED))
    bulge_of_samples(points, model.samples.normals, np.argsort(points[:, 0], kind="stable"), reach, bulges)
    return bulge_classes(bulges, signed=signed)


def counts(classes: Classes, borders: Sequence[float]) -> NDArray[np.intp]:
    """How many are in each of the classes between some borders, (C,)."""
    return np.bincount(classes, minlength=len(borders) + 1)


def shares(classes: Classes, borders: Sequence[float], unlike: float) -> Floats:
    """The share in each class, (C,), none below `unlike` of what it would be if none were."""
    found = counts(classes, borders) / max(len(classes), 1) + unlike
    return np.asarray(found / found.sum())


def ratios(likely: Floats, there: NDArray[np.intp]) -> Floats:
    """The likelihood ratio of each class over the largest, (C,): so likely on a model, so often in the scene."""
    ratio = np.where(there > 0, likely / np.maximum(there, 1), 0.0)
    return np.asarray(ratio / max(ratio.max(), 1e-300))
