"""The objects one looks for: the paper's pipe spool and box frame, and spools that only look alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanfind.errors import InvalidGeometryError
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.equipment import FLANGE_OVER_PIPE, TOWARDS_X, flange_thickness, joint, valve
from scanfind.simulate.parts import SIDES, assemble, blocks, elbow, elbow_end, flange, pipe, tee, tee_branch

FRAME_SIZE_M = (3.5, 2.0, 2.0)
FRAME_MEMBER_M = 0.1
RIGHT_ANGLE = np.pi / 2
# Lengths of two spools differ by at least this somewhere; a recogniser that mixes them up has no excuse.
CLEARLY_DIFFERENT_M = 0.25


@dataclass(frozen=True)
class SpoolDesign:
    """The lengths of a spool that starts at a flange, runs along x, turns to y, and turns twice more. Metres.

    run : first leg, flange to the first elbow's start
    branch_at : middle of the upward branch on the first leg, from the flange
    rise : height of the upward branch's port above the first leg's axis
    across : second leg, along y
    outlet_at : middle of the side branch on the second leg, from its start
    back : last leg, turned by `turn` radians from the second
    """

    radius: float = 0.1
    branch_radius: float = 0.08
    run: float = 2.5
    branch_at: float = 0.9
    rise: float = 0.34
    across: float = 0.95
    outlet_at: float = 0.45
    back: float = 0.6
    turn: float = RIGHT_ANGLE


class Route:
    """Pipework laid piece by piece from an open end; `end` is where it goes on (spool_from_end, z leading on)."""

    def __init__(self, radius: float, start: Pose) -> None:
        self.radius = radius
        self.end = start
        self.placed: list[tuple[Mesh, Pose]] = []
        self.sides: list[Route] = []

    def _put(self, part: Mesh, part_end: Pose) -> None:
        self.placed.append((part, self.end))
        self.end = self.end @ part_end

    def straight(self, length: float) -> None:
        """Go on by `length`."""
        self._put(pipe(self.radius, length), _forward(length))

    def bend(self, angle: float, roll: float = 0.0) -> None:
        """Turn by `angle` towards this end's x, after a `roll` about the pipe; long-radius elbow (1.5 diameters)."""
        self.roll(roll)
        bend_radius = 3.0 * self.radius
        self._put(elbow(self.radius, bend_radius, angle), elbow_end(bend_radius, angle))

    def branch(self, radius: float, length: float, height: float, roll: float = 0.0) -> Route:
        """Put a tee of `length` that branches towards x after a `roll`; the branch is a route of its own."""
        self.roll(roll)
        side = Route(radius, self.end @ tee_branch(length, height))
        self._put(tee(self.radius, radius, length, height), _forward(length))
        self.sides.append(side)
        return side

    def all_placed(self) -> list[tuple[Mesh, Pose]]:
        """Its parts and those of its branches."""
        return [*self.placed, *(part for side in self.sides for part in side.all_placed())]

    def flange(self) -> None:
        """Close this end with a blind flange of usual proportions."""
        thickness = flange_thickness(self.radius)
        self._put(flange(self.radius, FLANGE_OVER_PIPE * self.radius, thickness), _forward(thickness))

    def joint(self) -> None:
        """A pair of flanges bolted together."""
        part, length = joint(self.radius)
        self._put(part, _forward(length))

    def valve(self, roll: float = 0.0) -> None:
        """A flanged gate valve, its handwheel towards this end's x after a `roll`."""
        self.roll(roll)
        part, length = valve(self.radius)
        self._put(part, _forward(length))

    def roll(self, angle: float) -> None:
        """Turn about the pipe; by whole facets only, or the corners of the next part would miss these."""
        facets = angle * SIDES / (2 * np.pi)
        if abs(facets - round(facets)) > 1e-9:
            msg = f"a roll must be a multiple of {360 / SIDES} degrees, got {np.degrees(angle):.3f}"
            raise InvalidGeometryError(msg)
        self.end = self.end @ Pose.from_rotation_vector([0.0, 0.0, angle])


