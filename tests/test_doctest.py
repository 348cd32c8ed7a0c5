"""Examples in docstrings run and print what they show."""

import doctest
import importlib
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import tensorsim as ts

PACKAGE = Path(ts.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if ">>>" in path.read_text(encoding="utf-8")
)


@pytest.fixture
def _film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A film of 65 frames that examples read as ``clip.mp4``."""
    monkeypatch.chdir(tmp_path)
    ts.data.write_video(tmp_path / "clip.mp4", [np.full((48, 64, 3), 128, np.uint8)] * 65, 30.0)


@pytest.mark.parametrize("name", MODULES)
@pytest.mark.usefixtures("_film")
def test_examples(name: str) -> None:
    module = importlib.import_module(name)
    known = {
        **vars(module),
        "torch": torch,
        "ts": ts,
        "detector": ts.vision.RTMDet.from_pretrained(),
        "pose": ts.vision.HRNet.from_pretrained(),
        "video": torch.zeros(1, 6, 3, 64, 64, dtype=torch.uint8),
        "fps": 30.0,
    }
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    tests = [t for t in doctest.DocTestFinder().find(module, name, globs=known) if t.examples]
    report: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ts.TensorsimWarning)  # nobody is in the video above
        for test in tests:
            runner.run(test, out=report.append)
    assert runner.tries > 0
    assert runner.failures == 0, "".join(report)
