"""Make flanged_pipe.stl: a 6-inch pipe with one flange, as both skids' discharge pipes have it above the valve.

python examples/pump/make_flanged_pipe.py
"""

from __future__ import annotations

from pathlib import Path

import trimesh

from scanfind.mesh import Mesh
from scanfind.simulate.parts import revolve

# Metres. The pipe measures 87.4 and 88.1 mm in the scan (6-inch ductile iron: outside diameter 175.3 mm); the flange
# 139 to 140 mm and an inch (class 150: outside diameter 279.4 mm, 25.4 mm thick). The second pipe leaves the scanner's
# field of view 0.98 m above its flange.
PIPE_RADIUS, FLANGE_RADIUS, FLANGE_THICKNESS, LENGTH = 0.0875, 0.1397, 0.0254, 0.95


def flanged_pipe() -> Mesh:
    """The flange's face at the origin, the pipe along +z; its far end is open."""
    rim = [(0.0, 0.0), (FLANGE_RADIUS, 0.0), (FLANGE_RADIUS, FLANGE_THICKNESS), (PIPE_RADIUS, FLANGE_THICKNESS)]
    return revolve("flanged_pipe", [*rim, (PIPE_RADIUS, LENGTH)])


def main() -> None:
    """Write flanged_pipe.stl beside this file."""
    mesh, path = flanged_pipe(), Path(__file__).parent / "flanged_pipe.stl"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    print(f"{path}: {len(mesh.faces)} triangles")


if __name__ == "__main__":
    main()
