"""Every parameter of the method, by stage, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, field

from scanfind.assembly.parameters import AssemblyParameters
from scanfind.errors import require
from scanfind.evidence.verify import VerifyParameters
from scanfind.fit.refine import RefineParameters
from scanfind.grid.scene import GridParameters
from scanfind.library.pairs import PairParameters
from scanfind.library.surface import SurfaceParameters
from scanfind.search.surface import SearchParameters


@dataclass(frozen=True)
class IsolationParameters:
    """Which raw points belong to a detection.

    tolerance_m : those within this distance of the placed model's surface; None: `noises` times the scan's own noise
        around the detection, at least a tenth and at most half of the grid's cell
    """

    tolerance_m: float | None = None
    noises: float = 4.0

    def __post_init__(self) -> None:
        require(
            self.tolerance_m is None or self.tolerance_m > 0.0, "tolerance_m", self.tolerance_m, "a positive length"
        )
        require(self.noises > 0.0, "noises", self.noises, "more than 0")


@dataclass(frozen=True)
class Parameters:
    """Every parameter of the method, by stage."""

    surface: SurfaceParameters = field(default_factory=SurfaceParameters)
    pairs: PairParameters = field(default_factory=PairParameters)
    grid: GridParameters = field(default_factory=GridParameters)
    search: SearchParameters = field(default_factory=SearchParameters)
    refine: RefineParameters = field(default_factory=RefineParameters)
    verify: VerifyParameters = field(default_factory=VerifyParameters)
    isolate: IsolationParameters = field(default_factory=IsolationParameters)
    assembly: AssemblyParameters = field(default_factory=AssemblyParameters)


PRESETS = {
    "default": Parameters(),
    # Table 2 of the paper and what its text says: one pair distance, uniform draws, normals of unit length, all of the
    # time, five steps of ICP, the best single hypothesis by support alone.
    "sharif2017": Parameters(
        pairs=PairParameters(distances=(0.75,), rungs_per_octave=64, angle_cell_deg=12.0),
        search=SearchParameters(
            overlap_ratio=0.15, time_limit_s=20.0, miss_probability=0.0, max_instances=1, facing_only=False,
            by_shape=False, telling_first=False, each_once=False, by_lines=False,
            normal_length_m=1.0,
        ),
        refine=RefineParameters(coarse_iterations=3, fine_iterations=2, raw_steps=0),
        verify=VerifyParameters(
            min_score=0.0, min_support=0.15, min_support_blind=0.15, penalty_weight=0.0, alternatives=0
        ),
    ),
}  # fmt: skip
