"""What became of a design, over all tiles: its elements are told by the tiles that own them, and joined here.

Beams tell it, those of all scanners: one that stands in the next hall may say that a wall hides what it went towards.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.design.elements import assigned, elements_of, placements_of
from scanfind.recognition.sizes import by_size
from scanfind.recognition.stands import as_found
from scanfind.recognition.witnesses import Witnesses
from scanfind.tiles.search import middle_in
from scanfind.tiles.stored import beams_into, parts_of
from scanfind.tiles.tasks import design_in
from scanfind.tiles.work import Crew, all_done

if TYPE_CHECKING:
    from scanfind.design.elements import Element
    from scanfind.detection import Detection
    from scanfind.evidence.free_space import Limits
    from scanfind.library.model import Model
    from scanfind.pose import Pose
    from scanfind.tiles.plan import Tile
    from scanfind.tiles.search import Searched
    from scanfind.tiles.tasks import Job

Floats = NDArray[np.float64]

EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])


class Questions(NamedTuple):
    """What the scanners are asked about one tile.

    places : models, by name, the numbers of their placements, and whether the element was found
    detections : without their points; with where the design has the element each is taken for, if any
    """

    places: list[tuple[str, int, bool]]
    detections: list[tuple[Detection, Pose | None]]


class Answers(NamedTuple):
    """What they say.

    said : for each place, what each of S scanners says, rows as of Spoken, (S, 4), m²
    detections : by id, as they are told in the end
    numbers : of each scanner, that of its station
    """

    said: dict[tuple[str, int], Floats]
    detections: dict[int, Detection]
    numbers: list[int]


def all_told(
    job: Job, findings: Sequence[Detection], searched: Sequence[Mapping[Tile, Searched]], stations: Floats,
    scans: Sequence[Path], crew: Crew,
) -> tuple[list[Detection], list[Element]]:  # fmt: skip
    """Every detection with what its ends and each station say, and every element of the design, as `find` tells them.

    searched : for each size of models, the searches of its tiles
    stations : where all scanners stood, in order, (S, 3); scans : the folders of those summed up
    """
    tasks = {}
    bare = [replace(one, isolated=None) for one in findings]
    for group, (models, found) in enumerate(zip(by_size(job.models()), searched, strict=True)):
        for tile, some in asked_of_tiles(job, models, found, bare).items():
            limits = found[tile].limits
            tasks[f"tell-{group}-{tile.name()}"] = (tell, job, some, bare, limits, stations, scans)
    said: dict[tuple[str, int], Floats] = {}
    told: dict[int, Detection] = {}
    numbers: list[int] = []
    for answers in all_done(job.folder, crew, tasks):
        said, told, numbers = said | answers.said, told | answers.detections, answers.numbers
    findings = [replace(told[one.id], isolated=one.isolated) for one in findings]
    elements = []
    for model in job.models() if job.at_design else ():
        by_place = [said[model.name, k] for k in range(len(placements_of(model)))]
        elements += elements_of(model, findings, by_place, numbers)
    return findings, elements


def asked_of_tiles(
    job: Job, models: Sequence[Model], found: Mapping[Tile, Searched], findings: Sequence[Detection]
) -> Mapping[Tile, Questions]:
    """What each tile is asked about models of one size.

    found : the searches of all tiles for them; findings : without their points
    """
    asked: dict[Tile, Questions] = defaultdict(lambda: Questions([], []))
    for model in models:
        places = placements_of(model) if job.at_design else ()
        taken = assigned(model, places, findings)
        designs = {one.id: places[k].design_from_model for k, one in taken.items()}
        for one in (one for one in findings if one.model == model.name):
            tile = nearest(job, found, model.name, one.scene_from_model)
            asked[tile].detections.append((one, designs.get(one.id)))
        for k, place in enumerate(places):
            asked[nearest(job, found, model.name, place.design_from_model)].places.append((model.name, k, k in taken))
    return asked


def nearest(job: Job, tiles: Iterable[Tile], name: str, pose: Pose) -> Tile:
    """The tile that the middle of a placed model is in, or nearest to."""
    middle, bin_m = middle_in(job, name, pose), job.bin_m()

    def away(tile: Tile) -> float:
        low, high = tile.metres(bin_m)
        return float(np.linalg.norm(np.maximum(np.maximum(low - middle, middle - high), 0.0)))

    return min(tiles, key=away)


def tell(
    folder: Path, job: Job, asked: Questions, found: Sequence[Detection], limits: Limits, stations: Floats,
    scans: Sequence[Path],
) -> Answers:  # fmt: skip
    """Ask all scanners; found : all detections; limits : of the tile; stations, scans : see `all_told`."""
    grid, models = job.grid(), {model.name: model for model in job.models()}
    grid.look(beams_into(parts_of(scans), EVERYWHERE))
    design = design_in(job.folder) if job.at_design else None
    witnesses = Witnesses(grid.beams(), np.array(job.offset), limits, design)
    among = witnesses.among(as_found(job.models(), found)) if job.at_design else witnesses
    said = {
        (name, k): among.say_of_place(models[name], placements_of(models[name])[k].design_from_model, is_there)
        for name, k, is_there in asked.places
    }
    detections = {}
    for one, place in asked.detections:
        model = models[one.model]
        told = one if place is None else witnesses.at_its_ends(model, one, place)
        detections[one.id] = among.with_stations(model, told, stations) if len(stations) > 1 else told
    return Answers(said, detections, witnesses.numbers(stations))
