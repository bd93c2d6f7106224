"""A virtual laser scanner, and scenes to try it on.

from scanfind.simulate import SCANNERS, plant, simulate

simulate(plant(seed=7), "sim", scanner=SCANNERS["phase"], points=2_000_000)
simulate(plant(seed=7), scanner=SCANNERS["phase"]).targets()    # writes nothing: what would be seen?
"""

from scanfind.simulate.building import frame
from scanfind.simulate.instruments import SCANNERS, FrameSensor, Instrument, Photogrammetry, Scanner
from scanfind.simulate.piping import plant
from scanfind.simulate.run import Simulated, simulate
from scanfind.simulate.scanner import SimulatedScan, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.simulate.scene_file import SceneFile, read_scene
from scanfind.simulate.scenes import shop
from scanfind.simulate.sight import Sight

__all__ = [
    "SCANNERS",
    "FrameSensor",
    "Instrument",
    "Photogrammetry",
    "Scanner",
    "Scene",
    "SceneFile",
    "SceneObject",
    "Sight",
    "Simulated",
    "SimulatedScan",
    "frame",
    "plant",
    "read_scene",
    "scan",
    "shop",
    "simulate",
]
