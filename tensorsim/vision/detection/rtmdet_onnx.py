"""RTMDet's weights from an ONNX file of mmdeploy, whose batch norms are folded into the convolutions."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.vision.detection.rtmdet_layers import ConvModule


class FoldedConv(NamedTuple):
    """A convolution: name of its weight, weight (outputs, inputs / groups, k, k), bias (outputs,)."""

    name: str
    weight: Tensor
    bias: Tensor


def read_convolutions(path: str | os.PathLike[str]) -> list[FoldedConv]:
    """The convolutions of an ONNX file in graph order.

    Raises:
        TensorsimError: no such file, not an ONNX file, or convolutions without constant weight and bias.
    """
    import onnx
    from onnx import numpy_helper

    if not Path(path).is_file():
        raise TensorsimError(f"{path}: no such file, expected an ONNX network")
    try:
        graph = onnx.load(path).graph
    except Exception as error:  # protobuf's own exceptions, whichever implementation of it is installed
        raise TensorsimError(f"{path}: damaged or not an ONNX file ({type(error).__name__})") from error
    constants = {tensor.name: tensor for tensor in graph.initializer}
    convolutions = []
    for node in graph.node:
        if node.op_type == "Identity" and node.input[0] in constants:  # equal tensors are stored once
            constants[node.output[0]] = constants[node.input[0]]
        if node.op_type == "Conv":
            names = node.input[1:]
            if len(names) != 2 or any(name not in constants for name in names):
                raise TensorsimError(f"{path}: {node.name} has no constant weight and bias, expected both")
            weight, bias = (torch.tensor(numpy_helper.to_array(constants[name])) for name in names)
            convolutions.append(FoldedConv(names[0], weight, bias))
    return convolutions


def unfold(
    network: nn.Module, convolutions: list[FoldedConv], source: str | os.PathLike[str]
) -> dict[str, Tensor]:
    """The state dict with which ``network`` computes what the folded convolutions do.

    A folded weight is ``g W`` per output channel, g the scale of the batch norm. The convolution takes it
    whole and the batch norm becomes the identity plus the folded bias. Where one W serves several levels of
    the head, each of its channels is taken from the level with the largest g, and the batch norm of a level
    scales by the ratio of its g to that one.

    Args:
        network: an RTMDet in evaluation mode.
        convolutions: in the order in which the network calls its own.
        source: where they come from, for messages.

    Raises:
        TensorsimError: another number, order or shape of convolutions than the network's.
    """
    called = _call_order(network)
    if len(convolutions) != len(called):
        raise TensorsimError(f"{source}: got {len(convolutions)} convolutions, expected {len(called)}")
    state: dict[str, Tensor] = {}
    levels_of: dict[nn.Conv2d, list[tuple[str, float, FoldedConv]]] = {}
    for (path, module), folded in zip(called, convolutions, strict=True):
        conv = module.conv if isinstance(module, ConvModule) else module
        # Exporters rename what they fold and keep the other names: those check the order.
        renamed = not folded.name.startswith(("backbone.", "neck.", "bbox_head."))
        if folded.weight.shape != conv.weight.shape or not (renamed or folded.name.startswith(path + ".")):
            raise TensorsimError(
                f"{source}: got a convolution {folded.name} of {list(folded.weight.shape)}, "
                f"expected {path} of {list(conv.weight.shape)}"
            )
        if isinstance(module, ConvModule):
            levels_of.setdefault(conv, []).append((path, module.bn.eps, folded))
        else:
            state[f"{path}.weight"], state[f"{path}.bias"] = folded.weight, folded.bias

    for conv, levels in levels_of.items():
        folded_weights = torch.stack([folded.weight.flatten(1) for _, _, folded in levels])
        largest = folded_weights.norm(dim=-1).argmax(0)
        weight = folded_weights[largest, torch.arange(len(largest))]
        scales = (folded_weights * weight).sum(-1) / weight.square().sum(-1).clamp(min=1e-30)
        error = (scales.unsqueeze(-1) * weight - folded_weights).abs().max()
        if error > 1e-4 * weight.abs().max():
            raise TensorsimError(f"{source}: {levels[0][0]} differs between levels, expected one for all")
        for (path, eps, folded), scale in zip(levels, scales, strict=True):
            state[f"{path}.conv.weight"] = weight.reshape(conv.weight.shape)
            state[f"{path}.bn.weight"], state[f"{path}.bn.bias"] = scale, folded.bias
            # Batch norm divides by sqrt(variance + eps), here exactly 1.
            state[f"{path}.bn.running_mean"] = torch.zeros_like(scale)
            state[f"{path}.bn.running_var"] = torch.full_like(scale, 1 - eps)
            state[f"{path}.bn.num_batches_tracked"] = torch.tensor(0)
    return state


def _call_order(network: nn.Module) -> list[tuple[str, ConvModule | nn.Conv2d]]:
    """Paths and modules of convolutions, together with their batch norms, in the order of their calls."""
    called: list[tuple[str, ConvModule | nn.Conv2d]] = []
    handles = []
    for path, module in network.named_modules():
        # The `conv` of a ConvModule counts with the module, of which each level has its own even if `conv` is shared.
        if isinstance(module, (ConvModule, nn.Conv2d)) and not path.endswith(".conv"):
            handles.append(module.register_forward_hook(lambda m, x, y, path=path: called.append((path, m))))
    dense = cast(Callable[[Tensor], Any], network.dense)
    with torch.no_grad():
        dense(torch.zeros(1, 3, 32, 32))
    for handle in handles:
        handle.remove()
    return called
