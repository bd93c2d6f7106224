"""Options that several commands share, and how they say things."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

Flag = Annotated[bool, Parameter(negative=(), show_default=False)]
Paths = Annotated[list[Path], Parameter(consume_multiple=True, negative=())]
Names = Annotated[list[str], Parameter(consume_multiple=True, negative=())]
Units = Literal["mm", "cm", "m", "in", "ft"]
Format = Literal["ply", "laz", "las", "e57", "pcd"]
Position = Annotated[str, Parameter(allow_leading_hyphen=True, metavar="X,Y,Z")]
Direction = Annotated[str, Parameter(allow_leading_hyphen=True, metavar="z|X,Y,Z")]
Box = Annotated[str, Parameter(allow_leading_hyphen=True, metavar="X,Y,Z,X,Y,Z")]
Counts = Annotated[list[str], Parameter(consume_multiple=True, negative=(), metavar="N|MODEL=N")]
Degrees = Annotated[float, Parameter(metavar="DEG")]
Metres = Annotated[float, Parameter(metavar="M")]
Share = Annotated[float, Parameter(metavar="SHARE")]
Seconds = Annotated[float, Parameter(metavar="S")]
Count = Annotated[int, Parameter(metavar="N")]


def say(text: str) -> None:
    """Print data on stdout. A reader that has gone away, such as `head`, is no error of ours."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # Python flushes once more on its way out and would complain then.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def note(text: str) -> None:
    """Print a remark for people on stderr, in one line."""
    print("scanfind:", " ".join(text.split()), file=sys.stderr)
