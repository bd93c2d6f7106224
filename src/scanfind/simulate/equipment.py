"""What stands in a plant besides pipes: valves, flanged joints, vessels, pumps, bunds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.parts import assemble, blocks, cylinder, revolve

Floats = NDArray[np.float64]

FLANGE_OVER_PIPE = 1.7
TOWARDS_X = Pose(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), np.zeros(3))
TOWARDS_Y = Pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def flange_thickness(radius: float) -> float:
    """That of a flange on a pipe of this radius."""
    return 0.25 * radius + 0.01


def joint(radius: float) -> tuple[Mesh, float]:
    """Two flanges bolted together in a run along +z, open at both ends; and its length."""
    length, rim = 2 * flange_thickness(radius), FLANGE_OVER_PIPE * radius
    return revolve("joint", [(radius, 0.0), (rim, 0.0), (rim, length), (radius, length)]), length


def valve(radius: float) -> tuple[Mesh, float]:
    """A flanged gate valve in a run along +z, its handwheel towards +x, open at both ends; and its length."""
    r, rim, thick = radius, FLANGE_OVER_PIPE * radius, flange_thickness(radius)
    length = 4.4 * r + 0.12
    middle = length / 2
    body = revolve(
        "body",
        [
            *[(r, 0.0), (rim, 0.0), (rim, 2 * thick), (1.15 * r, 2 * thick)],
            *[(1.15 * r, middle - 0.9 * r), (1.5 * r, middle - 0.7 * r)],
            *[(1.5 * r, middle + 0.7 * r), (1.15 * r, middle + 0.9 * r)],
            *[(1.15 * r, length - 2 * thick), (rim, length - 2 * thick), (rim, length), (r, length)],
        ],
    )
    wheel = revolve(
        "wheel", [(1.25 * r, 0.0), (1.5 * r, 0.0), (1.5 * r, 0.15 * r), (1.25 * r, 0.15 * r), (1.25 * r, 0.0)]
    )
    spokes = [((-1.3 * r, -0.07 * r, 0.0), (1.3 * r, 0.07 * r, 0.1 * r))]
    spokes += [((-0.07 * r, -1.3 * r, 0.0), (0.07 * r, 1.3 * r, 0.1 * r))]
    axis = Pose(TOWARDS_X.rotation, np.array([0.0, 0.0, middle]))

    def out(x: float) -> Pose:
        return axis @ Pose(np.eye(3), np.array([0.0, 0.0, x]))

    placed = [
        (body, Pose.identity()),
        (cylinder(0.6 * r, 1.8 * r), out(r)),
        (cylinder(0.15 * r, 1.9 * r), out(2.8 * r)),
    ]
    placed += [(wheel, out(4.5 * r)), (blocks("spokes", spokes), out(4.5 * r))]
    return assemble("valve", placed), length


def nozzle(radius: float, length: float) -> Mesh:
    """A flanged stub along +z: its flange face is at z = length, its root at 0 inside a vessel."""
    thick = flange_thickness(radius)
    rim = FLANGE_OVER_PIPE * radius
    return revolve(
        "nozzle",
        [(0.0, 0.0), (radius, 0.0), (radius, length - thick), (rim, length - thick), (rim, length), (0.0, length)],
    )


def upright_vessel(radius: float, height: float, inlet: float, inlet_radius: float) -> Mesh:
    """A vessel on a skirt at the origin, dished ends, a manway, a vent, and a nozzle towards -y at height `inlet`.

    The inlet's flange face is at y = -(radius + 0.2).
    """
    dish = [(radius * np.cos(a), height + 0.5 * radius * np.sin(a)) for a in np.linspace(0.0, np.pi / 2, 9)]
    base = [(0.0, 0.0), (radius + 0.12, 0.0), (radius + 0.12, 0.03), (radius, 0.03)]
    shell = revolve("shell", [*base, *[(float(r), float(z)) for r, z in dish]])
    back = Pose(TOWARDS_Y.rotation @ np.diag([1.0, -1.0, -1.0]), np.array([0.0, -0.8 * radius, inlet]))
    manway = Pose(TOWARDS_X.rotation, np.array([0.8 * radius, 0.0, 1.0]))
    vent = Pose(np.eye(3), np.array([0.0, 0.0, height + 0.4 * radius]))
    return assemble(
        "vessel",
        [
            (shell, Pose.identity()),
            (nozzle(inlet_radius, 0.2 * radius + 0.2), back),
            (nozzle(0.25, 0.2 * radius + 0.18), manway),
            (nozzle(0.06, 0.1 * radius + 0.25), vent),
        ],
    )


def drum_vessel(radius: float, length: float, axis: float, inlet_radius: float) -> Mesh:
    """A vessel along x on two saddles, its middle above the origin, its axis at height `axis`, a nozzle on its top.

    The inlet's flange face is at z = axis + radius + 0.2.
    """
    ends = np.linspace(0.0, np.pi / 2, 9)
    dish = [(radius * float(np.sin(a)), -0.5 * radius * float(np.cos(a))) for a in ends]
    profile = [*dish, *[(r, length - z) for r, z in reversed(dish)]]
    shell = revolve("shell", profile)
    wide, tall = 0.8 * radius, axis - 0.6 * radius
    saddles = [((u - 0.1, -wide, 0.0), (u + 0.1, wide, tall)) for u in (-0.3 * length, 0.3 * length)]
    lying = Pose(TOWARDS_X.rotation, np.array([-length / 2, 0.0, axis]))
    top = Pose(np.eye(3), np.array([0.0, 0.0, axis + 0.8 * radius]))
    manway = Pose(TOWARDS_X.rotation, np.array([length / 2 + 0.3 * radius, 0.0, axis]))
    return assemble(
        "vessel",
        [
            (shell, lying),
            (blocks("saddles", saddles), Pose.identity()),
            (nozzle(inlet_radius, 0.2 * radius + 0.2), top),
            (nozzle(0.25, 0.2 * radius + 0.15), manway),
        ],
    )


def pump(height: float, inlet_radius: float) -> Mesh:
    """A pump with its motor on a plinth, away along +y from its inlet's flange face at the origin, `height` up."""
    plinth = max(0.1, height - 0.35)
    steel = [
        ((-0.3, 0.15, -height), (0.3, 1.45, plinth - height)),
        ((-0.15, 0.85, plinth - height), (0.15, 1.3, -0.12)),
    ]
    volute = Pose(TOWARDS_Y.rotation, np.array([0.0, 0.2, 0.0]))
    motor = Pose(TOWARDS_Y.rotation, np.array([0.0, 0.75, 0.0]))
    shaft = Pose(TOWARDS_Y.rotation, np.array([0.0, 0.3, 0.0]))
    up = Pose(np.eye(3), np.array([0.16, 0.29, 0.0]))
    mouth = Pose(TOWARDS_Y.rotation @ np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.25, 0.0]))
    return assemble(
        "pump",
        [
            (blocks("plinth", steel), Pose.identity()),
            (cylinder(max(0.24, 1.6 * inlet_radius), 0.18), volute),
            (cylinder(0.19, 0.6), motor),
            (cylinder(0.05, 0.5), shaft),
            (nozzle(0.06, 0.45), up),
            (nozzle(inlet_radius, 0.25), mouth),
        ],
    )


def bund(x: float, y: float, height: float = 0.3, thickness: float = 0.15) -> Mesh:
    """A low wall around (0, 0) … (x, y), outside of it."""
    t = thickness
    walls = [((-t, -t, 0.0), (x + t, 0.0, height)), ((-t, y, 0.0), (x + t, y + t, height))]
    walls += [((-t, 0.0, 0.0), (0.0, y, height)), ((x, 0.0, 0.0), (x + t, y, height))]
    return blocks("bund", walls)
