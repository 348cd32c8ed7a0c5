"""DnCNN: a convolutional network that predicts the noise of an image; the clean image is the difference.

Source: K. Zhang, W. Zuo, Y. Chen, D. Meng, L. Zhang, "Beyond a Gaussian denoiser: residual learning of deep
CNN for image denoising", IEEE Transactions on Image Processing 26 (2017).
"""

import os
import re

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from tensorsim.enhance.perona_malik import PeronaMalik
from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_count,
    check_finite,
    check_floating,
    check_like_weights,
    check_min_rank,
    check_not_empty,
    is_exporting,
)

#: How a map is scaled to an image for the network, see :class:`MapDenoiser`.
SCALES = ("peak", "floor")
#: Ten times the depth and the width of the paper's network.
MAX_DEPTH, MAX_CHANNELS = 200, 640


class DnCNN(nn.Module):
    """Noisy images in [0, 1] -> clean images $x - Q(x)$; the network $Q$ predicts the noise (residual learning).

    ``depth`` convolutions of 3x3, all but the first and the last with batch normalisation. The state dict has the
    names of the authors' PyTorch code: ``model.{3i-1}`` and ``model.{3i}`` for convolution i and its normalisation,
    ``model.{2i}`` for convolution i if normalisation is folded into it.

    Args:
        depth: number of convolutions, also the radius of the receptive field in pixels.
        channels: width of the network.
        batch_norm: False builds the network without normalisation, as in the released weights.

    Example:
        >>> DnCNN(depth=17)(torch.rand(2, 40, 60)).shape
        torch.Size([2, 40, 60])

    Raises:
        TensorsimError: a depth below 2 or a width below 1.
    """

    def __init__(self, depth: int = 20, channels: int = 64, batch_norm: bool = True) -> None:
        super().__init__()
        check_count(depth, "DnCNN depth", 2, MAX_DEPTH)
        check_count(channels, "DnCNN channels", 1, MAX_CHANNELS)
        self.depth = depth
        self.reach = depth
        self.channels = channels
        self.batch_norm = batch_norm
        layers: list[nn.Module] = [_convolution(1, channels), nn.ReLU(inplace=True)]
        for _ in range(depth - 2):
            layers.append(_convolution(channels, channels))
            if batch_norm:
                layers.append(nn.BatchNorm2d(channels, eps=1e-4))
            layers.append(nn.ReLU(inplace=True))
        layers.append(_convolution(channels, 1))
        self.model = nn.Sequential(*layers)

    def forward(self, images: Tensor) -> Tensor:
        """Clean images (..., H, W) in [0, 1]; the output is not clipped.

        Raises:
            TensorsimError: see :meth:`noise`.
        """
        return images - self.noise(images)

    @torch.jit.export
    def noise(self, images: Tensor) -> Tensor:
        """Q, the noise of images (..., H, W) in [0, 1].

        Raises:
            TensorsimError: not real, fewer than two dimensions, or empty.
        """
        check_floating(images, "DnCNN")
        check_min_rank(images, 2, "DnCNN", "(..., H, W)")
        check_not_empty(images, "DnCNN")
        check_like_weights(images, self.model[0].weight, "DnCNN")  # type: ignore[arg-type]
        check_finite(images, "DnCNN")
        noise: Tensor = self.model(images.reshape(-1, 1, images.shape[-2], images.shape[-1]))
        return noise.reshape(images.shape)

    def folded(self) -> "DnCNN":
        """The network with normalisation folded into the convolutions: the same output in evaluation mode, faster."""
        if not self.batch_norm:
            return self
        convolutions = [layer for layer in self.model if isinstance(layer, nn.Conv2d)]
        norms = [layer for layer in self.model if isinstance(layer, nn.BatchNorm2d)]
        folded = DnCNN(self.depth, self.channels, batch_norm=False).to(convolutions[0].weight)
        for i, (conv, norm) in enumerate(zip(convolutions, [None, *norms, None], strict=True)):
            weight, bias = conv.weight, conv.bias
            if norm is not None:
                mean, variance = norm.get_buffer("running_mean"), norm.get_buffer("running_var")
                weight, bias = fuse_conv_bn_weights(
                    weight, bias, mean, variance, norm.eps, norm.weight, norm.bias
                )
            folded.model[2 * i].load_state_dict({"weight": weight, "bias": bias})
        return folded.train(self.training)

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str] | None = None) -> "DnCNN":
        """Build the network of a weight file, in evaluation mode.

        Args:
            source: path of a ``.pth`` or ``.safetensors`` file with the names ``conv{i}`` (folded) or those of the
                authors' PyTorch code, folded or not, which this class has too; or a name from
                ``tensorsim models list``; None for the shipped weights.

        Raises:
            TensorsimError: no such file, an unsafe or incomplete file, or weights of another network.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, cls.__name__)
        weights = load_state_dict(path)
        state = {
            re.sub(r"^conv(\d+)\.", lambda m: f"model.{2 * int(m[1])}.", k): w for k, w in weights.items()
        }
        first = state.get("model.0.weight")
        if first is None or first.dim() != 4 or first.shape[1:] != (1, 3, 3):
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of a grey "
                f"DnCNN (model.0.weight or conv0.weight with shape (channels, 1, 3, 3))"
            )
        depth = sum(w.dim() == 4 for w in state.values())
        batch_norm = any(key.endswith("running_mean") for key in state)
        network = cls(max(depth, 2), first.shape[0], batch_norm)
        load_strict(network, state, path)
        return network.eval()


def _convolution(in_channels: int, out_channels: int) -> nn.Conv2d:
    """3x3 with the paper's initial weights (He)."""
    convolution = nn.Conv2d(in_channels, out_channels, 3, padding=1)
    nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
    nn.init.constant_(convolution.get_parameter("bias"), 0.0)
    return convolution


