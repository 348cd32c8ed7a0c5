"""TWR-ADFE-Net: an enhanced Doppler-time map, and the 3DCA-ConvMixer that reads it.

Source: L. Tang, S. Guo, J. Li, J. Zhu, G. Cui, L. Kong, X. Yang. Published: the steps and the sizes of an open
reproduction, which this module follows and whose channel gate, it states, stands in for the original's attention along
height, width and channels. Reconstructed: the width of the two weights at pulse repetition frequencies other than
200 Hz; the original's weights adapt to the data and are not published.
"""

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.ops import safe_sqrt
from tensorsim.radar.processing.doppler import DopplerFrames
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.recognition.blocks import ChannelGate, ImageClassifier


def fuse_doppler(cancelled: Tensor, centred: Tensor, doppler_hz: Tensor, sigma_hz: float) -> Tensor:
    """Two Doppler-time maps of one clip as one: fast motion from the first, slow motion from the second.

    ``W cancelled / max + (1 - W) centred / max`` with ``W = 1 - exp(-f^2 / (2 sigma^2))``, over its own maximum. A
    two-pulse canceller suppresses slow motion as well as static echoes; subtracting the mean over the clip keeps it.

    Args:
        cancelled: (..., F, K) magnitude after two-pulse cancellation.
        centred: (..., F, K) magnitude after subtraction of the mean over pulses.
        doppler_hz: (F,).
        sigma_hz: width of the slow part.

    Returns:
        (..., F, K) in [0, 1]; zeros where both are zero.
    """
    fast = (1 - torch.exp(-doppler_hz.square() / (2 * sigma_hz**2))).to(cancelled.dtype).unsqueeze(-1)
    both = fast * _over_peak(cancelled) + (1 - fast) * _over_peak(centred)
    return _over_peak(both)


def _over_peak(maps: Tensor) -> Tensor:
    peak = maps.amax((-2, -1), keepdim=True)
    return maps / torch.where(peak > 0, peak, torch.ones_like(peak))


class DopplerEnhancement(DopplerFrames):
    """Range profiles to the enhanced Doppler-time map of TWR-ADFE-Net, see :func:`fuse_doppler`.

    The magnitudes of the transforms of the range bins are added, not their powers.

    Args:
        radar, window_s, overlap: see :class:`~tensorsim.radar.processing.doppler.DopplerFrames`; the source uses a
            Hamming window of 0.1 s and an overlap of 0.9.
        sigma_hz: None is a twentieth of the pulse repetition frequency, 10 Hz at the source's 200 Hz.

    Shapes: (..., M, R) complex -> (..., F, K) in [0, 1], Doppler ascending, positive = approaching. Differentiable.

    Raises:
        TensorsimError: a width that is not positive; real profiles, fewer pulses than one window plus one.
    """

    def __init__(
        self,
        radar: RadarConfig,
        window_s: float = 0.1,
        overlap: float = 0.9,
        sigma_hz: float | None = None,
    ) -> None:
        super().__init__(radar, window_s, overlap)
        self.sigma_hz = radar.prf_hz / 20 if sigma_hz is None else sigma_hz
        if not self.sigma_hz > 0:
            raise TensorsimError(
                f"DopplerEnhancement.sigma_hz: got {sigma_hz}, expected a positive number of Hz"
            )
        hamming = torch.hamming_window(self.length, periodic=True, dtype=torch.float64)
        alternating = 1.0 - 2.0 * (torch.arange(self.length, dtype=torch.float64) % 2)
        self.window.copy_(hamming)
        self.shifting_window.copy_(hamming * alternating)
        self.cancel = MovingTargetIndicator("two-pulse")
        self.centre = MovingTargetIndicator("mean")

    def forward(self, profiles: Tensor) -> Tensor:
        """Profiles (..., M, R) complex to the map (..., F, K)."""
        cancelled = self.magnitudes(self.cancel(profiles))
        centred = self.magnitudes(self.centre(profiles)[..., 1:, :])
        return fuse_doppler(cancelled, centred, self.doppler_hz, self.sigma_hz)

    def magnitudes(self, profiles: Tensor) -> Tensor:
        """Sum over range bins of the magnitudes of their transforms: (..., F, K)."""
        frames = self.series(profiles).unfold(-1, self.length, self.hop)  # (B, R, K, L)
        total = torch.zeros_like(self.spectrum(frames[:, 0])[..., 0])
        for r in range(frames.shape[1]):
            power = self.spectrum(frames[:, r]).square().sum(-1)
            total = total + safe_sqrt(power)
        shape = list(profiles.shape[:-2])
        shape.extend([self.bins, frames.shape[2]])
        return total.transpose(-1, -2).reshape(shape)


class MixerBlock(nn.Module):
    """Depthwise 9x9 convolution, gated by channel and added to the input; then a 1x1 convolution."""

    def __init__(self, channels: int, kernel: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(channels, channels, kernel, padding=kernel // 2, groups=channels)
        self.norm1 = nn.BatchNorm2d(channels)
        self.gate = ChannelGate(channels, channels // 4)
        self.pointwise = nn.Conv2d(channels, channels, 1)
        self.norm2 = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        u = self.norm1(nn.functional.gelu(self.depthwise(x)))
        x = x + u * self.gate(u)
        return self.norm2(nn.functional.gelu(self.pointwise(x)))


class ADFENet(ImageClassifier):
    """The network of TWR-ADFE-Net, 3DCA-ConvMixer: patches of 7x7 pixels, eight mixer blocks of 256 channels.

    Args:
        num_classes, in_channels: see :class:`~tensorsim.recognition.blocks.ImageClassifier`.

    Shapes: images (..., C, H, W) in [0, 1], 224x224 in the source, at least 7x7 -> logits (..., num_classes).
    Differentiable. 983 564 parameters for 12 classes and one channel.

    Raises:
        TensorsimError: see the base class; images smaller than a patch.
    """

    def __init__(self, num_classes: int = 12, in_channels: int = 1) -> None:
        super().__init__(num_classes, in_channels)
        self.patches = nn.Conv2d(in_channels, 256, 7, stride=7)
        self.norm = nn.BatchNorm2d(256)
        self.blocks = nn.Sequential(*[MixerBlock(256, 9) for _ in range(8)])
        self.head = nn.Linear(256, num_classes)

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, H, W) to logits (B, num_classes)."""
        if min(x.shape[-2], x.shape[-1]) < 7:
            raise TensorsimError(f"ADFENet: got images of {x.shape[-2]}x{x.shape[-1]}, expected at least 7x7")
        x = self.norm(nn.functional.gelu(self.patches(x)))
        return self.head(self.blocks(x).mean((-2, -1)))
