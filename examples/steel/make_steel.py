"""Make a small steel frame to inspect: steel.ifc, and hall.e57, a simulated scan of it as it was built.

python examples/steel/make_steel.py

Of what was built one beam stands 25 mm too low, and one bracket is not there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from uuid import UUID, uuid5

import ifcopenshell
import ifcopenshell.guid
import numpy as np

from scanfind import Mesh, Pose, read_models
from scanfind.scans import open_stations
from scanfind.simulate.parts import blocks
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.simulate.steel import along

HERE = Path(__file__).parent
STATIONS = np.array([[-3.0, -3.5, 1.6], [8.5, -2.5, 1.6], [7.5, 6.5, 1.6], [2.0, 2.0, 1.6]])
# Class, name, from where to where, metres; a section of 200 × 200 mm, or of 140 × 270.
HEB, IPE = (0.2, 0.2, 0.009, 0.015), (0.135, 0.27, 0.0066, 0.0102)
MEMBERS = [
    ("IfcColumn", "C1", (0.0, 0.0, 0.0), (0.0, 0.0, 3.0), HEB),
    ("IfcColumn", "C2", (6.0, 0.0, 0.0), (6.0, 0.0, 3.0), HEB),
    ("IfcColumn", "C3", (0.0, 4.0, 0.0), (0.0, 4.0, 3.0), HEB),
    ("IfcColumn", "C4", (6.0, 4.0, 0.0), (6.0, 4.0, 3.0), HEB),
    ("IfcBeam", "B1", (0.1, 0.0, 2.8), (5.9, 0.0, 2.8), IPE),
    ("IfcBeam", "B2", (0.1, 4.0, 2.8), (5.9, 4.0, 2.8), IPE),
    ("IfcBeam", "B3", (0.0, 0.1, 2.5), (0.0, 3.9, 2.5), IPE),
    ("IfcBeam", "B4", (6.0, 0.1, 2.5), (6.0, 3.9, 2.5), IPE),
    ("IfcMember", "bracket", (0.1, 0.0, 1.2), (1.0, 0.0, 1.2), IPE),
]
LOW, MISSING = "B4", "bracket"


def main() -> None:
    """Write steel.ifc and hall.e57 beside this file."""
    write_ifc(HERE / "steel.ifc")
    objects = [SceneObject("floor", blocks("floor", [((-5, -5, -0.1), (11, 9, 0))]), Pose.identity())]
    lower = Pose(np.eye(3), np.array([0.0, 0.0, -0.025]))
    for mesh in read_models(HERE / "steel.ifc"):
        assert isinstance(mesh, Mesh)
        for place in mesh.placements:
            if place.name != MISSING:
                pose = lower @ place.design_from_model if place.name == LOW else place.design_from_model
                objects.append(SceneObject(place.name, mesh, pose))
    found = scan(Scene(tuple(objects), STATIONS), scanner=Scanner(step=0.005))
    with open_stations(HERE / "hall.e57", {"intensity": np.dtype(np.float32)}) as file:
        for number, station in enumerate(found.stations, start=1):
            pose = Pose(np.eye(3), STATIONS[number - 1])
            file.station(f"station {number}", pose, (found.scanner.rows(), found.scanner.columns()))
            file.write(station.xyz, {"intensity": station.attributes["intensity"]})
    print(
        f"{HERE / 'steel.ifc'}: {len(MEMBERS)} members; {HERE / 'hall.e57'}: {sum(map(len, found.stations)):,} points"
    )


def write_ifc(path: Path) -> None:
    """The frame in millimetres, in a storey of a building of a site."""
    file = ifcopenshell.file(schema="IFC4")

    def new(kind: str, name: str, **said: Any) -> Any:
        number = ifcopenshell.guid.compress(uuid5(UUID(int=0), f"steel {kind} {name}").hex)
        return file.create_entity(kind, GlobalId=number, Name=name, **said)

    def axes(pose: Pose) -> Any:
        point = file.create_entity("IfcCartesianPoint", (1e3 * pose.translation).tolist())
        z, x = (file.create_entity("IfcDirection", pose.rotation[:, k].tolist()) for k in (2, 0))
        return file.create_entity("IfcAxis2Placement3D", point, z, x)

    def placed(parent: Any, pose: Pose) -> Any:
        return file.create_entity("IfcLocalPlacement", parent and parent.ObjectPlacement, axes(pose))

    unit = file.create_entity("IfcSIUnit", None, "LENGTHUNIT", "MILLI", "METRE")
    context = file.create_entity("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, axes(Pose.identity()))
    units = file.create_entity("IfcUnitAssignment", [unit])
    whole = new("IfcProject", "steel", RepresentationContexts=[context], UnitsInContext=units)
    parent = None
    for kind, name in (("IfcSite", "site"), ("IfcBuilding", "hall"), ("IfcBuildingStorey", "ground floor")):
        part = new(kind, name, ObjectPlacement=placed(parent, Pose.identity()))
        new("IfcRelAggregates", f"{name} in", RelatingObject=whole, RelatedObjects=[part])
        whole = parent = part
    made = []
    for kind, name, start, end, section in MEMBERS:
        profile = file.create_entity("IfcIShapeProfileDef", "AREA", None, None, *(1e3 * size for size in section))
        up = file.create_entity("IfcDirection", [0.0, 0.0, 1.0])
        length = 1e3 * float(np.linalg.norm(np.subtract(end, start)))
        solid = file.create_entity("IfcExtrudedAreaSolid", profile, axes(Pose.identity()), up, length)
        body = file.create_entity("IfcShapeRepresentation", context, "Body", "SweptSolid", [solid])
        shape = file.create_entity("IfcProductDefinitionShape", None, None, [body])
        made.append(new(kind, name, ObjectPlacement=placed(parent, along(start, end)), Representation=shape))
    new("IfcRelContainedInSpatialStructure", "steel", RelatedElements=made, RelatingStructure=parent)
    file.write(str(path))


if __name__ == "__main__":
    main()
