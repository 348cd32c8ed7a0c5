import csv
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.flop_counter import FlopCounterMode

from tensorsim.errors import TensorsimError
from tensorsim.pipeline import pretrained_pose
from tensorsim.vision.pose2d.cpm import CPM
from tensorsim.vision.pose2d.topdown import TopDownPose
from tensorsim.weights import save_weights
from tests.networks import settled
from tests.stage import StageTester


def make_network(stages: int = 2) -> CPM:
    """A seeded net in evaluation mode whose normalisations are far from the identity."""
    torch.manual_seed(1)
    return settled(CPM(stages))


class TestCPM(StageTester):
    batch_shapes = ((2,),)

    def make(self) -> nn.Module:
        return make_network()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (torch.rand(*batch, 3, 16, 8, dtype=dtype, generator=torch.Generator().manual_seed(0)),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(3, 64, 32),), r"got shape \[3, 64, 32\], expected \(N, 3, H, W\)"),
            ((torch.zeros(1, 3, 64, 36),), "multiples of 8"),
            ((torch.zeros(1, 3, 64, 0),), "multiples of 8"),
            ((torch.zeros(1, 3, 64, 32, dtype=torch.uint8),), "floating"),
        ]


def reference(state: dict[str, Tensor], images: Tensor, stages: int) -> Tensor:
    """The published net as functions of its state dict."""

    def conv(x: Tensor, name: str) -> Tensor:
        weight = state[f"{name}.conv.weight"]
        x = F.conv2d(x, weight, state.get(f"{name}.conv.bias"), padding=weight.shape[-1] // 2)
        if f"{name}.bn.weight" not in state:
            return x
        gain = state[f"{name}.bn.weight"] / torch.sqrt(state[f"{name}.bn.running_var"] + 1e-5)
        x = (x - state[f"{name}.bn.running_mean"][:, None, None]) * gain[:, None, None]
        return (x + state[f"{name}.bn.bias"][:, None, None]).relu()

    def trunk(x: Tensor, name: str) -> Tensor:
        for i in (0, 2, 4):
            x = F.max_pool2d(conv(x, f"{name}.{i}"), 3, 2, 1)
        return x

    mean = torch.tensor([123.675, 116.28, 103.53]).view(3, 1, 1)
    x = (images * 255 - mean) / torch.tensor([58.395, 57.12, 57.375]).view(3, 1, 1)
    maps = trunk(x, "backbone.stem")
    for i in (6, 7, 8, 9):
        maps = conv(maps, f"backbone.stem.{i}")
    features = trunk(x, "backbone.middle")
    for stage in range(stages - 1):
        y = torch.cat([maps, conv(features, f"backbone.middle_conv.{stage}.0")], 1)
        for i in range(3):
            y = conv(y, f"backbone.cpm_stages.{stage}.model.{i}")
        maps = conv(conv(y, f"backbone.out_convs.{stage}.0"), f"backbone.out_convs.{stage}.1")
    return maps


def test_equals_the_published_net_written_over_its_state_dict() -> None:
    network, images = make_network(3).double(), torch.rand(2, 3, 32, 24, dtype=torch.float64)
    with torch.no_grad():
        expected, actual = reference(network.state_dict(), images, 3), network(images)
    assert actual.shape == (2, 17, 4, 3)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-6 * float(expected.abs().max()))


def test_size_of_the_published_net() -> None:
    network = CPM().eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        maps = network(torch.zeros(1, 3, 256, 192))
    assert maps.shape == (1, 17, 32, 24)
    assert sum(p.numel() for p in network.parameters()) == 31_304_166
    assert counter.get_total_flops() / 2e9 == pytest.approx(63.74, abs=0.01)


def test_keys_and_shapes_of_the_published_checkpoints(shared_data: Path) -> None:
    with open(shared_data.parent / "specs" / "keys_cpm_coco_mmpose.tsv", newline="") as file:
        manifest = {
            key: [] if shape == "scalar" else [int(n) for n in shape.split("x")]
            for key, shape in csv.reader(file, delimiter="\t")
        }
    with torch.device("meta"):
        state = CPM().state_dict()
    assert {key: list(value.shape) for key, value in state.items()} == manifest


def test_loads_its_file(tmp_path: Path) -> None:
    network, images = make_network(), torch.rand(1, 3, 16, 16)
    path = tmp_path / "td-hm_cpm_coco-384x288.pth"
    torch.save({"meta": {}, "state_dict": network.state_dict()}, path)
    loaded = CPM.from_pretrained(path)
    assert loaded.input_size == (384, 288)
    assert torch.equal(loaded(images), network(images))
    torch.save({"state_dict": {"head.weight": torch.zeros(1)}}, path)
    with pytest.raises(TensorsimError, match="not the weights of this CPM"):
        CPM.from_pretrained(path)


def test_a_narrow_one_is_read_as_such(tmp_path: Path) -> None:
    torch.manual_seed(1)
    network = settled(CPM(2, (64, 48), width=8))
    save_weights(network, tmp_path / "best.safetensors", {"network": "CPM", "input_size": "64x48"})
    loaded = pretrained_pose(tmp_path / "best.safetensors", flip_test=False).network
    assert isinstance(loaded, CPM)
    assert loaded.input_size == (64, 48)
    images = torch.rand(1, 3, 64, 48)
    torch.testing.assert_close(loaded(images), network(images), atol=2e-3, rtol=0)  # the file is in float16


def test_one_map_pixel_is_eight_crop_pixels() -> None:
    class Peak(CPM):
        """Says that every keypoint is at map pixel (3, 5)."""

        def forward(self, crops: Tensor) -> Tensor:
            maps = torch.zeros(crops.shape[0], 17, crops.shape[2] // 8, crops.shape[3] // 8)
            maps[:, :, 5, 3] = 1.0
            return maps

    pose = TopDownPose(Peak(1, input_size=(64, 48)), padding=1.0)
    boxes = torch.tensor([[[10.0, 20.0, 58.0, 84.0]]])
    keypoints, _ = pose(torch.zeros(1, 3, 120, 100), boxes, torch.ones(1, 1, dtype=torch.bool))
    torch.testing.assert_close(keypoints[0, 0, 0], torch.tensor([10.0 + 24, 20.0 + 40]), atol=1.0, rtol=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stages": 0}, "CPM.stages: got 0"),
        ({"input_size": (100, 64)}, "multiples of 8"),
        ({"width": 6}, "multiple of 4"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        CPM(**arguments)
