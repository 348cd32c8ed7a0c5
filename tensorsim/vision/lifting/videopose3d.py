"""VideoPose3D: tracks of 2D joints to 3D joints by convolutions along time, and as a lifter of the pipeline.

D. Pavllo, C. Feichtenhofer, D. Grangier, M. Auli, "3D human pose estimation in video with temporal convolutions and
semi-supervised training", CVPR 2019. Names are those of MMPose, whose checkpoints load key by key. The original
simulator compares its matching with such a network (TCN).
"""

import os
import re

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.body.skeleton import body_height, mid_hips
from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_floating,
    check_image_size,
    check_min_rank,
    check_not_empty,
    check_size,
)
from tensorsim.types import Lifted
from tensorsim.vision.lifting.lifter import check_to_lift, fit_poses
from tensorsim.vision.smoothing.along_time import nearest_valid

#: Joints of Human3.6M in its order, which the published networks take and give.
H36M_JOINTS = (
    "pelvis",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_hip",
    "left_knee",
    "left_ankle",
    "spine",
    "thorax",
    "neck",
    "head",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
)


class _ConvBN(nn.Module):
    """Convolution along time without padding or bias, normalisation, ReLU."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int, dilation: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv1d(channels_in, channels_out, kernel, dilation=dilation, bias=False)
        self.bn = nn.BatchNorm1d(channels_out)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


class _Block(nn.Module):
    """A wide and a pointwise convolution with a shortcut, which is cropped like the output of the wide one."""

    def __init__(self, channels: int, kernel: int, dilation: int, dropout: float) -> None:
        super().__init__()
        self.trim = (kernel - 1) * dilation // 2
        self.conv1 = nn.Sequential(_ConvBN(channels, channels, kernel, dilation))
        self.conv2 = nn.Sequential(_ConvBN(channels, channels, 1))
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        y = self.dropout(self.conv2(self.dropout(self.conv1(x))))
        return x[..., self.trim : x.shape[-1] - self.trim] + y


class _Backbone(nn.Module):
    def __init__(self, channels_in: int, channels: int, kernels: tuple[int, ...], dropout: float) -> None:
        super().__init__()
        self.expand_conv = _ConvBN(channels_in, channels, kernels[0])
        self.dropout = nn.Dropout(dropout)
        blocks: list[nn.Module] = []
        dilation = kernels[0]
        for kernel in kernels[1:]:
            blocks.append(_Block(channels, kernel, dilation, dropout))
            dilation *= kernel
        self.tcn_blocks = nn.ModuleList(blocks)

    def forward(self, x: Tensor) -> Tensor:
        x = self.dropout(self.expand_conv(x))
        for block in self.tcn_blocks:
            x = block(x)
        return x


class _Head(nn.Module):
    def __init__(self, channels: int, channels_out: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(channels, channels_out, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


class VideoPose3D(nn.Module):
    """(..., T, 17, 2) joints in the image -> (..., T, 17, 3) joints relative to the pelvis in metres, Human3.6M order.

    Image coordinates are pixels from the centre over half the width, u right and v down; the results are in
    camera axes: x right, y down, z away. Every frame is estimated from ``receptive_field`` frames around it; beyond
    the ends of a track its first and last frame are repeated.

    Args:
        kernels: odd lengths of the convolutions; dilations are such that each input frame counts once.
        channels: width of the network.
        dropout: rate of dropout in training.

    Raises:
        TensorsimError: no kernels, or an even one; no channels; joints that are not (..., T, 17, 2).
    """

    def __init__(
        self, kernels: tuple[int, ...] = (3, 3, 3, 3, 3), channels: int = 1024, dropout: float = 0.25
    ) -> None:
        super().__init__()
        if not kernels or any(kernel < 1 or kernel % 2 == 0 for kernel in kernels):
            raise TensorsimError(f"VideoPose3D: got kernels {kernels}, expected odd lengths")
        check_count(channels, "VideoPose3D.channels")
        joints = len(H36M_JOINTS)
        self.receptive_field = 1
        for kernel in kernels:
            self.receptive_field *= kernel
        self.backbone = _Backbone(2 * joints, channels, kernels, dropout)
        self.head = _Head(channels, 3 * joints)

    def forward(self, joints: Tensor) -> Tensor:
        """Lift tracks (..., T, 17, 2)."""
        layout = "(..., T, 17, 2)"
        check_floating(joints, "VideoPose3D joints")
        check_min_rank(joints, 3, "VideoPose3D joints", layout)
        check_size(joints, -2, 17, "VideoPose3D joints", layout)
        check_size(joints, -1, 2, "VideoPose3D joints", layout)
        check_not_empty(joints, "VideoPose3D joints")
        check_finite(joints, "VideoPose3D joints")
        frames, reach = joints.shape[-3], (self.receptive_field - 1) // 2
        x = joints.flatten(-2).reshape(-1, frames, 34).transpose(1, 2)
        x = F.pad(x, [reach, reach], mode="replicate")
        lifted: Tensor = self.head(self.backbone(x))
        return lifted.transpose(1, 2).reshape(joints.shape[:-1] + (3,))  # noqa: RUF005  # as TorchScript has it

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str] | None = None) -> "VideoPose3D":
        """Load our own weights or a Human3.6M checkpoint of MMPose (their 2021 and later names), in evaluation mode.

        Args:
            source: a path of a ``.pth`` or ``.safetensors``, a name that ``tensorsim models list`` prints, or None for
                the shipped weights.

        Raises:
            TensorsimError: an unknown name, weights that cannot be fetched, a file that cannot be read or trusted, or
                keys and shapes that are not this network's.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, cls.__name__)
        state = {
            re.sub(r"^keypoint_head\.", "head.", key): value for key, value in load_state_dict(path).items()
        }
        wide = [state.get("backbone.expand_conv.conv.weight")]
        while (key := f"backbone.tcn_blocks.{len(wide) - 1}.conv1.0.conv.weight") in state:
            wide.append(state[key])
        kernels = [weight.shape[-1] for weight in wide if weight is not None and weight.dim() == 3]
        if len(kernels) != len(wide):
            raise TensorsimError(
                f"{path}: got tensors such as {', '.join(list(state)[:3])}, expected those of VideoPose3D"
            )
        network = cls(tuple(kernels), state["backbone.expand_conv.conv.weight"].shape[0])
        load_strict(network, state, path)
        return network.eval()


