"""What a worker does with a tile: search it, its own elements of a design first; and whose each instance is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.clock import Clock
from scanfind.design.elements import placements_of
from scanfind.detection import Detection, Refused
from scanfind.find import begin, recognise
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import first_cell, without_sparse_levels
from scanfind.pose import Pose
from scanfind.priors.allowed import middle_of
from scanfind.recognition.candidate import Standing
from scanfind.recognition.in_place import Asked
from scanfind.recognition.sizes import Size, Sizes, by_size
from scanfind.tiles.plan import RIM, Tile, margin_of
from scanfind.tiles.stored import beams_into, count_in, parts_of, rows_in
from scanfind.tiles.tasks import Found, Job, design_in, surface_of

if TYPE_CHECKING:
    from scanfind.evidence.free_space import Limits
    from scanfind.library.model import Model
    from scanfind.search.served import Tally


class Searched(NamedTuple):
    """What was found in one tile, its own or nearly so; see `own`.

    noise, cell, reach : of the search, metres
    tally : how it went, for each model
    limits : when a beam is on a surface here, beside it or through
    by_design : the ids of those that trying where the design puts them led to
    """

    detections: list[Detection]
    refused: list[Refused]
    notes: list[str]
    noise: float
    cell: float
    reach: float
    tally: Tally
    limits: Limits
    by_design: frozenset[int]


class Owned(NamedTuple):
    """Of a design what is a tile's own: the elements whose middle it puts there.

    places : by name of a model, the numbers of its placements
    others : by name, how many more of it are wanted, see Asked
    only : nothing else is looked for
    """

    places: Mapping[str, Sequence[int]]
    others: Mapping[str, int]
    only: bool

    def asked(self, job: Job, models: Sequence[Model]) -> Asked:
        """What to try in the tile."""
        places = {model.name: [placements_of(model)[k] for k in self.places.get(model.name, ())] for model in models}
        return Asked(places, self.others, design_in(job.folder))


def search(
    folder: Path, job: Job, group: int, tile: Tile, standing: Sequence[Found], reach: float, signed: bool,
    scans: Sequence[Path], learnt: Sequence[float], deeper: bool, owned: Owned | None = None,
) -> Searched:  # fmt: skip
    """Search a tile, with its margin, for the models of one size.

    standing : instances of larger models; reach : how far from their surface their points may lie, metres
    scans : the folders of those summed up
    learnt : see Search; deeper : see SearchParameters
    owned : where a design has models in this tile, to be tried first; None: nobody asks
    """
    models = by_size(job.models())[group]
    # How many there are of the whole site says nothing of a tile.
    limits, priors = job.parameters.search, replace(job.parameters.priors, expect=None)
    own = replace(job.parameters, search=replace(limits, max_instances=None, deeper=deeper), priors=priors)
    size, found = Size(models, 0, 1), Sizes(models, own)
    grid = without_sparse_levels(grid_of(job, models, tile, signed, scans), found.smallest(), own.grid)
    taken = [
        Standing(surface_of(job.folder, one.model, reach), one.scene_from_model)
        for one in standing
        if touches(job, tile.grown(job.margin(models)), one)
    ]
    if owned is not None and not grid.points:  # of what the design has where no scan was made beams tell
        owned = owned._replace(places={})
    asked = None if owned is None else owned.asked(job, models)
    if owned is not None and owned.only:
        search = begin(size, grid, taken, own, job.seed, job.jobs, Clock(), asked, learnt)
    else:
        search = recognise(size, grid, taken, own, job.seed, job.jobs, Clock(), _silent, asked, learnt)
    found.add(search)
    diameters = {model.name: model.diameter for model in models}
    detections, tried = found.detections(), {search.telling.pose(one).translation.tobytes() for one in search.by_design}
    by_design = frozenset(one.id for one in detections if one.scene_from_model.translation.tobytes() in tried)

    def near(one: Detection | Refused) -> bool:
        return tile.has(middle_in(job, one.model, one.scene_from_model), job.bin_m(), RIM * diameters[one.model])

    notes = found.notes() if grid.points else []
    return Searched(
        [one for one in detections if one.id in by_design or near(one)],
        [one for one in found.refused() if near(one)], notes, found.noise(), found.cell(), search.reach(),
        search.search.tally(), search.weighing.witnesses.limits, by_design,
    )  # fmt: skip


def middle_in(job: Job, name: str, pose: Pose) -> NDArray[np.float64]:
    """Where the middle of a placed model is, (3,), metres from the grid's offset."""
    model = next(model for model in job.models() if model.name == name)
    return np.asarray(pose.move(middle_of(model)[None])[0] - job.offset)


