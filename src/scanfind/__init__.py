"""Find known 3D objects (CAD, BIM or a piece of scan) in cluttered laser scans.

    import scanfind

    for found in scanfind.find("shop.e57", "spool.stl"):
        print(found.id, found.model, found.scene_from_model.matrix(), found.score)

The names below are imported when first used: `import scanfind` itself loads no array or compiler library.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scanfind.cloud import CloudModel, PointCloud
    from scanfind.detection import Detection, Findings
    from scanfind.errors import ScanfindError
    from scanfind.find import find
    from scanfind.inspect import inspect
    from scanfind.isolation.isolate import isolate
    from scanfind.library import ModelLibrary
    from scanfind.mesh import Mesh
    from scanfind.models import read_models
    from scanfind.parameters import PRESETS, Parameters
    from scanfind.pose import Pose
    from scanfind.results import read_results, write_results
    from scanfind.scans import read_scan, scan_info
    from scanfind.symmetry import Symmetry, pose_error
    from scanfind.tiles import find_in_tiles

    __version__: str

__all__ = [
    "PRESETS",
    "CloudModel",
    "Detection",
    "Findings",
    "Mesh",
    "ModelLibrary",
    "Parameters",
    "PointCloud",
    "Pose",
    "ScanfindError",
    "Symmetry",
    "__version__",
    "find",
    "find_in_tiles",
    "inspect",
    "isolate",
    "pose_error",
    "read_models",
    "read_results",
    "read_scan",
    "scan_info",
    "write_results",
]

_HOME = {
    "CloudModel": "cloud",
    "PointCloud": "cloud",
    "Detection": "detection",
    "Findings": "detection",
    "ScanfindError": "errors",
    "PRESETS": "parameters",
    "Parameters": "parameters",
    "find": "find",
    "find_in_tiles": "tiles",
    "inspect": "inspect",
    "isolate": "isolation.isolate",
    "ModelLibrary": "library",
    "Mesh": "mesh",
    "read_models": "models",
    "Pose": "pose",
    "read_results": "results",
    "write_results": "results",
    "read_scan": "scans",
    "scan_info": "scans",
    "Symmetry": "symmetry",
    "pose_error": "symmetry",
}


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        value: object = version("scanfind")
    elif name in _HOME:
        value = getattr(import_module(f"scanfind.{_HOME[name]}"), name)
    else:
        msg = f"module 'scanfind' has no attribute {name!r}"
        raise AttributeError(msg)
    globals()[name] = value  # asked once only
    return value


def __dir__() -> list[str]:
    return __all__


class _Package(ModuleType):
    """Keeps `scanfind.find` and `scanfind.inspect` the functions, whoever imports the modules of the same name.

    Importing a submodule binds it to its package under its name, and would bury the function.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if isinstance(value, ModuleType) and _HOME.get(name) == name:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
