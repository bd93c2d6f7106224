"""What all cloud writers share: a temporary sibling that gets its name on success, and the check at the door."""

from __future__ import annotations

import contextlib
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.cloud import Attributes, Floats, as_points
from scanfind.errors import InvalidGeometryError, OutputError

Columns = dict[str, NDArray[Any]]


class CloudFile(ABC):
    """A cloud file being written. A format says how to begin, append and finish at `self.part`; the rest is here.

    path : the name the file gets when closed; until then the data lie in `part`, a hidden sibling
    fields : attribute name → dtype, all that any `write` may carry
    shift : (3,) metres, near the points
    crs : WKT or None
    """

    def __init__(
        self, path: Path, fields: Mapping[str, np.dtype[Any]], *, shift: Floats, crs: str | None = None
    ) -> None:
        self.path = path
        self.part = path.with_name(f".{path.name}.{os.getpid()}.part")
        self.fields = dict(fields)
        self.shift = np.asarray(shift, dtype=np.float64)
        self.crs = crs
        self.points = 0
        self.is_open = True
        with self._failures():
            self._begin()

    def write(self, xyz: ArrayLike, attributes: Attributes) -> None:
        """Append points (N, 3) and attributes name → (N,); see `CloudWriter.write`.

        Raises InvalidGeometryError for shapes that do not fit or a field not announced, OutputError when the disk
        refuses.
        """
        if not self.is_open:
            msg = f"{self.path} is closed already"
            raise OutputError(msg)
        points = as_points(xyz)
        columns = self._columns(attributes, len(points))
        if not len(points):
            return
        with self._failures():
            self._append(points, columns)
        self.points += len(points)

    def close(self) -> None:
        """Complete the file and give it its name. Closing twice is harmless."""
        if not self.is_open:
            return
        with self._failures():
            self._finish()
            self.part.replace(self.path)
        self.is_open = False

    def abort(self) -> None:
        """Drop what was written. Harmless after `close`."""
        if not self.is_open:
            return
        self.is_open = False
        # Whatever the format's library thinks of being interrupted, the part must go.
        with contextlib.suppress(Exception):
            self._discard()
        self.part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    @abstractmethod
    def _begin(self) -> None:
        """Create `self.part`."""

    @abstractmethod
    def _append(self, xyz: Floats, columns: Columns) -> None:
        """Append (N, 3) unshifted points and all of `fields`, each (N,) of its dtype; N > 0."""

    @abstractmethod
    def _finish(self) -> None:
        """Complete and close `self.part`; nothing may have been appended."""

    @abstractmethod
    def _discard(self) -> None:
        """Close `self.part` without completing it."""

    def _columns(self, attributes: Attributes, count: int) -> Columns:
        if unknown := sorted(set(attributes) - set(self.fields)):
            msg = f"{self.path.name}: attribute {unknown[0]!r} was not announced when the file was opened"
            raise InvalidGeometryError(msg)
        columns: Columns = {}
        for name, dtype in self.fields.items():
            if name not in attributes:
                columns[name] = np.full(count, np.nan if dtype.kind == "f" else 0, dtype)
                continue
            given = np.asarray(attributes[name])
            if given.shape != (count,):
                msg = f"attribute {name!r} must have shape ({count},) like its points, got {given.shape}"
                raise InvalidGeometryError(msg)
            if given.dtype.kind != "b" and not np.can_cast(given.dtype, dtype, "same_kind"):
                msg = f"attribute {name!r} was announced as {dtype}, got {given.dtype}"
                raise InvalidGeometryError(msg)
            columns[name] = given.astype(dtype, copy=False)
        return columns

    @contextlib.contextmanager
    def _failures(self) -> Iterator[None]:
        """Any failure removes the part; the system's refusals become OutputError."""
        try:
            yield
        except OSError as error:
            self.abort()
            msg = f"cannot write {self.path}: {error.strerror or error}"
            raise OutputError(msg) from error
        except BaseException:
            self.abort()
            raise


class HeaderFirst(CloudFile):
    """A cloud file whose header has one length: written first, and again when the number of points is known."""

    _file: BinaryIO

    @abstractmethod
    def _header(self) -> bytes:
        """The header for so many points as there are now."""

    def _finish(self) -> None:
        self._file.seek(0)
        self._file.write(self._header())
        self._file.close()

    def _discard(self) -> None:
        self._file.close()
