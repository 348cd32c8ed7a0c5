"""The process of the ``tensorsim`` command: threads that do not spin for long, and an exit that leaves nothing behind.

``tensorsim/__init__.py`` imports this first, because torch's OpenMP runtime reads its settings when it is loaded.
Importing it changes nothing in processes other than the command.
"""

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

#: Iterations that a thread spins while waiting for work before it sleeps. OpenMP's default keeps a core busy for
#: milliseconds, which makes everything many times slower when another thread needs that core, such as the one that
#: writes a film during the radar simulation; OpenMP itself uses 1000 when there are more threads than cores.
SPIN_ROUNDS = 100
#: Freed memory in blocks below this many bytes stays with the process. The C library would return each tensor of a
#: megabyte to the kernel, and the next one would cost a page fault for every 4 KB: a twentieth of the time of a film.
#: Live simulation gains nothing from it and would need 200 MB more.
KEPT_BLOCK_BYTES = 64_000_000
#: Environment variables with the numbers of threads of NumPy and OpenCV. Their work here is short and runs beside other
#: work, and their threads spin for a while after it: on one thread each, a film takes 3 % less processor time.
_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
#: Options of the GNU C library's ``mallopt``.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def is_command() -> bool:
    """Whether this process was started as ``tensorsim`` or ``python -m tensorsim``, or by such a process."""
    started = Path(sys.argv[0])
    module = started == Path(__file__).with_name("__main__.py") or sys.orig_argv[1:3] == ["-m", "tensorsim"]
    return started.stem == "tensorsim" or module


def prepare() -> None:
    """Do the setup needed before torch, NumPy and OpenCV are imported; variables set by the user are kept."""
    signal.signal(signal.SIGINT, _quit)
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & set(os.environ):
        os.environ["GOMP_SPINCOUNT"] = str(SPIN_ROUNDS)
    for name in _THREAD_COUNTS:
        os.environ.setdefault(name, "1")
    quota = cpu_quota()
    if "OMP_NUM_THREADS" not in os.environ and quota < (os.cpu_count() or 1):
        os.environ["OMP_NUM_THREADS"] = str(quota)
    try:
        os.getcwd()
    except FileNotFoundError:
        print("tensorsim: error: the working directory was deleted, go to one that exists", file=sys.stderr)
        os._exit(2)


def keep_freed_memory() -> None:
    """Let the process reuse freed memory, see :data:`KEPT_BLOCK_BYTES`; only with the GNU C library."""
    if {"MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"} & set(os.environ):
        return
    with suppress(AttributeError, OSError, TypeError):  # another C library, or none to ask
        library = ctypes.CDLL(None)
        for option in (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD):
            library.mallopt(option, KEPT_BLOCK_BYTES)


def cpu_quota(limit: Path = Path("/sys/fs/cgroup/cpu.max")) -> int:
    """Processors that this process may use, given its CPU affinity and the limit of its container."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = limit.read_text().split()
        return count if quota == "max" else max(1, min(count, round(int(quota) / int(period))))
    except (OSError, ValueError):
        return count


@contextmanager
def ending_cleanly() -> Iterator[None]:
    """In the block, SIGTERM and SIGHUP end the process as an exception would, so temporary files are removed.

    Closed standard streams are replaced by the null device.
    """
    for stream in ("stdin", "stdout", "stderr"):
        if getattr(sys, stream) is None:
            setattr(sys, stream, open(os.devnull, "r+", encoding="utf-8"))  # noqa: SIM115  # open until exit
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: _end}
    if hasattr(signal, "SIGHUP"):
        handlers[signal.SIGHUP] = _end
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def load_torch() -> None:
    """Import torch unless that is done, which takes a second; an interrupt meanwhile ends the process at once.

    Imported objects are kept out of garbage collection, which would cost another half second.
    """
    if "torch" in sys.modules:
        return
    before = signal.signal(signal.SIGINT, _quit)
    gc.disable()
    try:
        import torch  # noqa: F401
    finally:
        gc.freeze()
        gc.enable()
        signal.signal(signal.SIGINT, before)


def leave() -> None:
    """End the process now, unless something still runs in it: Python would first take everything apart for 0.3 s."""
    import multiprocessing
    import threading

    running = [thread for thread in threading.enumerate() if not thread.daemon]
    if running == [threading.current_thread()] and not multiprocessing.active_children():
        os._exit(0)


def end_with_parent() -> None:
    """Make this ``multiprocessing`` worker end when its parent process does, even if the parent is killed.

    Otherwise the workers of a pool would wait forever for their next job.
    """
    import multiprocessing
    import threading

    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _end(number: int, frame: FrameType | None) -> NoReturn:
    signal.signal(number, signal.SIG_IGN)  # only once: cleanup follows
    sys.exit(128 + number)


def _quit(number: int, frame: FrameType | None) -> NoReturn:
    print("tensorsim: interrupted", file=sys.stderr, flush=True)
    os._exit(130)  # nothing is written yet, and libraries turn exceptions in their imports into others


if is_command():
    prepare()
