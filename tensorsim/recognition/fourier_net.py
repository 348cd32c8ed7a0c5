"""The networks of RadHARSimulator's first version: layers that filter whole images in the Fourier domain.

Source: RadHARSimulator V1 (arXiv 2509.06751) and the code published with it: :class:`FourierNet` is its MATLAB form,
:class:`GlobalFilterNet` its Python form, which is GFNet (Y. Rao et al., "Global Filter Networks for Image
Classification", NeurIPS 2021). Both are exact. A filter has the size of its image, so the size of the pictures is
part of the network.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import TensorsimError, check_choice
from tensorsim.recognition.blocks import ImageClassifier, SameConv, same_padding


def _check_size(x: Tensor, size: int, name: str) -> None:
    if x.shape[-2] != size or x.shape[-1] != size:
        raise TensorsimError(
            f"{name}: got images of {x.shape[-2]}x{x.shape[-1]}, expected {size}x{size}, the size of its filters"
        )


class FourierBlock(nn.Module):
    """``relu(x + A(x) B(x) + Re ifft2(fft2(x) K))``: A and B are 3x3 convolutions with normalisation and ReLU.

    Args:
        channels: of input and result.
        size: height and width; K is a complex number per channel and frequency.
    """

    def __init__(self, channels: int, size: int) -> None:
        super().__init__()
        self.a, self.b = self._layer(channels), self._layer(channels)
        self.real = nn.Parameter(0.02 * torch.randn(channels, size, size))
        self.imag = nn.Parameter(0.02 * torch.randn(channels, size, size))

    @staticmethod
    def _layer(channels: int) -> nn.Sequential:
        return nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1), nn.BatchNorm2d(channels), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        # Fourier transforms have no half precision on the CPU.
        spectrum = torch.fft.fft2(x.to(self.real.dtype)) * torch.complex(self.real, self.imag)
        filtered = torch.real(torch.fft.ifft2(spectrum)).to(x.dtype)
        return torch.relu(x + self.a(x) * self.b(x) + filtered)


class HalvingConv(nn.Module):
    """3x3 convolution of stride 2 with MATLAB's padding, normalisation, ReLU."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv = SameConv(in_channels, out_channels, stride=2)
        self.norm = nn.BatchNorm2d(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H / 2, W / 2)."""
        return torch.relu(self.norm(self.conv(x)))


class FourierNet(ImageClassifier):
    """FFTBasedNN of version 1, MATLAB form: six Fourier blocks of 64 to 256 channels.

    Args:
        num_classes, in_channels: see :class:`~tensorsim.recognition.blocks.ImageClassifier`.
        size: height and width of the pictures, a multiple of 16.

    Shapes: images (..., C, size, size) in [0, 1] -> logits (..., num_classes). Differentiable. 6 496 012 parameters for
    12 classes, 3 channels and 256x256 pixels, of which 1 835 008 in filters.

    Raises:
        TensorsimError: see the base class; a size that is not a multiple of 16, images of another size.
    """

    def __init__(self, num_classes: int = 12, in_channels: int = 1, size: int = 256) -> None:
        super().__init__(num_classes, in_channels)
        if size < 16 or size % 16:
            raise TensorsimError(f"FourierNet.size: got {size}, expected a multiple of 16")
        self.size = size
        self.stem = HalvingConv(in_channels, 64)
        layers: list[nn.Module] = []
        for channels, part in ((64, 4), (128, 8), (256, 16)):
            layers += [FourierBlock(channels, size // part) for _ in range(2)]
            layers.append(HalvingConv(channels, 2 * channels))
        self.body = nn.Sequential(*layers)
        self.head = nn.Linear(512, num_classes)

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, size, size) to logits (B, num_classes)."""
        _check_size(x, self.size, "FourierNet")
        x = self.stem(x)
        top, bottom = same_padding(x.shape[-2], 3, 2)
        left, right = same_padding(x.shape[-1], 3, 2)
        # After a ReLU, padding with zeros equals padding with minus infinity.
        x = F.max_pool2d(F.pad(x, [left, right, top, bottom]), 3, 2)
        return self.head(self.body(x).mean((-2, -1)))

    @classmethod
    def arguments(cls, weights: dict[str, Tensor]) -> dict[str, Any]:
        """See :meth:`ImageClassifier.arguments`."""
        return {
            "num_classes": weights["head.weight"].shape[0],
            "in_channels": weights["mean"].shape[0],
            "size": 4 * weights["body.0.real"].shape[-1],
        }


