"""Export refuses edges, and leaves nothing half-written."""

from pathlib import Path

import pytest
import torch
from torch import nn

import tensorsim as ts
from tensorsim.vision.onnx_engine import OnnxPose


class Unscriptable(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return globals()["torch"].sin(x)  # type: ignore[no-any-return]


def test_writes_a_file_that_loads_and_keeps_the_mode(tmp_path: Path) -> None:
    module = nn.Sequential(nn.Linear(3, 3), nn.Dropout()).train()
    ts.export.to_torchscript(module, tmp_path / "m.pt")
    assert module.training
    loaded = torch.jit.load(tmp_path / "m.pt")
    x = torch.randn(2, 3)
    assert torch.equal(loaded(x), module.eval()(x)), "exported in evaluation mode"


def test_frozen_parts_stay_frozen(tmp_path: Path) -> None:
    module = nn.Sequential(nn.BatchNorm1d(3), nn.Dropout(), nn.Linear(3, 3)).train()
    module[0].eval()
    modes = [part.training for part in module.modules()]
    ts.export.to_torchscript(module, tmp_path / "m.pt")
    assert [part.training for part in module.modules()] == modes


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ts.TensorsimError, match="is a folder, expected a file"):
        ts.export.to_torchscript(nn.Linear(1, 1), tmp_path)


def test_what_is_no_module_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ts.TensorsimError, match="to_torchscript: got the class Linear, expected an instance of Module"
    ):
        ts.export.to_torchscript(nn.Linear, tmp_path / "m.pt")  # type: ignore[arg-type]


def test_leaves_nothing_behind_when_scripting_fails(tmp_path: Path) -> None:
    (tmp_path / "m.pt").write_bytes(b"old")
    with pytest.raises(
        ts.TensorsimError, match=r"got a Unscriptable that TorchScript cannot compile .*globals"
    ):
        ts.export.to_torchscript(Unscriptable(), tmp_path / "m.pt")
    assert [p.name for p in tmp_path.iterdir()] == ["m.pt"]
    assert (tmp_path / "m.pt").read_bytes() == b"old"


def test_a_network_in_another_runtime_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ts.TensorsimError, match="another runtime runs it, expected the network itself"):
        ts.export.to_torchscript(OnnxPose(nn.Conv2d(3, 17, 1)), tmp_path / "pose.pt")


def test_an_onnx_network_is_an_edge_and_says_so(tmp_path: Path, shared_data: Path) -> None:
    pose = ts.vision.OnnxHeatmaps(shared_data / "weights" / "simplepose_coco17_256x192.onnx")
    sim = ts.VideoToDoppler(ts.vision.RTMDet("nano-person"), pose, radar=ts.RadarConfig.through_wall())
    with pytest.raises(ts.TensorsimError, match="ONNX Runtime"):
        ts.export.to_torchscript(sim, tmp_path / "sim.pt")
    assert list(tmp_path.iterdir()) == []
