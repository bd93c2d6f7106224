"""The bars of a frame that a file gives part by part: each a rigid thing of its sides, and its two ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from math import radians, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly.parts import told_apart
from scanfind.detection import ANGLE, LINEAR
from scanfind.dimensions.drawing import Wanted, angle, face_to_centre
from scanfind.dimensions.features import BAR, Feature, features_of
from scanfind.mesh import Mesh

Floats = NDArray[np.float64]

SLENDER = 3.0  # length over width: what is shorter is a plate or a block
TOUCHING_M = 0.01
ASKEW = sin(radians(2.0))  # members that are more nearly parallel make no corner
MOST_MEMBERS = 8


class Member(NamedTuple):
    """A bar as a feature, its two ends, and the box it is in, (2, 3), model frame, metres."""

    bar: Feature
    ends: tuple[Feature, Feature]
    box: Floats


def members_of(mesh: Mesh) -> list[Member]:
    """The bars among a mesh's parts, the longest first; none where the file knows no parts."""
    parts = mesh.notes.get("parts", ())
    if len(parts) < 2:
        return []
    names = told_apart([str(name) for name, _, _ in parts])
    found = [
        member
        for name, (_, first, end) in zip(names, parts, strict=True)
        if (member := member_of(name, mesh, first, end)) is not None
    ]
    found.sort(key=lambda member: -round(member.bar.half, 3))
    return found[:MOST_MEMBERS]


def member_of(name: str, mesh: Mesh, first: int, end: int) -> Member | None:
    """One part as a bar; None where it is none."""
    part = Mesh(name, mesh.vertices, mesh.faces[first:end])
    features = [
        replace(each, surfaces=tuple(replace(one, faces=one.faces + first) for one in each.surfaces))
        for each in features_of(part)
    ]
    if len(features) != 6 or features[0].name != "length side 1":
        return None
    one, other, *sides = features
    middle, axis = 0.5 * (one.centre + other.centre), np.cross(sides[0].axis, sides[2].axis)
    half = 0.5 * abs(float((other.centre - one.centre) @ axis))
    width = abs(float((sides[1].centre - sides[0].centre) @ sides[0].axis))
    if 2.0 * half < SLENDER * width:
        return None
    bar = Feature(name, BAR, middle, axis / np.linalg.norm(axis), tuple(each.surfaces[0] for each in sides), half=half)
    corners = part.triangles().reshape(-1, 3)
    ends = replace(one, name=f"{name} end 1"), replace(other, name=f"{name} end 2")
    return Member(bar, ends, np.stack([corners.min(axis=0), corners.max(axis=0)]))


def features_and_wanted(members: Sequence[Member], first: int) -> tuple[list[Feature], list[Wanted]]:
    """The features of members, numbered from `first` on, and their lengths and the angles of those that meet."""
    features = [feature for member in members for feature in (member.bar, *member.ends)]
    lengths = [
        Wanted(f"{member.bar.name} length", LINEAR, (first + 3 * k + 1, first + 3 * k + 2), face_to_centre)
        for k, member in enumerate(members)
    ]
    return features, [*lengths, *corners_of(members, first)]


def corners_of(members: Sequence[Member], first: int) -> Iterator[Wanted]:
    """The angles between members that meet."""
    for (a, one), (b, other) in combinations(enumerate(members), 2):
        apart = np.maximum(one.box[0] - other.box[1], other.box[0] - one.box[1]).max()
        if apart < TOUCHING_M and np.linalg.norm(np.cross(one.bar.axis, other.bar.axis)) > ASKEW:
            yield Wanted(f"{one.bar.name} – {other.bar.name}, angle", ANGLE, (first + 3 * a, first + 3 * b), angle)
