"""The second stage: a model's parts, each where the scan has it (the paper's future work).

A model is cut into parts (`parts`, `members`); the parts of a placed model are fitted as rigid bodies hinged where they
join (`fit`); and what became of them is told, and whether they explain the scan together (`explain`).
"""

from scanfind.assembly.explain import Assemblies, Explained
from scanfind.assembly.fit import View
from scanfind.assembly.parameters import AssemblyParameters
from scanfind.assembly.parts import Assembly, Joint, assembly_of
from scanfind.assembly.points import REACH_M

__all__ = ["REACH_M", "Assemblies", "Assembly", "AssemblyParameters", "Explained", "Joint", "View", "assembly_of"]
