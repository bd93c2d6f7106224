"""The model library (paper 3.2, the offline phase): what is computed once for a model and looked up in every scene.

Models accumulate in one SQLite file. A model already there, by a hash of its geometry and parameters, costs no work.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from math import inf
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import CloudModel, OrientedCloud
from scanfind.errors import LibraryError, ScanfindError
from scanfind.library.model import DEFAULTS, Model, ModelParameters, ModelSummary, build_model, model_hash
from scanfind.library.pairs import PairParameters
from scanfind.library.self_similar import Similar
from scanfind.library.store import Record, Store
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh, Placement
from scanfind.pose import Pose
from scanfind.symmetry import Axis, Symmetry

__all__ = ["Model", "ModelLibrary", "ModelParameters", "ModelSummary"]


class ModelLibrary:
    """Models by name, in one file or in memory. Iterates over the names, sorted; a context manager.

    Several processes may use one file at once; one ModelLibrary belongs to the thread that opened it. Every method
    raises LibraryError where the file is damaged, locked for too long or cannot be written.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    @staticmethod
    def open(path: str | Path, *, create: bool = False, timeout_s: float = 30.0) -> ModelLibrary:
        """Open the library file at `path`; only `create=True` makes one where there is none.

            timeout_s : how long to wait for another process that is writing

        Raises LibraryError for a file that is missing, no library, damaged, of another version or locked too long.
        """
        return ModelLibrary(Store.open(Path(path), create=create, timeout_s=timeout_s))

    @staticmethod
    def in_memory() -> ModelLibrary:
        """An empty library that vanishes when closed."""
        return ModelLibrary(Store.in_memory())

    def add(self, model: Mesh | CloudModel, parameters: ModelParameters = DEFAULTS) -> Model:
        """Prepare a model and keep it; where its geometry and parameters are there already, return what is there.

        A model known under another name keeps that name. Placements it brings join those known, by GlobalId. Raises
        LibraryError where another model has the name, InvalidGeometryError where the model has no surface.
        """
        (added,) = self.add_all([model], parameters)
        return added

    def add_all(
        self, models: Iterable[Mesh | CloudModel], parameters: ModelParameters = DEFAULTS, jobs: int = 1
    ) -> Iterator[Model]:
        """Add models one after the other, as `add` does, but prepare so many of them side by side."""
        listed = [(model_hash(model, parameters), model) for model in models]
        new: dict[str, Mesh | CloudModel] = {}
        with self._store.transaction():
            for sha256, model in listed:
                if sha256 not in new and not self._is_known(sha256, model.name):
                    new[sha256] = model
        # Outside any transaction, because it takes seconds: others go on meanwhile, and may add the same model.
        with ThreadPoolExecutor(jobs) as threads:
            built = {sha256: threads.submit(build_model, model, parameters) for sha256, model in new.items()}
            try:
                for sha256, model in listed:
                    if sha256 in built:
                        yield self.put(built.pop(sha256).result())
                    else:
                        yield self._join_placements(sha256, model.placements if isinstance(model, Mesh) else ())
            finally:  # Ctrl-C waits for those being prepared, not for all
                threads.shutdown(wait=False, cancel_futures=True)

    def put(self, model: Model) -> Model:
        """Keep a model that is prepared already, such as one of another library; otherwise as `add`."""
        with self._store.transaction(write=True):
            if not self._is_known(model.sha256, model.name):
                self._store.insert(Record(model.sha256, model.name, _facts(model)), _arrays(model))
                return model
        return self._join_placements(model.sha256, model.placements)

    def remove(self, name: str) -> None:
        """Forget a model; raises LibraryError where there is none of that name."""
        with self._store.transaction(write=True):
            self._store.delete(self._named(name))

    def names(self) -> list[str]:
        """All names, sorted by code point."""
        return [summary.name for summary in self.show()]

    def get(self, name: str) -> Model:
        """The model of that name; raises LibraryError where there is none."""
        with self._store.transaction():
            return self._load(self._named(name))

    def models(self) -> list[Model]:
        """All models, sorted by name."""
        with self._store.transaction():
            return [self._load(record) for record in self._store.records()]

    def show(self) -> list[ModelSummary]:
        """What is there, sorted by name, without reading the arrays."""
        with self._store.transaction():
            return [self._summary(record) for record in self._store.records()]

    def close(self) -> None:
        """Close the file. Nothing is lost without it: every add and remove is on disk when it returns."""
        self._store.close()

    def __len__(self) -> int:
        return len(self.show())

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def __contains__(self, name: object) -> bool:
        return name in self.names()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _is_known(self, sha256: str, name: str) -> bool:
        if self._store.by_hash(sha256):
            return True
        if not name or not _is_text(name):
            msg = f"a model needs a name that is text, got {name!r}; give it another"
            raise LibraryError(msg)
        if self._store.by_name(name):
            msg = f"model {name!r} is there already, of other geometry or parameters; remove it or rename the new one"
            raise LibraryError(msg)
        return False

    def _named(self, name: str) -> Record:
        record = self._store.by_name(name) if _is_text(name) else None
        if record is None:
            there = [repr(record.name) for record in self._store.records()]
            msg = f"no model {name!r} in the library; it has {', '.join(there[:10]) or 'none'}"
            if len(there) > 10:
                msg += f" and {len(there) - 10} more"
            raise LibraryError(msg)
        return record

    def _join_placements(self, sha256: str, placements: tuple[Placement, ...]) -> Model:
        """The model of that hash, with these placements beside those it has; the newer one of a GlobalId holds."""
        with self._store.transaction():
            model = self._by_hash(sha256)
        known = {placement.global_id: _placement_facts(placement) for placement in model.placements}
        if all(_placement_facts(placement) == known.get(placement.global_id) for placement in placements):
            return model
        with self._store.transaction(write=True):
            model = self._by_hash(sha256)  # again: another process may just have joined its own
            joined = tuple({p.global_id: p for p in (*model.placements, *placements)}.values())
            mesh = replace(model.mesh, placements=joined) if model.mesh else None
            model = replace(model, placements=joined, mesh=mesh)
            self._store.replace(Record(sha256, model.name, _facts(model)))
        return model

    def _by_hash(self, sha256: str) -> Model:
        record = self._store.by_hash(sha256)
        if record is None:
            msg = "another process removed the model while it was being added; add it again"
            raise LibraryError(msg)
        return self._load(record)

    def _load(self, record: Record) -> Model:
        arrays = self._store.arrays(record)
        try:
            return _model(record, arrays)
        except (KeyError, TypeError, ValueError, ScanfindError):
            self._store.damaged(f"model {record.name!r}")

    def _summary(self, record: Record) -> ModelSummary:
        try:
            facts = record.facts
            return ModelSummary(
                record.name,
                record.sha256,
                str(facts["source"]),
                float(facts["diameter"]),
                int(facts["samples"]),
                int(facts["pairs"]),
                int(facts["triangles"]),
                len(facts["placements"]),
                _symmetry(facts["symmetry"]),
            )
        except (KeyError, TypeError, ValueError, ScanfindError):
            self._store.damaged(f"model {record.name!r}")


