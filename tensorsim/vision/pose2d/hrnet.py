"""HRNet for human pose: crops of people to heat maps of the 17 COCO keypoints.

K. Sun, B. Xiao, D. Liu, J. Wang, "Deep High-Resolution Representation Learning for Human Pose Estimation",
CVPR 2019. The network keeps a branch at a quarter of the input resolution throughout and adds branches of half
the resolution and twice the channels; after every group of residual blocks each branch receives the sum of
all of them. Module names are those of the authors' code, so published checkpoints load key by key.
"""

import math
import os
import re
from dataclasses import astuple, dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.config import COCO_KEYPOINTS
from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_like_weights,
    check_rank,
    check_size,
)

#: Statistics of ImageNet for RGB in [0, 1], which published pose networks were trained with.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

_STEM_CHANNELS = 64
_EXPANSION = 4


@dataclass(frozen=True)
class HRNetConfig:
    """The numbers that define an HRNet.

    Attributes:
        width: channels C of the branch of highest resolution; branch b has 2^b C.
        blocks: residual blocks of a branch in each exchange module.
        modules: exchange modules of stages 2, 3 and 4 (of 2, 3 and 4 branches).
        bottlenecks: bottleneck blocks of stage 1.
        planes: inner channels of those; their outputs have 4 times as many.
        presence: hidden units of the :class:`PresenceHead`; 0 for none, as in published nets.

    Raises:
        TensorsimError: a number below one, a negative ``presence``, or not three counts of modules.
    """

    width: int
    blocks: int = 4
    modules: tuple[int, int, int] = (1, 4, 3)
    bottlenecks: int = 4
    planes: int = 64
    presence: int = 0

    def __post_init__(self) -> None:
        counts = (self.width, self.blocks, self.bottlenecks, self.planes, *self.modules, self.presence + 1)
        if len(self.modules) != 3 or not all(isinstance(n, int) and n >= 1 for n in counts):
            raise TensorsimError(
                f"HRNetConfig: got {astuple(self)}, expected integers >= 1, three module counts and presence >= 0"
            )


#: Published nets by the number in their name. W18-small is its authors' first version, whose narrowest branch
#: has 16 channels.
VARIANTS: dict[int, HRNetConfig] = {
    18: HRNetConfig(width=16, blocks=2, modules=(1, 1, 1), bottlenecks=1, planes=32),
    32: HRNetConfig(width=32),
    48: HRNetConfig(width=48),
}


