"""What the fit of parts may be told."""

from __future__ import annotations

from dataclasses import dataclass

from scanfind.errors import require


@dataclass(frozen=True)
class AssemblyParameters:
    """Whether and how a model's parts are fitted one by one.

    parts : fit them, and believe a pose refused as a whole when its parts, moved within the bounds below, explain it
    most_shift_m, most_turn_deg : how far a part may be from where the part it joins would have it, at the joint
    least_visible : poses with less of the surface that scanners should have seen on the scan are not tried in parts
    least_kept : share of what is seen of the surface that must keep to the design, rigidly
    most_missing : share of the surface that may be missing, in whole parts that join others at two places or more: a
        frame without a brace is that frame; a spool without a branch is another spool
    tried : poses of each model a round that are tried in parts, the best first
    samples : of the surface, for all parts together: a branch wants more than its share of what the search uses
    """

    parts: bool = False
    most_shift_m: float = 0.08
    most_turn_deg: float = 7.0
    least_visible: float = 0.4
    least_kept: float = 0.4
    most_missing: float = 0.1
    tried: int = 4
    samples: int = 6000

    def __post_init__(self) -> None:
        require(self.most_shift_m > 0.0, "most_shift_m", self.most_shift_m, "a positive length")
        require(0.0 < self.most_turn_deg <= 45.0, "most_turn_deg", self.most_turn_deg, "above 0 and at most 45")
        for name in ("least_visible", "least_kept", "most_missing"):
            require(0.0 <= getattr(self, name) <= 1.0, name, getattr(self, name), "from 0 to 1")
        require(self.tried >= 1, "tried", self.tried, "1 or more")
        require(self.samples >= 100, "samples", self.samples, "100 or more")
