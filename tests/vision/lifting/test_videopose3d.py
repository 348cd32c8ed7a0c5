import csv
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import TensorsimError
from tensorsim.vision.lifting.videopose3d import VideoPose3D
from tests.networks import settled
from tests.stage import StageTester


def make_network(kernels: tuple[int, ...] = (3, 3, 5)) -> VideoPose3D:
    torch.manual_seed(1)
    return settled(VideoPose3D(kernels, channels=16))


class TestVideoPose3D(StageTester):
    def make(self) -> nn.Module:
        return make_network((3, 3))

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (torch.rand(*batch, 4, 17, 2, dtype=dtype, generator=torch.Generator().manual_seed(0)),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(4, 14, 2),), "expected .*17"),
            ((torch.zeros(17, 2),), r"expected \(..., T, 17, 2\)"),
            ((torch.zeros(0, 4, 17, 2),), "empty|expected"),
        ]


def strided(state: dict[str, Tensor], window: Tensor, kernels: tuple[int, ...]) -> Tensor:
    """The other published form: a window of exactly the receptive field (1, 34, R) to one frame, with strides."""

    def conv(x: Tensor, name: str, stride: int) -> Tensor:
        x = F.conv1d(x, state[f"{name}.conv.weight"], stride=stride)
        gain = state[f"{name}.bn.weight"] / torch.sqrt(state[f"{name}.bn.running_var"] + 1e-5)
        x = (x - state[f"{name}.bn.running_mean"][:, None]) * gain[:, None]
        return (x + state[f"{name}.bn.bias"][:, None]).relu()

    x = conv(window, "backbone.expand_conv", kernels[0])
    for i, kernel in enumerate(kernels[1:]):
        block = f"backbone.tcn_blocks.{i}"
        x = x[:, :, kernel // 2 :: kernel] + conv(conv(x, f"{block}.conv1.0", kernel), f"{block}.conv2.0", 1)
    return F.conv1d(x, state["head.conv.weight"], state["head.conv.bias"])


def test_equals_the_strided_form_on_every_window() -> None:
    kernels = (3, 3, 5)
    network = make_network(kernels).double()
    joints = torch.rand(7, 17, 2, dtype=torch.float64)
    assert network.receptive_field == 45
    padded = F.pad(joints.flatten(1).T.unsqueeze(0), [22, 22], mode="replicate")
    with torch.no_grad():
        lifted = network(joints)
        for t in range(7):
            expected = strided(network.state_dict(), padded[..., t : t + 45], kernels)
            torch.testing.assert_close(lifted[t], expected.view(17, 3), rtol=0, atol=1e-10)


@pytest.mark.parametrize(("frames", "parameters"), [(27, 8_555_571), (81, 12_753_971), (243, 16_952_371)])
def test_sizes_of_the_published_nets(frames: int, parameters: int) -> None:
    kernels = {27: (3,) * 3, 81: (3,) * 4, 243: (3,) * 5}[frames]
    with torch.device("meta"):
        network = VideoPose3D(kernels)
    assert network.receptive_field == frames
    assert sum(p.numel() for p in network.parameters()) == parameters


def test_keys_and_shapes_of_the_published_checkpoints(shared_data: Path) -> None:
    with open(shared_data.parent / "specs" / "keys_videopose3d_243.tsv", newline="") as file:
        manifest = {
            key: [] if shape == "scalar" else [int(n) for n in shape.split("x")]
            for key, shape in csv.reader(file, delimiter="\t")
        }
    with torch.device("meta"):
        state = VideoPose3D().state_dict()
    assert {key: list(value.shape) for key, value in state.items()} == manifest


@pytest.mark.parametrize("head", ["head", "keypoint_head"])
def test_loads_both_namings(tmp_path: Path, head: str) -> None:
    network = make_network()
    state = {key.replace("head.", f"{head}."): value for key, value in network.state_dict().items()}
    torch.save({"state_dict": state}, tmp_path / "net.pth")
    joints = torch.rand(5, 17, 2)
    assert torch.equal(VideoPose3D.from_pretrained(tmp_path / "net.pth")(joints), network(joints))
    torch.save({"state_dict": {"other": torch.zeros(1)}}, tmp_path / "net.pth")
    with pytest.raises(TensorsimError, match="expected those of VideoPose3D"):
        VideoPose3D.from_pretrained(tmp_path / "net.pth")


@pytest.mark.parametrize("kernels", [(), (3, 2)])
def test_bad_kernels(kernels: tuple[int, ...]) -> None:
    with pytest.raises(TensorsimError, match="expected odd lengths"):
        VideoPose3D(kernels)