def _is_text(name: str) -> bool:
    """False for what Linux allows in a file name and SQLite does not take: bytes that are no UTF-8."""
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


def _facts(model: Model) -> dict[str, Any]:
    """What a record says of a model beside its arrays; JSON keeps every digit of a float."""
    return {
        "source": model.source,
        "diameter": model.diameter,
        "spacing": model.spacing,
        "area": model.area,
        "signed": model.signed,
        "samples": len(model.samples),
        "pairs": model.pair_count,
        "triangles": len(model.mesh.faces) if model.mesh else 0,
        "parameters": asdict(model.parameters),
        "symmetry": {"centre": model.symmetry.centre.tolist(), "axes": model.symmetry.axes},
        "similar": [{"overlap": each.overlap, **_pose_facts(each.motion)} for each in model.similar],
        "placements": [_placement_facts(placement) for placement in model.placements],
        "parts": list(model.mesh.notes.get("parts", ())) if model.mesh else [],
    }


def _placement_facts(placement: Placement) -> dict[str, Any]:
    return {
        "global_id": placement.global_id,
        "ifc_class": placement.ifc_class,
        "name": placement.name,
        **_pose_facts(placement.design_from_model),
    }


def _pose_facts(pose: Pose) -> dict[str, Any]:
    return {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist()}


