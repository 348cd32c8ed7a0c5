"""Networks to test with, without training one."""

from typing import TypeVar

import torch
from torch import nn

Network = TypeVar("Network", bound=nn.Module)


def settled(network: Network) -> Network:
    """The network in evaluation mode, its normalisations far from the identity, as training leaves them."""
    generator = torch.Generator().manual_seed(5)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            for values, low, high in (
                (module.running_mean, -0.15, 0.15),
                (module.running_var, 0.5, 2.0),
                (module.weight, 0.5, 1.5),
                (module.bias, -0.15, 0.15),
            ):
                nn.init.uniform_(values, low, high, generator=generator)
    return network.eval()
