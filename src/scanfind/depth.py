"""What each scanner saw in each direction: the nearest range, as a cube map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DEPTH_PIXELS = 360  # along an edge of the cube map: 0.25° a pixel, 35 mm at 8 m
# Where a scan has fewer beams than pixels, pixels are joined until most of what was looked at has a range.
MOST_HOLES, LEAST_DEPTH_PIXELS = 0.15, 45


class DepthMap(NamedTuple):
    """The nearest surface seen from one scanner position in each direction.

    origin : (3,) relative to the grid's offset
    ranges : (6 · edge²,) float32, metres, cube map (see kernels.grid.cube_pixel); inf where no beam came back
    """

    origin: Floats
    ranges: NDArray[np.float32]
    edge: int

    def coarser(self) -> DepthMap:
        """Pixels of twice the edge, each the nearest of its four."""
        half = self.edge // 2
        pixels = self.ranges.reshape(6, half, 2, half, 2)
        return DepthMap(self.origin, pixels.min(axis=(2, 4)).reshape(-1), half)

    def holes(self) -> float:
        """Share of empty pixels among the four of each coarser pixel that saw anything: 3/4 where beams are sparse."""
        filled = float(np.isfinite(self.ranges).sum())
        around = 4.0 * float(np.isfinite(self.coarser().ranges).sum())
        return 1.0 - filled / around if around else 0.0


def joined_until_full(maps: list[DepthMap]) -> list[DepthMap]:
    """Depth maps of one resolution, made coarser together until the worst of them has few holes."""
    while maps and maps[0].edge > LEAST_DEPTH_PIXELS and max(depth.holes() for depth in maps) > MOST_HOLES:
        maps = [depth.coarser() for depth in maps]
    return maps
