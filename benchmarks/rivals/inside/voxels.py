"""python voxels.py POINTS.npy CELL

Asked by a line on stdin, downsamples the points with Open3D's two ways and prints the seconds of each. Needs nothing of
ours: it runs in the rivals' environment.
"""

from __future__ import annotations

import sys
from time import perf_counter

import numpy as np
import open3d as o3d


def main(path: str, cell: float) -> None:
    """A line out for each line in."""
    points = np.load(path)
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    tensor = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    print("ready", flush=True)
    for _ in sys.stdin:
        began = perf_counter()
        legacy.voxel_down_sample(cell)
        middle = perf_counter()
        tensor.voxel_down_sample(cell)
        print(middle - began, perf_counter() - middle, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
