"""Rows kept on disk as they come, so that a run that was interrupted goes on where it stopped."""

from __future__ import annotations

import csv
from collections.abc import Hashable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from benchmarks.common import origin_lines, write_rows
from scanfind.errors import UsageError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    class Keyed(DataclassInstance, Protocol):
        """A row: numbers and words, the seed it comes from, and what it is about."""

        @property
        def seed(self) -> int: ...

        def key(self) -> Hashable: ...


R = TypeVar("R", bound="Keyed")


class Ledger(Generic[R]):
    """Rows of one kind in one file: each is there as soon as it is added, and a later run goes on from there.

    Raises UsageError where the rows there come from another machine, commit or version, unless `fresh`.
    """

    def __init__(self, kind: type[R], path: Path, date: str = "", fresh: bool = False) -> None:
        self.path, self.rows = path, list[R]()
        self.machine, self.versions, self.commit, _, self.dated = origin_lines("", date)
        if path.exists() and not fresh:
            comments, self.rows = read_rows(kind, path)
            if changed := [line for line in (self.machine, self.versions, self.commit) if line not in comments]:
                msg = f"{path}: its rows have another origin than {changed[0]!r}; use --fresh to replace them, or --out"
                raise UsageError(msg)
        self.keys = {row.key() for row in self.rows}

    def add(self, row: R) -> None:
        """Keep a row."""
        self.rows.append(row)
        self.keys.add(row.key())
        seeds = f"seeds: {_ranges({row.seed for row in self.rows})}"
        write_rows(self.path, self.rows, [self.machine, self.versions, self.commit, seeds, self.dated])


def read_rows(kind: type[R], path: Path) -> tuple[list[str], list[R]]:
    """The comment lines and rows of a results file."""
    kinds = {field.name: {"str": str, "int": int, "float": float}[str(field.type)] for field in fields(kind)}
    lines = path.read_text(encoding="utf-8").splitlines()
    comments = [line[2:] for line in lines if line.startswith("# ")]
    rows = csv.DictReader(line for line in lines if not line.startswith("# "))
    return comments, [kind(**{name: kinds[name](value) for name, value in row.items()}) for row in rows]


def _ranges(seeds: set[int]) -> str:
    """`0-4,7` for 0, 1, 2, 3, 4, 7."""
    starts = sorted(seed for seed in seeds if seed - 1 not in seeds)
    ends = sorted(seed for seed in seeds if seed + 1 not in seeds)
    return ",".join(f"{a}-{b}" if b > a else f"{a}" for a, b in zip(starts, ends, strict=True))
