"""SPNet with densely connected blocks, as the text of its paper describes but its published layer list does not.

Source: RadHARSimulator V2 (arXiv 2511.09022): "densely connected" 3x3 convolutions, each fed with the concatenation of
all before it, a 1x1 fusion and a residual addition, three times. Everything that the text leaves open (six
convolutions per block, each as wide as the block's input, the other sizes) is that of
:class:`~tensorsim.recognition.SPNet`. There is no published figure of this form.
"""

import torch
from torch import Tensor, nn

from tensorsim.recognition.blocks import ImageClassifier, SameConv, glorot


class DenseBlock(nn.Module):
    """Normalisation, six 3x3 convolutions each fed with all before it, their fusion, and a shortcut. Halves the size.

    Args:
        channels: of the input, and of each convolution.
        out_channels: of the result.
    """

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(channels)
        self.halve = SameConv(channels, channels, stride=2)
        self.layers = nn.ModuleList([SameConv(k * channels, channels) for k in range(1, 7)])
        self.fuse = nn.Conv2d(7 * channels, out_channels, 1)
        self.shortcut = SameConv(channels, out_channels, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H / 2, W / 2)."""
        x = torch.relu(self.norm(x))
        found = torch.relu(self.halve(x))
        for layer in self.layers:
            found = torch.cat([found, torch.relu(layer(found))], dim=1)
        return self.shortcut(x) + self.fuse(found)


class SPNetDense(ImageClassifier):
    """SPNet with dense blocks; a reconstruction from the text of the paper.

    Args:
        num_classes: number of classes.
        in_channels: number of channels C of the images.

    Shapes: images (..., C, H, W) in [0, 1], 224x224 in the paper -> logits (..., num_classes). Differentiable.

    Raises:
        TensorsimError: see :class:`~tensorsim.recognition.blocks.ImageClassifier`.
    """

    def __init__(self, num_classes: int = 12, in_channels: int = 1) -> None:
        super().__init__(num_classes, in_channels)
        self.conv1 = SameConv(in_channels, 12, stride=2)
        self.conv2 = SameConv(12, 24, stride=2)
        self.blocks = nn.Sequential(DenseBlock(24, 96), DenseBlock(96, 192), DenseBlock(192, 384))
        self.conv6 = nn.Conv2d(384, 1024, 1)
        self.fc1 = nn.Linear(1024, 1024)
        self.head = nn.Linear(1024, num_classes)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                glorot(module)

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, H, W) to logits (B, num_classes)."""
        x = torch.relu(self.blocks(self.conv2(torch.relu(self.conv1(x)))))
        x = torch.relu(self.conv6(x)).mean((-2, -1))
        return self.head(torch.relu(self.fc1(x)))
