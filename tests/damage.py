"""Damage for files that readers must survive: bytes turned over, a tail cut off, a piece doubled."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from scanfind.cloud import PointChunk
from scanfind.errors import ScanfindError
from scanfind.scans import read_scan, scan_info


@st.composite
def damaged(draw: st.DrawFn, sound: bytes) -> bytes:
    """`sound` with up to eight bytes replaced, then perhaps cut short or a piece of it repeated."""
    content = bytearray(sound)
    for _ in range(draw(st.integers(0, 8))):
        content[draw(st.integers(0, len(content) - 1))] = draw(
            st.one_of(st.integers(0, 255), st.sampled_from(b"0 9-\n.,"))
        )
    first, last = sorted((draw(st.integers(0, len(content))), draw(st.integers(0, len(content)))))
    match draw(st.sampled_from(["whole", "cut", "repeated"])):
        case "cut":
            del content[last:]
        case "repeated":
            content[last:last] = content[first:last]
    return bytes(content)


def read_all(path: Path, chunk_points: int = 1_000_000) -> PointChunk:
    """All chunks of a file as one, after checking what every chunk promises."""
    chunks = list(read_scan(path, chunk_points=chunk_points))
    assert chunks, "no points"
    assert all(len(chunk) <= chunk_points for chunk in chunks)
    assert all(len(chunk) for chunk in chunks[:-1])
    for chunk in chunks:
        assert np.isfinite(chunk.xyz).all()
        assert all(values.shape == (len(chunk),) for values in chunk.attributes.values())
        assert all(values.dtype.isnative for values in chunk.attributes.values())
    return PointChunk(
        np.concatenate([chunk.xyz for chunk in chunks]),
        {name: np.concatenate([chunk.attributes[name] for chunk in chunks]) for name in chunks[0].attributes},
        np.concatenate([chunk.source_index for chunk in chunks]),
        chunks[-1].scan,
        chunks[0].origin,
        sum(chunk.dropped for chunk in chunks),
    )


def assert_same(a: PointChunk, b: PointChunk) -> None:
    """Same points, attributes with their types, indices, origin and count of dropped records."""
    np.testing.assert_array_equal(a.xyz, b.xyz)
    np.testing.assert_array_equal(a.source_index, b.source_index)
    assert list(a.attributes) == list(b.attributes)
    for name, values in a.attributes.items():
        assert values.dtype == b.attributes[name].dtype
        np.testing.assert_array_equal(values, b.attributes[name])
    assert a.dropped == b.dropped
    assert (a.origin is None) == (b.origin is None)


def assert_reads_or_refuses(path: Path) -> None:
    """A file gives points or one line of complaint, and nothing else: no other exception, no warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for ask in (scan_info, lambda p: list(read_scan(p, chunk_points=7))):
            complaint = "none"
            try:
                ask(path)
            except ScanfindError as error:
                complaint = str(error)
            assert len(complaint.splitlines()) == 1
