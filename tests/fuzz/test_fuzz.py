"""5000 inputs, and as many more as there is time for; what once failed is tried first."""

import time
from pathlib import Path

import pytest

from tests.fuzz.inputs import KINDS, BrokenError, run

#: How many of each kind; cheap ones more often.
COUNTS = {"stage": 3000, "settings": 800, "yaml": 500, "file": 640, "command": 60}
CORPUS = [line.split() for line in (Path(__file__).parent / "corpus.txt").read_text().splitlines()]


@pytest.mark.parametrize(("kind", "seed"), CORPUS)
def test_what_once_failed(kind: str, seed: str) -> None:
    run(kind, int(seed))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_random_inputs(kind: str, request: pytest.FixtureRequest) -> None:
    end = time.monotonic() + float(request.config.getoption("--fuzz-seconds")) / len(KINDS)
    broken, seed = [], 0
    while seed < COUNTS[kind] or time.monotonic() < end:
        try:
            run(kind, seed)
        except BrokenError as error:
            broken.append(str(error))
        seed += 1
    assert not broken, f"{len(broken)} of {seed} broke:\n" + "\n".join(broken[:20])
