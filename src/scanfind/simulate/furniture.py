"""What stands about in a shop: walls, columns, tables, racks, saw horses, drums, stairs, crates, cable trays."""

from __future__ import annotations

import numpy as np

from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.parts import assemble, blocks, i_section, pipe, revolve

WALL_M = 0.2


def hall(x: float, y: float, z: float) -> Mesh:
    """Outer walls, floor and ceiling around (0, 0, 0) … (x, y, z)."""
    w = WALL_M
    slabs = [((-w, -w, -w), (x + w, y + w, 0.0)), ((-w, -w, z), (x + w, y + w, z + w))]
    slabs += [((-w, -w, 0.0), (0.0, y + w, z)), ((x, -w, 0.0), (x + w, y + w, z))]
    slabs += [((0.0, -w, 0.0), (x, 0.0, z)), ((0.0, y, 0.0), (x, y + w, z))]
    return blocks("hall", slabs)


def office(x: float, y: float, z: float) -> Mesh:
    """Two inner walls that make a room of x by y in the corner at the origin's far side: a door and a window.

    It lies at -x … 0, -y … 0; the door, 0.9 m wide, is in the wall along y, the window in the one along x.
    """
    w, sill, lintel, door = 0.1, 1.0, 2.0, 2.1
    walls = [((-x, -y, 0.0), (-x + w, 0.6 - y, z)), ((-x, 1.5 - y, 0.0), (-x + w, 0.0, z))]
    walls += [((-x, 0.6 - y, door), (-x + w, 1.5 - y, z))]
    walls += [((-x, -y, 0.0), (0.0, w - y, sill)), ((-x, -y, lintel), (0.0, w - y, z))]
    walls += [((-x, -y, sill), (0.7 - x, w - y, lintel)), ((-0.7, -y, sill), (0.0, w - y, lintel))]
    return blocks("office", walls)


def column(height: float) -> Mesh:
    """An I section column 200 x 200 mm on a base plate, standing at the origin."""
    base = blocks("base", [((-0.2, -0.2, 0.0), (0.2, 0.2, 0.025))])
    here = Pose.identity()
    return assemble("column", [(i_section(0.2, 0.2, 0.015, 0.009, height), here), (base, here)])


def table(length: float, width: float, height: float = 0.85) -> Mesh:
    """A welding table with a shelf, its middle at the origin."""
    x, y, leg = length / 2, width / 2, 0.06
    parts = [((-x, -y, height - 0.04), (x, y, height)), ((-x, -y, 0.25), (x, y, 0.27))]
    parts += [((u, v, 0.0), (u + leg, v + leg, height)) for u in (-x, x - leg) for v in (-y, y - leg)]
    return blocks("table", parts)


def rack(rng: np.random.Generator, length: float = 3.0, depth: float = 0.8, height: float = 2.4) -> Mesh:
    """A rack of four levels, loaded with straight pipes and boxes, its middle at the origin."""
    x, y, post = length / 2, depth / 2, 0.07
    levels = np.linspace(0.3, height - 0.3, 4)
    steel = [((u - post / 2, v, 0.0), (u + post / 2, v + post, height)) for u in (-x, 0.0, x) for v in (-y, y - post)]
    steel += [((u - 0.03, -y, low - 0.08), (u + 0.03, y, low)) for u in (-x, 0.0, x) for low in levels]
    placed = [(blocks("rack", steel), Pose.identity())]
    for low in levels:
        if rng.random() < 0.3:
            crate = rng.uniform([0.4, 0.3, 0.15], [0.9, 0.6, 0.35])
            at = rng.uniform(-x + 0.05, -crate[0] - 0.05)
            box = ((at, -crate[1] / 2, low), (at + crate[0], crate[1] / 2, low + crate[2]))
            placed.append((blocks("crate", [box]), Pose.identity()))
            continue
        across = -y + post + 0.02
        while across + 2 * (radius := float(rng.choice([0.03, 0.045, 0.06, 0.085]))) < y - post:
            long = float(rng.uniform(0.75, 1.15)) * length
            start = [float(rng.uniform(-0.1, 0.1)) - long / 2, across + radius, low + radius]
            placed.append((pipe(radius, long), Pose.from_rotation_vector([0.0, np.pi / 2, 0.0], start)))
            across += 2 * radius + float(rng.exponential(0.06))
    return assemble("rack", placed)