def touches(job: Job, box: Tile, one: Found) -> bool:
    """May an instance reach into a box?"""
    model = next(model for model in job.models() if model.name == one.model)
    return box.has(middle_in(job, one.model, one.scene_from_model), job.bin_m(), margin_of([model]))


def grid_of(job: Job, models: Sequence[Model], tile: Tile, signed: bool, scans: Sequence[Path]) -> MomentGrid:
    """The moments of a tile with its margin, in the cells its models are searched with, and the beams into it."""
    box = tile.grown(job.margin(models))
    parts = parts_of(scans)
    cell, levels = cell_of(job, models)
    # Shards are not quite of one size.
    grid = MomentGrid(cell, np.array(job.offset), job.jobs, int(1.25 * count_in(parts, box)) + 100_000)
    grid.units *= 2.0**levels
    for rows in rows_in(parts, box):
        for coarse in coarsened(job, rows, levels):
            grid.add_rows(coarse)
    grid.look(beams_into(parts, box.metres(job.bin_m())))
    grid.signed = signed
    return grid


def coarsened(job: Job, rows: NDArray[Any], levels: int) -> Sequence[NDArray[Any]]:
    """Rows (R,) of ROW in cells of 2**levels times the edge."""
    if not levels:
        return [rows]
    grid = job.grid()
    grid.add_rows(rows)
    for _ in range(levels):
        grid = grid.coarser()
    return list(grid.rows())


def cell_of(job: Job, models: Sequence[Model]) -> tuple[float, int]:
    """The cell that models are searched with first, metres, and how many levels it is above the finest."""
    wanted = first_cell([model.diameter for model in models], job.parameters.grid)
    cell, levels = job.cell, 0
    while 2.0 * cell <= wanted * (1.0 + 1e-9):
        cell, levels = 2.0 * cell, levels + 1
    return cell, levels


def own(searched: Mapping[Tile, Searched], job: Job) -> list[Detection]:
    """The detections of all tiles, each instance once, in the order of the tiles.

    Of two tiles that tell the same instance the one is believed that tried it where the design puts it, or else the
    one in whose half-open box its middle lies.
    """
    every = [(tile, one) for tile, found in sorted(searched.items()) for one in found.detections]
    mine = {id(one): tile.has(np.array(one.pivot) - job.offset, job.bin_m()) for tile, one in every}
    tried = {id(one): one.id in searched[tile].by_design for tile, one in every}
    diameters = {model.name: model.diameter for model in job.models()}
    kept: list[tuple[Tile, Detection]] = []
    for tile, one in sorted(every, key=lambda pair: (not tried[id(pair[1])], not mine[id(pair[1])])):
        middle, rim = np.array(one.pivot), RIM * diameters[one.model]
        if tried[id(one)] or not any(
            other.model == one.model and there != tile and np.linalg.norm(np.array(other.pivot) - middle) < rim
            for there, other in kept
        ):
            kept.append((tile, one))
    order = {id(one): place for place, (_, one) in enumerate(every)}
    return sorted((one for _, one in kept), key=lambda one: order[id(one)])


def _silent(stage: str, done: float, total: float) -> None:
    pass
