"""Times of ours and of peers, taken in turn in one run."""

import os
import statistics
import sys
import time
from collections.abc import Callable

import torch


def host() -> str:
    """What a table of times was measured on."""
    return f"torch {torch.__version__}, {torch.get_num_threads()} thread(s), load {os.getloadavg()[0]:.1f}"


Clock = Callable[[], float]


def chosen_clock() -> Clock:
    """Wall time, or with ``--cpu`` on the command line the processor's."""
    return time.process_time if "--cpu" in sys.argv else time.perf_counter


def seconds(function: Callable[[], object], clock: Clock = time.perf_counter) -> float:
    """Time of one call.

    ``clock=time.process_time`` counts the work of all threads and leaves out what others do on a busy machine.
    """
    start = clock()
    function()
    return clock() - start


def medians(
    functions: list[Callable[[], object]], rounds: int, clock: Clock = time.perf_counter
) -> list[float]:
    """Median seconds of each, called in turn; a round before the first warms up."""
    for function in functions:
        function()
    times = [[seconds(function, clock) for function in functions] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*times, strict=True)]
