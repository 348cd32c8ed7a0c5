"""CCLN: convolutional features whose mean and whose course over time, read by an LSTM, are concatenated.

Source: Xiong, Ren, Yuan, Zahid, Abbasi, Imran, "Human Motion Recognition by Micro-Doppler Features and Concatenated
CNN-LSTM Network", IEEE Sensors Journal 25 (2025), doi 10.1109/JSEN.2024.3447790. Published (abstract): a 2D
convolutional network concatenated with an LSTM. Reconstructed: all sizes. The clutter filter of the source, an adaptive
threshold on the echo, comes before the map and is not included here.
"""

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.recognition.blocks import ImageClassifier, conv_norm


class CCLN(ImageClassifier):
    """CCLN, the concatenated CNN-LSTM network.

    Args:
        num_classes, in_channels: see :class:`~tensorsim.recognition.blocks.ImageClassifier`.

    Shapes: images (..., C, H, W) in [0, 1], columns in time, at least 16x16 -> logits (..., num_classes).
    Differentiable. 247 004 parameters for 12 classes and 3 channels.

    Raises:
        TensorsimError: see the base class; images that are too small.
    """

    def __init__(self, num_classes: int = 12, in_channels: int = 1) -> None:
        super().__init__(num_classes, in_channels)
        layers: list[nn.Module] = []
        channels = in_channels
        for width in (16, 32, 64, 128):
            layers += [conv_norm(channels, width, 3), nn.MaxPool2d(2)]
            channels = width
        self.body = nn.Sequential(*layers)
        self.sequence = nn.LSTM(128, 128, batch_first=True)
        self.hidden = nn.Linear(256, 64)
        self.drop = nn.Dropout(0.5)
        self.head = nn.Linear(64, num_classes)

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, H, W) to logits (B, num_classes)."""
        if min(x.shape[-2], x.shape[-1]) < 16:
            raise TensorsimError(f"CCLN: got images of {x.shape[-2]}x{x.shape[-1]}, expected at least 16x16")
        features = self.body(x)
        course = self.sequence(features.mean(-2).transpose(1, 2).contiguous())[0][:, -1]
        joined = torch.cat([features.mean((-2, -1)), course], dim=1)
        return self.head(self.drop(torch.relu(self.hidden(joined))))
