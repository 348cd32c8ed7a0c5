"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# FFmpeg reads its log level when OpenCV first uses it, which is often a test that writes a film, not the reader.
os.environ["OPENCV_FFMPEG_LOGLEVEL"] = "-8"

# Tests run in a process per core: more threads in each would only wait for each other. Programs that tests start
# read it from the environment.
if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"

# The same examples at every run: a failure on one machine is a failure on all.
settings.register_profile("seeded", derandomize=True)
settings.load_profile("seeded")

#: Real videos, networks and motion beside the checkout; tests that read it skip where it is missing.
SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fuzz-seconds", default="0", help="time for random inputs beyond the usual number")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip(f"needs the real inputs at {SHARED_DATA}, which are not here")
    return SHARED_DATA


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)
