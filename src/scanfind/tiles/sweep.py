"""All tiles of a site searched, and some of them again: what one finds tells how long another need be searched.

Most tiles hold no instance, and `find` searches such a scan long: it has nothing to tell how easily one would be found.
The other tiles have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from math import exp
from typing import TYPE_CHECKING

import numpy as np

from scanfind.search.surface import LEARNT, RIGHT_PAIR_FINDS, Tally
from scanfind.tiles.plan import Held, Tile, tiles_of
from scanfind.tiles.tasks import Found, Job, Searched, cell_of, own, search
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


def search_all(
    job: Job, group: int, models: list[Model], held: Held, summed: list[Summed],
    folders: list[Path], standing: Sequence[Detection], searched: list[Searched], crew: Crew, tell: Progress,
) -> dict[Tile, Searched]:  # fmt: skip
    """What every tile of the site holds of the models of one size.

    standing, searched : instances of larger models, and the searches for them
    """
    _, levels = cell_of(job, models)
    # A cell of a level above stands for four of a surface.
    tiles = tiles_of(held._replace(rows=held.rows // 4**levels), job.margin(models), job.memory)
    taken = [Found(k, one.model, one.scene_from_model) for k, one in enumerate(standing)]
    reach = 2.0 * max((one.reach for one in searched), default=0.0)
    signed = all(one.signed for one in summed)
    limits, done, wanted = job.parameters.search, 0, 0

    def told(name: str, one: Searched) -> None:
        nonlocal done
        done += 1
        tell("search", done, wanted)

    def found(name: str, some: Sequence[Tile], learnt: Sequence[float], *, deeper: bool) -> dict[Tile, Searched]:
        nonlocal wanted
        wanted += len(some)
        tasks = {
            f"{name}-{group}-{tile.name()}": (
                search, job, group, tile, taken, reach, signed, folders, learnt, deeper,
            ) for tile in some
        }  # fmt: skip
        return dict(zip(some, all_done(job.folder, crew, tasks, told), strict=True))

    if len(tiles) == 1 or not limits.miss_probability:
        return found("search", tiles, (), deeper=limits.deeper)
    first = found("search", tiles, (HOPED,) * len(models), deeper=False)
    learnt = learnt_from(one.tally for one in first.values())
    left = [tile for tile, one in first.items() if not enough(one.tally, learnt, limits.miss_probability)]
    # As in one piece: deeper where the whole site shows too little, not where a tile shows nothing, as most tiles do.
    counts = Counter(one.model for one in own(first, job))
    expected = job.parameters.priors.expected([model.name for model in models])
    if any(learnt) and all(counts[name] >= count for name, count in expected.items()):
        return first | found("again", left, learnt, deeper=False)
    return first | found("again", tiles if expected else left, learnt, deeper=limits.deeper)


def learnt_from(tallies: Iterable[Tally]) -> tuple[float, ...]:
    """How many of the right pairs found each model over all tiles, less what was easy about it; 0: nothing did.

    Never fewer than are believed of a model that nobody saw: nothing is searched longer for having been seen.
    """
    _, hits, shown = (np.sum(column, axis=0) for column in zip(*tallies, strict=True))
    share = LEARNT * hits / np.maximum(shown, 1e-300)
    return tuple(np.where(hits > 0.0, np.maximum(share, RIGHT_PAIR_FINDS), 0.0).tolist())


def enough(tally: Tally, learnt: Sequence[float], allowed: float) -> bool:
    """Was a tile searched until the chance to have missed an instance of a model was below the one allowed?

    Where it found one, it was; where nothing of a model was found on the whole site, nobody knows.
    """
    return all(
        hits > 0.0 or (share > 0.0 and exp(-share * tested) < allowed)
        for share, hits, tested in zip(learnt, tally.hits, tally.tested, strict=True)
    )
