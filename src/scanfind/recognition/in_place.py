"""Elements where the design puts them: tried there first, with what is allowed there and nowhere else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.design.elements import LEAST_LOOKED_AT, placements_of
from scanfind.evidence.free_space import Design
from scanfind.evidence.rays import RayCaster
from scanfind.evidence.verify import score, why_refused
from scanfind.fit.refine import Refined, held, shrinking
from scanfind.pose import Pose
from scanfind.recognition.candidate import Candidate
from scanfind.recognition.claims import Claims
from scanfind.recognition.swaps import GAIN, explained, looked_at, onto, pairs_alike
from scanfind.search.hypotheses import joined

if TYPE_CHECKING:
    from scanfind.library.model import Model
    from scanfind.mesh import Placement
    from scanfind.recognition.fitting import Fitting
    from scanfind.recognition.ground import Ground
    from scanfind.recognition.weighing import Weighing
    from scanfind.search.hypotheses import Hypotheses

Floats = NDArray[np.float64]

DRAWN_IN_CELLS = (2.0, 0.75)  # of the largest: how far off its design an element is met at once …
FARTHER_IF = 1.2  # … where so many more of its samples meet the scan there than about the design
# Where an element that is not in its place is looked for beside it, across its length; and how far off it then may be.
AROUND_M, AROUND_MOST_M = (-0.04, 0.0, 0.04), 0.12
IN_PLACE_M = 0.06  # what ICP carried no farther off is still where the design puts it


class Asked(NamedTuple):
    """What is asked of a design before anything else is looked for.

    places : by name of a model, where to try it
    others : by name, how many more of it are wanted, wherever they stand: in tiles, those that other tiles miss
    shadows : all elements where the design has them: what they hide is no evidence; None where it has no meshes
    """

    places: Mapping[str, Sequence[Placement]]
    others: Mapping[str, int]
    shadows: Design | None


NOTHING = Asked({}, {}, None)


class InPlace:
    """The poses a design gives, tried, and what is believed of them."""

    def __init__(self, ground: Ground, fitting: Fitting, weighing: Weighing, asked: Asked) -> None:
        self._ground, self._fitting, self._weighing, self._asked = ground, fitting, weighing, asked
        self._places: list[Placement] = []

    def wanted(self) -> NDArray[np.intp]:
        """How many instances of each model are wanted, (models,)."""
        places, others = self._asked.places, self._asked.others
        return np.array([len(places[model.name]) + others.get(model.name, 0) for model in self._ground.models])

    def hypotheses(self) -> Iterator[Hypotheses]:
        """The poses the design gives, so many of each model at a time as one refinement takes."""
        ground, kept = self._ground, self._ground.parameters.search.kept
        every = [self._asked.places[model.name] for model in ground.models]
        for start in range(0, max(map(len, every)), kept):
            places = [some[start : start + kept] for some in every]
            self._places = [each for some in places for each in some]
            yield joined(
                [
                    ground.placements(number, [ground.in_grid(each.design_from_model) for each in some])
                    for number, some in enumerate(places)
                    if some
                ]
            )

    def refine(self, hypotheses: Hypotheses) -> Refined:
        """Poses the design gives, as they are; then each after ICP, drawn in from farther away where that meets more.

        Along what the scan hardly fixes ICP may carry an element off to where its neighbours begin: it is held back.
        """
        refine, around = self._ground.parameters.refine, self._ground.scene.around
        gates = shrinking(DRAWN_IN_CELLS, refine.coarse_iterations, around.cell)
        near = self._fitting.coarse(hypotheses)
        far = self._fitting.icp(hypotheses, around, gates, refine.coarse_samples)
        far = self._fitting.coarse(far.hypotheses)
        farther = far.matched > FARTHER_IF * near.matched
        start = joined([near.hypotheses, far.hypotheses]).take(np.arange(len(farther)) + len(farther) * farther)
        found = self._fitting.fine(start)
        self._hold(found, hypotheses)
        both = joined([hypotheses, found.hypotheses])
        return Refined(both, np.tile(found.hessians, (2, 1, 1)), np.tile(found.matched, 2), np.tile(found.rms, 2))

    def _hold(self, found: Refined, designs: Hypotheses) -> None:
        """Draw refined poses back to their designs along what the scan hardly fixes."""
        centres, radii = self._ground.arrays.centres, self._ground.arrays.radii
        for k, number in enumerate(designs.models):
            design, pose = (Pose(h.rotations[k], h.translations[k]) for h in (designs, found.hypotheses))
            pose = held(design, pose, found.hessians[k], centres[number], float(radii[number]))
            found.hypotheses.rotations[k], found.hypotheses.translations[k] = pose.rotation, pose.translation

    def _around(self, asked: Candidate) -> Candidate:
        """The best of poses that ICP reaches from beside the design's, across its length, held as that one is.

        What is thinner than it was moved is not drawn in from there: a plate of 8 mm that stands 60 mm off has
        other surfaces nearer to its place than its own.
        """
        ground, pose = self._ground, asked.pose()
        points = ground.models[asked.model].samples.points
        across = pose.turn(np.eye(3)[np.argsort(np.ptp(points, axis=0), kind="stable")[:2]])
        shifts = [one * across[0] + other * across[1] for one in AROUND_M for other in AROUND_M if one or other]
        starts = ground.placements(asked.model, [Pose(pose.rotation, pose.translation + shift) for shift in shifts])
        found = self._fitting.fine(self._fitting.coarse(starts).hypotheses)
        self._hold(found, ground.placements(asked.model, [pose] * len(shifts)))
        return max([asked, *self._weighing.candidates(found, in_place=True)], key=lambda candidate: candidate.score)

    def believe(
        self, refined: Refined, before: Sequence[Candidate]
    ) -> tuple[list[Candidate], list[tuple[Candidate, str]]]:
        """Of poses the design gives, as `refine` leaves them, believe the better of each pair if it holds.

        What lies where the design puts it need not be of a telling shape, may adjoin others, and is not asked what else
        it could be taken for. What ICP carried away from there must stand as one found anywhere would.

        before : what is believed already
        Returns what is believed besides, and what is not and why.
        """
        ground, found = self._ground, self._weighing.candidates(refined, in_place=True)
        believed, refused, elsewhere, missed = list[Candidate](), [], [], []
        asked_all, moved_all = found[: len(found) // 2], found[len(found) // 2 :]
        bests = [self._better(*pair) for pair in zip(moved_all, asked_all, strict=True)]
        swapped = {} if ground.blind else self._swapped(bests)
        for k, (asked, best) in enumerate(zip(asked_all, bests, strict=True)):
            if k in swapped:
                believed.append(swapped[k])
            elif ground.apart(best, asked) > IN_PLACE_M:
                told = score(best.evidence, ground.blind, ground.parameters.verify)
                elsewhere.append(best._replace(score=told, in_place=False))
            elif reason := self.why_not(best):
                refused.append((best, reason))
                missed.append(asked)
            else:
                believed.append(best)
        claims = Claims(ground, [*before, *believed])
        for asked in missed if not ground.blind else ():
            best = self._around(asked)
            near = ground.apart(best, asked) < AROUND_MOST_M and not claims.hold(best)
            if near and not self.why_not(best):
                believed.append(best)
                claims.add(best)
        for candidate in sorted(elsewhere, key=lambda c: -c.area):
            if reason := ground.why_not_believed(candidate):
                refused.append((candidate, reason))
            elif not claims.hold(candidate):
                believed.append(candidate)
                claims.add(candidate)
        return believed, refused

    def _better(self, moved: Candidate, asked: Candidate) -> Candidate:
        """Of a pose as the design gives it and as ICP leaves it the better; one carried off only if the other fails."""
        best = max(moved, asked, key=lambda candidate: candidate.score)
        return asked if self._ground.apart(best, asked) > IN_PLACE_M and not self.why_not(asked) else best

    def _swapped(self, bests: Sequence[Candidate]) -> dict[int, Candidate]:
        """By number of the place what stands in it, where two elements stand in each other's.

        bests : of the place of each element, what the design has there, as it was found
        """
        alike, stand_ins, told = pairs_alike(self._ground.models), {}, []
        for places in combinations(range(len(bests)), 2):
            pair = [bests[k] for k in places]
            if tuple(sorted(each.model for each in pair)) not in alike:
                continue
            gains = []
            for here, there in (places, places[::-1]):
                is_there, model = bests[here].evidence.spoken, bests[there].model
                if (here, model) not in stand_ins:
                    stand_ins[here, model] = self._instead(bests[here], model, self._places[here])
                more = explained(stand_ins[here, model].evidence.spoken) - explained(is_there)
                gains.append(more / max(looked_at(is_there), 1e-300))
                if gains[-1] < GAIN:
                    break
            else:
                told.append((sum(gains), places))
        found: dict[int, Candidate] = {}
        for _, (one, other) in sorted(told, reverse=True):
            instead = {one: stand_ins[one, bests[other].model], other: stand_ins[other, bests[one].model]}
            if not found.keys() & instead.keys() and not any(map(self.why_not, instead.values())):
                found |= instead
        return found

    def _instead(self, stands: Candidate, model: int, place: Placement) -> Candidate:
        """Another model where one stands, the way round that beams speak for."""
        pose = stands.pose()
        ways = [pose @ way for way in onto(self._ground.models[model], self._ground.models[stands.model])]
        best = max(ways, key=lambda way: explained(self._weighing.spoken_of(model, way)))
        start = self._ground.placements(model, [best])
        refined = self._fitting.fine(start)
        self._hold(refined, start)
        asked, found = (
            self._weighing.candidates(each, in_place=True)[0] for each in (refined._replace(hypotheses=start), refined)
        )
        better = asked if self._ground.apart(found, asked) > IN_PLACE_M else found
        return better._replace(instead_of=place)

    def why_not(self, candidate: Candidate) -> str:
        """Why an element is not believed to stand where the design puts it; empty where it is."""
        on, beside, through, _ = candidate.evidence.spoken
        enough = LEAST_LOOKED_AT * self._ground.models[candidate.model].area
        if not self._ground.blind and on + beside + through < enough:
            return "scanners looked at too little of it to be sure"
        return why_refused(candidate.evidence, self._ground.blind, self._ground.parameters.verify, in_place=True)


def asked_of(models: Sequence[Model]) -> Asked:
    """All elements of a design."""
    return Asked({model.name: placements_of(model) for model in models}, {}, design_of(models))


def design_of(models: Sequence[Model]) -> Design | None:
    """Elements where the design has them; None where it has no meshes."""
    placed = [
        (model.name, model.mesh, each.design_from_model)
        for model in models
        if model.mesh is not None
        for each in placements_of(model)
    ]
    if not placed:
        return None
    return Design(RayCaster([(mesh, pose) for _, mesh, pose in placed]), tuple(name for name, _, _ in placed))
