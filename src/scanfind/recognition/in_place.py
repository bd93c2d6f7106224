"""Elements where the design puts them: tried there first, with what is allowed there and nowhere else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.design.elements import LEAST_LOOKED_AT, placements_of
from scanfind.evidence.verify import score, why_refused
from scanfind.fit.refine import Refined, as_they_are, held, shrinking
from scanfind.pose import Pose
from scanfind.recognition.around import FARTHEST_M, across, drawn_in, long_side, of_others
from scanfind.recognition.candidate import Candidate, Standing
from scanfind.recognition.claims import Claims
from scanfind.recognition.stands import as_designed
from scanfind.recognition.swaps import (
    GAIN,
    ROUGH_GAIN,
    explained,
    missing,
    more_explained,
    onto,
    pairs_alike,
    sides_of,
)
from scanfind.search.hypotheses import joined

if TYPE_CHECKING:
    from scanfind.evidence.neighbours import Design
    from scanfind.library.model import Model
    from scanfind.mesh import Placement
    from scanfind.recognition.fitting import Fitting
    from scanfind.recognition.ground import Ground
    from scanfind.recognition.weighing import Weighing
    from scanfind.search.hypotheses import Hypotheses

Floats = NDArray[np.float64]

DRAWN_IN_CELLS = (2.0, 0.75)  # of the largest: how far off its design an element is met at once …
FARTHER_IF = 1.2  # … where so many more of its samples meet the scan there than about the design
IN_PLACE_M = 0.06  # what ICP carried no farther off is still where the design puts it
# Of what is found beside the place of an element: so far to each side so much less of what is looked at is explained.
STANDS_OUT_M, STANDS_OUT = 0.04, 0.25


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

    def __init__(
        self, ground: Ground, fitting: Fitting, weighing: Weighing, asked: Asked, standing: Sequence[Standing] = ()
    ) -> None:
        self._ground, self._fitting, self._weighing, self._asked = ground, fitting, weighing, asked
        self._standing = standing
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
        found = self._fitted(start, hypotheses)
        both = joined([hypotheses, found.hypotheses])
        return Refined(both, np.tile(found.hessians, (2, 1, 1)), np.tile(found.matched, 2), np.tile(found.rms, 2))

    def _fitted(self, start: Hypotheses, designs: Hypotheses) -> Refined:
        """Poses fitted to fine surfels, drawn back to their designs along what these hardly fix, and fitted to beams.

        The edges of a flat bar of 8 mm are lost in cells of 20 mm: from its true pose ICP carried it 14 mm across, to
        where the rest of it lies on its neighbours.
        """
        found = self._fitting.fine(start)
        self._hold(found, designs)
        return self._on_beams(found)

    def _on_beams(self, found: Refined) -> Refined:
        """Poses fitted to where beams end; as they are where raw points are not asked."""
        return self._fitting.on_beams(found, np.full(len(found.matched), self._ground.parameters.refine.raw_steps > 0))

    def _hold(self, found: Refined, designs: Hypotheses) -> None:
        """Draw refined poses back to their designs along what the scan hardly fixes."""
        centres, radii = self._ground.arrays.centres, self._ground.arrays.radii
        for k, number in enumerate(designs.models):
            design, pose = (Pose(h.rotations[k], h.translations[k]) for h in (designs, found.hypotheses))
            pose = held(design, pose, found.hessians[k], centres[number], float(radii[number]))
            found.hypotheses.rotations[k], found.hypotheses.translations[k] = pose.rotation, pose.translation

    def _around(self, asked: Candidate, moved: Candidate, others: Sequence[Standing]) -> Candidate | None:
        """What stands beside the place of an element that is not in it; None where nothing does that is its own.

        moved : where ICP carried it; others : what else stands
        """
        ground, number = self._ground, asked.model
        model, inlier = ground.models[number], self._weighing.fine.inlier
        surface = self._fitting.near(number)._replace(reach=FARTHEST_M)
        ends, areas = self._weighing.witnesses.unexplained(model, asked.pose(), surface)
        own = ~of_others(ends + ground.offset, others, inlier)
        if areas[own].sum() < LEAST_LOOKED_AT * model.area:
            return None
        poses = drawn_in(surface, asked.pose(), model.samples.points, ends[own], 2.0 * inlier)
        found = self._on_beams(as_they_are(ground.placements(number, poses)))
        for each in sorted(
            [moved, *self._weighing.candidates(found, in_place=True)], key=lambda c: -explained(c.evidence.spoken)
        ):
            if ground.apart(each, asked) > FARTHEST_M or self.why_not(each) or not self._stands_out(each):
                continue
            one = self._at_its_ends(each)
            where, much = self._weighing.witnesses.met(model, one.pose())
            shared = much[of_others(where, others, inlier)].sum() / max(much.sum(), 1e-300)
            if shared <= ground.parameters.verify.shared and not ground.why_not_allowed(one):
                return one
        return None

    def _stands_out(self, found: Candidate) -> bool:
        """Does a pose explain more than those beside it on every side? On a wall as much is explained all about."""
        pose, said = found.pose(), found.evidence.spoken
        beside = [
            Pose(pose.rotation, pose.translation + shift)
            for shift in STANDS_OUT_M * across(pose, self._ground.models[found.model].samples.points)
        ]
        most = max(explained(self._weighing.spoken_of(found.model, each, in_place=True)) for each in beside)
        return most < explained(said) - STANDS_OUT * said.looked_at()

    def _at_its_ends(self, found: Candidate) -> Candidate:
        """A pose as far along the length of its model as beams say; as it is where they do not."""
        pose, model = found.pose(), self._ground.models[found.model]
        along = pose.turn(long_side(model.samples.points)[None])[0]
        told = self._weighing.witnesses.slid(model, pose, along, 0.0)
        if told is None:
            return found
        at = Pose(pose.rotation, pose.translation + told.by * along)
        return self._weighing.candidates(as_they_are(self._ground.placements(found.model, [at])), in_place=True)[0]

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
        believed, refused, elsewhere = list[Candidate](), [], []
        asked_all, moved_all = found[: len(found) // 2], found[len(found) // 2 :]
        bests = [self._better(*pair) for pair in zip(moved_all, asked_all, strict=True)]
        sure = {} if ground.blind else self._swapped_or_beside(asked_all, bests, before)
        for k, (asked, best) in enumerate(zip(asked_all, bests, strict=True)):
            if k in sure:
                believed.append(sure[k])
            elif ground.apart(best, asked) > IN_PLACE_M:
                told = score(best.evidence, ground.blind, ground.parameters.verify)
                elsewhere.append(best._replace(score=told, in_place=False))
            elif reason := self.why_not(best):
                refused.append((best, reason))
            else:
                believed.append(best)
        claims = Claims(ground, [*before, *believed])
        for candidate in sorted(elsewhere, key=lambda c: -c.area):
            if reason := ground.why_not_believed(candidate):
                refused.append((candidate, reason))
            elif not claims.hold(candidate):
                believed.append(candidate)
                claims.add(candidate)
        return believed, refused

    def _swapped_or_beside(
        self, asked: Sequence[Candidate], bests: Sequence[Candidate], before: Sequence[Candidate]
    ) -> dict[int, Candidate]:
        """By number of the place what stands in it instead of its own, or beside it where nothing stands in it.

        What is swapped explains more than what stands beside: of a beam that was moved a shorter one explains much.
        """
        ground, found = self._ground, dict[int, Candidate]()
        far = [ground.apart(best, place) > IN_PLACE_M for place, best in zip(asked, bests, strict=True)]
        in_place = [place if off else best for place, best, off in zip(asked, bests, far, strict=True)]
        empty = [k for k, best in enumerate(bests) if far[k] or self.why_not(best)]
        sound = [best for k, best in enumerate(bests) if k not in empty]
        others = [*self._standing, *map(self._stands, [*before, *sound])]
        for k in sorted(empty, key=lambda k: -ground.models[asked[k].model].area):  # small ones are drawn to large ones
            if one := self._around(asked[k], bests[k], others):
                found[k] = one
                others.append(self._stands(one))
        carried_off = {k: bests[k] for k in empty if far[k] and not self.why_not(bests[k])}
        return found | self._swapped(in_place, carried_off | found)

    def _stands(self, candidate: Candidate) -> Standing:
        """What is believed, as others are told of it."""
        return Standing(self._fitting.near(candidate.model), self._ground.in_scans(candidate.pose()))

    def _better(self, moved: Candidate, asked: Candidate) -> Candidate:
        """Of a pose as the design gives it and as ICP leaves it the better; one carried off only if the other fails.

        What fails in its place is believed beside it only where it stands out.
        """
        best = max(asked, moved, key=lambda candidate: candidate.score)
        if best is asked or not self.why_not(asked) or self._looked_at_too_little(moved):
            return asked if self._ground.apart(best, asked) > IN_PLACE_M else best
        near = self._ground.apart(best, asked) <= IN_PLACE_M and not self._ground.blind
        return asked if near and not self._stands_out(best) else best

    def _swapped(self, bests: Sequence[Candidate], beside: Mapping[int, Candidate]) -> dict[int, Candidate]:
        """By number of the place what stands in it, where two elements stand in each other's.

        bests : of the place of each element, what the design has there, as it was found; beside : the same farther off
        """
        alike, long, told = self._alike, self._sides[:, 2], []
        stand_ins: dict[tuple[int, int], Candidate | None] = {}

        def gain(here: int, there: int) -> float:
            """What share of what is looked at here is explained more where the element of another place stands here."""
            key, is_there = (here, bests[there].model), [bests[here], *([beside[here]] if here in beside else [])]
            if key not in stand_ins:
                stand_ins[key] = self._instead(bests[here], bests[there].model, self._places[here])
            instead = stand_ins[key]
            if instead is None:
                return -np.inf
            return min(more_explained(instead.evidence.spoken, each.evidence.spoken) for each in is_there)

        for places in combinations(range(len(bests)), 2):
            if tuple(sorted(bests[k].model for k in places)) not in alike:
                continue
            # Of the longer one something is missing where the shorter stands: asked first, that costs nothing.
            longer, shorter = sorted(places, key=lambda k: -long[bests[k].model])
            if missing(bests[longer].evidence.spoken) < 0.5 * GAIN:
                continue
            gains = gain(longer, shorter)
            if gains >= GAIN and (other := gain(shorter, longer)) >= GAIN:
                told.append((gains + other, places))
        found: dict[int, Candidate] = {}
        for _, (one, other) in sorted(told, reverse=True):
            instead = {one: stand_ins[one, bests[other].model], other: stand_ins[other, bests[one].model]}
            sound = {k: each for k, each in instead.items() if each and not self.why_not(each)}
            if len(sound) == len(instead) and not found.keys() & instead.keys():
                found |= sound
        return found

    def _instead(self, stands: Candidate, model: int, place: Placement) -> Candidate | None:
        """Another model where one stands, the way round that beams speak for; None where it plainly does not."""
        pose = stands.pose()
        ways = [pose @ way for way in onto(self._ground.models[model], self._ground.models[stands.model])]
        other = self._ground.models[stands.model].name
        said = [self._weighing.spoken_of(model, way, in_place=True, instead_of=other) for way in ways]
        best = int(np.argmax([explained(each) for each in said]))
        if more_explained(said[best], stands.evidence.spoken) < -ROUGH_GAIN:
            return None
        start = self._ground.placements(model, [ways[best]])
        refined = self._fitted(start, start)
        asked, found = (
            self._weighing.candidates(each, in_place=True, instead_of=other)[0]
            for each in (refined._replace(hypotheses=start), refined)
        )
        better = max(asked, found, key=lambda each: explained(each.evidence.spoken))
        return better._replace(instead_of=place)

    @cached_property
    def _sides(self) -> Floats:
        """Of each model, (models, 3): see `sides_of`."""
        return np.array([sides_of(model) for model in self._ground.models]).reshape(-1, 3)

    @cached_property
    def _alike(self) -> set[tuple[int, int]]:
        """The models that could stand in each other's place: see `pairs_alike`."""
        return pairs_alike(self._sides)

    def why_not(self, candidate: Candidate) -> str:
        """Why an element is not believed to stand where the design puts it; empty where it is."""
        if self._looked_at_too_little(candidate):
            return "scanners looked at too little of it to be sure"
        return why_refused(candidate.evidence, self._ground.blind, self._ground.parameters.verify, in_place=True)

    def _looked_at_too_little(self, candidate: Candidate) -> bool:
        """Do beams say too little of a pose to be asked? One that hides within others nothing speaks against."""
        enough = LEAST_LOOKED_AT * self._ground.models[candidate.model].area
        return not self._ground.blind and candidate.evidence.spoken.looked_at() < enough


def asked_of(models: Sequence[Model]) -> Asked:
    """All elements of a design."""
    return Asked({model.name: placements_of(model) for model in models}, {}, as_designed(models))
