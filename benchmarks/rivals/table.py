"""The rivals there are, and the environments they live in."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

ROOT = Path(__file__).parents[2]
HOME = ROOT / ".rivals"
SOURCE = Path(__file__).parent / "pcl"


@dataclass(frozen=True)
class Environment:
    """A virtual environment below `.rivals/`.

    packages : what pip installs there; programs : C++ of ours that CMake builds there (folder, then names)
    imports : what must import, for the environment to be there
    """

    name: str
    packages: tuple[str, ...]
    imports: tuple[str, ...]
    programs: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        return HOME / self.name

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    @property
    def complete(self) -> Path:
        """Written when everything is installed; holds `recipe` and the versions."""
        return self.folder / "complete"

    def recipe(self) -> str:
        """One line of what it was made from: another one, and it is to be made anew."""
        sources = [path.read_bytes() for path in sorted(SOURCE.iterdir())] if self.programs else []
        return sha256(b"\n".join([" ".join(self.packages).encode(), *sources])).hexdigest()

    def is_current(self) -> bool:
        return self.complete.exists() and self.complete.read_text(encoding="utf-8").startswith(self.recipe())


@dataclass(frozen=True)
class Rival:
    """One method of one library.

    title : as tables call it; train : `module:function` that runs in the child, see inside/matcher.py
    tries : how often it is asked, with another seed each time; licence : of the library
    """

    name: str
    title: str
    environment: str
    train: str
    tries: int
    licence: str

    @property
    def install(self) -> str:
        """The command that sets its environment up."""
        return f"python -m benchmarks.rivals.install {self.name}"


COMMON = ("numpy>=2", "scipy>=1.13")
# open3d-cpu is the same Open3D without CUDA, a tenth of the download.
OPEN3D = "open3d-cpu==0.20.0"

ENVIRONMENTS = {
    environment.name: environment
    for environment in (
        Environment("open3d", (*COMMON, OPEN3D), ("open3d",)),
        Environment("opencv", (*COMMON, "opencv-contrib-python-headless==5.0.0.93"), ("cv2.ppf_match_3d",)),
        Environment("kiss", (*COMMON, OPEN3D, "kiss-matcher==1.0.2"), ("open3d", "kiss_matcher")),
        Environment("pcl", COMMON, (), ("objrecransac", "ppf", "prerejective")),
    )
}

# What was tried and is not to be had by a package manager; the installer says so.
UNAVAILABLE = {
    "teaser": "TEASER++: no wheel on PyPI, and the build of its source package (cmeel-teaser-plusplus 2.0) fetches "
    "pybind11 and PMC from elsewhere and fails where it cannot; left out, not run untested",
}

_INSIDE = "benchmarks.rivals.inside"

RIVALS = {
    rival.name: rival
    for rival in (
        Rival("open3d_ransac", "Open3D FPFH + RANSAC", "open3d", f"{_INSIDE}.fpfh:train_ransac", 5, "MIT"),
        Rival("open3d_fgr", "Open3D FPFH + FGR", "open3d", f"{_INSIDE}.fpfh:train_fgr", 5, "MIT"),
        Rival("kiss_solver", "KISS solver on FPFH", "kiss", f"{_INSIDE}.kiss:train_solver", 1, "MIT"),
        Rival("kiss_matcher", "KISS-Matcher", "kiss", f"{_INSIDE}.kiss:train_pipeline", 1, "MIT"),
        Rival("opencv_ppf", "OpenCV PPF", "opencv", f"{_INSIDE}.opencv:train", 1, "Apache-2.0"),
        Rival("pcl_objrecransac", "PCL ObjRecRANSAC", "pcl", f"{_INSIDE}.pcl:train_objrecransac", 5, "BSD-3-Clause"),
        Rival("pcl_prerejective", "PCL prerejective", "pcl", f"{_INSIDE}.pcl:train_prerejective", 3, "BSD-3-Clause"),
        Rival("pcl_ppf", "PCL PPF", "pcl", f"{_INSIDE}.pcl:train_ppf", 10, "BSD-3-Clause"),
    )
}


def available() -> list[str]:
    """Names of the rivals whose environment is there."""
    return [name for name, rival in RIVALS.items() if ENVIRONMENTS[rival.environment].is_current()]
