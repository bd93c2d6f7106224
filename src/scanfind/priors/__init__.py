"""What a user knows before the search: where to look, what stands upright, where the design puts it, how many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError, require

Floats = NDArray[np.float64]
# Two sizes of a part farther apart than this are as likely two parts (a pipe of 4 inches, one of 5).
MOST_FREE = 0.15
Direction = Literal["x", "y", "z", "-x", "-y", "-z"] | tuple[float, float, float]


@dataclass(frozen=True)
class Priors:
    """What is known before the search. Each makes it quicker and its answer surer; none is needed.

    region : x, y, z of the low and of the high corner of a box, the scans' frame, metres: an instance is looked for
        where its middle lies in it, however far it sticks out; -inf and inf are open ends
    outline : the same as a polygon in plan, (x, y) of its corners one after the other, at any height
    up : which way is up in the scans: instances stand upright as they were drawn …
    model_up : … where this way was up …
    tilt_deg : … and lean no farther than this
    near_design_m : instances stand where the design puts them, their middles no farther off than this, metres …
    turned_deg : … and turned by no more than this
    expect : how many instances there are of each model, or by the model's name: with so many found a search ends, with
        fewer it goes on until its time is over
    scale_free : the scans' unit may be off from a metre by up to this share: 0.1 is by ten per cent; 0: it is a metre.
        A region, an outline and where a scanner stood are then in the scans' own unit, all other lengths in metres

    Symmetry is understood: a drum that was turned over stands upright.
    """

    region: tuple[float, float, float, float, float, float] | None = None
    outline: tuple[tuple[float, float], ...] | None = None
    up: Direction | None = None
    model_up: Direction = "z"
    tilt_deg: float = 10.0
    near_design_m: float | None = None
    turned_deg: float | None = None
    expect: int | Mapping[str, int] | None = None
    scale_free: float = 0.0

    def __post_init__(self) -> None:
        if self.region is not None:
            fits = len(self.region) == 6 and all(low < high for low, high in zip(*self._corners(), strict=True))
            require(fits, "region", self.region, "the low corner x,y,z, then a higher one")
        outline = () if self.outline is None else self.outline
        require(self.outline is None or len(outline) >= 3, "outline", outline, "three corners (x, y) or more")
        for name in ("up", "model_up"):
            if (way := getattr(self, name)) is not None:
                length = float(np.linalg.norm(direction(way)))
                require(0.0 < length < np.inf, name, way, "a direction: x, y, z, -z or three numbers not all 0")
        require(0.0 < self.tilt_deg <= 180.0, "tilt_deg", self.tilt_deg, "above 0 and at most 180 degrees")
        near, turned = self.near_design_m, self.turned_deg
        require(near is None or near > 0.0, "near_design_m", near, "above 0 metres")
        require(turned is None or 0.0 < turned <= 180.0, "turned_deg", turned, "above 0 and at most 180 degrees")
        require(turned is None or near is not None, "turned_deg", turned, "given together with near_design_m")
        counts = (
            self.expect.values() if isinstance(self.expect, Mapping) else [1 if self.expect is None else self.expect]
        )
        require(all(count >= 1 for count in counts), "expect", self.expect, "1 or more")
        free = self.scale_free
        require(0.0 <= free <= MOST_FREE, "scale_free", free, f"a share from 0 to {MOST_FREE}, such as 0.1")
        require(not free or near is None, "scale_free", free, "0 where near_design_m says where the design puts things")

    def in_metres(self, scale: float) -> Priors:
        """The same of scans in metres that had so many metres a unit."""
        region = None if self.region is None else tuple(scale * x for x in self.region)
        outline = None if self.outline is None else tuple((scale * x, scale * y) for x, y in self.outline)
        return replace(self, region=region, outline=outline, scale_free=0.0)  # type: ignore[arg-type]

    def check(self, models: Sequence[str], max_instances: int | None) -> None:
        """Raise UsageError where counts are expected of models that are not sought, or more than may be found."""
        if isinstance(self.expect, Mapping):
            for name in sorted(set(self.expect) - set(models)):
                near = get_close_matches(name, models, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(sorted(models))}"
                msg = f"expect: no model is called {name!r}: {hint}"
                raise UsageError(msg)
        expected = sum(self.expected(models).values())
        if max_instances is not None and expected > max_instances:
            msg = f"expect: {expected} instances are expected, and max_instances allows {max_instances}: leave one out"
            raise UsageError(msg)

    def expected(self, models: Sequence[str]) -> dict[str, int]:
        """How many instances there should be of those models of which that is known."""
        if isinstance(self.expect, Mapping):
            return {name: self.expect[name] for name in models if name in self.expect}
        return {} if self.expect is None else dict.fromkeys(models, self.expect)

    def box(self, margin: float = 0.0) -> Floats | None:
        """Low and high corner (2, 3) of what may hold the middle of an instance, so much larger on every side, metres;
        None: anything.
        """
        if self.region is None and self.outline is None:
            return None
        low, high = np.array(self._corners()) if self.region else np.array([[-np.inf] * 3, [np.inf] * 3])
        if self.outline is not None:
            corners = np.array(self.outline, np.float64)
            low[:2] = np.maximum(low[:2], corners.min(axis=0))
            high[:2] = np.minimum(high[:2], corners.max(axis=0))
        return np.array([low - margin, high + margin])

    def holds(self, point: Floats) -> bool:
        """Is a point (3,), scans' frame, where instances are looked for?"""
        box = self.box()
        inside = box is None or bool(((point >= box[0]) & (point <= box[1])).all())
        return inside and (self.outline is None or within(point[:2], np.array(self.outline, np.float64)))

    def _corners(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        region = self.region or ()
        return region[:3], region[3:]


def direction(way: Direction) -> Floats:
    """A direction as (3,), not of unit length where it was given by numbers."""
    if not isinstance(way, str):
        return np.array(way, np.float64)
    axis = np.eye(3)["xyz".index(way[-1])]
    return np.asarray(-axis if way.startswith("-") else axis)


def within(point: Floats, corners: Floats) -> bool:
    """Is a point (2,) within a polygon (K, 2)? A ray from it to the right crosses its edges an odd number of times."""
    (x, y), (x0, y0), (x1, y1) = point, corners.T, np.roll(corners, -1, axis=0).T
    crossing = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) / (y1 - y0) * (x1 - x0)
    return bool(np.count_nonzero(crossing & (x < at)) % 2)
