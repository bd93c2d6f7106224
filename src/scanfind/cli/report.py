"""`scanfind report`: a result folder in; a page, a PDF or a table out, judged by any tolerance."""

from __future__ import annotations

from pathlib import Path

from scanfind.cli.options import Count, Flag, Paths, note


def report(
    result_dir: Path,
    /,
    *,
    out: Paths | None = None,
    tolerance: str | None = None,
    scan: Paths | None = None,
    title: str | None = None,
    points: Count = 1_000_000,
    overwrite: Flag = False,
) -> None:
    """Write a report of a result: one HTML file with a viewer, a PDF, CSV or XLSX.

    The result itself is not changed, and nothing is searched again.

    For example:

        scanfind report found --out report.html report.pdf

        scanfind report inspected --tolerance structural-steel --out steel.html steel.xlsx

    Parameters
    ----------
    result_dir
        The folder that `scanfind find --out` or `scanfind inspect --out` wrote.
    out
        Files to write: .html, .pdf, .csv, .xlsx; report.html unless given.
    tolerance
        A profile: a TOML file, pipe-spools, structural-steel or fabricated-steel; the inspection's unless given.
    scan
        Scan files to show around what was found; those searched, unless given.
    title
        Of the report; the names of the scans unless given.
    points
        To show in all; a million make the page 10 MB large.
    overwrite
        Replace files that are there.

    """
    from scanfind.report import write_report

    files = out or [Path("report.html")]
    content = write_report(
        result_dir, files, tolerance=tolerance, scans=scan or [], title=title, points=points, overwrite=overwrite
    )
    for remark in content.notes():
        note(remark)
    counts = ", ".join(f"{count} {words}" for _, words, count in content.counts())
    note(f"{len(content.items)} {content.noun}: {counts or 'nothing'}; report in {', '.join(map(str, files))}")
