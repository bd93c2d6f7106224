"""Every error scanfind raises on purpose: what, why, what to do, and the exit code it gives."""

from __future__ import annotations


class ScanfindError(Exception):
    """Base of all errors a user may meet. The message is one line: what, why, what to do."""

    exit_code = 1


class UsageError(ScanfindError):
    """The call itself is wrong: an unknown option, a value out of range, arguments that exclude each other."""

    exit_code = 2


def require(holds: bool, name: str, value: object, wanted: str) -> None:
    """Raise UsageError "name must be …, got …" unless a parameter holds to what is wanted of it."""
    if not holds:
        msg = f"{name} must be {wanted}, got {value}"
        raise UsageError(msg)


class InvalidGeometryError(ScanfindError):
    """An array, mesh or pose of the wrong shape or with impossible values (no triangle, no extent, NaN)."""


class UnreadableFileError(ScanfindError):
    """A file that is missing, damaged, cut short, or not of the format its name says."""


class UnsupportedFormatError(ScanfindError):
    """A format, version or schema that scanfind does not read or write."""


class MissingExtraError(ScanfindError):
    """An optional library is not installed; the message names the `pip install` that brings it."""


class AlignmentError(ScanfindError):
    """Where the design lies in the frame of the scans cannot be told, or in two ways equally well."""


class LibraryError(ScanfindError):
    """A model library that is damaged, of another version, locked, or lacks the model asked for."""


class OutputError(ScanfindError):
    """The result cannot be written: folder exists and is not ours, no room, no permission."""


class Interrupted(ScanfindError):  # noqa: N818 - not an error of anyone's
    """The user pressed Ctrl-C; nothing half written is left behind."""

    exit_code = 130