def spool(name: str, design: SpoolDesign) -> Mesh:
    """A spool built to `design`, one closed surface; first leg's axis along +x from the origin, branch up (+z)."""
    lead = Route(design.radius, TOWARDS_X @ Pose.from_rotation_vector([np.pi, 0.0, 0.0]))
    lead.flange()
    main = Route(design.radius, TOWARDS_X)
    tee_length = 2.6 * design.radius

    main.straight(design.branch_at - tee_length / 2)
    up = main.branch(design.branch_radius, tee_length, 1.6 * design.radius, roll=np.pi)
    up.straight(design.rise - 1.6 * design.radius)
    up.flange()
    main.straight(design.run - design.branch_at - tee_length / 2)
    main.bend(RIGHT_ANGLE, roll=-RIGHT_ANGLE)
    main.straight(design.outlet_at - tee_length / 2)
    outlet = main.branch(design.branch_radius, tee_length, 1.6 * design.radius, roll=np.pi)
    outlet.straight(0.06)
    outlet.flange()
    main.straight(design.across - design.outlet_at - tee_length / 2)
    main.bend(design.turn, roll=np.pi)
    main.straight(design.back)
    main.flange()
    return assemble(name, [*lead.placed, *main.placed, *up.placed, *outlet.placed])


def pipe_spool(design: SpoolDesign | None = None) -> Mesh:
    """The paper's PS: a pipe spool of about 3 x 2 x 0.5 m."""
    return spool("pipe_spool", design or SpoolDesign())


def other_spool(rng: np.random.Generator, unlike: SpoolDesign | None = None, name: str = "other_spool") -> Mesh:
    """A spool of the same pipe whose legs and branches differ from `unlike` by at least CLEARLY_DIFFERENT_M each."""
    model = unlike or SpoolDesign()

    def other(length: float, low: float, high: float) -> float:
        while abs((drawn := float(rng.uniform(low, high))) - length) < CLEARLY_DIFFERENT_M:
            pass
        return drawn

    run, across = other(model.run, 1.0, 3.2), other(model.across, 0.5, 1.5)
    # Half a tee from either end is kept free; a leg too short for a branch elsewhere has it in its middle.
    half = 1.4 * model.radius
    return spool(
        name,
        SpoolDesign(
            radius=model.radius,
            branch_radius=model.branch_radius,
            run=run,
            branch_at=float(rng.uniform(half, run - half)),
            rise=float(rng.uniform(0.25, 0.7)),
            across=across,
            outlet_at=float(rng.uniform(half, across - half)),
            back=other(model.back, 0.1, 1.2),
            turn=float(rng.choice([RIGHT_ANGLE / 2, RIGHT_ANGLE])),
        ),
    )


def box_frame() -> Mesh:
    """The paper's BF: a 3.5 x 2 x 2 m frame of square hollow sections, nearly but not exactly symmetric.

    Twelve edges; one cross member at mid-height of the end at x = 0; one brace on the side at y = 0,
    from the post at x = 0 up to the top member.
    """
    (x, y, z), m = FRAME_SIZE_M, FRAME_MEMBER_M
    members = [((0.0, v, w), (x, v + m, w + m)) for v in (0.0, y - m) for w in (0.0, z - m)]
    members += [((u, 0.0, w), (u + m, y, w + m)) for u in (0.0, x - m) for w in (0.0, z - m)]
    members += [((u, v, 0.0), (u + m, v + m, z)) for u in (0.0, x - m) for v in (0.0, y - m)]
    members.append(((0.0, 0.0, z / 2 - m / 2), (m, y, z / 2 + m / 2)))

    # The brace, 80 mm square, rises 3 in 4 from the post's inner face to the top member's underside. Where it lands,
    # the members' faces are left out. Its corners: on the post low and high, on the member far and near.
    near, far, foot, slope = m / 10, m - m / 10, (0.25, 0.35), 0.75
    head = [m + (z - m - low) / slope for low in foot]
    holes = [((m, near, foot[0]), (m, far, foot[1])), ((head[1], near, z - m), (head[0], far, z - m))]
    profile = [(m, foot[0]), (m, foot[1]), (head[0], z - m), (head[1], z - m)]
    corners = [(u, v, w) for u, w in profile for v in (near, far)]
    sides = [(0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    brace = Mesh.of("brace", corners, [three for a, b, c, d in sides for three in ((a, b, c), (a, c, d))])
    here = Pose.identity()
    return assemble("box_frame", [(blocks("edges", members, holes), here), (brace, here)])


def _forward(length: float) -> Pose:
    return Pose(np.eye(3), np.array([0.0, 0.0, length]))
