"""One SQLite file of named records with arrays: transactional, shared by processes, checked when read.

It knows nothing of models. A record is a name, a hash, some facts as JSON, and arrays by role.
"""

from __future__ import annotations

import json
import math
import sqlite3
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import LibraryError

APPLICATION_ID = 0x53434644  # "SCFD": what tells our file from other people's SQLite files
VERSION = 3  # a record says how large a surface is
# `content` holds the sum of the records' CRCs: a damaged page may take its rows with it without a word.
SCHEMA = (
    "CREATE TABLE records (sha256 TEXT PRIMARY KEY, name TEXT NOT NULL UNIQUE, facts TEXT, crc INTEGER)",
    "CREATE TABLE arrays (sha256 TEXT, role TEXT, dtype TEXT, shape TEXT, crc INTEGER, data BLOB, "
    "PRIMARY KEY (sha256, role))",
    "CREATE TABLE content (crcs INTEGER)",
    "INSERT INTO content VALUES (0)",
)
DTYPES = ("<f8", "<i4")  # little-endian on every machine
REMEDY = {
    sqlite3.SQLITE_NOTADB: "is not a model library (no SQLite file); name another file",
    sqlite3.SQLITE_CORRUPT: "is damaged; restore it from a copy or build it anew from the model files",
    sqlite3.SQLITE_READONLY: "cannot be written to: the file or its folder is read-only; copy it elsewhere",
    sqlite3.SQLITE_READONLY_ROLLBACK: "was left half written and is read-only; open it once where it can be written",
    sqlite3.SQLITE_CANTOPEN: "cannot be opened; check the path and the permissions of the file and its folder",
    sqlite3.SQLITE_FULL: "cannot grow: the disk is full; nothing was changed, make room and try again",
    sqlite3.SQLITE_TOOBIG: "cannot take an array of more than 1 GB; use a coarser model",
}


class Record(NamedTuple):
    """What a record is called, the hash of its content, and its facts (anything JSON can say)."""

    sha256: str
    name: str
    facts: Mapping[str, Any]


