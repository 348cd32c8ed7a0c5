"""VideoPose3D: tracks of 2D joints to 3D joints by convolutions along time.

D. Pavllo, C. Feichtenhofer, D. Grangier, M. Auli, "3D human pose estimation in video with temporal convolutions and
semi-supervised training", CVPR 2019. Names are those of MMPose, whose checkpoints load key by key. The original
simulator compares its matching with such a network (TCN).
"""

import os
import re

from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_min_rank,
    check_not_empty,
    check_size,
)

#: Joints of Human3.6M in its order, those of the published networks in and out.
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
        dropout: in training.

    Raises:
        TensorsimError: no kernels, or an even one; joints that are not (..., T, 17, 2).
    """

    def __init__(
        self, kernels: tuple[int, ...] = (3, 3, 3, 3, 3), channels: int = 1024, dropout: float = 0.25
    ) -> None:
        super().__init__()
        if not kernels or any(kernel < 1 or kernel % 2 == 0 for kernel in kernels):
            raise TensorsimError(f"VideoPose3D: got kernels {kernels}, expected odd lengths")
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
        """Load a Human3.6M checkpoint of MMPose (their 2021 and later names), in evaluation mode.

        Args:
            source: a path of a ``.pth`` or ``.safetensors``, or a name that ``tensorsim models list`` prints.

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
