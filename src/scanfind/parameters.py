"""Every parameter of the method, by stage, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, field

from scanfind.assembly.parameters import AssemblyParameters
from scanfind.evidence.verify import VerifyParameters
from scanfind.fit.refine import RefineParameters
from scanfind.grid.scene import GridParameters
from scanfind.isolation.own import IsolationParameters
from scanfind.library.pairs import PairParameters
from scanfind.library.surface import SurfaceParameters
from scanfind.priors import Priors
from scanfind.search.surface import SearchParameters


@dataclass(frozen=True)
class Parameters:
    """Every parameter of the method, by stage; and what is known of the scene beforehand."""

    surface: SurfaceParameters = field(default_factory=SurfaceParameters)
    pairs: PairParameters = field(default_factory=PairParameters)
    grid: GridParameters = field(default_factory=GridParameters)
    search: SearchParameters = field(default_factory=SearchParameters)
    refine: RefineParameters = field(default_factory=RefineParameters)
    verify: VerifyParameters = field(default_factory=VerifyParameters)
    isolate: IsolationParameters = field(default_factory=IsolationParameters)
    assembly: AssemblyParameters = field(default_factory=AssemblyParameters)
    priors: Priors = field(default_factory=Priors)


# Of sensors whose points are off by 5 to 15 mm: cells twice as large average four times as many of them (noisy normals
# are what a surface is not recognised by), and of those that are left more may be off. A frame of structured light then
# gives its true pose a score of 0.94 to 1.0 where the default gives 0.44 to 0.89. One view hides all but a little of a
# wrong pose: of those that stood for that 0.12 and 0.19 lay on the scan, of the right ones 0.25 and more.
COARSE = GridParameters(cells_across=90.0)
LENIENT = VerifyParameters(inlier_noises=5.0, normal_agreement=0.6, min_support=0.22)

PRESETS = {
    "default": Parameters(),
    # Noise that grows with the square of the range; one view, from a known place: free space tells what is missing.
    # Frames are dense, and need no lines to be found by: these are what the wrong pose of 0.19 was told by.
    "structured-light": Parameters(grid=COARSE, search=SearchParameters(by_lines=False), verify=LENIENT),
    # Table 2 of the paper and what its text says: one pair distance, uniform draws, normals of unit length, all of the
    # time, five steps of ICP, the best single hypothesis by support alone.
    "sharif2017": Parameters(
        pairs=PairParameters(distances=(0.75,), rungs_per_octave=64, angle_cell_deg=12.0),
        search=SearchParameters(
            overlap_ratio=0.15, time_limit_s=20.0, miss_probability=0.0, max_instances=1, facing_only=False,
            by_shape=False, telling_first=False, each_once=False, by_air=False, by_lines=False,
            normal_length_m=1.0,
        ),
        refine=RefineParameters(coarse_iterations=3, fine_iterations=2, raw_steps=0),
        verify=VerifyParameters(
            min_score=0.0, min_support=0.15, min_support_blind=0.15, penalty_weight=0.0, alternatives=0
        ),
    ),
}  # fmt: skip