def body_to_h36m(joints: Tensor) -> Tensor:
    """The 17 joints of Human3.6M from the 14 of ``tensorsim.JOINTS``: (..., 14, D) -> (..., 17, D).

    The thorax is the middle of the shoulders; the spine is half-way between it and the pelvis, the neck half-way
    between it and the head.
    """
    pelvis, thorax, head = mid_hips(joints)[..., None, :], joints[..., 1:2, :], joints[..., 0:1, :]
    right_arm, left_arm = joints[..., 2:5, :], joints[..., 5:8, :]
    right_leg, left_leg = joints[..., 8:11, :], joints[..., 11:14, :]
    spine, neck = 0.5 * (pelvis + thorax), 0.5 * (thorax + head)
    return torch.cat([pelvis, right_leg, left_leg, spine, thorax, neck, head, left_arm, right_arm], dim=-2)


def h36m_to_body(joints: Tensor) -> Tensor:
    """The 14 joints of ``tensorsim.JOINTS`` among the 17 of Human3.6M: (..., 17, D) -> (..., 14, D)."""
    head, thorax = joints[..., 10:11, :], joints[..., 8:9, :]
    right_arm, left_arm = joints[..., 14:17, :], joints[..., 11:14, :]
    right_leg, left_leg = joints[..., 1:4, :], joints[..., 4:7, :]
    return torch.cat([head, thorax, right_arm, left_arm, right_leg, left_leg], dim=-2)


class VideoPoseLifter(nn.Module):
    """:class:`VideoPose3D` in place of :class:`~tensorsim.vision.NearestPoseLifter` (the TCN of the paper).

    Args:
        network: with its weights.
        image_height, image_width: of the picture in pixels: the network takes coordinates relative to its centre.

    Shapes:
        joints (..., T, 14, 2) pixels and weights (..., T, 14) >= 0 (0 = not seen) -> :class:`tensorsim.types.Lifted`,
        with zero deviation. A frame with fewer than two weighted joints takes the nearest other frame; the network
        does not see the weights, and takes hidden joints where they are given. Differentiable.

    Raises:
        TensorsimError: other shapes, NaN, negative weights, no frames, or a picture without pixels.
    """

    def __init__(self, network: VideoPose3D, image_height: int, image_width: int) -> None:
        super().__init__()
        check_image_size(image_height, image_width)
        self.network = network
        self.image_height, self.image_width = image_height, image_width

    def forward(self, keypoints: Tensor, weights: Tensor) -> Lifted:
        """Joints (..., T, 14, 2) pixels and weights (..., T, 14) -> Lifted."""
        check_to_lift(keypoints, weights)
        source = nearest_valid((weights > 0).sum(dim=-1) >= 2)
        keypoints = keypoints.gather(-3, source[..., None, None].expand_as(keypoints))
        weights = weights.gather(-2, source[..., None].expand_as(weights)).to(keypoints.dtype)

        joints = body_to_h36m(keypoints)
        u = (joints[..., 0] - (self.image_width - 1) / 2) / (self.image_width / 2)
        v = (joints[..., 1] - (self.image_height - 1) / 2) / (self.image_width / 2)
        found = torch.zeros(joints.shape[:-1] + (3,), dtype=joints.dtype, device=joints.device)  # noqa: RUF005  # as TorchScript has it
        if joints.numel() > 0:  # the network refuses empty input
            found = self.network(torch.stack([u, v], dim=-1))
        right_down_away = h36m_to_body(found)
        # Axes of the pool of poses: x right, y away, z up; relative to the hips, in heights of this body.
        pose = torch.stack(
            [right_down_away[..., 0], right_down_away[..., 2], -right_down_away[..., 1]], dim=-1
        )
        pose = pose - mid_hips(pose)[..., None, :]
        pose = pose / body_height(pose).clamp(min=1e-3)[..., None, None]
        scale, placed, distance = fit_poses(keypoints, weights, pose)
        depth = pose[..., 1]
        none = torch.zeros_like(distance, dtype=torch.int64)
        return Lifted(depth, scale, placed, none, distance, torch.zeros_like(depth))
