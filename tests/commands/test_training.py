"""What all training commands share."""

from pathlib import Path

import pytest

from tensorsim.commands.training import TrainOptions
from tensorsim.training import loop


def test_the_first_process_tells_the_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(loop, "fit", lambda *_: {"score": 0.5, "step": 3.0})
    options = TrainOptions(out=tmp_path)
    for rank, printed in (("0", f"{tmp_path / 'best.safetensors'}: score 0.5, step 3\n"), ("1", "")):
        monkeypatch.setenv("RANK", rank)
        assert options.train(None, None) == tmp_path / "best.safetensors"  # type: ignore[arg-type]
        assert capsys.readouterr().out == printed
