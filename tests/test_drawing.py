"""Figures drawn in a process of their own, and the command that uses it."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from tensorsim import plot
from tensorsim.exceptions import TensorsimError
from tensorsim.files import NotWrittenError
from tensorsim.plot.apart import Drawing, drawing_apart
from tensorsim.process import cpu_quota

FIGURE = partial(plot.confusion_figure, np.eye(2), ["a", "b"], "counts")


def end_process() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def pool() -> Iterator[Executor]:
    with ProcessPoolExecutor(1, get_context("spawn")) as one:
        yield one


def test_another_process_draws_the_same_figure(pool: Executor, tmp_path: Path) -> None:
    here, there = Drawing(), Drawing(pool)
    with here.complete(), there.complete():
        here.draw(FIGURE, tmp_path / "here.png")
        there.draw(FIGURE, tmp_path / "there.png")
    assert (tmp_path / "here.png").read_bytes() == (tmp_path / "there.png").read_bytes()


def test_errors_of_the_other_process_are_raised_here(pool: Executor, tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    drawing = Drawing(pool)
    with pytest.raises(NotWrittenError, match=r"a\.png: could not be written"), drawing.complete():
        drawing.draw(FIGURE, tmp_path / "a.png")


def test_nothing_is_drawn_any_more_after_a_failure(pool: Executor, tmp_path: Path) -> None:
    def interrupted(drawing: Drawing) -> None:
        with drawing.complete():
            for index in range(20):
                drawing.draw(FIGURE, tmp_path / f"{index}.png")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted(Drawing(pool))
    written = set(tmp_path.iterdir())
    assert len(written) < 20
    later = Drawing(pool)
    with later.complete():
        later.draw(FIGURE, tmp_path / "later.png")
    assert set(tmp_path.iterdir()) == {*written, tmp_path / "later.png"}


def test_a_process_that_was_killed_is_said(tmp_path: Path) -> None:
    def killed(pool: Executor) -> None:
        drawing = Drawing(pool)
        with drawing.complete():
            pool.submit(end_process)
            drawing.draw(FIGURE, tmp_path / "a.png")

    with (
        ProcessPoolExecutor(1, get_context("spawn")) as one,
        pytest.raises(TensorsimError, match="process that draws them was killed"),
    ):
        killed(one)
    assert list(tmp_path.iterdir()) == []


def test_only_the_command_starts_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def pools(cores: int, command: bool) -> bool:
        monkeypatch.setattr("tensorsim.plot.apart.cpu_quota", lambda: cores)
        monkeypatch.setattr("tensorsim.plot.apart.is_command", lambda: command)
        with drawing_apart() as drawing:
            return drawing._pool is not None

    assert [pools(2, True), pools(1, True), pools(2, False)] == [True, False, False]


@pytest.mark.skipif(cpu_quota() < 2, reason="the command draws in its own process on one processor")
@pytest.mark.parametrize(
    "command", [["-m", "tensorsim"], [shutil.which("tensorsim", path=Path(sys.executable).parent)]]
)
def test_the_process_that_draws_needs_no_torch(command: list[str], tmp_path: Path) -> None:
    """Python prints what is imported, in both processes."""
    joints = np.full((12, 14, 3), (0.0, 3.0, 1.0))
    joints[:, :, 2] += np.linspace(0.7, -0.7, 14)
    np.savez(tmp_path / "rising.npz", joints_m=joints[None], fps=10.0)
    written = tmp_path / "out"
    options = ["simulate", str(tmp_path / "rising.npz"), "--out", str(written), "--quiet"]
    done = subprocess.run(
        [sys.executable, "-X", "importtime", *command, *options], capture_output=True, text=True, check=True
    )
    imported = [line.split("|")[-1].strip() for line in done.stderr.splitlines() if "import time:" in line]
    counts = {name: imported.count(name) for name in ("tensorsim.plot.figure", "torch", "matplotlib.figure")}
    assert counts == {"tensorsim.plot.figure": 2, "torch": 1, "matplotlib.figure": 1}
    assert {"skeleton.png", "doppler_time.png"} <= {path.name for path in written.iterdir()}
