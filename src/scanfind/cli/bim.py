"""`scanfind bim`: what an inspection found, back into the BIM tool; no search."""

from __future__ import annotations

from pathlib import Path

from scanfind.cli.options import Flag, note
from scanfind.errors import UsageError


def bim(
    result_dir: Path,
    /,
    *,
    bcf: Path | None = None,
    ifc: Path | None = None,
    design: Path | None = None,
    move: Flag = False,
    tolerance: str | None = None,
    overwrite: Flag = False,
) -> None:
    """Bring an inspection back into the BIM: its findings as BCF issues, and an IFC file that says what was built.

    For example:

        scanfind bim inspected --bcf findings.bcf
        scanfind bim inspected --ifc asbuilt.ifc --design steel.ifc --move

    Parameters
    ----------
    result_dir
        The folder that `scanfind inspect --out` wrote.
    bcf
        A BCF 2.1 file to write: a topic for each element that is not found, out of tolerance or in question.
    ifc
        An IFC file to write: a copy of --design with a property set scanfind_AsBuilt on each element.
    design
        The IFC file that was inspected; it is not changed.
    move
        In --ifc, place what is installed where it was found.
    tolerance
        What is out of tolerance: a TOML profile, or a preset such as pipe-spools; as in the inspection unless given.
    overwrite
        Replace older files at --bcf and --ifc.

    """
    if bcf is None and ifc is None:
        msg = "bim: nothing to write: give --bcf FILE, or --ifc FILE with --design FILE"
        raise UsageError(msg)
    if (ifc is None) != (design is None) or (move and ifc is None):
        msg = "bim: --ifc, which --move goes with, is a copy of the design: give both --ifc FILE and --design FILE"
        raise UsageError(msg)

    if ifc is not None and design is not None:
        from scanfind.bim.as_built import write_as_built

        told = write_as_built(result_dir, design, ifc, move=move, tolerance=tolerance, overwrite=overwrite)
        moved = f", {told.moved} moved to where they stand" if move else ""
        note(f"{told.described} elements described{moved}: {ifc}")
        if told.unmoved:
            note(
                f"{len(told.unmoved)} are placed by a grid or an alignment and were not moved: {' '.join(told.unmoved)}"
            )
    if bcf is not None:
        from scanfind.bim.bcf import write_bcf

        note(f"{write_bcf(result_dir, bcf, tolerance=tolerance, overwrite=overwrite)} topics: {bcf}")