def map_floor(maps: Tensor) -> Tensor:
    """Median (..., 1, 1) of each map (..., H, W): its noise level, if echoes cover less than half of it."""
    return maps.flatten(-2).median(-1).values.unsqueeze(-1).unsqueeze(-1)


class MapDenoiser(nn.Module):
    """Denoise magnitude maps with a network for images.

    The map is scaled to an image x, and the noise that the network predicts, ``x - network(x)``, is subtracted from
    the map in its own scale:

    - ``scale="peak"``: ``x = (map - min) / (max - min)``, for networks trained on photographs;
    - ``scale="floor"``: ``x = log(1 + map / floor)`` with the median of the map as floor; the predicted noise is in
      units of the floor. Noise covers more than half of a map, so its level in x does not depend on the
      signal-to-noise ratio or the gain. For networks trained on this scale.

    Maps are processed in tiles of columns that overlap by the receptive field of the network: the result is that of
    the whole map, and memory does not grow with its length.

    Args:
        network: noisy images (..., H, W) -> clean ones, :class:`DnCNN` or
            :class:`~tensorsim.enhance.perona_malik.PeronaMalik`.
        tile: columns (time) per tile.
        scale: ``"peak"`` or ``"floor"``.

    Example:
        >>> denoiser = MapDenoiser.from_pretrained()  # the shipped weights, with their scale
        >>> denoiser(torch.rand(2, 64, 40)).shape
        torch.Size([2, 64, 40])

    Raises:
        TensorsimError: a tile without columns, an unknown scale.
    """

    def __init__(self, network: DnCNN | PeronaMalik, tile: int = 1024, scale: str = "peak") -> None:
        super().__init__()
        check_count(tile, "MapDenoiser.tile")
        check_choice(scale, SCALES, "MapDenoiser.scale")
        self.network = network
        self.tile = tile
        self.scale = scale
        self.reach: int = network.reach

    def forward(self, maps: Tensor) -> Tensor:
        """Denoise magnitude maps (..., H, W), each on its own scale.

        Differentiable, except where the result is clipped at its lower bound.

        Returns:
            Tensor of the shape of ``maps``, clipped at the minimum of the map (``"peak"``) or at 0 (``"floor"``). A map
            whose floor is 0 has no noise and is returned unchanged.

        Raises:
            TensorsimError: not real, fewer than two dimensions, empty, or NaN; negative values with ``"floor"``.
        """
        check_floating(maps, "MapDenoiser")
        check_min_rank(maps, 2, "MapDenoiser", "(..., H, W)")
        check_not_empty(maps, "MapDenoiser")
        check_finite(maps, "MapDenoiser")
        if self.scale == "floor":
            if not is_exporting() and bool((maps < 0).any()):
                raise TensorsimError("MapDenoiser: got negative values, expected linear magnitudes, not dB")
            floor = map_floor(maps)
            images = torch.log1p(maps / torch.where(floor > 0, floor, torch.ones_like(floor)))
            return (maps - floor * (images - self.clean(images))).clamp(min=0.0)
        low, high = maps.amin(dim=(-2, -1), keepdim=True), maps.amax(dim=(-2, -1), keepdim=True)
        span = high - low
        images = (maps - low) / torch.where(span > 0, span, torch.ones_like(span))
        return self.clean(images).clamp(min=0.0) * span + low

    def clean(self, images: Tensor) -> Tensor:
        """Denoise images (..., H, W), one after another."""
        flat = images.reshape(-1, images.shape[-2], images.shape[-1])
        return torch.stack([self.clean_in_tiles(image) for image in flat.unbind(0)]).reshape(images.shape)

    def clean_in_tiles(self, image: Tensor) -> Tensor:
        """Denoise one image (H, W), tile after tile."""
        width = image.shape[-1]
        tiles: list[Tensor] = []
        for start in range(0, width, self.tile):
            first = max(0, start - self.reach)
            count = min(self.tile, width - start)
            last = min(width, start + count + self.reach)
            tiles.append(self.network(image[:, first:last])[:, start - first : start - first + count])
        return torch.cat(tiles, dim=-1)

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str] | None = None, tile: int = 1024) -> "MapDenoiser":
        """A :class:`DnCNN` on the scale in the metadata of its weight file, ``"peak"`` if there is none.

        Args:
            source: see :meth:`DnCNN.from_pretrained`.
            tile: columns per tile.

        Raises:
            TensorsimError: see :meth:`DnCNN.from_pretrained`; a file with an unknown scale.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import read_metadata

        path = locate(source, "DnCNN")
        network = DnCNN.from_pretrained(path).folded()
        return cls(network, tile, read_metadata(path).get("scale", "peak")).eval()