#: Channels and blocks of each version of GlobalFilterNet.
GLOBAL_FILTER_SIZES = {"tiny": (256, 12), "xs": (384, 12), "s": (384, 19), "b": (512, 19)}


class GlobalFilterBlock(nn.Module):
    """``x + MLP(norm(filter(norm(x))))`` on a grid of patches (B, H, W, C)."""

    def __init__(self, channels: int, grid: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels)
        self.filter = nn.Parameter(0.02 * torch.randn(grid, grid // 2 + 1, channels, 2))
        self.norm2 = nn.LayerNorm(channels)
        self.wide = nn.Linear(channels, 4 * channels)
        self.narrow = nn.Linear(4 * channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, H, W, C) to the same shape."""
        y = self.norm1(x).to(self.filter.dtype)
        spectrum = torch.fft.rfft2(y, dim=(1, 2), norm="ortho") * torch.complex(
            self.filter[..., 0], self.filter[..., 1]
        )
        y = torch.fft.irfft2(spectrum, s=(x.shape[1], x.shape[2]), dim=(1, 2), norm="ortho")
        return x + self.narrow(F.gelu(self.wide(self.norm2(y))))


class GlobalFilterNet(ImageClassifier):
    """FFTBasedNN of version 1, Python form: GFNet on patches of 16x16 pixels.

    Args:
        num_classes, in_channels: see :class:`~tensorsim.recognition.blocks.ImageClassifier`.
        version: ``"tiny"``, ``"xs"``, ``"s"`` or ``"b"``, in order of size.
        size: height and width of the pictures, a multiple of 16.

    Shapes: images (..., C, size, size) in [0, 1] -> logits (..., num_classes). Differentiable. 7 257 868 parameters for
    tiny, 12 classes, 3 channels and 224x224 pixels.

    Raises:
        TensorsimError: see the base class; an unknown version, a size that is not a multiple of 16, images of another
            size.
    """

    def __init__(
        self, num_classes: int = 12, in_channels: int = 1, version: str = "tiny", size: int = 224
    ) -> None:
        super().__init__(num_classes, in_channels)
        check_choice(version, GLOBAL_FILTER_SIZES, "GlobalFilterNet.version")
        if size < 16 or size % 16:
            raise TensorsimError(f"GlobalFilterNet.size: got {size}, expected a multiple of 16")
        self.size = size
        grid = size // 16
        channels, depth = GLOBAL_FILTER_SIZES[version]
        self.patches = nn.Conv2d(in_channels, channels, 16, stride=16)
        self.position = nn.Parameter(torch.zeros(1, grid, grid, channels))
        self.blocks = nn.Sequential(*[GlobalFilterBlock(channels, grid) for _ in range(depth)])
        self.norm = nn.LayerNorm(channels)
        self.head = nn.Linear(channels, num_classes)
        nn.init.trunc_normal_(self.position, std=0.02)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, size, size) to logits (B, num_classes)."""
        _check_size(x, self.size, "GlobalFilterNet")
        x = self.patches(x).permute(0, 2, 3, 1) + self.position
        return self.head(self.norm(self.blocks(x)).mean((1, 2)))

    @classmethod
    def arguments(cls, weights: dict[str, Tensor]) -> dict[str, Any]:
        """See :meth:`ImageClassifier.arguments`."""
        grid, channels = weights["position"].shape[1], weights["position"].shape[-1]
        depth = sum(key.endswith(".filter") for key in weights)
        versions = [name for name, sizes in GLOBAL_FILTER_SIZES.items() if sizes == (channels, depth)]
        return {
            "num_classes": weights["head.weight"].shape[0],
            "in_channels": weights["mean"].shape[0],
            "version": versions[0],
            "size": 16 * grid,
        }
