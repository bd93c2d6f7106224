"""Cut the first pump skid out of the pump room's scan: skid.ply, a piece of scan that serves as a model.

python examples/pump/cut_skid.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanfind.cloud import Floats
from scanfind.scans import open_writer, read_scan

HERE = Path(__file__).parent

# Metres, scan frame. From above the concrete plinth, whose top is at -1.67, to the flange at the head of the discharge
# pipe: pump, motor, pipe, flanges, valve and gauges; no floor, no plinth, nothing of the second skid or the pipe above.
LOW, HIGH = (-0.45, -4.65, -1.64), (1.12, -2.95, 1.35)
COLOURS = ("red", "green", "blue")


def inside(points: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Which of points (N, 3) are in the box, (N,)."""
    return np.asarray(((points >= LOW) & (points <= HIGH)).all(axis=1))


def main() -> None:
    """Write skid.ply beside this file."""
    points = 0
    fields = {colour: np.dtype(np.uint8) for colour in COLOURS}
    with open_writer(HERE / "skid.ply", fields) as out:
        for chunk in read_scan(HERE / "scan.e57"):
            kept = inside(chunk.xyz)
            points += int(kept.sum())
            out.write(chunk.xyz[kept], {colour: chunk.attributes[colour][kept] for colour in COLOURS})
    print(f"{HERE / 'skid.ply'}: {points:,} points")


if __name__ == "__main__":
    main()
