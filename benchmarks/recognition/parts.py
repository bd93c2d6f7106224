"""What is sought: parametric spools, frames, headers, valves and flanges, their twins, and how each is symmetric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np

from benchmarks.common import PoseError, centre_of, pose_error
from scanfind.library import ModelLibrary
from scanfind.library.model import Model, build_model
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.equipment import FLANGE_OVER_PIPE, TOWARDS_X, flange_thickness, valve
from scanfind.simulate.objects import Route, SpoolDesign, box_frame, pipe_spool, spool
from scanfind.simulate.parts import assemble, blocks, revolve
from scanfind.symmetry import FREE, Axis, Symmetry

# A heavier rating's flange: as much wider and thicker (DN 200: PN 16 has 340 x 24 mm, PN 63 has 415 x 42).
HEAVIER_RIM, HEAVIER_PLATE = 1.22, 1.75
# By how much twins that differ in a length do: less than a flange's width, ten times the noise and more.
TWIN_BRANCH_M, TWIN_RISE_M, TWIN_CROSS_M = 0.12, 0.1, 0.15
HALF_TURN = np.pi
# By how much the library's flanges are wider than those that stand about: half a size.
FLANGE_BESIDE_M = 0.005


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh that is sought, by its name, and its symmetry, which is known because it is built so."""

    mesh: Mesh
    symmetry: Symmetry

    @staticmethod
    def of(mesh: Mesh, *axes: Axis) -> Part:
        """A part that is symmetric about the middle of its box."""
        return Part(mesh, Symmetry(centre_of(mesh.vertices), axes))

    @property
    def name(self) -> str:
        return self.mesh.name

    def diameter(self) -> float:
        """Diagonal of its box, metres."""
        return float(np.linalg.norm(np.ptp(self.mesh.vertices, axis=0)))

    def error(self, found: Pose, truth: Pose) -> PoseError:
        """Of a pose, modulo the symmetry; at the middle of the part's box."""
        return pose_error(found, truth, self.symmetry)


@cache
def prepared(part: Part) -> Model:
    """As in the paper's offline phase, outside of any time measured."""
    return build_model(part.mesh)


@lru_cache(maxsize=8)
def library_of(parts: tuple[Part, ...]) -> ModelLibrary:
    """The parts, prepared."""
    made = ModelLibrary.in_memory()
    for part in parts:
        made.put(prepared(part))
    return made


def named(mesh: Mesh, name: str) -> Mesh:
    """The same under another name."""
    return Mesh(name, mesh.vertices, mesh.faces)


def mirrored(mesh: Mesh) -> Mesh:
    """Its mirror image in the plane y = 0, which no motion brings onto it."""
    return Mesh(f"{mesh.name}_mirrored", mesh.vertices * [1.0, -1.0, 1.0], mesh.faces[:, ::-1].copy())


def heavier(mesh: Mesh, design: SpoolDesign) -> Mesh:
    """A spool whose inlet and riser have flanges of a higher rating: the corners of theirs pushed outwards."""
    moved = mesh.vertices.copy()
    x, y, z = mesh.vertices.T
    inlet = (x <= 1e-9) & (np.abs(y) < 2.0 * design.radius)
    riser = z >= design.rise - 1e-9
    for flange, along, end, middle, radius in (
        (inlet, 0, 0.0, (0.0, 0.0, 0.0), design.radius),
        (riser, 2, design.rise, (design.branch_at, 0.0, 0.0), design.branch_radius),
    ):
        beside = [axis for axis in range(3) if axis != along]
        out = mesh.vertices[:, beside] - np.array(middle)[beside]
        rim = flange & (np.linalg.norm(out, axis=1) > 1.01 * radius)
        moved[np.ix_(rim, beside)] += (HEAVIER_RIM - 1.0) * out[rim]
        moved[flange, along] = end + HEAVIER_PLATE * (mesh.vertices[flange, along] - end)
    return Mesh.of(f"{mesh.name}_heavier", moved, mesh.faces)


