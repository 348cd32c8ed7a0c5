"""SPGNet: grouped 3x3 convolutions in two levels, a smaller network than SPNet.

Source: X. Wang, S. Lai, Z. Chai, X. Zhang, X. Qian, "SPGNet: Serial and Parallel Group Network", IEEE Transactions on
Multimedia 24 (2022), in the form of the Python code of RadHARSimulator V2 (arXiv 2511.09022) for 32x32 images.
"""

import os

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_choice, check_count
from tensorsim.recognition.blocks import as_pictures, centred, conv_norm

#: Groups of each version; the widths of the stages are 16, 32 and 64 times this number.
VERSIONS = {"s2p6": 6, "s2p7": 7, "s2p8": 8, "s2p9": 9}
#: Number of layers of each stage.
_BLOCKS = (4, 8, 3)


class TwoLevelLayer(nn.Module):
    """``relu(skip(x) + fuse(concat(o1, o2)))``: o1 is a grouped 3x3 convolution, o2 a second one applied to o1.

    Args:
        in_channels: channels of x.
        out_channels: channels of the result.
        stride: of the first convolution.
        groups: of both convolutions.
    """

    def __init__(self, in_channels: int, out_channels: int, stride: int, groups: int) -> None:
        super().__init__()
        half = out_channels // 2
        self.enter = conv_norm(in_channels, half, 1)
        self.first = conv_norm(half, half, 3, stride, groups)
        self.second = conv_norm(half, half, 3, 1, groups)
        self.fuse = conv_norm(out_channels, out_channels, 1, relu=False)
        self.skip: nn.Module = nn.Identity()
        if stride > 1:
            self.skip = nn.Sequential(
                conv_norm(in_channels, in_channels, 3, stride, in_channels, relu=False),
                conv_norm(in_channels, out_channels, 1, relu=False),
            )
        elif in_channels != out_channels:
            self.skip = conv_norm(in_channels, out_channels, 1, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H / stride, W / stride)."""
        o1 = self.first(self.enter(x))
        fused = self.fuse(torch.cat([o1, self.second(o1)], dim=1))
        return torch.relu(self.skip(x) + fused)


class SPGNet(nn.Module):
    """SPGNet: images of radar maps to activities, with a third of SPNet's parameters.

    Args:
        num_classes: number of classes.
        in_channels: 1 for one map, 2 for a range-time and a Doppler-time map, 3 for a colour image.
        version: ``"s2p6"`` to ``"s2p9"``, in order of width.

    Attributes:
        mean: (C,) mean of each channel over the training images, which is subtracted; part of the weights.

    Shapes: images (..., C, H, W) in [0, 1], 32x32 in the source -> logits (..., num_classes). Differentiable.
    3 268 052 parameters for s2p6, 12 classes and 3 channels.

    Raises:
        TensorsimError: fewer than one class or channel, an unknown version; images with another number of
            channels, or NaN.
    """

    mean: Tensor

    def __init__(self, num_classes: int = 12, in_channels: int = 1, version: str = "s2p6") -> None:
        super().__init__()
        check_count(num_classes, "SPGNet.num_classes")
        check_count(in_channels, "SPGNet.in_channels")
        check_choice(version, VERSIONS, "SPGNet.version")
        self.num_classes, self.in_channels = num_classes, in_channels
        groups = VERSIONS[version]
        self.register_buffer("mean", torch.zeros(in_channels))
        layers: list[nn.Module] = [
            conv_norm(in_channels, 2 * groups, 3),
            conv_norm(2 * groups, 4 * groups, 3),
        ]
        channels = 4 * groups
        for blocks, width in zip(_BLOCKS, (16 * groups, 32 * groups, 64 * groups), strict=True):
            for block in range(blocks):
                layers.append(TwoLevelLayer(channels, width, 2 if block == 0 else 1, groups))
                channels = width
        layers.append(conv_norm(channels, 1024, 1))
        self.body = nn.Sequential(*layers)
        self.fc1 = nn.Linear(1024, 1024, bias=False)
        self.norm = nn.BatchNorm1d(1024)
        self.dropout = nn.Dropout(0.2)
        self.fc2 = nn.Linear(1024, num_classes, bias=False)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            elif isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, 0.0, 0.01)

    def forward(self, pictures: Tensor) -> Tensor:
        """Images (..., C, H, W) to logits (..., num_classes)."""
        x = self.body(centred(pictures, self.mean, "SPGNet")).mean((-2, -1))
        x = self.fc2(self.dropout(torch.relu(self.norm(self.fc1(x)))))
        return as_pictures(x, pictures)

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str] | None = None) -> "SPGNet":
        """Build the network of a weight file, in evaluation mode.

        Args:
            source: a path, a name from ``tensorsim models list``, or None for the shipped weights.

        Raises:
            TensorsimError: no such file or name, or weights of another network.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, "SPGNet")
        weights = load_state_dict(path)
        first, last = weights.get("body.0.0.weight"), weights.get("fc2.weight")
        widths = {2 * groups: version for version, groups in VERSIONS.items()}
        if (
            first is None
            or first.dim() != 4
            or first.shape[0] not in widths
            or last is None
            or last.dim() != 2
        ):
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of an SPGNet"
            )
        network = cls(last.shape[0], first.shape[1], widths[first.shape[0]])
        load_strict(network, weights, path)
        return network.eval()
