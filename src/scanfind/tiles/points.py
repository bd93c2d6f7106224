"""The raw points of a site once more: those of each detection, in any number of workers, and what is left."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from scanfind.dimensions import dimensioned
from scanfind.fit.polish import polished
from scanfind.isolation.own import with_own_points, within
from scanfind.second_pass import write_left_over
from scanfind.tiles.tasks import Cut, Found, cut, gathered, on_disk, plan_in, surface_of
from scanfind.tiles.work import Crew, all_done, no_room

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from scanfind.clock import Clock
    from scanfind.cloud import PointChunk
    from scanfind.detection import Detection, Findings
    from scanfind.progress import Progress
    from scanfind.scans import CloudWriter
    from scanfind.tiles.listed import Listed
    from scanfind.tiles.tasks import Job, Summed


def isolate_all(
    job: Job, listed: Listed, findings: Findings, tolerance: float, summed: list[Summed], crew: Crew, clock: Clock,
    tell: Progress,
) -> list[Detection]:  # fmt: skip
    """Every detection with its raw points, on disk, and fitted to them."""
    found = [Found(one.id, one.model, one.scene_from_model) for one in findings]
    tasks = {
        f"cut-{k:05d}": (cut, job, listed.all[k].scan, k, found, tolerance, first) for k, first in readable(summed)
    }
    done, expected = 0, sum(one.told.points for one in summed)

    def told(name: str, one: Cut) -> None:
        nonlocal done
        done += summed[int(name.rpartition("-")[2])].told.points
        tell("isolate", done, expected)

    cuts = list(zip([job.folder / name for name in tasks], all_done(job.folder, crew, tasks, told), strict=True))
    stations = [place for one in summed for place in one.told.stations]
    measured = []
    for one in findings:
        cut_out = gathered(cuts, one.id)
        with clock("refine"):
            surface = surface_of(job.folder, one.model, tolerance)
            fitted = polished(within(one, cut_out, tolerance), surface, job.parameters.refine, job.jobs)
            around = fitted.isolated
            fitted = with_own_points(fitted, job.parameters.isolate, tolerance, job.cell)
        if job.parameters.isolate.dimensions and around is not None:
            with clock("measure"):
                plan = plan_in(job.folder, one.model)
                if plan is not None:
                    fitted = dimensioned(fitted, plan, surface, around, stations, tolerance, jobs=job.jobs)
        points = fitted.isolated or cut_out
        try:
            measured.append(replace(fitted, isolated=on_disk(points, job.folder / f"points-{one.id:05d}")))
        except OSError as error:
            raise no_room(job.folder, error) from error
    return measured


def write_remainder(
    listed: Listed, findings: Findings, summed: list[Summed], remainder: CloudWriter, tell: Progress
) -> None:
    """Every point that belongs to no detection, in the order of the scans: one file is written by one process."""
    expected = sum(one.told.points for one in summed)

    def chunks() -> Iterator[PointChunk]:
        done = 0
        for k, first in readable(summed):
            for chunk in listed.all[k].opened(listed.origin).chunks(first):
                yield chunk
                done += len(chunk)
                tell("remainder", done, expected)

    write_left_over(remainder, chunks(), findings)


def readable(summed: Sequence[Summed]) -> list[tuple[int, int]]:
    """The scans that could be read: their number, and that of their first setup among all."""
    firsts = np.cumsum([0, *(one.scans for one in summed)]).tolist()
    return [(k, firsts[k]) for k, one in enumerate(summed) if not one.missing]