def spool_and_twins(name: str, design: SpoolDesign) -> dict[str, Mesh]:
    """A spool, and four that are easily taken for it: by what differs, "" for the spool itself."""
    made = spool(name, design)
    return {
        "": made,
        "branch": spool(f"{name}_branch", replace(design, branch_at=design.branch_at + TWIN_BRANCH_M)),
        "rise": spool(f"{name}_rise", replace(design, rise=design.rise + TWIN_RISE_M)),
        "rating": heavier(made, design),
        "mirrored": mirrored(made),
    }


def frame(name: str, size: tuple[float, float, float], member: float, cross: float, left_out: bool = False) -> Mesh:
    """A frame of square members: twelve edges (`left_out`: eleven), and one cross member at height `cross` at x = 0."""
    (x, y, z), m = size, member
    boxes = [((0.0, v, w), (x, v + m, w + m)) for v in (0.0, y - m) for w in (0.0, z - m)]
    boxes += [((u, 0.0, w), (u + m, y, w + m)) for u in (0.0, x - m) for w in (0.0, z - m)]
    boxes += [((u, v, 0.0), (u + m, v + m, z)) for u in (0.0, x - m) for v in (0.0, y - m)]
    boxes.append(((0.0, 0.0, cross - m / 2), (m, y, cross + m / 2)))
    # A rail of one side that makes it differ from its mirror image: it goes half way along the top.
    boxes.append(((0.0, 0.0, 0.7 * z), (0.5 * x, m, 0.7 * z + m)))
    return blocks(name, boxes[1:] if left_out else boxes)


def frame_and_twins(name: str, size: tuple[float, float, float], member: float) -> dict[str, Mesh]:
    """A frame, and three that are easily taken for it, by what differs."""
    cross = 0.45 * size[2]
    made = frame(name, size, member, cross)
    return {
        "": made,
        "cross": frame(f"{name}_cross", size, member, cross - TWIN_CROSS_M),
        "member": frame(f"{name}_member", size, member, cross, left_out=True),
        "mirrored": mirrored(made),
    }


def header(name: str, radius: float = 0.08, gaps: Sequence[float] = (0.55, 0.9, 0.7), rise: float = 0.3) -> Mesh:
    """A flanged straight run along x with two equal branches up, `gaps` from an end, each other, and the other end.

    Turned end for end it is the same but for where its branches are: by the difference of the outer gaps.
    """
    lead = Route(radius, TOWARDS_X @ Pose.from_rotation_vector([HALF_TURN, 0.0, 0.0]))
    lead.flange()
    main, tee = Route(radius, TOWARDS_X), 2.6 * radius
    roll = HALF_TURN
    for gap, used in zip(gaps[:-1], (tee / 2, tee), strict=True):
        main.straight(gap - used)
        side = main.branch(0.7 * radius, tee, 1.6 * radius, roll=roll)
        side.straight(rise - 1.6 * radius)
        side.flange()
        roll = 0.0
    main.straight(gaps[-1] - tee / 2)
    main.flange()
    return assemble(name, [*lead.placed, *main.all_placed()])


def gate_valve(name: str, radius: float, geared: bool = False) -> Part:
    """A flanged gate valve along z, closed by blind faces; `geared`: a gear box on the side of its bonnet.

    Without one it is the same turned half about its handwheel's axis.
    """
    body, length = valve(radius)
    ends = [revolve("end", [(0.0, 0.0), (radius, 0.0)]), revolve("end", [(radius, length), (0.0, length)])]
    box = blocks("box", [((1.6 * radius, 0.0, length / 2 - 0.4 * radius), (2.6 * radius, 1.5 * radius, length / 2))])
    pieces = [body, *ends, *([box] if geared else [])]
    mesh = assemble(name, [(piece, Pose.identity()) for piece in pieces])
    middle = np.array([0.0, 0.0, length / 2])
    return Part(mesh, Symmetry(middle, () if geared else (Axis((1.0, 0.0, 0.0), 2),)))