def saw_horse(width: float, height: float) -> Mesh:
    """A trestle: a beam along y whose top is at `height`, on two splayed pairs of legs."""
    beam = 0.1
    top = blocks("beam", [((-beam / 2, -width / 2, height - beam), (beam / 2, width / 2, height))])
    lean = 0.25
    legs = []
    for side in (-1.0, 1.0):
        for along in (-width / 2 + 0.12, width / 2 - 0.12):
            tall = (height - beam / 2) / np.cos(lean)
            leg = blocks("leg", [((-0.025, -0.025, 0.0), (0.025, 0.025, tall))])
            foot = [side * (height - beam / 2) * np.tan(lean), along, 0.0]
            legs.append((leg, Pose.from_rotation_vector([0.0, -side * lean, 0.0], foot)))
    return assemble("saw_horse", [(top, Pose.identity()), *legs])


def goalpost(width: float, height: float) -> Mesh:
    """A support of 100 mm hollow sections: a beam along y whose top is at `height`, on two posts."""
    y, half = width / 2, 0.05
    posts = [((-half, v - half, 0.0), (half, v + half, height)) for v in (half - y, y - half)]
    plates = [((-2 * half, v - 2 * half, 0.0), (2 * half, v + 2 * half, 0.015)) for v in (half - y, y - half)]
    return blocks("goalpost", [*posts, *plates, ((-half, -y, height - 2 * half), (half, y, height))])


def drum() -> Mesh:
    """A 200 litre drum with its two hoops."""
    r, h = 0.285, 0.88
    hoops = [(r, 0.29), (r + 0.012, 0.30), (r, 0.31), (r, 0.58), (r + 0.012, 0.59), (r, 0.60)]
    return revolve(
        "drum", [(0.0, 0.0), (r, 0.0), *hoops, (r, h), (r - 0.015, h), (r - 0.015, h - 0.02), (0.0, h - 0.02)]
    )


def stairs(steps: int = 8, width: float = 0.9) -> Mesh:
    """Open steel stairs that climb along +x."""
    treads = [((0.25 * k, 0.0, 0.2 * k + 0.16), (0.25 * k + 0.28, width, 0.2 * k + 0.2)) for k in range(steps)]
    last, top = 0.25 * steps, 0.2 * steps
    landing = [((last, 0.0, top - 0.04), (last + 0.9, width, top))]
    posts = [((u, v, 0.0), (u + 0.06, v + 0.06, top + 1.0)) for u in (last, last + 0.84) for v in (0.0, width - 0.06)]
    rails = [((last, v, top + 0.95), (last + 0.9, v + 0.06, top + 1.0)) for v in (0.0, width - 0.06)]
    return blocks("stairs", treads + landing + posts + rails)


def cable_tray(length: float) -> Mesh:
    """A tray of 300 mm along x with rungs, hung from two rods 0.5 m long."""
    parts = [((0.0, v, 0.0), (length, v + 0.004, 0.08)) for v in (0.0, 0.296)]
    parts += [((u, 0.0, 0.0), (u + 0.03, 0.3, 0.02)) for u in np.arange(0.1, length - 0.1, 0.3)]
    parts += [((u, v, 0.08), (u + 0.012, v + 0.012, 0.58)) for u in (0.5, length - 0.5) for v in (0.0, 0.288)]
    return blocks("cable_tray", parts)


def crates(rng: np.random.Generator) -> Mesh:
    """Crates of several sizes on top of each other."""
    parts, low = [], 0.0
    for _ in range(int(rng.integers(1, 4))):
        x, y, z = rng.uniform([0.4, 0.3, 0.2], [0.9, 0.7, 0.45])
        parts.append(((-x / 2, -y / 2, low), (x / 2, y / 2, low + z)))
        low += z
    return blocks("crates", parts)
