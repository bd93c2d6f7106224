"""From hypotheses to detections: refine, weigh the evidence, settle who may claim which surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from math import ceil, log
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly import Assemblies, Explained, View
from scanfind.design.elements import LEAST_LOOKED_AT, Element, assigned, elements_of, open_slide, placements_of, said_by
from scanfind.detection import Detection, Motion, Refused
from scanfind.evidence.ends import slid
from scanfind.evidence.free_space import Design, Limits, Spoken, caster_of, spoken_by_each, towards
from scanfind.evidence.rays import RayCaster
from scanfind.evidence.verify import (
    Evidence,
    Level,
    distances,
    distinct,
    gather_rough,
    gather_support,
    nearest,
    outlines,
    rough_score,
    score,
    why_refused,
)
from scanfind.fit.polish import polish
from scanfind.fit.refine import Refined, covariance_of, held, icp, shrinking, triple, unobservable
from scanfind.library.near_surface import near_model, signed_distances
from scanfind.pose import Pose
from scanfind.priors.allowed import OUTSIDE, why_not
from scanfind.recognition.swaps import GAIN, explained, looked_at, onto, pairs_alike
from scanfind.search.hypotheses import Hypotheses, joined, model_arrays
from scanfind.search.lines import LineSearch
from scanfind.search.surface import Search

if TYPE_CHECKING:
    from scanfind.grid.scene import Scene
    from scanfind.grid.surfels import Surfels
    from scanfind.kernels.distance import NearSurface
    from scanfind.library import JointTable
    from scanfind.library.model import Model
    from scanfind.mesh import Placement
    from scanfind.parameters import Parameters

Floats = NDArray[np.float64]

BATCHES = 3  # of hypotheses refined a round, each far from where those before it went
CLAIM_CELLS = 2  # a detection claims the surfels up to so many cells around those that support its samples
# Without scanner positions: a second instance shows at least this much of what the best one shows (another spool in a
# shop: 0.61).
BLIND_SHARE = 0.7
DRIFT_CELLS = 3  # of a gate of one cell, and two that a pose may still move after the coarse steps
ALL_SAMPLES = 1 << 30
# Share of the score asked for that the evidence on the coarse surfels must reach: there 400 samples tell the final
# score of a shop's 96 best poses within 0.2.
PROMISING = 0.67
# A score that none of the poses a model could be taken for reaches: of 218 wrong poses in shops one was above 0.96, of
# 128 right ones in shops sparse or with half of the object gone 60.
SURE = 0.98
NET_PENALTY = 2.0
WEARY = 12  # poses of a model tried in parts, from which on only what comes closer than any of these is tried
DRAWN_IN_CELLS = (2.0, 0.75)  # of the largest: how far off its design an element is met at once …
FARTHER_IF = 1.2  # … where so many more of its samples meet the scan there than about the design
# Where an element that is not in its place is looked for beside it, across its length; and how far off it then may be.
AROUND_M, AROUND_MOST_M = (-0.04, 0.0, 0.04), 0.12
IN_PLACE_M = 0.06  # what ICP carried no farther off is still where the design puts it
ON_BEAMS_CELLS, ON_BEAMS_STEPS = 1.5, 2  # how near the surface beams end that a pose is fitted to, and how often
TOLD_BY_LINES = 12  # poses that these speak for, refined whatever the coarse surfels say
EDGE_INLIERS = 2.0  # a laser's spot is a centimetre wide at 10 m: nearer to the outline some of it went past
ALONG = 0.95  # cosine between a slide and one that is the same
REFUSED_SHOWN = 3  # of each model: what came closest


class Candidate(NamedTuple):
    """A refined pose with what the scene says of it.

    model : its number among those sought
    rotation, translation : (3, 3), (3,) scene_from_model, relative to the grid's offset
    hessian, rms : (6, 6) of ICP and what it left, metres, see Refined
    score : 0 … 1; area : supported surface, counted by how much it tells, less what was seen through, m²: by it
        conflicting poses are ranked
    whole : its parts, where they were fitted: of a pose that is believed by them alone
    in_place : the design puts it there; what adjoins it by design may share its surface
    instead_of : the element in whose place it stands, where the two were swapped
    """

    model: int
    rotation: Floats
    translation: Floats
    hessian: Floats
    rms: float
    evidence: Evidence
    score: float
    area: float
    whole: Explained | None = None
    in_place: bool = False
    instead_of: Placement | None = None


class Standing(NamedTuple):
    """An instance found by an earlier search, whose surface is taken: asked for distances up to its reach."""

    surface: NearSurface
    scene_from_model: Pose


class Recognition:
    """The state of one search: what is believed so far, what was refused and why."""

    def __init__(
        self, scene: Scene, models: Sequence[Model], table: JointTable, parameters: Parameters, seed: int, jobs: int,
        standing: Sequence[Standing] = (), design: Design | None = None, learnt: Sequence[float] = (),
    ) -> None:  # fmt: skip
        self.scene, self.models, self.parameters, self.jobs = scene, models, parameters, jobs
        self.arrays = model_arrays(models)
        self.search = Search(
            scene, models, table, self.arrays, parameters.search, seed, jobs, learnt, parameters.priors
        )
        fine, coarse = self.search.telling()
        inlier = parameters.verify.inlier_noises * scene.noise
        inliers = [inlier + parameters.verify.inlier_cells * level.cell for level in (scene.fine, scene.coarse)]
        self._lines: LineSearch | None = None
        # What surface found elsewhere need not be looked for by lines here.
        self._by_lines = np.array([not share for share in learnt or [0.0] * len(models)])
        self._seed = seed
        self._fine = Level(scene.fine, fine, ALL_SAMPLES, inliers[0])
        self._thin = Level(scene.coarse, coarse, ALL_SAMPLES, inliers[0])
        self._rough = Level(scene.coarse, coarse, parameters.refine.coarse_samples, inliers[1])
        self.signed = scene.fine.signed and all(model.signed for model in models)
        self.blind = not scene.depths
        self.believed: list[Candidate] = []
        self._refused: list[tuple[Candidate, str]] = []
        self._standing = standing
        self._ran_out_of_time = False
        expected = parameters.priors.expected([model.name for model in models])
        self._expected = np.array([expected.get(model.name, 0) for model in models])
        self._wanted = np.where(self._expected > 0, self._expected, np.iinfo(np.int64).max)
        diameters = np.array([model.diameter for model in models])
        # Poses closer than a thirtieth of the diameter meet in one ICP; after it a hundredth tells them apart.
        self._apart_before, self._apart_after = diameters / 30.0, diameters / 100.0
        self._the_same = diameters / 1000.0
        self._drawn_in = diameters / 10.0
        self._casters: dict[int, RayCaster] = {}
        self._places: list[Placement] = []
        self._design = design
        self._near: dict[int, NearSurface] = {}
        view = View(scene, self._fine, self._thin, self.signed, parameters.verify)
        self._assemblies = Assemblies(models, view, parameters.assembly, self.blind)
        self._tried_in_parts: list[Candidate] = []
        self._in_parts: dict[int, tuple[int, Explained]] = {}

    def wants_more(self, seconds: float) -> bool:
        """Is another round worth it: time left, instances wanted, and the chance of having missed one too high?"""
        limits = self.parameters.search
        if limits.time_limit_s is not None and seconds >= limits.time_limit_s:
            self._ran_out_of_time = self.search.chance_missed() > limits.miss_probability > 0.0
            return False
        if limits.miss_probability <= 0.0:
            return self.search.pool_left()
        enough = limits.max_instances is not None and self._found().sum() >= limits.max_instances
        if enough:
            return False
        # With less to show than is expected, rather a longer search than an answer that the next seed contradicts.
        short = not self.believed or self._fewer_than_expected()
        if not self.search.may_stop() or (short and (self._untried() or self.search.look_deeper())):
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
        middles, holds = self.arrays.centres, self.parameters.priors.holds
        return [c for c in self.believed if holds(self.pose_of(c).move(middles[c.model][None])[0])]

    def _untried(self) -> bool:
        """Are lines still to be asked?"""
        return self.parameters.search.by_lines and self._lines is None and bool(self._by_lines.any())

    def round(self) -> Hypotheses:
        """Hypotheses of one more round, best first: of pairs of surface; once, for models of which the first round of
        these found nothing, of lines.
        """
        if self._untried() and (self.search.rounds or not self.search.pool_left()):
            limits, priors, wanted = (
                self.parameters.search,
                self.parameters.priors,
                self._by_lines & (self._found() == 0),
            )
            self._lines = LineSearch(self.scene, self.models, wanted, limits, self._seed, self.jobs, priors)
            if self._lines:
                # What was refused for telling too little may be told by its lines.
                again = [self._placements(c.model, [Pose(c.rotation, c.translation)]) for c, _ in self._refused]
                return joined([*again, self._lines.round()])
        return self.search.round()

    def at_design(self) -> Iterator[Hypotheses]:
        """The poses the design gives, so many of each model at a time as one refinement takes.

        From here on as many instances of each model are wanted as the design has.
        """
        offset, kept = self.scene.fine.cells.offset, self.parameters.search.kept
        designs = [[each.design_from_model for each in placements_of(model)] for model in self.models]
        self._wanted = np.array([len(poses) for poses in designs])
        for start in range(0, int(self._wanted.max()), kept):
            placed = [
                self._placements(number, [Pose(each.rotation, each.translation - offset) for each in some])
                for number, poses in enumerate(designs)
                if (some := poses[start : start + kept])
            ]
            self._places = [each for model in self.models for each in placements_of(model)[start : start + kept]]
            yield joined(placed)

    def progress(self) -> float:
        """How far the search has come, 0 … 1: the log of the chance to have missed something, as against its limit."""
        limit = self.parameters.search.miss_probability
        if limit <= 0.0:
            return 0.0
        return min(1.0, log(max(self.search.chance_missed(), limit)) / log(limit))

    def refine(self, hypotheses: Hypotheses) -> Refined:
        """ICP of what is distinct among the hypotheses on the coarse surfels; of what these do not refute, the fine."""
        kept, met = self.parameters.search.kept, None
        rough: list[Refined] = []
        for _ in range(BATCHES):
            # One good instance passes the test hundreds of times: those poses must not use up the place of the others.
            batch = hypotheses.take(distinct(hypotheses, self.arrays, self._apart_before, kept, 4 * kept, met))
            if not len(batch.models):
                break
            rough.append(self._icp_coarse(batch))
            met = joined([r.hypotheses for r in rough])
            hypotheses = hypotheses.take(self._far_from(hypotheses, met))
        if met is None:
            return self._icp_fine(hypotheses)
        better = met.take(np.argsort(-np.concatenate([r.matched for r in rough]), kind="stable"))
        better = better.take(distinct(better, self.arrays, self._apart_after, kept, 2 * kept))
        fine = self._icp_fine(better.take(self._promising(better, REFUSED_SHOWN)))
        if self._lines and self.parameters.refine.raw_steps:
            fine = self._on_beams(fine, self._lines.beyond_chance(fine.hypotheses) > 0.0)
        fine = fine.take(np.argsort(-fine.matched, kind="stable"))
        # What ended at one place is asked once.
        return fine.take(distinct(fine.hypotheses, self.arrays, self._the_same, kept, 2 * kept))

    def refine_in_place(self, hypotheses: Hypotheses) -> Refined:
        """Poses the design gives, as they are; then each after ICP, drawn in from farther away where that meets more.

        Along what the scan hardly fixes ICP may carry an element off to where its neighbours begin: it is held back.
        """
        refine, around = self.parameters.refine, self.scene.around
        gates = shrinking(DRAWN_IN_CELLS, refine.coarse_iterations, around.cell)
        near, far = self._icp_coarse(hypotheses), self._icp(hypotheses, around, gates, refine.coarse_samples)
        far = self._icp_coarse(far.hypotheses)
        farther = far.matched > FARTHER_IF * near.matched
        start = joined([near.hypotheses, far.hypotheses]).take(np.arange(len(farther)) + len(farther) * farther)
        found = self._icp_fine(start)
        self._hold(found, hypotheses)
        both = joined([hypotheses, found.hypotheses])
        return Refined(both, np.tile(found.hessians, (2, 1, 1)), np.tile(found.matched, 2), np.tile(found.rms, 2))

    def _hold(self, found: Refined, designs: Hypotheses) -> None:
        """Draw refined poses back to their designs along what the scan hardly fixes."""
        for k, number in enumerate(designs.models):
            design, pose = (Pose(h.rotations[k], h.translations[k]) for h in (designs, found.hypotheses))
            pose = held(design, pose, found.hessians[k], self.arrays.centres[number], float(self.arrays.radii[number]))
            found.hypotheses.rotations[k], found.hypotheses.translations[k] = pose.rotation, pose.translation

    def _around(self, asked: Candidate) -> Candidate:
        """The best of poses that ICP reaches from beside the design's, across its length, held as that one is.

        What is thinner than it was moved is not drawn in from there: a plate of 8 mm that stands 60 mm off has
        other surfaces nearer to its place than its own.
        """
        points, pose = self.models[asked.model].samples.points, Pose(asked.rotation, asked.translation)
        across = pose.turn(np.eye(3)[np.argsort(np.ptp(points, axis=0), kind="stable")[:2]])
        shifts = [one * across[0] + other * across[1] for one in AROUND_M for other in AROUND_M if one or other]
        starts = self._placements(asked.model, [Pose(pose.rotation, pose.translation + shift) for shift in shifts])
        found = self._icp_fine(self._icp_coarse(starts).hypotheses)
        self._hold(found, self._placements(asked.model, [pose] * len(shifts)))
        return max([asked, *self.candidates(found, in_place=True)], key=lambda candidate: candidate.score)

    def _on_beams(self, refined: Refined, some: NDArray[np.bool_]) -> Refined:
        """Refined poses, some of them (H,) fitted to where beams ended that went towards them.

        Where cells are too empty for normals ICP ends within half a cell; held against the model's own faces the beams
        themselves bring that to a millimetre, in ten milliseconds.
        """
        found = refined.hypotheses
        for k in np.flatnonzero(some):
            number = int(found.models[k])
            if number not in self._near:
                self._near[number] = near_model(self.models[number], ON_BEAMS_CELLS * self.scene.fine.cell)
            pose = Pose(found.rotations[k], found.translations[k])
            for _ in range(ON_BEAMS_STEPS):
                ends = towards(self.models[number], pose, self.scene.beams).ends()
                fitted = polish(self._near[number], pose, ends, np.zeros(len(ends), np.int64), self.parameters.refine)
                pose = fitted.scene_from_model if fitted else pose
            found.rotations[k], found.translations[k] = pose.rotation, pose.translation
        return refined

    def _promising(self, hypotheses: Hypotheses, shown: int) -> NDArray[np.intp]:
        """Those whose evidence on the coarse surfels is not hopeless, and the best `shown` of each model (indices)."""
        verify = self.parameters.verify
        rough = gather_rough(hypotheses, self.scene, self._rough, self.arrays, self.signed, verify, self.jobs)
        scores = np.array([rough_score(seen, self.blind) for seen in rough])
        kept = scores >= PROMISING * verify.min_score
        for model in np.unique(hypotheses.models):
            theirs = np.flatnonzero(hypotheses.models == model)
            kept[theirs[np.argsort(-scores[theirs], kind="stable")[:shown]]] = True
        if self._lines:
            # A pose on lines is half a cell off until it is fitted to beams, and looks worse than it is.
            told = self._lines.beyond_chance(hypotheses)
            best = np.argsort(-told, kind="stable")[:TOLD_BY_LINES]
            kept[best[told[best] > 0.0]] = True
        return np.flatnonzero(kept)

    def _far_from(self, hypotheses: Hypotheses, met: Hypotheses) -> NDArray[np.intp]:
        """The hypotheses that would not be drawn to where those in `met` went already (indices)."""
        theirs, placed = outlines(met, self.arrays), outlines(hypotheses, self.arrays)
        far = np.ones(len(placed), np.bool_)
        for model in np.unique(hypotheses.models):
            mine = hypotheses.models == model
            far[mine] = nearest(placed[mine], theirs[met.models == model]) >= self._drawn_in[model]
        return np.flatnonzero(far)

    def _icp_coarse(self, hypotheses: Hypotheses) -> Refined:
        refine, coarse = self.parameters.refine, self.scene.coarse
        gates = shrinking(refine.coarse_gates, refine.coarse_iterations, coarse.cell)
        return self._icp(hypotheses, coarse, gates, refine.coarse_samples)

    def _icp_fine(self, hypotheses: Hypotheses) -> Refined:
        refine, fine = self.parameters.refine, self.scene.fine
        self._fit_near(hypotheses, DRIFT_CELLS)
        gates = shrinking(refine.fine_gates, refine.fine_iterations, fine.cell)
        return self._icp(hypotheses, fine, gates, refine.fine_samples)

    def _icp(self, hypotheses: Hypotheses, surfels: Surfels, gates: Floats, most_samples: int) -> Refined:
        agreement = self.parameters.refine.normal_agreement
        return icp(hypotheses, surfels, self.arrays, self.signed, gates, most_samples, agreement, self.jobs)

    def _fit_near(self, hypotheses: Hypotheses, reach: int) -> None:
        """Fit the fine surfels up to `reach` cells from the placed samples of some poses."""
        placed, starts = [np.empty((0, 3))], self.arrays.starts
        for number, rotation, translation in zip(*hypotheses[:3], strict=True):
            samples = self.arrays.points[starts[number] : starts[number + 1]]
            placed.append(samples @ rotation.T + translation)
        near = self._no_rows()
        self._mark(np.concatenate(placed), reach, near)
        self.scene.fine.fit(near[self.scene.fine.cells.rows])

    def _no_rows(self) -> NDArray[np.bool_]:
        return np.zeros(len(self.scene.fine.sides), np.bool_)

    def candidates(self, refined: Refined, *, in_place: bool = False) -> list[Candidate]:
        """Refined poses with their evidence; in_place : of where the design puts the models."""
        self._fit_near(refined.hypotheses, ceil(self.parameters.verify.gate_cells))
        found = []
        for k, seen in enumerate(self._evidence(refined.hypotheses, in_place=in_place)):
            number = int(refined.hypotheses.models[k])
            # What a pose explains of the scene, in samples; what beams passed through counts double.
            net = (seen.telling - NET_PENALTY * seen.penalty()) * seen.samples
            found.append(
                Candidate(
                    number, refined.hypotheses.rotations[k], refined.hypotheses.translations[k], refined.hessians[k],
                    float(refined.rms[k]), seen, score(seen, self.blind, self.parameters.verify, in_place=in_place),
                    net * self.models[number].area_of_a_sample(), in_place=in_place,
                )
            )  # fmt: skip
        return found

    def _evidence(self, hypotheses: Hypotheses, *, in_place: bool) -> list[Evidence]:
        """What surfels and beams say of poses near which the fine surfels are fitted; in_place : see `candidates`."""
        verify = self.parameters.verify
        support = gather_support(
            hypotheses, self.scene, self._fine, self._thin, self.arrays, self.signed, verify, self.jobs
        )  # fmt: skip
        lines = self._lines.beyond_chance(hypotheses) if self._lines else np.zeros(len(support))
        found = []
        for seen, on_lines, number, rotation, translation in zip(support, lines, *hypotheses[:3], strict=True):
            spoken = self._spoken_of(int(number), Pose(rotation, translation), in_place=in_place)
            rough = self.models[number].mesh is None
            found.append(Evidence(*seen[:-1], spoken, seen.claims, float(on_lines), rough))
        return found

    def _spoken_of(self, number: int, placed: Pose, *, in_place: bool = False) -> Spoken:
        """What beams say of a model at a pose relative to the grid's offset; in_place : see `candidates`."""
        return Spoken(*self._spoken_by_each(number, placed, in_place=in_place).sum(axis=0).tolist())

    def _spoken_by_each(self, number: int, placed: Pose, *, in_place: bool = False) -> Floats:
        """What the beams of each of S scanners say, rows as of Spoken, (S, 4)."""
        return spoken_by_each(
            self.models[number], self._caster(number), placed, self.scene.beams, self._limits(in_place=in_place),
            self._design if in_place else None, self.scene.fine.cells.offset,
        )  # fmt: skip

    def _limits(self, *, in_place: bool = False) -> Limits:
        """When a beam is on a surface, beside it, or through; in_place : see `candidates`."""
        verify, level = self.parameters.verify, self._fine
        edge = EDGE_INLIERS * level.inlier if in_place else 0.0
        return Limits(level.inlier, level.margin(verify), verify.least_facing, edge)

    def _caster(self, number: int) -> RayCaster:
        """The surface of a model, made ready for beams when first asked for."""
        if number not in self._casters:
            self._casters[number] = caster_of(self.models[number])
        return self._casters[number]

    def believe_in_place(self, refined: Refined) -> None:
        """Of poses the design gives, as `refine_in_place` leaves them, believe the better of each pair if it holds.

        What lies where the design puts it need not be of a telling shape, may adjoin others, and is not asked what else
        it could be taken for. What ICP carried away from there must stand as one found anywhere would.
        """
        found, verify, claimed = self.candidates(refined, in_place=True), self.parameters.verify, self._no_rows()
        elsewhere, missed = [], []
        asked_all, moved_all = found[: len(found) // 2], found[len(found) // 2 :]
        bests = [self._better_in_place(*pair) for pair in zip(moved_all, asked_all, strict=True)]
        swapped = {} if self.blind else self._swapped(bests)
        for k, (asked, best) in enumerate(zip(asked_all, bests, strict=True)):
            if k in swapped:
                self.believed.append(swapped[k])
            elif self._apart(best, asked) > IN_PLACE_M:
                elsewhere.append(best._replace(score=score(best.evidence, self.blind, verify), in_place=False))
            elif reason := self._why_not_in_place(best):
                self._refused.append((best, reason))
                missed.append(asked)
            else:
                self.believed.append(best)
        for candidate in self.believed:
            self._claim(candidate, claimed)
        for asked in missed if not self.blind else ():
            best = self._around(asked)
            near = self._apart(best, asked) < AROUND_MOST_M and not self._shares(best, claimed)
            if near and not self._why_not_in_place(best):
                self.believed.append(best)
                self._claim(best, claimed)
        for candidate in sorted(elsewhere, key=lambda c: -c.area):
            if reason := self._why_not_known(candidate) or why_refused(candidate.evidence, self.blind, verify):
                self._refused.append((candidate, reason))
            elif not self._shares(candidate, claimed):
                self.believed.append(candidate)
                self._claim(candidate, claimed)
        self._settled(claimed)

    def _better_in_place(self, moved: Candidate, asked: Candidate) -> Candidate:
        """Of a pose as the design gives it and as ICP leaves it the better; one carried off only if the other fails."""
        best = max(moved, asked, key=lambda candidate: candidate.score)
        return asked if self._apart(best, asked) > IN_PLACE_M and not self._why_not_in_place(asked) else best

    def _swapped(self, bests: Sequence[Candidate]) -> dict[int, Candidate]:
        """By number of the place what stands in it, where two elements stand in each other's.

        bests : of the place of each element, what the design has there, as it was found
        """
        alike, stand_ins, told = pairs_alike(self.models), {}, []
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
            if not found.keys() & instead.keys() and not any(map(self._why_not_in_place, instead.values())):
                found |= instead
        return found

    def _instead(self, stands: Candidate, model: int, place: Placement) -> Candidate:
        """Another model where one stands, the way round that beams speak for."""
        pose = Pose(stands.rotation, stands.translation)
        ways = [pose @ way for way in onto(self.models[model], self.models[stands.model])]
        best = max(ways, key=lambda way: explained(self._spoken_of(model, way)))
        start = self._placements(model, [best])
        refined = self._icp_fine(start)
        self._hold(refined, start)
        asked, found = (
            self.candidates(each, in_place=True)[0] for each in (refined._replace(hypotheses=start), refined)
        )
        better = asked if self._apart(found, asked) > IN_PLACE_M else found
        return better._replace(instead_of=place)

    def _why_not_in_place(self, candidate: Candidate) -> str:
        """Why an element is not believed to stand where the design puts it; empty where it is."""
        on, beside, through, _ = candidate.evidence.spoken
        enough = LEAST_LOOKED_AT * self.models[candidate.model].area
        if not self.blind and on + beside + through < enough:
            return "scanners looked at too little of it to be sure"
        return why_refused(candidate.evidence, self.blind, self.parameters.verify, in_place=True)

    def _apart(self, one: Candidate, other: Candidate) -> float:
        """How far the sample that two poses of one model part the most is from where it was, metres."""
        points = self.models[one.model].samples.points
        moved = points @ (one.rotation - other.rotation).T + one.translation - other.translation
        return float(np.linalg.norm(moved, axis=1).max())

    def believe(self, hypotheses: Hypotheses, refined: Refined) -> None:
        """Accept what the evidence carries; of poses that claim one surface, the one that explains most of it.

        Papazov & Burschka's conflict graph, solved greedily by the surface a pose explains.

        hypotheses : of the round, to learn how often an instance is hit
        refined : what became of the best of them, see `refine`
        """
        verify, settled = self.parameters.verify, {id(candidate) for candidate in self.believed}
        fresh, refused = [], []
        for candidate in self.candidates(refined):
            if known := self._why_not_known(candidate):
                self._refused.append((candidate, known))
            elif reason := why_refused(candidate.evidence, self.blind, verify):
                refused.append((candidate, reason))
            else:
                fresh.append(candidate)
        if self.parameters.assembly.parts:
            fresh += self._explained_by_parts([candidate for candidate, _ in refused], [*self.believed, *fresh])
        self._refused += refused
        claimed, believed = self._no_rows(), []
        for candidate in sorted([*self.believed, *fresh], key=lambda c: (not c.in_place, -c.area)):
            taken = not candidate.in_place and (self._shares(candidate, claimed) or self._stands_elsewhere(candidate))
            if taken:
                self._refused.append((candidate, "another pose explains more of the same surface"))
                continue
            best = candidate
            if id(candidate) not in settled:
                best = self._best_of_similar(candidate)
                if best is not candidate and self._shares(best, claimed):
                    continue  # turned over, it is one we have
                self.search.learn(best.model, self._hits(hypotheses, best), best.evidence.support())
            believed.append(best)
            self._claim(best, claimed)
        self.believed = self._shown_alike(believed) if self.blind else believed
        self._settled(claimed)

    def _settled(self, claimed: NDArray[np.bool_]) -> None:
        """What is believed claims these rows (…,): nothing more is drawn there."""
        self._refused = closest(self._refused)
        self.search.served(self._found() >= self._wanted)
        self.search.withdraw(claimed[self.scene.fine.cells.rows])

    def _explained_by_parts(self, refused: Sequence[Candidate], believed: Sequence[Candidate]) -> list[Candidate]:
        """Those among the best refused that, with each part where it is, the evidence carries."""
        limits, claimed, found = self.parameters.assembly, self._no_rows(), []
        for candidate in believed:
            self._claim(candidate, claimed)
        tried = dict.fromkeys(range(len(self.models)), 0)
        best = {model: max((c.score for c in self._tried_in_parts if c.model == model), default=0.0) for model in tried}
        weary = {model: sum(c.model == model for c in self._tried_in_parts) >= WEARY for model in tried}
        for candidate in sorted(refused, key=lambda c: -c.score):
            model = candidate.model
            if candidate.evidence.visible_support() < limits.least_visible or tried[model] >= limits.tried:
                continue
            if self._shares(candidate, claimed):
                continue
            if weary[model] and candidate.score <= best[model]:
                continue
            if any(other.model == model and self._coincide(candidate, other) for other in self._tried_in_parts):
                continue
            self._tried_in_parts.append(candidate)
            tried[model] += 1
            whole = self._assemblies.explain(model, Pose(candidate.rotation, candidate.translation))
            if whole is None or whole.reason:
                continue
            net = whole.evidence.telling - NET_PENALTY * whole.evidence.penalty()
            area = net * self.models[model].area
            found.append(
                candidate._replace(
                    rotation=whole.pose.rotation, translation=whole.pose.translation, evidence=whole.evidence,
                    score=score(whole.evidence, self.blind, self.parameters.verify), area=area, whole=whole,
                )
            )  # fmt: skip
            self._claim(found[-1], claimed)
        return found

    def _coincide(self, one: Candidate, other: Candidate) -> bool:
        """Are two poses of one model so near that the fit of parts would lead both to one place?"""
        here, there = (
            outlines(self._placements(c.model, [Pose(c.rotation, c.translation)]), self.arrays) for c in (one, other)
        )
        return bool(distances(here[0], there)[0] < self._apart_after[one.model])

    def _shown_alike(self, believed: Sequence[Candidate]) -> list[Candidate]:
        """Of each model those that show nearly as much of themselves as the best one: where free space says nothing, a
        part that resembles the model lies on the scan with half of its samples, as one half hidden would.
        """
        most = {c.model: 0.0 for c in believed}
        for candidate in believed:
            most[candidate.model] = max(most[candidate.model], candidate.evidence.support())
        alike = [c for c in believed if c.evidence.support() >= BLIND_SHARE * most[c.model]]
        kept = {id(c) for c in alike}
        reason = "much less of it lies on the scan than of another instance, and no free space is known to tell why"
        self._refused.extend((c, reason) for c in believed if id(c) not in kept)
        return alike

    def _claim(self, candidate: Candidate, claimed: NDArray[np.bool_]) -> None:
        """Mark the cells a pose claims: its samples are too few to name every cell of its surface themselves."""
        claims = candidate.evidence.claims
        if len(claims):
            self._mark(self.scene.fine.means[claims], CLAIM_CELLS, claimed)
        else:  # so sparse that coarse cells and lines speak alone
            samples = self.models[candidate.model].samples.points
            self._mark(samples @ candidate.rotation.T + candidate.translation, CLAIM_CELLS, claimed)

    def _mark(self, points: Floats, reach: int, marked: NDArray[np.bool_]) -> None:
        """Mark the rows of the fine cells up to `reach` cells from points (N, 3)."""
        from scanfind.kernels.nearest import mark_around, mark_rows

        at = self.scene.fine.cells
        layers = np.zeros((len(at.block_rows), 8), np.uint64)
        mark_around(points, reach, at.cell, at.hash_keys, at.hash_values, layers)
        mark_rows(at.order, layers, at.block_rows, marked)

    def _hits(self, hypotheses: Hypotheses, found: Candidate) -> int:
        """How many of a round's hypotheses lead to a pose, or to one that looks the same or could be taken for it."""
        placed, model = Pose(found.rotation, found.translation), self.models[found.model]
        motions = [*model.symmetry.motions(), *self._similar(found.model)]
        poses = [placed @ motion for motion in motions]
        theirs = outlines(self._placements(found.model, poses), self.arrays)
        mine = outlines(hypotheses.take(np.flatnonzero(hypotheses.models == found.model)), self.arrays)
        return int(np.count_nonzero(nearest(mine, theirs) < self._drawn_in[found.model]))

    def _placements(self, model: int, poses: Sequence[Pose]) -> Hypotheses:
        """Poses of one model as hypotheses."""
        count = len(poses)
        return Hypotheses(
            np.full(count, model), np.array([p.rotation for p in poses]), np.array([p.translation for p in poses]),
            np.ones(count),
        )  # fmt: skip

    def _shares(self, candidate: Candidate, claimed: NDArray[np.bool_]) -> bool:
        """Is too much of what supports a pose claimed by others already?"""
        claims: NDArray[Any] = self.scene.fine.cells.rows[self.scene.fine.cell_of[candidate.evidence.claims]]
        if not len(claims):
            claims = self._no_rows()
            self._claim(candidate, claims)
            if not claims.any():
                return True
        return bool(claimed[claims].mean() > self.parameters.verify.shared)

    def _stands_elsewhere(self, candidate: Candidate) -> bool:
        """Does too much of what supports a pose belong to an instance of a larger model?"""
        points = self.scene.fine.means[candidate.evidence.claims] + self.scene.fine.cells.offset
        return any(
            float(np.isfinite(signed_distances(one.surface, one.scene_from_model.inverse().move(points))[0]).mean())
            > self.parameters.verify.shared
            for one in self._standing
        )

    def _similar(self, model: int) -> list[Pose]:
        """The motions after which a model could be taken for itself. True symmetries are not tried: nothing tells."""
        return [each.motion for each in self.models[model].similar[: self.parameters.verify.alternatives]]

    def _best_of_similar(self, candidate: Candidate) -> Candidate:
        """The best of a pose and those it could be taken for: the model turned over onto itself, each refined again."""
        if candidate.score >= SURE:
            return candidate
        number = candidate.model
        placed = Pose(candidate.rotation, candidate.translation)
        others = [placed @ motion for motion in self._similar(number)]
        if not others:
            return candidate
        turned = self._placements(number, others)
        met = self._icp_coarse(turned).hypotheses
        refined = self._icp_fine(met.take(self._promising(met, 0)))
        verify, found = self.parameters.verify, self.candidates(refined)
        sound = [c for c in found if not (self._why_not_known(c) or why_refused(c.evidence, self.blind, verify))]
        return max([candidate, *sound], key=lambda c: c.area)

    def _why_not_known(self, candidate: Candidate) -> str:
        """Why what is known beforehand speaks against a pose, in words; empty where it does not."""
        return why_not(self.models[candidate.model], self.parameters.priors, self.pose_of(candidate))

    def detection(self, number: int, found: Candidate) -> Detection:
        """What is told of something believed, under a number, in the scans' own frame."""
        whole = found.whole
        if self.parameters.assembly.parts and whole is None:
            whole = self._assemblies.explain(found.model, Pose(found.rotation, found.translation), believed=True)
        if whole is not None:
            self._in_parts[number] = found.model, whole
            found = found._replace(rotation=whole.pose.rotation, translation=whole.pose.translation)
        # Of poses that look the same the one whose parts are told: turned over, each would have another's name.
        pose = self.pose_of(found) if whole else self._pose(found)
        seen, radius = found.evidence, float(self.arrays.radii[found.model])
        pivot = pose.move(self.arrays.centres[found.model][None])[0]
        below = self.parameters.refine.unobservable_below
        return Detection(
            id=number, model=self.models[found.model].name, scene_from_model=pose, score=found.score,
            support=seen.support(), visible_support=seen.visible_support(), penalty=seen.penalty(),
            coverage=seen.support(), rms_m=seen.rms, unobservable=self._unobservable(found),
            covariance=covariance_of(found.hessian, found.rms, radius, below) if np.isfinite(found.rms) else None,
            pivot=triple(pivot), instead_of=found.instead_of.name if found.instead_of else "",
            parts=whole.parts if whole else (),
        )  # fmt: skip

    def elements(self, number: int, detections: Sequence[Detection], stations: Floats) -> list[Element]:
        """What became of each element of the design that is of a model.

        detections : as they are reported; stations : where all of them stood, in order, (S, 3)
        """
        return elements_of(
            self.models[number], detections, lambda pose: self._said_at(number, pose), self._numbers(stations)
        )

    def at_its_ends(self, number: int, found: Detection, design: Pose) -> Detection:
        """A detection slid to where beams say its ends are, where its faces do not tell and they refute the design's.

        design : scene_from_model as the design has it, in the scans' own frame
        """
        model, placed = self.models[number], found.scene_from_model
        along = open_slide(model, found)
        if along is None or self.blind or found.parts or found.covariance is None or found.pivot is None:
            return found
        centre = model.symmetry.centre[None]
        alike = model.symmetry.nearest(design, placed.rotation)
        from_here = float((alike.move(centre) - placed.move(centre))[0] @ along)
        here = Pose(placed.rotation, placed.translation - self.scene.fine.cells.offset)
        told = slid(
            model, self._caster(number), here, along, from_here, self.scene.beams, self._limits(), self._design,
            self.scene.fine.cells.offset,
        )  # fmt: skip
        if told is None:
            return found
        step, covariance = told.by * along, found.covariance.copy()
        covariance[3:, 3:] += told.sigma**2 * np.outer(along, along)
        own = placed.rotation.T @ along
        others = [each for each in found.unobservable if each.kind != "slide" or abs(np.dot(each.axis, own)) < ALONG]
        return replace(
            found, scene_from_model=Pose(placed.rotation, placed.translation + step), covariance=covariance,
            pivot=triple(np.array(found.pivot) + step), slide=triple(along),
            unobservable=(*others, Motion("slide", triple(own), triple(centre[0]), told.sigma)),
        )  # fmt: skip

    def with_stations(self, number: int, found: Detection, stations: Floats) -> Detection:
        """A detection of a model with what each station says of it; stations : see `elements`."""
        said = self._said_at(number, found.scene_from_model)
        return replace(found, stations=said_by(said, self._numbers(stations)))

    def with_ends(self, number: int, detections: Sequence[Detection]) -> dict[int, Detection]:
        """By id the detections of a model that stand for an element, each `at_its_ends`."""
        model, places = self.models[number], placements_of(self.models[number])
        taken = assigned(model, places, [one for one in detections if one.model == model.name])
        return {one.id: self.at_its_ends(number, one, places[place].design_from_model) for place, one in taken.items()}

    def _said_at(self, number: int, pose: Pose) -> Floats:
        """What the beams of each scanner say of a model at a pose in the scans' own frame: see `_spoken_by_each`."""
        here = Pose(pose.rotation, pose.translation - self.scene.fine.cells.offset)
        return self._spoken_by_each(number, here, in_place=self._design is not None)

    def _numbers(self, stations: Floats) -> list[int]:
        """Of each scanner the number, from 1, of the station that stood where it did."""
        stood = [scanner.origin + self.scene.fine.cells.offset for scanner in self.scene.beams]
        return [1 + int(np.nanargmin(np.linalg.norm(stations - where, axis=1))) for where in stood]

    def reach(self) -> float:
        """How far from its surface points of an instance may lie, metres."""
        return self._fine.inlier

    def built(self) -> dict[int, Floats]:
        """By detection, where it was fitted in parts: its faces (F, 3, 3) as built, scan frame, metres."""
        offset = self.scene.fine.cells.offset
        return {k: self._assemblies.faces(*of) + offset for k, of in self._in_parts.items()}

    def measured(self, found: Detection, points: Floats | None) -> Detection:
        """A detection with its parts fitted to raw points (N, 3) around it, scan frame; None: it has no parts."""
        if points is None:
            return found
        model, whole = self._in_parts[found.id]
        offset = self.scene.fine.cells.offset
        whole = self._assemblies.measured(model, whole, points - offset)
        self._in_parts[found.id] = model, whole
        pose = Pose(whole.pose.rotation, whole.pose.translation + offset)
        return replace(found, scene_from_model=pose, parts=whole.parts)

    def _pose(self, found: Candidate) -> Pose:
        """In the scans' own frame; of the poses that look the same always one, however it was come by."""
        return self.models[found.model].symmetry.canonical(self.pose_of(found))

    def pose_of(self, found: Candidate) -> Pose:
        """In the scans' own frame, as it was come by."""
        return Pose(found.rotation, found.translation + self.scene.fine.cells.offset)

    def _unobservable(self, found: Candidate) -> tuple[Motion, ...]:
        """In the model's own axes."""
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = self._pose(found).rotation
        centre, radius = self.arrays.centres[found.model], float(self.arrays.radii[found.model])
        return unobservable(turn.T @ found.hessian @ turn, centre, radius, self.parameters.refine.unobservable_below)

    def refused(self) -> list[Refused]:
        """What came closest of each model and why it was not believed."""
        reported = {id(c) for c in self.reported()}
        return [
            Refused(
                self.models[c.model].name, self._pose(c), c.score, c.evidence.support(), c.evidence.visible_support(),
                c.evidence.penalty(), reason,
            )
            for c, reason in [*self._refused, *((c, OUTSIDE) for c in self.believed if id(c) not in reported)]
        ]  # fmt: skip

    def noise(self) -> float:
        """Spread of the raw points about the surfels that support what was found (or about all), metres."""
        claims = [c.evidence.claims for c in self.believed]
        if not claims:
            return self.scene.noise
        # Their flatter quarter: edges and bends spread the points of most surfels of a part as well.
        return max(float(np.quantile(self.scene.fine.flatness[np.concatenate(claims)], 0.25)), 0.5 * self.scene.noise)

    def notes(self) -> list[str]:
        """What a user should know about how far the answer may be trusted."""
        told = []
        if self.blind:
            told.append("no scanner position is known, so free space says nothing: give --origin X,Y,Z if you know it")
        if self.scene.unaddressable:
            told.append(f"{self.scene.unaddressable} points lie too far from the rest and were left out")
        if self._ran_out_of_time:
            chance = self.search.chance_missed()
            told.append(f"the time limit ended the search; an instance may have been missed with chance {chance:.0%}")
        return told


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


def closest(refused: list[tuple[Candidate, str]]) -> list[tuple[Candidate, str]]:
    """The best few of each model by score, most convincing first; of poses at nearly one place only the best."""
    kept: list[tuple[Candidate, str]] = []
    for candidate, reason in sorted(refused, key=lambda pair: (-pair[0].score, -pair[0].area)):
        same = [c for c, _ in kept if c.model == candidate.model]
        if len(same) < REFUSED_SHOWN and all(
            np.linalg.norm(c.translation - candidate.translation) > 1e-3
            or np.abs(c.rotation - candidate.rotation).max() > 1e-3
            for c in same
        ):
            kept.append((candidate, reason))
    return kept