def weld_neck(name: str, radius: float, rim: float, plate: float) -> Part:
    """A blind weld-neck flange about z, as round as its facets let it be."""
    neck = 1.2 * radius
    profile = [(0.0, 0.0), (radius, 0.0), (radius, neck), (rim, neck), (rim, neck + plate), (0.0, neck + plate)]
    return Part.of(revolve(name, profile), Axis((0.0, 0.0, 1.0), FREE))


@cache
def pipe_spool_part() -> Part:
    """The paper's PS."""
    return Part.of(pipe_spool())


@cache
def box_frame_part() -> Part:
    """The paper's BF."""
    return Part.of(box_frame())


@cache
def likenesses() -> tuple[Part, ...]:
    """Parts that nearly coincide with themselves when turned: only the brace, a gap or a short rail tells."""
    cage = frame("cage", (1.4, 1.4, 1.4), 0.08, 0.5)
    return (box_frame_part(), Part.of(header("header")), Part.of(cage))


@cache
def twins(kind: str) -> tuple[Part, Part]:
    """Two parts that differ in one respect only: `branch`, `rise`, `rating`, `mirrored` (spools), `cross`, `member`."""
    if kind in ("cross", "member"):
        made = frame_and_twins("frame", (2.2, 1.4, 1.5), 0.08)
    else:
        made = spool_and_twins("spool", SpoolDesign())
    return Part.of(made[""]), Part.of(made[kind])


TWINS = ("branch", "rise", "rating", "mirrored", "cross", "member")


def design_of(number: int) -> SpoolDesign:
    """The spool designs of the library: each leg of another length."""
    rng = np.random.default_rng([41, number])
    run, across = float(rng.uniform(1.2, 2.4)), float(rng.uniform(0.7, 1.2))
    radius = (0.06, 0.08, 0.1)[number % 3]
    return SpoolDesign(
        radius=radius,
        branch_radius=0.8 * radius,
        run=run,
        branch_at=float(rng.uniform(0.25, 0.6)) * run,
        rise=float(rng.uniform(0.3, 0.6)),
        across=across,
        outlet_at=0.5 * across,
        back=float(rng.uniform(0.4, 1.0)),
        turn=(np.pi / 2, np.pi / 4)[number % 2],
    )


@cache
def hundred() -> tuple[Part, ...]:
    """A library of 100: 8 spools and 5 frames with their twins, 10 valves and 10 flanges of two kinds each.

    No flange is of the size of those on the spools that stand about in a shop: where one was, it was found on each of
    these, and rightly.
    """
    parts: list[Part] = []
    for k in range(8):
        parts += [Part.of(mesh) for mesh in spool_and_twins(f"spool_{k}", design_of(k)).values()]
    for k in range(5):
        size = (1.6 + 0.3 * k, 1.2 + 0.1 * k, 1.1 + 0.15 * k)
        parts += [Part.of(mesh) for mesh in frame_and_twins(f"frame_{k}", size, (0.06, 0.08)[k % 2]).values()]
    for k in range(10):
        radius = 0.1 + 0.01 * k
        parts += [gate_valve(f"valve_{k}", radius), gate_valve(f"valve_{k}_geared", radius, geared=True)]
        neck = radius + FLANGE_BESIDE_M
        rim, plate = FLANGE_OVER_PIPE * neck, flange_thickness(neck)
        parts.append(weld_neck(f"flange_{k}", neck, rim, plate))
        parts.append(weld_neck(f"flange_{k}_heavier", neck, HEAVIER_RIM * rim, HEAVIER_PLATE * plate))
    return tuple(parts)


@cache
def ten() -> tuple[Part, ...]:
    """The models of the plant: of the hundred those about a metre and a half and larger, twins among them, a header
    and a valve.
    """
    by_name = {part.name: part for part in hundred()}
    wanted = (
        "spool_0",
        "spool_0_mirrored",
        "spool_1",
        "spool_1_branch",
        "spool_2",
        "spool_3",
        "frame_0",
        "frame_0_cross",
    )
    return (*(by_name[name] for name in wanted), Part.of(header("header")), gate_valve("valve", 0.15, geared=True))
