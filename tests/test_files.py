"""Files and folders appear whole, with ordinary rights, or not at all."""

from pathlib import Path

import pytest
import torch
from torch import nn

import tensorsim as ts
from tensorsim.files import complete_file, complete_or_nothing
from tensorsim.weights import save_weights


def test_a_file_appears_at_the_end_in_a_folder_that_is_made(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    with complete_file(path) as scratch:
        scratch.write_text("half")
        assert not path.exists()
        scratch.write_text("whole")
    assert path.read_text() == "whole"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


def test_a_block_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), complete_file(path) as scratch:  # noqa: PT012
        scratch.write_text("half")
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt), complete_or_nothing(tmp_path / "folder") as folder:  # noqa: PT012
        (folder / "b.txt").write_text("half")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert path.read_text() == "old"


def test_others_may_read_what_is_written(tmp_path: Path) -> None:
    (tmp_path / "usual").touch()
    ts.export.to_torchscript(nn.Linear(2, 2), tmp_path / "m.pt")
    save_weights(nn.Linear(2, 2), tmp_path / "m.safetensors", {})
    assert len({p.stat().st_mode for p in tmp_path.iterdir()}) == 1
    assert torch.jit.load(tmp_path / "m.pt")(torch.zeros(1, 2)).shape == (1, 2)
