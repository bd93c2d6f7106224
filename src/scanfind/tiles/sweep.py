"""All tiles of a site searched, and some of them again: what one finds tells how long another need be searched.

Most tiles hold no instance, and `find` searches such a scan long: it has nothing to tell how easily one would be found.
The other tiles have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import exp
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.design.elements import placements_of
from scanfind.search.served import RIGHT_PAIR_FINDS, Tally, believed_of_others
from scanfind.tiles.plan import Held, Tile, tiles_of
from scanfind.tiles.search import Owned, Searched, cell_of, middle_in, own, search
from scanfind.tiles.tasks import Found, Job
from scanfind.tiles.work import Crew, all_done

if TYPE_CHECKING:
    from pathlib import Path

    from scanfind.detection import Detection
    from scanfind.library.model import Model
    from scanfind.progress import Progress
    from scanfind.tiles.tasks import Summed

# Each tile is first searched as if so many of the right pairs found an instance: of spools 0.13 to 1.3 did, where one
# was whole in its tile. Where they turn out to be fewer the tile is searched again.
HOPED = 0.1


@dataclass(eq=False)
class Sweep:
    """One size of models over the tiles of a site.

    tiles : in the order of their places; taken : instances of larger models, reach : how far from their surface their
    points may lie, metres; signed : all scanner positions are known
    """

    job: Job
    group: int
    models: list[Model]
    tiles: list[Tile]
    taken: list[Found]
    reach: float
    signed: bool
    folders: list[Path]
    crew: Crew
    tell: Progress
    done: int = 0
    wanted: int = 0

    def search(
        self, name: str, some: Sequence[Tile], learnt: Sequence[float] = (), *, deeper: bool = False,
        owned: Mapping[Tile, Owned] | None = None, taken: Mapping[Tile, Sequence[Found]] | None = None,
    ) -> dict[Tile, Searched]:  # fmt: skip
        """Search some tiles, under a name of its own among all such searches of the size.

        owned : of a design what is each tile's own; taken : other instances that each tile has to respect
        """
        self.wanted += len(some)
        tasks = {
            f"{name}-{self.group}-{tile.name()}": (
                search, self.job, self.group, tile, [*self.taken, *(taken or {}).get(tile, ())], self.reach,
                self.signed, self.folders, learnt, deeper, (owned or {}).get(tile),
            ) for tile in some
        }  # fmt: skip
        return dict(zip(some, all_done(self.job.folder, self.crew, tasks, self._told), strict=True))

    def _told(self, name: str, one: Searched) -> None:
        self.done += 1
        self.tell("search", self.done, self.wanted)


def search_all(
    job: Job, group: int, models: list[Model], held: Held, summed: list[Summed],
    folders: list[Path], standing: Sequence[Detection], searched: list[Searched], crew: Crew, tell: Progress,
) -> dict[Tile, Searched]:  # fmt: skip
    """What every tile of the site holds of the models of one size.

    standing, searched : instances of larger models, and the searches for them
    """
    _, levels = cell_of(job, models)
    # A cell of a level above stands for four of a surface.
    held = held._replace(rows=held.rows // 4**levels)
    if job.at_design:  # each place is in some tile, whether the scan has anything there or not
        held = held.with_bins(bins_of_places(job, models))
    tiles = tiles_of(held, job.margin(models), job.memory)
    taken = [Found(k, one.model, one.scene_from_model) for k, one in enumerate(standing)]
    reach = 2.0 * max((one.reach for one in searched), default=0.0)
    signed = all(one.signed for one in summed)
    sweep = Sweep(job, group, models, tiles, taken, reach, signed, folders, crew, tell)
    return by_design(sweep) if job.at_design else anywhere(sweep)


def anywhere(sweep: Sweep) -> dict[Tile, Searched]:
    """Every tile searched with no guess, and again where what others found tells that it was not enough."""
    job, models, tiles, limits = sweep.job, sweep.models, sweep.tiles, sweep.job.parameters.search
    if len(tiles) == 1 or not limits.miss_probability:
        return sweep.search("search", tiles, deeper=limits.deeper)
    first = sweep.search("search", tiles, (HOPED,) * len(models))
    learnt = learnt_from(one.tally for one in first.values())
    left = [tile for tile, one in first.items() if not enough(one.tally, learnt, limits.miss_probability)]
    # As in one piece: deeper where the whole site shows too little, not where a tile shows nothing, as most tiles do.
    counts = Counter(one.model for one in own(first, job))
    expected = job.parameters.priors.expected([model.name for model in models])
    if any(learnt) and all(counts[name] >= count for name, count in expected.items()):
        return first | sweep.search("again", left, learnt)
    return first | sweep.search("again", tiles if expected else left, learnt, deeper=limits.deeper)


def by_design(sweep: Sweep) -> dict[Tile, Searched]:
    """Every tile's own elements tried where the design has them; all tiles searched for what is in none of its places.

    The search begins by trying again, which gives the same, and respects what other tiles found in its place.
    """
    job, models, tiles = sweep.job, sweep.models, sweep.tiles
    places = {tile: owned_places(job, tile, models) for tile in tiles}
    deeper = job.parameters.search.deeper
    if len(tiles) == 1:
        return sweep.search("search", tiles, deeper=deeper, owned={tiles[0]: Owned(places[tiles[0]], {}, only=False)})
    tried = sweep.search("place", tiles, owned={tile: Owned(places[tile], {}, only=True) for tile in tiles})
    missing = {tile: missing_of(places[tile], tried[tile].detections) for tile in tiles}
    in_all = {model.name: sum(each[model.name] for each in missing.values()) for model in models}
    if max(in_all.values()) <= 0:
        return tried
    others = {tile: {name: max(count, 0) - missing[tile][name] for name, count in in_all.items()} for tile in tiles}
    sweep.reach = max(sweep.reach, 2.0 * max(one.reach for one in tried.values()))
    stand = {tile: [Found(one.id, one.model, one.scene_from_model) for one in tried[tile].detections] for tile in tiles}
    # As in one piece: lines, and what shows little, are asked where no tile has anything, not where one has nothing.
    nothing = not any(stand.values())
    return sweep.search(
        "search", tiles, () if nothing else (RIGHT_PAIR_FINDS,) * len(models), deeper=deeper and nothing,
        owned={tile: Owned(places[tile], others[tile], only=False) for tile in tiles},
        taken={tile: [one for there in tiles if there != tile for one in stand[there]] for tile in tiles},
    )  # fmt: skip


def bins_of_places(job: Job, models: Sequence[Model]) -> NDArray[np.int64]:
    """The bins in which the design has the middle of each element, (P, 3)."""
    middles = [middle_in(job, model.name, at.design_from_model) for model in models for at in placements_of(model)]
    return np.floor(np.array(middles) / job.bin_m()).astype(np.int64)


def owned_places(job: Job, tile: Tile, models: Sequence[Model]) -> dict[str, list[int]]:
    """By name of a model, the numbers of the placements that are a tile's own."""
    return {model.name: np.flatnonzero(tile.holds(bins_of_places(job, [model]))).tolist() for model in models}


def missing_of(places: Mapping[str, Sequence[int]], found: Sequence[Detection]) -> dict[str, int]:
    """By name of a model, how many fewer of it were found than a tile has places for it."""
    counts = Counter(one.model for one in found)
    return {name: len(some) - counts[name] for name, some in places.items()}


def learnt_from(tallies: Iterable[Tally]) -> tuple[float, ...]:
    """How many of the right pairs found each model over all tiles, less what was easy about it; 0: nothing did.

    Never fewer than are believed of a model that nobody saw: nothing is searched longer for having been seen.
    """
    _, hits, shown = (np.sum(column, axis=0) for column in zip(*tallies, strict=True))
    share = believed_of_others(hits, shown)
    return tuple(np.where(hits > 0.0, np.maximum(share, RIGHT_PAIR_FINDS), 0.0).tolist())


def enough(tally: Tally, learnt: Sequence[float], allowed: float) -> bool:
    """Was a tile searched until the chance to have missed an instance of a model was below the one allowed?

    Where it found one, it was; where nothing of a model was found on the whole site, nobody knows.
    """
    return all(
        hits > 0.0 or (share > 0.0 and exp(-share * tested) < allowed)
        for share, hits, tested in zip(learnt, tally.hits, tally.tested, strict=True)
    )
