"""The paper's two objects (Table 4): as models, in the paper's figures, and the branches they are made of."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common import Floats
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.objects import FRAME_MEMBER_M, FRAME_SIZE_M, SpoolDesign, box_frame, pipe_spool

# A scanned point lies so far outside its branch's box at most: five times the range noise.
BOX_MARGIN_M = 0.015


@dataclass(frozen=True)
class Branch:
    """A piece of an object that can be cut away: a box in the model's frame, (3,) low and (3,) high, metres.

    turn : model_from_model, a motion after which the object without this piece looks as before; None for no such one
    """

    name: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    turn: Pose | None = None

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Which of N points (N, 3), model frame, are in it."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1), dtype=np.bool_)

    def along(self) -> int:
        """The axis of its longest side."""
        return int(np.argmax(np.subtract(self.high, self.low)))


@dataclass(frozen=True, eq=False)
class Target:
    """An object looked for.

    key : of the paper's tables, PS or BF; noun : for people
    scene_points : of the paper's fully cluttered scene; clutter_ratio : of that scene (first row of Tables 7, 8)
    branches : every point of the object is in one or more; the first has it
    telling : branches without which too little may be left to tell a pose: a pipe slides and rolls, a frame without
        its brace and cross member is the same turned over
    """

    key: str
    noun: str
    mesh: Mesh
    scene_points: int
    clutter_ratio: float
    branches: tuple[Branch, ...]
    telling: tuple[str, ...]

    def object_points(self, ratio: float, scene_points: int) -> int:
        """Equation 3 solved for |s|."""
        return round(scene_points / (1.0 + ratio))

    def branch_of(self, points: Floats) -> NDArray[np.int64]:
        """Which branch each of N points (N, 3), model frame, is part of, (N,)."""
        holds = np.array([branch.holds(points) for branch in self.branches])
        first: NDArray[np.int64] = holds.argmax(axis=0)
        return first


@cache
def paper() -> dict[str, Any]:
    """The paper's facts and figures."""
    return tomllib.loads((Path(__file__).parent / "tables.toml").read_text(encoding="utf-8"))


@cache
def target(key: str) -> Target:
    """PS or BF."""
    noun, mesh, branches, telling = {
        "PS": ("pipe spool", pipe_spool(), spool_branches(SpoolDesign()), ("riser",)),
        "BF": ("box frame", box_frame(), frame_branches(), ("cross", "brace")),
    }[key]
    full = paper()[{"PS": "table7_clutter_PS", "BF": "table8_clutter_BF"}[key]][0]
    return Target(key, noun, mesh, full["scene_points"][0], full["clutter_ratio"][0], tuple(branches), telling)


def spool_branches(spool: SpoolDesign) -> Sequence[Branch]:
    """Legs, elbows, tee and stubs of a spool that runs along +x, then +y, then back along -x."""
    far = 10.0
    half_tee, bend = 1.3 * spool.radius, 3.0 * spool.radius
    tee = (spool.branch_at - half_tee, spool.branch_at + half_tee)
    beside, end = spool.run + bend, bend + spool.across
    return (
        Branch("riser", (tee[0] - 0.1, -far, spool.radius), (tee[1] + 0.1, bend, far)),
        Branch("outlet", (beside + spool.radius, bend, -far), (far, end, far)),
        Branch("inlet", (-far, -far, -far), (tee[0], bend, far)),
        Branch("tee", (tee[0], -far, -far), (tee[1], bend, far)),
        Branch("run", (tee[1], -far, -far), (spool.run, bend, far)),
        Branch("elbow", (spool.run, -far, -far), (far, bend, far)),
        Branch("across", (spool.run, bend, -far), (far, end, far)),
        Branch("back", (-far, bend, -far), (far, far, far)),
    )


def frame_branches() -> Sequence[Branch]:
    """The twelve edges of the frame, its cross member, and the brace, which is what is left."""
    (x, y, z), m = FRAME_SIZE_M, FRAME_MEMBER_M

    def box(name: str, low: Sequence[float], high: Sequence[float]) -> Branch:
        a, b, c = (side - BOX_MARGIN_M for side in low)
        d, e, f = (side + BOX_MARGIN_M for side in high)
        return Branch(name, (a, b, c), (d, e, f))

    longs = [box(f"long_{p}{q}", (0, v, w), (x, v + m, w + m))
             for p, v in enumerate((0, y - m)) for q, w in enumerate((0, z - m))]  # fmt: skip
    ends = [box(f"end_{p}{q}", (u, 0, w), (u + m, y, w + m))
            for p, u in enumerate((0, x - m)) for q, w in enumerate((0, z - m))]  # fmt: skip
    posts = [box(f"post_{p}{q}", (u, v, 0), (u + m, v + m, z))
             for p, u in enumerate((0, x - m)) for q, v in enumerate((0, y - m))]  # fmt: skip
    cross = box("cross", (0, 0, z / 2 - m / 2), (m, y, z / 2 + m / 2))
    # Without its brace the frame is the same when it is turned over about its length.
    over = Pose.from_rotation_vector([np.pi, 0.0, 0.0], [0.0, y, z])
    brace = Branch("brace", (-1.0, -1.0, -1.0), (x + 1.0, y + 1.0, z + 1.0), over)
    return (*longs, *ends, *posts, cross, brace)