class Store:
    """Records in a file or in memory. Every method raises LibraryError, one line, where the file fails it."""

    def __init__(self, connection: sqlite3.Connection, label: str, timeout_s: float) -> None:
        self._connection, self._label, self._timeout_s = connection, label, timeout_s
        # A text that was damaged into no text is left to its CRC.
        connection.text_factory = lambda text: text.decode(errors="replace")

    @staticmethod
    def open(path: Path, *, create: bool, timeout_s: float) -> Store:
        """Open a file; only `create` makes one, and a call that only reads leaves no file behind."""
        if path.is_dir() or not (path.exists() or create):
            what = "is a folder; name a file" if path.is_dir() else "does not exist; add a model to make it"
            msg = f"model library {path} {what}"
            raise LibraryError(msg)
        # mode=rw opens a write-protected file for reading. The rollback journal, not WAL: it needs no files of its own
        # to read, so a library on a read-only medium works, and what is at rest is one file.
        mode = "rwc" if create else "rw"
        label = f"model library {path}"
        with _in_words(label, timeout_s):
            connection = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=timeout_s, isolation_level=None
            )
        store = Store(connection, label, timeout_s)
        try:
            store._prepare(create=create and path.stat().st_size == 0)
        except BaseException:
            connection.close()
            raise
        return store

    @staticmethod
    def in_memory() -> Store:
        """An empty store that vanishes when closed."""
        store = Store(sqlite3.connect(":memory:", isolation_level=None), "model library in memory", 0.0)
        store._prepare(create=True)
        return store

    def _prepare(self, *, create: bool) -> None:
        with _in_words(self._label, self._timeout_s):
            # The file may come from anyone: its schema runs nothing, its pages are not trusted.
            self._connection.execute("PRAGMA trusted_schema = OFF")
            self._connection.execute("PRAGMA cell_size_check = ON")
            if create:
                self._connection.execute("PRAGMA auto_vacuum = FULL")  # a model removed gives its room back
        if create:
            with self.transaction(write=True) as database:
                # Another process may have made it between our look and our lock.
                if not _schema(database):
                    _create(database)
        with self.transaction() as database:
            (application,) = database.execute("PRAGMA application_id").fetchone()
            (version,) = database.execute("PRAGMA user_version").fetchone()
            if application != APPLICATION_ID:
                what = "is not a model library; name another file"
            elif version != VERSION:
                what = f"has version {version}, this scanfind reads {VERSION}; build it anew from the model files"
            elif _schema(database) != _our_schema():
                what = REMEDY[sqlite3.SQLITE_CORRUPT]
            else:
                return
            msg = f"{self._label} {what}"
            raise LibraryError(msg)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    @contextmanager
    def transaction(self, *, write: bool = False) -> Iterator[sqlite3.Connection]:
        """All or nothing; what is read inside belongs together. A writer waits for its turn at the door."""
        with _in_words(self._label, self._timeout_s):
            self._connection.execute("BEGIN IMMEDIATE" if write else "BEGIN")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise

    # Everything below is called inside a transaction.

    def records(self) -> list[Record]:
        """All records, sorted by name (code points)."""
        rows = self._connection.execute("SELECT sha256, name, facts, crc FROM records ORDER BY name").fetchall()
        found = [self._record(row) for row in rows]
        if self._connection.execute("SELECT crcs FROM content").fetchall() != [(sum(row[3] for row in rows),)]:
            self.damaged("the list of models")
        return found

    def by_name(self, name: str) -> Record | None:
        """The record of that name."""
        query = "SELECT sha256, name, facts, crc FROM records WHERE name = ?"
        row = self._connection.execute(query, (name,)).fetchone()
        return self._record(row) if row else None

    def by_hash(self, sha256: str) -> Record | None:
        """The record of that hash."""
        query = "SELECT sha256, name, facts, crc FROM records WHERE sha256 = ?"
        row = self._connection.execute(query, (sha256,)).fetchone()
        return self._record(row) if row else None

    def arrays(self, record: Record) -> dict[str, NDArray[Any]]:
        """The arrays of a record by role; each is checked against its shape and its CRC."""
        found = {}
        query = "SELECT role, dtype, shape, crc, data FROM arrays WHERE sha256 = ? ORDER BY role"
        for role, dtype, shape, crc, data in self._connection.execute(query, (record.sha256,)):
            what = f"array {role!r} of {record.name!r}"
            if not isinstance(data, bytes) or crc != _crc(role, dtype, shape, data=data) or dtype not in DTYPES:
                self.damaged(what)
            sizes = self._json(shape, what)
            fits = isinstance(sizes, list) and all(isinstance(size, int) and size >= 0 for size in sizes)
            if not fits or math.prod(sizes) * np.dtype(dtype).itemsize != len(data):
                self.damaged(what)
            found[str(role)] = np.frombuffer(data, dtype).reshape(sizes).astype(np.dtype(dtype).newbyteorder("="))
        return found

    def insert(self, record: Record, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Add a record with its arrays, float64 or int32."""
        self._put(record)
        for role, array in arrays.items():
            dtype = f"<{array.dtype.kind}{array.dtype.itemsize}"
            data, shape = np.ascontiguousarray(array, dtype).tobytes(), json.dumps(array.shape)
            row = (record.sha256, role, dtype, shape, _crc(role, dtype, shape, data=data), data)
            self._connection.execute("INSERT INTO arrays VALUES (?, ?, ?, ?, ?, ?)", row)

    def replace(self, record: Record) -> None:
        """Put a record in the place of the one with its hash; the arrays stay."""
        self._take(record.sha256)
        self._put(record)

    def delete(self, record: Record) -> None:
        """Take a record and its arrays out."""
        self._take(record.sha256)
        self._connection.execute("DELETE FROM arrays WHERE sha256 = ?", (record.sha256,))

    def damaged(self, what: str) -> NoReturn:
        """Raise the error for content that is not what was written."""
        msg = f"{self._label} {REMEDY[sqlite3.SQLITE_CORRUPT]} ({what} does not add up)"
        raise LibraryError(msg)

    def _put(self, record: Record) -> None:
        row = (record.sha256, record.name, json.dumps(record.facts))
        crc = _crc(*row)
        self._connection.execute("INSERT INTO records VALUES (?, ?, ?, ?)", (*row, crc))
        self._connection.execute("UPDATE content SET crcs = crcs + ?", (crc,))

    def _take(self, sha256: str) -> None:
        query = "UPDATE content SET crcs = crcs - (SELECT crc FROM records WHERE sha256 = ?)"
        self._connection.execute(query, (sha256,))
        self._connection.execute("DELETE FROM records WHERE sha256 = ?", (sha256,))

    def _record(self, row: tuple[Any, ...]) -> Record:
        sha256, name, facts, crc = row
        if crc != _crc(sha256, name, facts):
            self.damaged(f"model {name!r}")
        return Record(sha256, name, self._json(facts, f"model {name!r}"))

    def _json(self, text: Any, what: str) -> Any:
        try:
            return json.loads(text)
        except (TypeError, ValueError, RecursionError):
            self.damaged(what)


def _create(database: sqlite3.Connection) -> None:
    for statement in SCHEMA:
        database.execute(statement)
    database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    database.execute(f"PRAGMA user_version = {VERSION}")


def _schema(database: sqlite3.Connection) -> list[Any]:
    return database.execute("SELECT type, name, sql FROM sqlite_master ORDER BY type, name").fetchall()


def _our_schema() -> list[Any]:
    with sqlite3.connect(":memory:") as database:
        _create(database)
        schema = _schema(database)
    database.close()
    return schema


def _crc(*texts: object, data: bytes = b"") -> int:
    return zlib.crc32(data, zlib.crc32(repr(texts).encode("utf-8", "backslashreplace")))


@contextmanager
def _in_words(label: str, timeout_s: float) -> Iterator[None]:
    """Turn what SQLite says into one line: what, why, what to do."""
    try:
        yield
    except UnicodeDecodeError as error:  # SQLite quotes a damaged schema in a message that Python cannot read
        msg = f"{label} {REMEDY[sqlite3.SQLITE_CORRUPT]}"
        raise LibraryError(msg) from error
    except sqlite3.Error as error:
        detail = getattr(error, "sqlite_errorcode", -1)
        code = detail & 0xFF  # the low byte is the kind of error
        if code in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
            what = f"is being written by another process and was not free within {timeout_s:g} s; try again"
        else:
            what = REMEDY.get(detail) or REMEDY.get(code) or f"failed: {' '.join(str(error).split())}"
        msg = f"{label} {what}"
        raise LibraryError(msg) from error
