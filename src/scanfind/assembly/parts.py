"""A model cut into parts, and where they join.

The parts are those the file names (the products of a STEP or IFC assembly, the objects of a scene), else the connected
pieces of its surface, else the straight members of one watertight surface (see `members`). What is too small to be
measured by itself (a bolt, a gasket) belongs to the part it touches most.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly.members import Labels, connected, members
from scanfind.library.near_surface import near_triangles, signed_distances, weld
from scanfind.library.surface import SurfaceParameters, random_points, sample_mesh
from scanfind.mesh import Mesh
from scanfind.search.hypotheses import ModelArrays

Floats = NDArray[np.float64]

# Parts nearer than this touch: wider than a weld's root gap or a gasket, narrower than two pipes side by side.
TOUCH_M = 0.005
# Points drawn over the whole surface to see what touches: 6 mm apart on a spool of 3 m², 20 mm on a frame of 30 m².
CONTACT_POINTS = 80_000
# With fewer samples of the surface a part's pose would hang on a handful of cells.
LEAST_SAMPLES = 40
MOST_PARTS = 200  # of more, the smallest join their neighbours


class Joint(NamedTuple):
    """Parts `a` < `b` touch around `place` (3,), model frame, metres; `points` of the surface do."""

    a: int
    b: int
    place: Floats
    points: int


@dataclass(frozen=True, eq=False)
class Assembly:
    """A model's P parts.

    names : (P,); part_of_face : (F,) the part each face of the model's mesh belongs to
    joints : where they touch
    arrays : the samples of the model's visible surface, part by part, as the kernels take models
    area_of_a_sample : m², on average
    """

    names: tuple[str, ...]
    part_of_face: Labels
    joints: tuple[Joint, ...]
    arrays: ModelArrays
    area_of_a_sample: float

    def samples(self) -> Labels:
        """How many samples each part has, (P,)."""
        counts: Labels = np.diff(self.arrays.starts)
        return counts

    def points(self, part: int) -> Floats:
        """The samples of a part, (N, 3), model frame."""
        return self.arrays.points[self.arrays.starts[part] : self.arrays.starts[part + 1]]

    def normals(self, part: int) -> Floats:
        """The unit normals of the same, (N, 3)."""
        return self.arrays.normals[self.arrays.starts[part] : self.arrays.starts[part + 1]]


def assembly_of(mesh: Mesh, surface: SurfaceParameters) -> Assembly | None:
    """The parts of a mesh; None where there is but one.

    surface : how it is sampled, for all parts together
    """
    part, names = first_cut(mesh)
    if len(names) < 2:
        return None
    samples = sample_mesh(mesh, surface).samples
    face = signed_distances(near_triangles(mesh.triangles(), 1e-3), samples.points)[1]
    part_of_sample = part[np.maximum(face, 0)]
    touching = contacts(mesh, part, len(names))
    kept, into = merged(np.bincount(part_of_sample, minlength=len(names)), touching[0])
    if len(kept) < 2:
        return None
    part, part_of_sample = into[part], into[part_of_sample]
    order = np.argsort(part_of_sample, kind="stable")
    starts = np.searchsorted(part_of_sample[order], np.arange(len(kept) + 1))
    arrays = arrays_of(samples.points[order], samples.normals[order], starts)
    joints = joints_of(*touching, into)
    return Assembly(tuple(names[k] for k in kept), part, joints, arrays, mesh.area() / len(order))


def first_cut(mesh: Mesh) -> tuple[Labels, tuple[str, ...]]:
    """The part of each face, (F,), and the parts' names: the file's own, connected pieces, or members."""
    named = mesh.notes.get("parts", ())
    if len(named) > 1:
        part = np.zeros(len(mesh.faces), np.int64)
        for number, (_, first, end) in enumerate(named):
            part[first:end] = number
        return part, told_apart([name for name, _, _ in named])
    corner = weld(mesh.triangles())
    label = connected(int(corner.max()) + 1, np.concatenate([corner[:, :2], corner[:, 1:]]))[corner[:, 0]]
    _, part = np.unique(label, return_inverse=True)
    pieces = int(part.max()) + 1
    return (part, tuple(f"piece {k}" for k in range(1, pieces + 1))) if pieces > 1 else members(mesh)


def told_apart(names: list[str]) -> tuple[str, ...]:
    """The same names, equal ones numbered from 1: an assembly has four bolts of one name."""
    seen: dict[str, int] = {}
    told = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        told.append(f"{name} #{seen[name]}" if names.count(name) > 1 else name)
    return tuple(told)


def contacts(mesh: Mesh, part: Labels, count: int) -> tuple[Labels, Floats]:
    """How many points of each part lie on each other one, (P, P), and the sum of their places, (P, P, 3)."""
    rng = np.random.default_rng(0)
    corners = mesh.triangles()
    drawn, _ = random_points(mesh, CONTACT_POINTS, rng)
    owner = part[signed_distances(near_triangles(corners, 1e-3), drawn)[1]]
    # Corners as well: where two parts share nothing but an edge, few points drawn lie on it.
    at, whose = np.concatenate([drawn, corners.reshape(-1, 3)]), np.concatenate([owner, np.repeat(part, 3)])
    counts, places = np.zeros((count, count), np.int64), np.zeros((count, count, 3))
    for number in range(count):
        own = corners[part == number]
        low, high = own.min(axis=(0, 1)) - TOUCH_M, own.max(axis=(0, 1)) + TOUCH_M
        near = np.flatnonzero((whose != number) & ((at >= low) & (at <= high)).all(axis=1))
        if not len(near):
            continue
        distance, _ = signed_distances(near_triangles(own, TOUCH_M), at[near])
        near = near[np.isfinite(distance)]
        counts[number] += np.bincount(whose[near], minlength=count)
        np.add.at(places[number], whose[near], at[near])
    return counts + counts.T, places + places.transpose(1, 0, 2)


def merged(samples: Labels, touching: Labels) -> tuple[Labels, Labels]:
    """Which parts are kept (K,), and the number among these that each of P parts becomes, (P,).

    A part of too few samples goes to the one it touches most; one that touches none, to the largest.
    """
    samples, touching, into = samples.copy(), touching.copy(), np.arange(len(samples))
    alive = np.ones(len(samples), np.bool_)
    while alive.sum() > 1:
        smallest = int(np.argmin(np.where(alive, samples, np.iinfo(np.int64).max)))
        if samples[smallest] >= LEAST_SAMPLES and alive.sum() <= MOST_PARTS:
            break
        alive[smallest] = False
        others = np.where(alive, touching[smallest], -1)
        best = int(np.argmax(others)) if others.max() > 0 else int(np.argmax(np.where(alive, samples, -1)))
        into[into == smallest] = best
        samples[best] += samples[smallest]
        touching[best] += touching[smallest]
        touching[:, best] += touching[:, smallest]
        touching[best, best] = 0
    kept = np.flatnonzero(alive)
    number = np.full(len(alive), -1)
    number[kept] = np.arange(len(kept))
    return kept, number[into]


def joints_of(counts: Labels, places: Floats, into: Labels) -> tuple[Joint, ...]:
    """The joints of parts merged `into` fewer, (P,)."""
    kept = int(into.max()) + 1
    points, sums = np.zeros((kept, kept), np.int64), np.zeros((kept, kept, 3))
    np.add.at(points, (into[:, None], into[None, :]), counts)
    np.add.at(sums, (into[:, None], into[None, :]), places)
    return tuple(
        Joint(a, b, sums[a, b] / points[a, b], int(points[a, b])) for a, b in np.argwhere(np.triu(points, 1)).tolist()
    )


def arrays_of(points: Floats, normals: Floats, starts: Labels) -> ModelArrays:
    """The samples of parts, end to end, as kernels take those of models; starts : (P + 1,)."""
    spans = [points[first:end] for first, end in pairwise(starts)]
    centres = np.array([span.mean(axis=0) for span in spans])
    radii = np.array([
        np.sqrt(((span - centre) ** 2).sum(axis=1).mean()) for span, centre in zip(spans, centres, strict=True)
    ])  # fmt: skip
    return ModelArrays(
        starts.astype(np.int64), np.ascontiguousarray(points), np.ascontiguousarray(normals),
        np.hstack([points, normals]).astype(np.float32), centres, radii,
    )  # fmt: skip
