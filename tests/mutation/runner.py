"""Runs tests on a copy of the package with one file changed."""

import hashlib
import importlib
import importlib.util
import json
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.mutation.nearest import ROOT, nearest_tests
from tests.mutation.slips import Slip

#: Imported once, before each run takes a copy of the process: they take longer than many tests.
LIBRARIES = (
    "pytest", "hypothesis", "numpy", "scipy.signal", "scipy.optimize", "scipy.spatial", "torch", "torch._dynamo",
    "torch.export", "torch.utils.data", "torchaudio", "kornia", "cv2", "onnx", "onnxruntime", "yaml", "tyro",
)  # fmt: skip
#: Tests of one slip and file take no longer together, but for the first few.
SECONDS, FEW = 8.0, 3
#: A slip may make a test endless. Tests take this many times their usual time at most, and a while to begin.
PATIENCE, BEGIN_SECONDS = 5.0, 30.0
#: No file of tests takes longer.
LONGEST_SECONDS = 600.0


class Runner:
    """A copy of the package in a folder of its own; each run is a process that imports the copy.

    Args:
        store: a folder that keeps what was learnt of each file of tests, while the package is as it is.
    """

    def __init__(self, store: Path) -> None:
        store.mkdir(parents=True, exist_ok=True)
        self.store = store.resolve()
        self._folder = tempfile.TemporaryDirectory(prefix="mutation")
        outer = Path(self._folder.name)
        self.root = outer / "tree"
        for name in ("tensorsim", "tests"):
            shutil.copytree(ROOT / name, self.root / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", self.root)
        for name in ("models", "README.md", "notebooks"):
            (self.root / name).symlink_to(ROOT / name)
        (outer / "shared").symlink_to(ROOT.parent / "shared")
        package = sorted((self.root / "tensorsim").rglob("*.py"))
        self._package = hashlib.sha256(b"".join(file.read_bytes() for file in package))
        self._watched: dict[Path, dict[str, Any]] = {}
        for name in LIBRARIES:
            importlib.import_module(name)

    def __enter__(self) -> "Runner":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.cleanup()

    def outcome(self, file: Path, slip: Slip) -> str:
        """``noticed``, ``too slow`` (noticed too) or ``survives``."""
        copied = self.root / file.relative_to(ROOT)
        original = copied.read_text(encoding="utf-8")
        for test in nearest_tests(file):
            names, seconds = self._choice(test, str(file.relative_to(ROOT)), slip)
            if not names:
                continue
            try:
                self._write(copied, slip.source)
                code = self._run(names, BEGIN_SECONDS + PATIENCE * seconds)
            finally:
                self._write(copied, original)
            if code is None:
                return "too slow"
            if code not in (0, 5):  # 5: there are no tests
                return "noticed"
        return "survives"

    def _choice(self, test: Path, part: str, slip: Slip) -> tuple[list[str], float]:
        """Tests of a file that run the statement of a part of the package, quick ones first, and their seconds."""
        tests = sorted(self._watch(test).items(), key=lambda item: item[1]["seconds"])
        hits = [item for item in tests if not set(slip.lines).isdisjoint(item[1]["lines"].get(part, []))]
        chosen: list[str] = []
        total = 0.0
        for name, watched in hits or (tests if slip.by_import else []):
            if len(chosen) < FEW or total + watched["seconds"] <= SECONDS:
                chosen.append(name)
                total += watched["seconds"]
        return chosen, total

    def _watch(self, test: Path) -> dict[str, dict[str, Any]]:
        """Each test of a file with its seconds and the lines that it runs, without a slip."""
        if test not in self._watched:
            key = self._package.copy()
            key.update((self.root / test.relative_to(ROOT)).read_bytes())
            stored = self.store / f"{test.stem}.{key.hexdigest()[:16]}.json"
            if not stored.is_file():
                scratch = Path(self._folder.name) / "watched.json"
                code = self._run([str(test.relative_to(ROOT))], LONGEST_SECONDS, scratch)
                if code not in (0, 5):
                    raise SystemExit(f"{test.relative_to(ROOT)}: fails, or takes too long, without a slip")
                shutil.move(scratch, stored)
            self._watched[test] = json.loads(stored.read_text())
        return self._watched[test]

    def _write(self, copied: Path, text: str) -> None:
        """Two slips within a second may have equal lengths: what was compiled before must go."""
        copied.write_text(text, encoding="utf-8")
        for compiled in (copied.parent / "__pycache__").glob(f"{copied.stem}.*"):
            compiled.unlink()

    def _run(self, names: list[str], seconds: float, watched: Path | None = None) -> int | None:
        """What pytest returns for tests or a file of tests, or none after so many seconds."""
        process = multiprocessing.get_context("fork").Process(
            target=_pytest, args=(self.root, names, watched)
        )
        process.start()
        try:
            process.join(seconds)
            return process.exitcode
        finally:
            if process.is_alive():
                os.killpg(process.pid, signal.SIGKILL)
                process.join()


def _pytest(root: Path, names: list[str], watched: Path | None) -> None:
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

    from tests.mutation.watch import Choose, Watch

    torch.set_num_threads(1)
    files = sorted({name.partition("::")[0] for name in names})
    plugin = Watch(root, watched) if watched else Choose(names)
    early = "ignore::pytest.PytestAssertRewriteWarning"  # of LIBRARIES
    options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-W", early]
    os._exit(pytest.main([*options, *files], plugins=[plugin]))