def _pose(facts: Mapping[str, Any]) -> Pose:
    return Pose(np.array(facts["rotation"], np.float64), np.array(facts["translation"], np.float64))


def _symmetry(facts: Mapping[str, Any]) -> Symmetry:
    axes = [Axis((float(x), float(y), float(z)), int(order)) for (x, y, z), order in facts["axes"]]
    return Symmetry(np.array(facts["centre"], np.float64), tuple(axes))


def _placement(facts: Mapping[str, Any]) -> Placement:
    return Placement(facts["global_id"], facts["ifc_class"], facts["name"], _pose(facts))


def _arrays(model: Model) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {
        "points": model.samples.points,
        "normals": model.samples.normals,
    }
    if model.mesh:
        arrays["vertices"] = np.asarray(model.mesh.vertices, np.float64)
        arrays["faces"] = np.asarray(model.mesh.faces, np.int32)
    if model.cloud:
        arrays["cloud"] = np.asarray(model.cloud.points, np.float64)
        if model.cloud.origin is not None:
            arrays["origin"] = np.asarray(model.cloud.origin, np.float64)
    return arrays


def _model(record: Record, arrays: Mapping[str, NDArray[Any]]) -> Model:
    """The model of a record. Raises KeyError, TypeError, ValueError or ScanfindError where they do not fit."""
    facts = record.facts
    surface, pairs = facts["parameters"]["surface"], facts["parameters"]["pairs"]
    parameters = ModelParameters(
        SurfaceParameters(**surface),
        PairParameters(**{**pairs, "distances": tuple(pairs["distances"])}),
        facts["parameters"]["symmetry"],
    )
    placements = tuple(_placement(placement) for placement in facts["placements"])
    mesh = cloud = None
    if "faces" in arrays:
        vertices = _shaped(arrays["vertices"], np.float64, (-1, 3))
        faces = _within(_shaped(arrays["faces"], np.int32, (-1, 3)), len(vertices))
        # A library written before parts were kept has none.
        parts = tuple((str(name), int(first), int(end)) for name, first, end in facts.get("parts", ()))
        mesh = Mesh(record.name, vertices, faces, facts["source"], placements, {"parts": parts} if parts else {})
    else:
        origin = _shaped(arrays["origin"], np.float64, (3,)) if "origin" in arrays else None
        cloud = CloudModel(record.name, _shaped(arrays["cloud"], np.float64, (-1, 3)), facts["source"], origin)
    sizes = [float(facts[what]) for what in ("diameter", "spacing", "area")]
    if not all(0.0 < size < inf for size in sizes):  # distances of pairs are shares of them
        raise ValueError(sizes)
    points, normals = (_shaped(arrays[role], np.float64, (-1, 3)) for role in ("points", "normals"))
    samples = OrientedCloud(points, _shaped(normals, np.float64, points.shape), facts["signed"])
    return Model(
        name=record.name,
        sha256=record.sha256,
        source=facts["source"],
        diameter=sizes[0],
        spacing=sizes[1],
        area=sizes[2],
        signed=bool(facts["signed"]),
        samples=samples,
        mesh=mesh,
        cloud=cloud,
        pair_count=int(facts["pairs"]),
        symmetry=_symmetry(facts["symmetry"]),
        similar=tuple(Similar(float(each["overlap"]), _pose(each)) for each in facts["similar"]),
        placements=placements,
        parameters=parameters,
    )


def _shaped(array: NDArray[Any], dtype: type, shape: tuple[int, ...]) -> NDArray[Any]:
    fits = array.ndim == len(shape) and all(want in {-1, have} for want, have in zip(shape, array.shape, strict=True))
    if array.dtype != dtype or not fits:
        raise ValueError(shape)
    return array


def _within(indices: NDArray[Any], end: int) -> NDArray[Any]:
    if indices.size and not 0 <= indices.min() <= indices.max() < end:
        raise ValueError(end)
    return indices
