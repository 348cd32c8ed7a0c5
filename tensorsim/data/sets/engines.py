"""Ways to run the work: in this process, in several processes, or on the nodes of a Ray cluster."""

import json
import logging
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

from tensorsim.errors import TensorsimError
from tensorsim.process import end_with_parent

Work = Callable[[Any], int]

#: Consecutive worker deaths before giving up.
_DEATHS = 3


class Engine(Protocol):
    """Runs independent jobs in any order."""

    def run(self, work: Work, jobs: Iterable[Any]) -> Iterator[int]:
        """Call ``work`` for every job; yields results as they arrive."""


class Serial:
    """Runs jobs in this process, one after the other."""

    def run(self, work: Work, jobs: Iterable[Any]) -> Iterator[int]:
        """See :class:`Engine`."""
        for job in jobs:
            yield work(job)


class Processes:
    """Runs jobs in several processes on this machine; a process that dies is replaced and its job repeated.

    Processes are spawned, so a script that uses them needs ``if __name__ == "__main__":``.

    Args:
        workers: number of processes.

    Raises:
        TensorsimError: workers die several times in a row, or an error raised by a job.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def run(self, work: Work, jobs: Iterable[Any]) -> Iterator[int]:
        """See :class:`Engine`."""
        waiting = list(jobs)[::-1]
        deaths = 0
        while waiting:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(min(self.workers, len(waiting)), context, _begin)
            running: dict[Future[int], Any] = {}
            try:
                while waiting or running:
                    while waiting and len(running) < 2 * self.workers:
                        running[pool.submit(work, waiting[-1])] = waiting[-1]
                        waiting.pop()  # only now: a pool that has broken meanwhile refuses jobs
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        count = future.result()
                        del running[future]
                        deaths = 0
                        yield count
            except BrokenProcessPool:
                deaths += 1
                waiting += running.values()
                if deaths == _DEATHS:
                    raise TensorsimError(
                        f"{_DEATHS} worker processes in a row died; there may be too little memory for this many "
                        "workers"
                    ) from None
            finally:
                _end(pool)


def _begin() -> None:
    end_with_parent()
    _one_thread()


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _end(pool: ProcessPoolExecutor) -> None:
    """Stop the workers, even in the middle of jobs that are no longer needed, so that none of them writes any more."""
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
    for process in processes:
        process.join()


class RayCluster:
    """Runs jobs on the nodes of a Ray cluster with Ray Data; all nodes need access to the data set's folder.

    Args:
        address: address of a running cluster; None starts one on this machine.
        workers: processors to use if a cluster is started on this machine.

    Raises:
        TensorsimError: Ray is not installed.
    """

    def __init__(self, address: str | None = None, workers: int = 1) -> None:
        try:
            import ray.data  # noqa: F401
        except ImportError as error:
            raise TensorsimError(
                f'--engine ray: Ray cannot be imported ({error}); install it with: pip install "tensorsim[scale]"'
            ) from None
        self.address, self.workers = address, workers

    def run(self, work: Work, jobs: Iterable[Any]) -> Iterator[int]:
        """See :class:`Engine`."""
        import ray

        waiting = list(jobs)
        if not waiting:
            return
        started = not ray.is_initialized()
        if started:
            # Unless the user wants it, a cluster of ours does not report its use to the makers of Ray.
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            ray.init(
                address=self.address,
                num_cpus=self.workers if self.address is None else None,
                include_dashboard=False,
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        try:
            logging.getLogger("ray.data").setLevel(logging.ERROR)
            ray.data.DataContext.get_current().enable_progress_bars = False
            rows = ray.data.from_items(
                [{"job": json.dumps(job)} for job in waiting], override_num_blocks=len(waiting)
            )
            kind, here = type(waiting[0]), os.getcwd()

            def done(row: dict[str, Any]) -> dict[str, int]:
                _one_thread()
                os.chdir(here)  # paths of a recipe are relative
                return {"count": work(kind(*json.loads(row["job"])))}

            for row in rows.map(done, num_cpus=1).iter_rows():
                yield int(row["count"])
        finally:
            if started:
                ray.shutdown()
