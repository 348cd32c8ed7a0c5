"""Convolutional pose machine: crops of people to heat maps of the 17 COCO keypoints, refined in six stages.

S.-E. Wei, V. Ramakrishna, T. Kanade, Y. Sheikh, "Convolutional Pose Machines", CVPR 2016. Every stage sees features
of the image and the maps of the stage before, with a receptive field that covers the whole body. Layer sizes and
names are those of MMPose, whose checkpoints load key by key. The original simulator offers it beside HRNet.
"""

import os
import re

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.config import COCO_KEYPOINTS
from tensorsim.errors import TensorsimError, check_count, check_floating, check_rank, check_size
from tensorsim.vision.pose2d.hrnet import IMAGENET_MEAN, IMAGENET_STD, normalise


class _ConvBN(nn.Module):
    """Convolution without bias that keeps the size, normalisation, ReLU."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels_in, channels_out, kernel, padding=kernel // 2, bias=False)
        self.bn = nn.BatchNorm2d(channels_out)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


class _Maps(nn.Module):
    """A 1x1 convolution to the maps."""

    def __init__(self, channels_in: int, maps: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels_in, maps, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


def _trunk(width: int) -> list[nn.Module]:
    """Three 9x9 convolutions, each at half the resolution of the one before: (N, 3, H, W) -> (N, width, H/8, W/8)."""
    layers: list[nn.Module] = []
    for channels in (3, width, width):
        layers += [_ConvBN(channels, width, 9), nn.MaxPool2d(3, stride=2, padding=1)]
    return layers


class _Stage(nn.Module):
    """Three 11x11 convolutions over maps and features."""

    def __init__(self, channels_in: int, width: int) -> None:
        super().__init__()
        self.model = nn.Sequential(
            _ConvBN(channels_in, width, 11), _ConvBN(width, width, 11), _ConvBN(width, width, 11)
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.model(x)


class _Backbone(nn.Module):
    def __init__(self, maps: int, stages: int, width: int) -> None:
        super().__init__()
        narrow, wide = width // 4, 4 * width
        self.stem = nn.Sequential(
            *_trunk(width),
            _ConvBN(width, narrow, 5),
            _ConvBN(narrow, wide, 9),
            _ConvBN(wide, wide, 1),
            _Maps(wide, maps),
        )
        self.middle = nn.Sequential(*_trunk(width))
        self.cpm_stages = nn.ModuleList(_Stage(maps + narrow, width) for _ in range(stages - 1))
        self.middle_conv = nn.ModuleList(nn.Sequential(_ConvBN(width, narrow, 5)) for _ in range(stages - 1))
        self.out_convs = nn.ModuleList(
            nn.Sequential(_ConvBN(width, width, 1), _Maps(width, maps)) for _ in range(stages - 1)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        maps = self.stem(x)
        features = self.middle(x)
        of_stages = [maps]
        for stage, middle, out in zip(self.cpm_stages, self.middle_conv, self.out_convs):  # noqa: B905  # TorchScript knows no strict
            maps = out(stage(torch.cat([maps, middle(features)], dim=1)))
            of_stages.append(maps)
        return of_stages


class CPM(nn.Module):
    """Convolutional pose machine: (N, 3, H, W) RGB crops in [0, 1] -> (N, 17, H/8, W/8) heat maps, peaks near 1.

    The ImageNet normalisation of its input happens inside. Pixel (u, v) of a heat map stands for pixel (8u, 8v) of the
    crop: half the resolution of :class:`HRNet`'s maps.

    Args:
        stages: number of stages, the first estimate included.
        input_size: (H, W) of the crops that its weights are meant for; :class:`TopDownPose` crops to it.
        width: channels of most layers, a multiple of 4; 128 in the published network.

    Raises:
        TensorsimError: fewer than one stage, another width; crops or sizes that are no multiples of 8; integers.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, stages: int = 6, input_size: tuple[int, int] = (256, 192), width: int = 128) -> None:
        super().__init__()
        check_count(stages, "CPM.stages")
        if len(input_size) != 2 or not all(n > 0 and n % 8 == 0 for n in input_size):
            raise TensorsimError(f"CPM: got input_size {input_size}, expected (H, W), multiples of 8")
        if width < 4 or width % 4:
            raise TensorsimError(f"CPM: got width {width}, expected a multiple of 4")
        self.input_size = (input_size[0], input_size[1])
        self.stride = 8
        self.backbone = _Backbone(len(COCO_KEYPOINTS), stages, width)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    def forward(self, crops: Tensor) -> Tensor:
        """Heat maps of the last stage."""
        return self.stages(crops)[-1]

    @torch.jit.export
    def stages(self, crops: Tensor) -> list[Tensor]:
        """Heat maps of every stage; training supervises each of them."""
        layout = "(N, 3, H, W) RGB in [0, 1], H and W multiples of 8"
        check_floating(crops, "CPM crops")
        check_rank(crops, 4, "CPM crops", layout)
        check_size(crops, 1, 3, "CPM crops", layout)
        if crops.shape[2] % 8 != 0 or crops.shape[3] % 8 != 0 or crops.shape[2] * crops.shape[3] == 0:
            raise TensorsimError(f"CPM crops: got shape {list(crops.shape)}, expected {layout}")
        return self.backbone(normalise(crops, self.mean, self.std))

    @classmethod
    def from_pretrained(
        cls, source: str | os.PathLike[str] | None = None, input_size: tuple[int, int] | None = None
    ) -> "CPM":
        """Load our own weights or a COCO checkpoint of MMPose, in evaluation mode.

        Args:
            source: a path of a ``.pth`` or ``.safetensors``, or a name that ``tensorsim models list`` prints.
            input_size: (H, W) of the crops the weights were trained on. None: as the file states it or
                has it in its name, else (256, 192).

        Raises:
            TensorsimError: an unknown name, weights that cannot be fetched, a file that cannot be read or trusted, or
                keys and shapes that are not this network's.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import input_size_of, load_state_dict, load_strict

        path = locate(source, cls.__name__)
        state = load_state_dict(path)
        stages = 1 + len(
            {match[1] for key in state if (match := re.match(r"backbone\.cpm_stages\.(\d+)\.", key))}
        )
        first = state.get("backbone.stem.0.conv.weight")
        width = 128 if first is None else first.shape[0]
        network = cls(stages, input_size or input_size_of(path) or (256, 192), width)
        load_strict(network, state, path)
        return network.eval()