def normalise(images: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Channel-wise ``(x - mean) / std`` of images (N, 3, H, W) with statistics (3, 1, 1)."""
    return (images - mean) / std


def _conv_bn(channels_in: int, channels_out: int, kernel: int, stride: int = 1) -> list[nn.Module]:
    conv = nn.Conv2d(channels_in, channels_out, kernel, stride, padding=kernel // 2, bias=False)
    return [conv, nn.BatchNorm2d(channels_out)]


# Sums and rectifiers work in place on what a layer has just computed, which saves passes through memory.


class _BasicBlock(nn.Module):
    """Two 3x3 convolutions with a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = _conv_bn(channels, channels, 3)
        self.conv2, self.bn2 = _conv_bn(channels, channels, 3)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        return F.relu(self.bn2(self.conv2(y)).add_(x), inplace=True)


class _Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 convolutions with a shortcut, which is projected where the channel count changes."""

    def __init__(self, channels_in: int, planes: int) -> None:
        super().__init__()
        channels_out = _EXPANSION * planes
        self.conv1, self.bn1 = _conv_bn(channels_in, planes, 1)
        self.conv2, self.bn2 = _conv_bn(planes, planes, 3)
        self.conv3, self.bn3 = _conv_bn(planes, channels_out, 1)
        same = channels_in == channels_out
        self.downsample = nn.Identity() if same else nn.Sequential(*_conv_bn(channels_in, channels_out, 1))

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = F.relu(self.bn2(self.conv2(y)), inplace=True)
        return F.relu(self.bn3(self.conv3(y)).add_(self.downsample(x)), inplace=True)


def _exchange(source: int, target: int, width: int) -> nn.Module:
    """Layers that bring branch ``source`` to the resolution and channels of branch ``target``."""
    channels_in, channels_out = width * 2**source, width * 2**target
    if source == target:
        return nn.Identity()
    if source > target:
        upsample = nn.Upsample(scale_factor=float(2 ** (source - target)), mode="nearest")
        return nn.Sequential(*_conv_bn(channels_in, channels_out, 1), upsample)
    halvings = [
        nn.Sequential(*_conv_bn(channels_in, channels_in, 3, stride=2), nn.ReLU(inplace=True))
        for _ in range(target - source - 1)
    ]
    return nn.Sequential(*halvings, nn.Sequential(*_conv_bn(channels_in, channels_out, 3, stride=2)))


class _Fusion(nn.ModuleList):
    """The sum of all branches, each resampled to the resolution and channels of branch ``target``."""

    def __init__(self, branches: int, target: int, width: int) -> None:
        super().__init__(_exchange(source, target, width) for source in range(branches))

    def forward(self, features: list[Tensor]) -> Tensor:
        terms: list[Tensor] = []
        for i, layer in enumerate(self):
            terms.append(layer(features[i]))
        total = terms[0] + terms[1]
        for term in terms[2:]:
            total.add_(term)
        return F.relu(total, inplace=True)


class _ExchangeModule(nn.Module):
    """Residual blocks on each branch, then each of the first ``outputs`` branches gets the sum of all."""

    def __init__(self, branches: int, outputs: int, blocks: int, width: int) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            nn.Sequential(*(_BasicBlock(width * 2**b) for _ in range(blocks))) for b in range(branches)
        )
        self.fuse_layers = nn.ModuleList(_Fusion(branches, target, width) for target in range(outputs))

    def forward(self, inputs: list[Tensor]) -> list[Tensor]:
        features: list[Tensor] = []
        for i, branch in enumerate(self.branches):
            features.append(branch(inputs[i]))
        fused: list[Tensor] = []
        for fusion in self.fuse_layers:
            fused.append(fusion(features))
        return fused


class _Stage(nn.ModuleList):
    """Exchange modules in a row; ``outputs`` branches leave the last one."""

    def __init__(self, branches: int, outputs: int, modules: int, config: HRNetConfig) -> None:
        super().__init__(
            _ExchangeModule(branches, branches if i < modules - 1 else outputs, config.blocks, config.width)
            for i in range(modules)
        )

    def forward(self, x: list[Tensor]) -> list[Tensor]:
        for module in self:
            x = module(x)
        return x


class _Transition(nn.ModuleList):
    """Adds a branch, computed from the last one at half its resolution; the others are unchanged."""

    def __init__(self, first: nn.Module, kept: int, channels_in: int, channels_out: int) -> None:
        new = nn.Sequential(*_conv_bn(channels_in, channels_out, 3, stride=2), nn.ReLU(inplace=True))
        super().__init__([first, *(nn.Identity() for _ in range(kept - 1)), nn.Sequential(new)])

    def forward(self, x: list[Tensor]) -> list[Tensor]:
        out: list[Tensor] = []
        for i, layer in enumerate(self):
            out.append(layer(x[min(i, len(x) - 1)]))
        return out


class PresenceHead(nn.Module):
    """How far to trust each heat map, from the whole crop: little if its keypoint is not in the picture.

    Where the picture ends within a person, a heat map still has a highest peak, at another part of the body or of
    somebody else. Two layers see the mean of the features in 4 x 4 parts of the crop, black edges included, and the
    heights of all peaks, and give each map a factor from 0 to 1 (as the squeeze and excitation of J. Hu et al., CVPR
    2018, with keypoints for channels). Places of peaks stay as they are.

    Args:
        channels: of the features.
        hidden: units of the first layer.
    """

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        # Factors above 1 are cut, so that keypoints that are surely there keep their scores.
        self.most = 1.3
        self.hidden = nn.Linear(16 * channels + len(COCO_KEYPOINTS), hidden)
        self.factor = nn.Linear(hidden, len(COCO_KEYPOINTS))
        # Training starts from factors just below 1: above there is no gradient.
        nn.init.zeros_(self.factor.weight)
        nn.init.constant_(self.factor.bias, -math.log(self.most - 1.0) - 1e-5)

    def forward(self, features: Tensor, maps: Tensor) -> Tensor:
        """Features (N, C, h, w), h and w multiples of 8, and heat maps (N, 17, h, w) -> heat maps."""
        # Exports to ONNX at any size, unlike pooling.
        parts = features.unflatten(-1, [4, -1]).mean(-1).unflatten(2, [4, -1]).mean(3)
        seen = torch.cat([parts.flatten(1), maps.amax((-2, -1))], dim=1)
        factor = (self.most * torch.sigmoid(self.factor(F.relu(self.hidden(seen))))).clamp(max=1.0)
        return maps * factor[..., None, None]


class _NoHead(nn.Module):
    """Heat maps as they are."""

    def forward(self, features: Tensor, maps: Tensor) -> Tensor:
        return maps


class HRNet(nn.Module):
    """High-resolution net: (N, 3, H, W) RGB crops in [0, 1] -> (N, 17, H/4, W/4) heat maps, peaks near 1.

    The ImageNet normalisation of its input happens inside. Pixel (u, v) of a heat map stands for pixel (4u,
    4v) of the crop. Fully convolutional: any H and W that are multiples of 32.

    Args:
        width: the number in the net's name (18 for W18-small, 32, 48), or the configuration of another net.
        input_size: (H, W) of the crops that its weights are meant for; :class:`TopDownPose` crops to it.

    Raises:
        TensorsimError: an unknown width, an input size or crops that are not multiples of 32, integer crops.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, width: int | HRNetConfig = 32, input_size: tuple[int, int] = (256, 192)) -> None:
        super().__init__()
        if isinstance(width, HRNetConfig):
            config = width
        elif width in VARIANTS:
            config = VARIANTS[width]
        else:
            raise TensorsimError(
                f"HRNet: got width {width!r}, expected one of {list(VARIANTS)} or an HRNetConfig"
            )
        if len(input_size) != 2 or not all(n > 0 and n % 32 == 0 for n in input_size):
            raise TensorsimError(f"HRNet: got input_size {input_size}, expected (H, W), multiples of 32")
        self.config = config
        self.input_size = (input_size[0], input_size[1])

        c, stage1 = config.width, _EXPANSION * config.planes
        self.conv1, self.bn1 = _conv_bn(3, _STEM_CHANNELS, 3, stride=2)
        self.conv2, self.bn2 = _conv_bn(_STEM_CHANNELS, _STEM_CHANNELS, 3, stride=2)
        self.layer1 = nn.Sequential(
            *(_Bottleneck(stage1 if i else _STEM_CHANNELS, config.planes) for i in range(config.bottlenecks))
        )
        self.transition1 = _Transition(
            nn.Sequential(*_conv_bn(stage1, c, 3), nn.ReLU(inplace=True)), 1, stage1, 2 * c
        )
        self.stage2 = _Stage(2, 2, config.modules[0], config)
        self.transition2 = _Transition(nn.Identity(), 2, 2 * c, 4 * c)
        self.stage3 = _Stage(3, 3, config.modules[1], config)
        self.transition3 = _Transition(nn.Identity(), 3, 4 * c, 8 * c)
        self.stage4 = _Stage(4, 1, config.modules[2], config)
        self.final_layer = nn.Conv2d(c, len(COCO_KEYPOINTS), 1)
        # Heat maps are almost zero everywhere: training starts from there.
        for parameter in self.final_layer.parameters():
            nn.init.normal_(parameter, std=0.001)
        self.presence = PresenceHead(c, config.presence) if config.presence else _NoHead()

        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    def forward(self, crops: Tensor) -> Tensor:
        """(N, 3, H, W) RGB in [0, 1] -> (N, 17, H/4, W/4)."""
        layout = "(N, 3, H, W) RGB in [0, 1], H and W multiples of 32"
        check_floating(crops, "HRNet crops")
        check_rank(crops, 4, "HRNet crops", layout)
        check_size(crops, 1, 3, "HRNet crops", layout)
        check_like_weights(crops, self.mean, "HRNet crops")
        check_finite(crops, "HRNet crops")
        if crops.shape[2] % 32 != 0 or crops.shape[3] % 32 != 0 or crops.shape[2] * crops.shape[3] == 0:
            raise TensorsimError(f"HRNet crops: got shape {list(crops.shape)}, expected {layout}")
        x = normalise(crops, self.mean, self.std)
        x = F.relu(self.bn1(self.conv1(x)), inplace=True)
        x = F.relu(self.bn2(self.conv2(x)), inplace=True)
        x = self.layer1(x)
        branches = self.stage2(self.transition1([x]))
        branches = self.stage3(self.transition2(branches))
        branches = self.stage4(self.transition3(branches))
        return self.presence(branches[0], self.final_layer(branches[0]))

    @classmethod
    def from_pretrained(
        cls,
        source: str | os.PathLike[str] | None = None,
        width: int | None = None,
        input_size: tuple[int, int] | None = None,
    ) -> "HRNet":
        """Load a ``.pth`` or ``.safetensors`` checkpoint, in evaluation mode.

        The variant follows from the shapes of the tensors; names may be those of the authors' code or of
        mmpose 0.x and 1.x.

        Args:
            source: a path, or a name that ``tensorsim models list`` prints, such as ``"hrnet-w32-coco"``; None: the
                shipped weights.
            width: accept this variant only.
            input_size: (H, W) of the crops the weights were trained on. None: as a ``.safetensors`` file states it
                or a published file has it in its name (``...384x288...``), else (256, 192).

        Raises:
            TensorsimError: an unknown name, weights that cannot be fetched, a file that cannot be read or trusted,
                keys or shapes that are not an HRNet's, or another variant than ``width``.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import input_size_of, load_state_dict, load_strict

        path = locate(source, cls.__name__)
        state = _original_names(load_state_dict(path))
        config = _read_config(state, str(path))
        if width is not None and VARIANTS.get(width) != config:
            raise TensorsimError(f"{path}: got the weights of {config}, expected HRNet width {width}")
        network = cls(config, input_size or input_size_of(path) or (256, 192))
        load_strict(network, state, str(path))
        return network.eval()


def _original_names(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Name tensors as the authors do: mmpose has a backbone and a head, DataParallel a module."""
    prefix = re.compile(r"^(module\.)?(backbone\.|(keypoint_)?head\.(?=final_layer\.))?")
    return {prefix.sub("", key): value for key, value in state.items()}


def _read_config(state: dict[str, Tensor], source: str) -> HRNetConfig:
    """The configuration that has tensors of these names and shapes."""

    def count(name: str) -> int:
        indices = {match[1] for key in state if (match := re.match(rf"{name}\.(\d+)\.", key))}
        return len(indices)

    try:
        return HRNetConfig(
            width=state["final_layer.weight"].shape[1],
            blocks=count(r"stage2\.0\.branches\.0"),
            modules=(count("stage2"), count("stage3"), count("stage4")),
            bottlenecks=count("layer1"),
            planes=state["layer1.0.conv1.weight"].shape[0],
            presence=len(state.get("presence.hidden.bias", ())),
        )
    except (KeyError, IndexError, TensorsimError) as error:
        some = ", ".join(list(state)[:3])
        raise TensorsimError(
            f"{source}: got tensors such as {some}, expected those of an HRNet for pose"
        ) from error
