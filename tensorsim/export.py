"""Export to TorchScript files that run where tensorsim is not installed."""

import os
import warnings

import torch
from torch import nn

from tensorsim.errors import TensorsimError
from tensorsim.files import complete_file


def to_torchscript(module: nn.Module, path: str | os.PathLike[str]) -> None:
    """Script a stage or a whole pipeline in evaluation mode and save it.

    The file loads with ``torch.jit.load`` in a process without tensorsim and takes other batch sizes, clip
    lengths and people counts.

    Args:
        module: the module; its training mode, and that of every module in it, is left as it was.
        path: file to write; it appears only when complete.

    Raises:
        TensorsimError: the path is a folder, or the module contains a stage that cannot be scripted,
            such as ``OnnxHeatmaps``.
    """
    if os.path.isdir(path):
        raise TensorsimError(f"{os.fspath(path)}: is a folder, expected a file to write")
    training = [part for part in module.modules() if part.training]
    with warnings.catch_warnings():
        # TorchScript is deprecated upstream; the caller has asked for it.
        warnings.filterwarnings("ignore", message=r".*torch\.jit.*deprecated")
        try:
            scripted = torch.jit.script(module.eval())
        finally:
            for part in training:
                part.training = True
        with complete_file(path) as scratch:
            torch.jit.save(scripted, str(scratch))
