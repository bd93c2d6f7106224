"""Shared fixtures: where the real data lie."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# Beside the clone, where it is too large or not licensed to be copied in; SCANFIND_DATA names another place.
SHARED = Path(os.environ.get("SCANFIND_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scans and models made by others."""
    if not SHARED.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"CI must see the shared data at {SHARED}")
        pytest.skip(f"no shared data at {SHARED} (set SCANFIND_DATA)")
    return SHARED
