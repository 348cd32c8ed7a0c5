"""Figures drawn in a process of their own, and the command that uses it."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import pytest

from tensorsim import plot
from tensorsim.exceptions import TensorsimError
from tensorsim.files import NotWrittenError
from tensorsim.plot.apart import Drawing, drawing_apart
from tensorsim.process import cpu_quota

FIGURE = partial(plot.confusion_figure, np.eye(2), ["a", "b"], "counts")


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> Iterator[Drawing]:
    monkeypatch.setattr("tensorsim.plot.apart.cpu_quota", lambda: 2)
    monkeypatch.setattr("tensorsim.plot.apart.is_command", lambda: True)
    with drawing_apart() as drawing:
        yield drawing
    assert active_children() == []


def test_another_process_draws_the_same_figure(apart: Drawing, tmp_path: Path) -> None:
    here = Drawing()
    with here.complete(), apart.complete():
        here.draw(FIGURE, tmp_path / "here.png")
        apart.draw(FIGURE, tmp_path / "there.png")
    assert type(apart) is not Drawing
    assert (tmp_path / "here.png").read_bytes() == (tmp_path / "there.png").read_bytes()


def test_errors_of_the_other_process_are_raised_here(apart: Drawing, tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    with pytest.raises(NotWrittenError, match=r"a\.png: could not be written"), apart.complete():
        apart.draw(FIGURE, tmp_path / "a.png")


def test_nothing_is_drawn_any_more_after_a_failure(apart: Drawing, tmp_path: Path) -> None:
    def interrupted() -> None:
        with apart.complete():
            for index in range(20):
                apart.draw(FIGURE, tmp_path / f"{index}.png")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    written = set(tmp_path.iterdir())
    assert len(written) < 20
    apart.draw(FIGURE, tmp_path / "later.png")
    apart._pool.shutdown()  # type: ignore[attr-defined]  # waits
    assert set(tmp_path.iterdir()) == {*written, tmp_path / "later.png"}


@pytest.mark.parametrize("when", ["idle", "busy"])
def test_a_process_that_was_killed_is_said(apart: Drawing, tmp_path: Path, when: str) -> None:
    def killed() -> None:
        with apart.complete():
            if when == "busy":
                apart.draw(partial(os.kill, active_children()[0].pid, signal.SIGKILL), tmp_path / "b.png")
            else:
                active_children()[0].kill()
                active_children()[0].join()
            apart.draw(FIGURE, tmp_path / "a.png")

    with pytest.raises(TensorsimError, match=r"\.png: the process that draws figures has ended"):
        killed()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("cores", "command"), [(1, True), (2, False)])
def test_only_the_command_starts_a_process(
    monkeypatch: pytest.MonkeyPatch, cores: int, command: bool
) -> None:
    monkeypatch.setattr("tensorsim.plot.apart.cpu_quota", lambda: cores)
    monkeypatch.setattr("tensorsim.plot.apart.is_command", lambda: command)
    with drawing_apart() as drawing:
        assert (type(drawing), active_children()) == (Drawing, [])


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
