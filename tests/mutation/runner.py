"""Runs tests on a copy of the package with one file changed."""

import importlib
import importlib.util
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType

from tests.mutation.nearest import ROOT, nearest_tests
from tests.mutation.slips import Slip

#: Imported once, before each run takes a copy of the process: they take longer than many tests.
LIBRARIES = (
    "pytest", "hypothesis", "numpy", "scipy.signal", "scipy.optimize", "scipy.spatial", "torch", "torch._dynamo",
    "torch.export", "torch.utils.data", "torchaudio", "kornia", "cv2", "onnx", "onnxruntime", "yaml", "tyro",
)  # fmt: skip
#: Tests after the first file are run while all together take no longer.
SECONDS = 12.0
#: A slip may make a test endless. Tests take this many times their usual time at most, and a while to begin.
PATIENCE, BEGIN_SECONDS = 4.0, 15.0


class Runner:
    """A copy of the package in a folder of its own; each run is a process that imports the copy."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="mutation")
        outer = Path(self._folder.name)
        self.root = outer / "tree"
        for name in ("tensorsim", "tests"):
            shutil.copytree(ROOT / name, self.root / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", self.root)
        for name in ("models", "README.md", "notebooks"):
            (self.root / name).symlink_to(ROOT / name)
        (outer / "shared").symlink_to(ROOT.parent / "shared")
        self._usual: dict[Path, tuple[list[Path], float]] = {}
        self._seconds: dict[Path, float] = {}
        for name in LIBRARIES:
            importlib.import_module(name)

    def __enter__(self) -> "Runner":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.cleanup()

    def outcome(self, file: Path, slip: Slip) -> str:
        """ "noticed", "too slow" (noticed too) or "survives"."""
        tests, usual = self._tests(file)
        if not tests:
            return "survives"
        copied = self.root / file.relative_to(ROOT)
        original = copied.read_text(encoding="utf-8")
        try:
            self._write(copied, slip.source)
            code = self._run(tests, BEGIN_SECONDS + PATIENCE * usual)
        finally:
            self._write(copied, original)
        if code is None:
            return "too slow"
        return "survives" if code in (0, 5) else "noticed"  # 5: pytest found no tests

    def _tests(self, file: Path) -> tuple[list[Path], float]:
        """The nearest tests that pass without a slip, and the seconds that they take."""
        if file not in self._usual:
            chosen: list[Path] = []
            total = 0.0
            for test in nearest_tests(file):
                if test not in self._seconds:
                    begin = time.monotonic()
                    code = self._run([test], 60.0)
                    self._seconds[test] = time.monotonic() - begin
                    if code in (1, 2, 3, 4):
                        raise SystemExit(f"{test.relative_to(ROOT)} fails without a slip")
                    if code is None:
                        self._seconds[test] = float("inf")
                if self._seconds[test] < float("inf") and (
                    not chosen or total + self._seconds[test] <= SECONDS
                ):
                    chosen.append(test)
                    total += self._seconds[test]
            self._usual[file] = chosen, total
        return self._usual[file]

    def _write(self, copied: Path, text: str) -> None:
        """Two slips within a second may have equal lengths: what was compiled before must go."""
        copied.write_text(text, encoding="utf-8")
        for compiled in (copied.parent / "__pycache__").glob(f"{copied.stem}.*"):
            compiled.unlink()

    def _run(self, tests: list[Path], seconds: float) -> int | None:
        """What pytest returns, or none after so many seconds."""
        names = [str(test.relative_to(ROOT)) for test in tests]
        process = multiprocessing.get_context("fork").Process(target=_pytest, args=(self.root, names))
        process.start()
        process.join(seconds)
        if process.is_alive():
            os.killpg(process.pid, signal.SIGKILL)
            process.join()
            return None
        return process.exitcode


def _pytest(root: Path, names: list[str]) -> None:
    """In a process of its own: run tests of the copy, up to the first that fails."""
    os.setsid()  # so that what tests start ends with them
    os.chdir(root)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    os.environ["PYTHONPATH"] = str(root)
    sys.dont_write_bytecode = False
    sys.path[:] = [str(root), *(place for place in sys.path if place not in ("", str(ROOT)))]
    for name in [name for name in sys.modules if name.split(".")[0] in ("tests", "tensorsim")]:
        del sys.modules[name]
    importlib.invalidate_caches()
    found = importlib.util.find_spec("tensorsim")
    if found is None or not str(found.origin).startswith(str(root)):
        raise SystemExit(f"{root} is not what is imported")
    import pytest
    import torch

    torch.set_num_threads(1)
    os._exit(pytest.main(["-x", "-q", "-n", "0", "-p", "no:cacheprovider", *names]))
