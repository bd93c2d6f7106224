"""From hypotheses to detections: the rounds of one search, and what is believed in the end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isnan, log, nan
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly import Assemblies, View
from scanfind.detection import Refused
from scanfind.evidence.verify import nearest, outlines
from scanfind.priors.allowed import OUTSIDE
from scanfind.recognition.by_parts import ByParts
from scanfind.recognition.candidate import FOR_ANOTHER, OUTWEIGHED, SHOWS_LESS, Candidate, Standing, closest
from scanfind.recognition.claims import Claims, stands_elsewhere
from scanfind.recognition.fitting import Fitting
from scanfind.recognition.ground import Ground
from scanfind.recognition.in_place import NOTHING, InPlace
from scanfind.recognition.likenesses import CLEARLY, Likenesses
from scanfind.recognition.telling import Telling
from scanfind.recognition.weighing import Weighing
from scanfind.search.hypotheses import Hypotheses, joined, model_arrays
from scanfind.search.lines import LineSearch
from scanfind.search.surface import Search

if TYPE_CHECKING:
    from scanfind.fit.refine import Refined
    from scanfind.grid.scene import Scene
    from scanfind.library.model import Model
    from scanfind.parameters import Parameters
    from scanfind.recognition.in_place import Asked

Floats = NDArray[np.float64]

# Without scanner positions: a second instance shows at least this much of what the best one shows (another spool in a
# shop: 0.61).
BLIND_SHARE = 0.7
NAMED = 5  # models in a note
# A score that none of the poses a model could be taken for reaches: of 218 wrong poses in shops one was above 0.96, of
# 128 right ones in shops sparse or with half of the object gone 60.
SURE = 0.98
# A score that no twin reaches in another's place: of 240 instances in plants five were so well explained by a twin that
# it would be believed, at up to 0.994.
SURE_OF_NAME = 0.998


class Recognition:
    """The state of one search: what is believed so far, what was refused and why.

    Poses are drawn (`search`), fitted (`fitting`) and weighed (`weighing`) here; what is told of them is told by
    `telling`.

    believed : what holds so far; by_design : of that, what was found by trying where the design puts it
    """

    def __init__(
        self, scene: Scene, models: Sequence[Model], parameters: Parameters, seed: int, jobs: int,
        standing: Sequence[Standing] = (), asked: Asked | None = None, learnt: Sequence[float] = (),
    ) -> None:  # fmt: skip
        """Take a scene; standing : instances of larger models; asked, learnt : see `find.recognise`."""
        self.ground = ground = Ground(scene, models, model_arrays(models), parameters, jobs)
        self.search = Search(scene, models, ground.arrays, parameters.search, seed, jobs, learnt, parameters.priors)
        self.weighing = Weighing(ground, self.search.pool.telling(), asked.shadows if asked else None)
        self.fitting = Fitting(ground, self.weighing)
        view = View(scene, self.weighing.fine, self.weighing.thin, ground.signed, parameters.verify)
        assemblies = Assemblies(models, view, parameters.assembly, ground.blind)
        self.telling = Telling(ground, assemblies)
        self._likenesses = Likenesses(models, parameters.verify.alternatives)
        self._by_parts = ByParts(ground, assemblies, self.fitting.apart)
        self._asked = asked
        self._in_place = InPlace(ground, self.fitting, self.weighing, asked or NOTHING, standing)
        # What surface found elsewhere need not be looked for by lines here.
        self._by_lines = np.array([not share for share in learnt or [0.0] * len(models)])
        self._seed, self._standing = seed, standing
        self.believed: list[Candidate] = []
        self.by_design: list[Candidate] = []
        self._refused: list[tuple[Candidate, str]] = []
        self._ran_out_of_time = False
        self._of_lines = self._lines_find = False  # the last round was of lines; it found something
        expected = parameters.priors.expected([model.name for model in models])
        self._expected = np.array([expected.get(model.name, 0) for model in models])
        self._wanted = np.where(self._expected > 0, self._expected, np.iinfo(np.int64).max)

    @property
    def models(self) -> Sequence[Model]:
        """The models sought."""
        return self.ground.models

    def wants_more(self, seconds: float) -> bool:
        """Is another round worth it: time left, instances wanted, and the chance of having missed one too high?"""
        limits = self.ground.parameters.search
        if limits.time_limit_s is not None and seconds >= limits.time_limit_s:
            self._ran_out_of_time = self.search.served.chance_missed() > limits.miss_probability > 0.0
            return False
        if limits.miss_probability <= 0.0:
            return self.search.pool_left()
        enough = limits.max_instances is not None and self._found().sum() >= limits.max_instances
        if enough:
            return False
        # With less to show than is expected, rather a longer search than an answer that the next seed contradicts.
        short = not self.believed or self._fewer_than_expected()
        if self._lines_find or not self.search.may_stop() or (short and (self._untried() or self.search.look_deeper())):
            return True
        return self._fewer_than_expected() and limits.time_limit_s is not None and self.search.pool_left()

    def _fewer_than_expected(self) -> bool:
        """Are more instances of some model known to be there than were found?"""
        return bool((self._found() < self._expected).any())

    def _found(self) -> NDArray[np.intp]:
        """How many instances of each model are believed, (models,)."""
        return np.bincount([candidate.model for candidate in self.reported()], minlength=len(self.models))

    def reported(self) -> list[Candidate]:
        """What is believed and lies in the region; the others claim what is theirs of it."""
        middles, holds = self.ground.arrays.centres, self.ground.parameters.priors.holds
        return [c for c in self.believed if holds(self.ground.in_scans(c.pose()).move(middles[c.model][None])[0])]

    def _untried(self) -> bool:
        """Are lines still to be asked?"""
        return self.ground.parameters.search.by_lines and self.weighing.lines is None and bool(self._by_lines.any())

    def round(self) -> Hypotheses:
        """Hypotheses of one more round, best first: of pairs of surface; for models of which the first round of these
        found nothing, of lines, once and again as long as these find something.
        """
        self._of_lines = self._lines_find or (
            self._untried() and bool(self.search.choices or not self.search.pool_left())
        )
        if self._lines_find and self.weighing.lines:
            return self._elsewhere(self.weighing.lines.round())
        if self._of_lines:
            ground, wanted = self.ground, self._by_lines & (self._found() == 0)
            lines = LineSearch(
                ground.scene, self.models, wanted, ground.parameters.search, self._seed, ground.jobs,
                ground.parameters.priors,
            )  # fmt: skip
            self.weighing.lines = lines
            self.fitting.look_again()
            if lines:
                # What was refused for telling too little may be told by its lines.
                again = [ground.placements(c.model, [c.pose()]) for c, _ in self._refused]
                self.search.served.lines_asked(lines.told(len(self.models)))
                return joined([*again, lines.round()])
            self._of_lines = False
        return self.search.round()

    def _elsewhere(self, hypotheses: Hypotheses) -> Hypotheses:
        """Those that do not lead to what is believed: lines are drawn from all of it, surface from what is left."""
        led = np.zeros(len(hypotheses.models), np.bool_)
        for candidate in self.believed:
            led |= self._lead_to(hypotheses, candidate)
        return hypotheses.take(np.flatnonzero(~led))

    def at_design(self) -> Iterator[Hypotheses]:
        """The poses the design gives, some of each model at a time; none where none is asked for.

        From here on as many instances of each model are wanted as the design has.
        """
        if self._asked:
            self._wanted = self._in_place.wanted()
            self.search.served.wanted = self._wanted > 0
            yield from self._in_place.hypotheses()

    def progress(self) -> float:
        """How far the search has come, 0 … 1: the log of the chance to have missed something, as against its limit."""
        limit = self.ground.parameters.search.miss_probability
        if limit <= 0.0:
            return 0.0
        return min(1.0, log(max(self.search.served.chance_missed(), limit)) / log(limit))

    def refine(self, hypotheses: Hypotheses) -> Refined:
        """The best of a round's hypotheses, fitted."""
        return self.fitting.refine(hypotheses)

    def refine_in_place(self, hypotheses: Hypotheses) -> Refined:
        """Poses the design gives, as they are, then each fitted."""
        return self._in_place.refine(hypotheses)

    def believe_in_place(self, refined: Refined) -> None:
        """Of poses the design gives, as `refine_in_place` leaves them, believe what holds there."""
        fresh, refused = self._in_place.believe(refined, self.believed)
        self.believed += fresh
        self.by_design += fresh
        self._refused += refused
        self._settled(Claims(self.ground, self.believed))

    def believe(self, hypotheses: Hypotheses, refined: Refined) -> None:
        """Accept what the evidence carries; of poses that claim one surface, the one that explains most of it.

        Papazov & Burschka's conflict graph, solved greedily by the surface a pose explains.

        hypotheses : of the round, to learn how often an instance is hit
        refined : what became of the best of them, see `refine`
        """
        ground, settled = self.ground, {id(candidate) for candidate in self.believed}
        fresh, refused = list[Candidate](), []
        for candidate in self.weighing.candidates(refined):
            if known := ground.why_not_allowed(candidate):
                self._refused.append((candidate, known))
            elif reason := ground.why_refused(candidate):
                refused.append((candidate, reason))
            else:
                fresh.append(candidate)
        if ground.parameters.assembly.parts:
            fresh += self._by_parts.explained([candidate for candidate, _ in refused], [*self.believed, *fresh])
        self._refused += refused
        claims, believed = Claims(ground), list[Candidate]()
        for candidate in sorted([*self.believed, *fresh], key=lambda c: (not c.in_place, -c.area)):
            free = candidate.in_place  # what adjoins it by design may share its surface
            if not free and (claims.hold(candidate) or stands_elsewhere(candidate, self._standing, ground)):
                self._refused.append((candidate, OUTWEIGHED))
                continue
            best = candidate
            if id(candidate) not in settled:
                best = self._best_of_similar(candidate)
                if best is not candidate and claims.hold(best):
                    continue  # turned over, or of another model, it is one we have
                hits = self._hits(hypotheses, best)
                self.search.learn(best.model, hits, best.evidence.support(), by_lines=self._of_lines)
            believed.append(best)
            claims.add(best)
        self.believed = self._shown_alike(believed) if ground.blind else believed
        changed = {id(candidate) for candidate in self.believed} != settled
        if changed:
            self.fitting.look_again()
        self._lines_find = self._of_lines and changed
        self._settled(claims)

    def _settled(self, claims: Claims) -> None:
        """Where what is believed claims the surface nothing more is drawn."""
        self._refused = closest(self._refused)
        self.search.served.wanted = self._found() < self._wanted
        self.search.withdraw(claims.marked[self.ground.scene.fine.cells.rows])

    def _shown_alike(self, believed: Sequence[Candidate]) -> list[Candidate]:
        """Of each model those that show nearly as much of themselves as the best one: where free space says nothing, a
        part that resembles the model lies on the scan with half of its samples, as one half hidden would.
        """
        most = {c.model: 0.0 for c in believed}
        for candidate in believed:
            most[candidate.model] = max(most[candidate.model], candidate.evidence.support())
        alike = [c for c in believed if c.evidence.support() >= BLIND_SHARE * most[c.model]]
        kept = {id(c) for c in alike}
        self._refused.extend((c, SHOWS_LESS) for c in believed if id(c) not in kept)
        return alike

    def _hits(self, hypotheses: Hypotheses, found: Candidate) -> int:
        """How many of a round's hypotheses lead to a pose."""
        return int(np.count_nonzero(self._lead_to(hypotheses, found)))

    def _lead_to(self, hypotheses: Hypotheses, found: Candidate) -> NDArray[np.bool_]:
        """Which hypotheses lead to a pose, or to one that looks the same or could be taken for it, (H,)."""
        placed, model = found.pose(), self.models[found.model]
        lead: NDArray[np.bool_] = hypotheses.models == found.model
        motions = [*model.symmetry.motions(), *self._likenesses.of_itself(found.model)]
        poses = [placed @ motion for motion in motions]
        theirs = outlines(self.ground.placements(found.model, poses), self.ground.arrays)
        mine = outlines(hypotheses.take(np.flatnonzero(lead)), self.ground.arrays)
        lead[lead] = nearest(mine, theirs) < self.fitting.drawn_in[found.model]
        return lead

    def _best_of_similar(self, candidate: Candidate) -> Candidate:
        """The best of a pose and of those it could be taken for, each refined again: the model turned over onto itself,
        or another one in its place that explains clearly more.
        """
        placed, number, wanted = candidate.pose(), candidate.model, self.search.served.wanted
        tried = {}
        if candidate.score < SURE:
            tried[number] = self._likenesses.of_itself(number)
        if candidate.score < SURE_OF_NAME:
            others = self._likenesses.of_others(number)
            tried |= {other: motions for other, motions in others.items() if wanted[other]}
        ways = [self.ground.placements(k, [placed @ motion for motion in some]) for k, some in tried.items() if some]
        if not ways:
            return candidate
        met = self.fitting.coarse(joined(ways)).hypotheses
        refined = self.fitting.fine(met.take(self.weighing.promising(met, 0)))
        sound = [c for c in self.weighing.candidates(refined) if not self.ground.why_not_believed(c)]
        best = max([candidate, *(c for c in sound if c.model == number)], key=lambda c: c.area)
        return max([best, *(c for c in sound if c.area > CLEARLY * best.area)], key=lambda c: c.area)

    def reach(self) -> float:
        """How far from its surface points of an instance may lie, metres."""
        return self.weighing.fine.inlier

    def refused(self) -> list[Refused]:
        """What came closest of each model and why it was not believed."""
        reported = {id(c) for c in self.reported()}
        refused = [*self._refused, *((c, OUTSIDE) for c in self.believed if id(c) not in reported)]
        return [
            Refused(
                self.models[c.model].name, self.telling.pose(c), c.score, c.evidence.support(),
                c.evidence.visible_support(), c.evidence.penalty(), reason, rival := self.rival(c),
                self.ground.probability(c, rival, outweighed=reason in FOR_ANOTHER or not isnan(rival)),
            )
            for c, reason in refused
        ]  # fmt: skip

    def rival(self, candidate: Candidate) -> float:
        """The best score among other poses of the same surface, NaN where there is none: of one that is believed those
        refused in its favour, of one refused those believed.
        """
        believed = any(one is candidate for one in self.believed)
        others = [c for c, reason in self._refused if reason in FOR_ANOTHER] if believed else self.believed
        return max((c.score for c in others if self._rivals(c, candidate)), default=nan)

    def _rivals(self, one: Candidate, other: Candidate) -> bool:
        """Do two poses that are not one share more of their surface than two instances may?"""
        if one.model == other.model and self.ground.apart(one, other) < self.fitting.apart[one.model]:
            return False
        mine, theirs = one.evidence.claims, other.evidence.claims
        common = len(np.intersect1d(mine, theirs, assume_unique=True))
        return common > self.ground.parameters.verify.shared * max(1, min(len(mine), len(theirs)))

    def noise(self) -> float:
        """Spread of the raw points about the surfels that support what was found (or about all), metres."""
        claims, scene = [c.evidence.claims for c in self.believed], self.ground.scene
        if not claims:
            return scene.noise
        # Their flatter quarter: edges and bends spread the points of most surfels of a part as well.
        return max(float(np.quantile(scene.fine.flatness[np.concatenate(claims)], 0.25)), 0.5 * scene.noise)

    def notes(self) -> list[str]:
        """What a user should know about how far the answer may be trusted."""
        told = []
        if self.ground.blind:
            told.append("no scanner position is known, so free space says nothing: give --origin X,Y,Z if you know it")
        if self.ground.scene.unaddressable:
            told.append(f"{self.ground.scene.unaddressable} points lie too far from the rest and were left out")
        if self._ran_out_of_time:
            chance = self.search.served.chance_missed()
            told.append(f"the time limit ended the search; an instance may have been missed with chance {chance:.0%}")
        elif too_little := [self.models[k].name for k in np.flatnonzero(self.search.served.unserved()).tolist()]:
            some = ", ".join(too_little[:NAMED]) + (" …" if len(too_little) > NAMED else "")
            told.append(f"the scan shows too little of parts of their size to be sure that none was missed: {some}")
        return told
