import csv
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.body.skeleton import body_height, mid_hips
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.vision.lifting.videopose3d import (
    H36M_JOINTS,
    VideoPose3D,
    VideoPoseLifter,
    body_to_h36m,
    h36m_to_body,
)
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


def test_no_channels() -> None:
    with pytest.raises(TensorsimError, match="channels: got 0"):
        VideoPose3D(channels=0)


class Told(VideoPose3D):
    """Returns a given pose, metres about the pelvis in camera axes, whatever it sees."""

    def __init__(self, pose: Tensor) -> None:
        super().__init__((1,), channels=4)
        self.register_buffer("pose", pose)

    def forward(self, joints: Tensor) -> Tensor:
        """The pose in every frame."""
        self.seen = joints
        return self.pose.to(joints.dtype).expand(*joints.shape[:-1], 3)


class TestVideoPoseLifter(StageTester):
    batched_arguments = (0, 1)

    def make(self) -> nn.Module:
        return VideoPoseLifter(make_network((3, 3)), 480, 640)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)
        keypoints = 100 + 200 * torch.rand(*batch, 5, 14, 2, generator=generator, dtype=dtype)
        return keypoints, 0.2 + 0.8 * torch.rand(*batch, 5, 14, generator=generator, dtype=dtype)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        k, w = torch.zeros(4, 14, 2), torch.ones(4, 14)
        return [
            ((torch.zeros(4, 17, 2), torch.ones(4, 17)), r"expected \(\.\.\., T, 14, 2\)"),
            ((k, torch.ones(4, 13)), r"weights: got shape \[4, 13\], expected \[4, 14\]"),
            ((k * float("nan"), w), "keypoints: got NaN"),
            ((k, w * float("nan")), "weights: got NaN"),
            ((k, -w), "weights: got negative"),
            ((k[:0], w[:0]), "at least 1 frame"),
        ]


def test_nobody_is_lifted() -> None:
    lifted = VideoPoseLifter(make_network((3,)), 480, 640)(
        torch.zeros(2, 0, 5, 14, 2), torch.zeros(2, 0, 5, 14)
    )
    assert lifted.depth.shape == (2, 0, 5, 14)
    assert lifted.scale.shape == (2, 0, 5)


def test_joints_of_human36m_by_name() -> None:
    """Each joint is where its name says, and the inverse gives the same body."""
    body = sample_poses(13, seed=4).float()
    there = dict(zip(H36M_JOINTS, body_to_h36m(body).unbind(-2), strict=True))
    here = dict(zip(JOINTS, body.unbind(-2), strict=True))
    for side in ("right", "left"):
        for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist"):
            assert torch.equal(there[f"{side}_{part}"], here[f"{side}_{part}"])
    assert torch.equal(there["pelvis"], mid_hips(body))
    torch.testing.assert_close(there["spine"], (mid_hips(body) + here["neck"]) / 2)
    torch.testing.assert_close(there["neck"], (here["head"] + here["neck"]) / 2)
    assert torch.equal(h36m_to_body(body_to_h36m(body)), body)


def test_lifter_gives_the_depths_that_the_network_says() -> None:
    """Of a pose that the network knows: depths in heights of the body, size and place in the picture."""
    pose = sample_poses(13, seed=4)[0].float()  # x right, y away, z up, body heights
    pose = pose - mid_hips(pose)
    camera_axes = 1.82 * torch.stack([pose[:, 0], -pose[:, 2], pose[:, 1]], dim=-1)
    network = Told(body_to_h36m(camera_axes))
    seen = 150 * torch.stack([pose[:, 0], -pose[:, 2]], dim=-1) + torch.tensor([300.0, 220.0])
    weights = torch.ones(2, 14)
    weights[1, 2:] = 0.0  # enough for the place
    lifted = VideoPoseLifter(network, 480, 640)(seen.expand(2, 14, 2), weights)
    tall = float(body_height(pose))
    torch.testing.assert_close(lifted.depth, (pose[:, 1] / tall).expand(2, 14))
    torch.testing.assert_close(lifted.scale, torch.full((2,), 150 * tall))
    torch.testing.assert_close(lifted.keypoints, seen.expand(2, 14, 2))
    # Coordinates about the centre of the picture over half its width.
    pelvis = (torch.tensor([300.0, 220.0]) - torch.tensor([319.5, 239.5])) / 320
    torch.testing.assert_close(network.seen[0, 0], pelvis)


def test_a_frame_without_joints_takes_the_nearest_other() -> None:
    lifter = VideoPoseLifter(make_network((3,)), 480, 640)
    keypoints, weights = 200 * torch.rand(6, 14, 2), torch.ones(6, 14)
    weights[4] = 0.0
    filled = keypoints.clone()
    filled[4] = keypoints[3]
    torch.testing.assert_close(lifter(keypoints, weights).depth, lifter(filled, torch.ones(6, 14)).depth)


def test_a_picture_has_pixels() -> None:
    with pytest.raises(TensorsimError, match="got 0 x 640 pixels"):
        VideoPoseLifter(make_network((3,)), 0, 640)
