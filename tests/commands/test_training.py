"""What all training commands share."""

from pathlib import Path

import pytest
import torch
from torch import nn

from tensorsim.commands.training import TrainOptions
from tensorsim.training import loop
from tensorsim.training.loop import Recipe


def test_the_first_process_tells_the_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(loop, "fit", lambda *_: {"score": 0.5, "step": 3.0})
    options = TrainOptions(out=tmp_path)
    for rank, printed in (("0", f"{tmp_path / 'best.safetensors'}: score 0.5, step 3\n"), ("1", "")):
        monkeypatch.setenv("RANK", rank)
        recipe = Recipe(nn.Identity(), {}, {})
        assert options.train(recipe, None) == tmp_path / "best.safetensors"  # type: ignore[arg-type]
        assert capsys.readouterr().out == printed


def test_a_run_from_other_weights_is_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where they took the place of the first ones."""
    monkeypatch.setattr(loop, "fit", lambda *_: {"score": 0.5})
    starts = set()
    for content in (None, b"first", b"second", b"second"):
        init = None if content is None else tmp_path / "w.safetensors"
        if init is not None:
            init.write_bytes(content or b"")
        recipe = Recipe(nn.Identity(), {}, {})
        TrainOptions(out=tmp_path, init=init).train(recipe, None)  # type: ignore[arg-type]
        starts.add(recipe.settings["init"])
    assert None in starts
    assert len(starts) == 3


@pytest.mark.parametrize(
    ("capabilities", "precision"),
    [
        ({"avx512_f": True, "amx_bf16": False}, "float32"),
        ({"avx512_bf16": True}, "bfloat16"),
        ({"bf16": True, "neon": True}, "bfloat16"),
    ],
)
def test_bfloat16_where_the_processor_has_instructions_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool], precision: str
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    assert TrainOptions(out=tmp_path, device="cpu").loop(steps=1, batch=1).precision == precision
    told = TrainOptions(out=tmp_path, device="cpu", precision="bfloat16")
    assert told.loop(steps=1, batch=1).precision == "bfloat16"
