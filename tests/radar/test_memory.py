"""A ten-minute clip needs little more memory than its maps."""

import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_ten_minutes_stay_below_one_gibibyte_plus_outputs():
    command = [sys.executable, "-m", "tests.benchmarks.bench_radar", "--ten-minutes"]
    run = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    peak = re.search(r"peak ([\d.]+) GiB, of which outputs ([\d.]+) GiB", run.stdout)
    assert peak is not None, run.stdout
    assert float(peak[1]) < 1 + float(peak[2])
    assert "range-time (200, 59942)" in run.stdout
