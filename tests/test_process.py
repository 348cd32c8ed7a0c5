"""The process of the command: how it starts and how it ends."""

import os
import platform
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tensorsim import process


def run_python(code: str, **options: object) -> subprocess.CompletedProcess[str]:
    threads = ("OMP_", "GOMP_", "OPENBLAS_", "OPENCV_FOR_THREADS_")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(threads)}
    environment["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment, **options
    )  # type: ignore[call-overload,no-any-return]


#: Something to do at the moment at which the package imports torch, and nothing after it.
AT_IMPORT = """
import os, signal, sys
class Watch:
    def find_spec(self, name, *_):
        if name == "torch":
            {action}
sys.meta_path.insert(0, Watch())
sys.argv = {argv}
from tensorsim.cli import main
main()
"""


def test_an_interrupt_while_torch_is_imported_is_one_line() -> None:
    interrupt = "os.kill(os.getpid(), signal.SIGINT)"
    done = run_python(AT_IMPORT.format(action=interrupt, argv=["/usr/bin/tensorsim", "check"]))
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "tensorsim: interrupted\n")


def test_threads_are_settled_before_torch_is_imported_and_for_the_command_only() -> None:
    names = ("GOMP_SPINCOUNT", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    show = f"print(*[os.environ.get(name) for name in {names}]); os._exit(0)"
    for argv, expected in (
        (["/usr/bin/tensorsim", "check"], "100 1 1"),
        (["my_program.py", "check"], "None None None"),
    ):
        done = run_python(AT_IMPORT.format(action=show, argv=argv))
        assert done.stdout.strip() == expected, done.stderr


#: Prints how many pages the kernel provided for ten blocks of 10 000 pages, one after another.
BLOCKS = """
import os, resource
from tensorsim import process
os.environ.update({settings})
process.keep_freed_memory()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    block = b"x" * 40_960_000
    del block
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only the GNU C library has this setting")
def test_freed_memory_is_reused_unless_the_user_has_decided() -> None:
    assert int(run_python(BLOCKS.format(settings={})).stdout) < 15_000
    kept = run_python(BLOCKS.format(settings={"MALLOC_MMAP_THRESHOLD_": "131072"}))
    assert int(kept.stdout) > 90_000


def test_a_deleted_working_directory_is_said(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    remove = f"os.rmdir({str(gone)!r})\n"
    code = "import os\n" + remove + AT_IMPORT.format(action="os._exit(0)", argv=["tensorsim", "check"])
    done = run_python(code, cwd=gone)
    assert done.returncode == 2
    assert done.stderr == "tensorsim: error: the working directory was deleted, go to one that exists\n"


#: A process that is ended by a signal while it writes a folder.
ENDED_WHILE_WRITING = """
import os, signal, time
from pathlib import Path
from tensorsim import process
from tensorsim.files import complete_or_nothing
with process.ending_cleanly(), complete_or_nothing(Path("out")) as folder:
    (folder / "half").touch()
    os.kill(os.getpid(), signal.{name})
    time.sleep(5)
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_signals_leave_nothing_behind(name: str, tmp_path: Path) -> None:
    done = run_python(ENDED_WHILE_WRITING.format(name=name), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (128 + signal.Signals[name], "")
    assert list(tmp_path.iterdir()) == []


def test_handlers_of_signals_are_put_back() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    with process.ending_cleanly():
        assert signal.getsignal(signal.SIGTERM) is not before[1]
    assert [signal.getsignal(number) for number in numbers] == before


@pytest.mark.parametrize("redirect", [">&-", ">/dev/full"])
def test_output_that_nobody_can_take(redirect: str) -> None:
    root = Path(__file__).resolve().parents[1]
    command = f"exec '{sys.executable}' -m tensorsim models list {redirect}"
    done = subprocess.run(
        ["bash", "-c", command],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(root)},
    )
    if redirect == ">&-":
        assert (done.returncode, done.stderr) == (0, "")
    else:
        assert (done.returncode, done.stderr) == (2, "tensorsim: error: [Errno 28] No space left on device\n")


def test_threads_of_a_container(tmp_path: Path) -> None:
    here = process.cpu_quota(tmp_path / "none")
    assert here >= 1
    for text, expected in (
        ("max 100000", here),
        ("50000 100000", 1),
        ("100000 100000", 1),
        ("99900000 100000", here),
        ("rubbish", here),
    ):
        (tmp_path / "cpu.max").write_text(text)
        assert process.cpu_quota(tmp_path / "cpu.max") == expected


@pytest.mark.parametrize("arguments", [["--help"], ["simulate", "--help"], ["simulate", "film.mp4"]])
def test_help_and_bad_options_load_no_torch(arguments: list[str]) -> None:
    heavy = "print(sorted({'torch', 'cv2', 'scipy', 'matplotlib', 'onnxruntime'} & set(sys.modules)))"
    code = f"""
import atexit, sys
sys.argv = ["tensorsim"]
from tensorsim import cli
atexit.register(lambda: {heavy})
cli.main({arguments})
"""
    done = run_python(code)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr


def test_public_names_come_when_the_command_uses_them_and_at_once_elsewhere() -> None:
    code = """
import sys
sys.argv = [{program!r}]
import tensorsim as ts
print("torch" in sys.modules, "VideoToDoppler" in vars(ts))
assert all(getattr(ts, name) is not None for name in ts.__all__)
try:
    ts.nothing
except AttributeError as error:
    print(error)
"""
    nothing = "module 'tensorsim' has no attribute 'nothing'\n"
    for program, loaded in (("tensorsim", "False False\n"), ("my_program.py", "True True\n")):
        done = run_python(code.format(program=program))
        assert done.stdout == loaded + nothing, done.stderr


#: A pool with one worker, whose number it prints.
POOL = """
import multiprocessing, os, sys, time
from concurrent.futures import ProcessPoolExecutor
from process import end_with_parent  # a copy of the module: it is imported without torch
if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), end_with_parent)
    print(pool.submit(os.getpid).result(), flush=True)
    time.sleep(60)
"""


def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "pool.py").write_text(POOL)
    shutil.copy(process.__file__, tmp_path / "process.py")
    command = [sys.executable, str(tmp_path / "pool.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        parent.kill()
        try:
            parent.communicate(timeout=10)  # to the end of all who have its output
        except subprocess.TimeoutExpired:
            os.kill(worker, signal.SIGKILL)
            raise


#: Leaves the command, with something that still runs in its process; an exit handler tells if Python took its time.
LEAVE = """
import atexit, multiprocessing, threading, time
from tensorsim import process
atexit.register(print, "taken apart")
{running}
process.leave()
"""


@pytest.mark.parametrize(
    ("running", "said"),
    [
        ("", ""),
        ("threading.Thread(target=time.sleep, args=(9,), daemon=True).start()", ""),
        ("threading.Thread(target=lambda: (time.sleep(0.5), print('done'))).start()", "done\ntaken apart\n"),
        (
            "multiprocessing.get_context('fork').Process(target=time.sleep, args=(1,)).start()",
            "taken apart\n",
        ),
    ],
)
def test_the_command_ends_at_once_unless_something_still_runs(running: str, said: str) -> None:
    done = run_python(LEAVE.format(running=running))
    assert (done.returncode, done.stdout) == (0, said), done.stderr


def test_a_missing_film_is_said_before_torch_is_imported() -> None:
    done = run_python(
        AT_IMPORT.format(
            action="os._exit(9)", argv=["/usr/bin/tensorsim", "simulate", "nothing.mp4", "--out", "out"]
        )
    )
    assert done.returncode == 2
    assert done.stderr == (
        "tensorsim: error: nothing.mp4: no such file, expected a video, motion capture or keypoints\n"
    )
