"""What the commands that search make of what was found: a folder, or a document alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scanfind.config import Run
    from scanfind.detection import Findings
    from scanfind.library import ModelLibrary
    from scanfind.parameters import Parameters
    from scanfind.progress import Progress
    from scanfind.results.schema import Results

NOT_AS_WANTED = 3  # the exit code of --fail-on
SCANS_MISSING = 4  # of a search in tiles that could not read some of many scans


def results_of(
    findings: Findings, folder: Path | None, models: ModelLibrary, run: Run, parameters: Parameters,
    progress: Progress | None, remainder: str | None = None,
) -> Results:  # fmt: skip
    """What results.json holds; into a staged result folder with all that belongs to it, where there is one."""
    from scanfind.results import fill_folder
    from scanfind.results.document import document, model_entries

    if folder is None:
        return document(findings, models=model_entries(models), parameters=parameters, seed=run.seed)
    return fill_folder(
        folder, findings, models=models, parameters=parameters, seed=run.seed, format=run.format, remainder=remainder,
        progress=progress,
    )  # fmt: skip
