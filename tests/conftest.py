"""Fixtures shared by all tests."""

from pathlib import Path

import pytest
import torch

#: Real videos, networks and motion beside the checkout; tests that read it skip where it is missing.
SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip(f"needs the real inputs at {SHARED_DATA}, which are not here")
    return SHARED_DATA


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)
