"""Export to TorchScript and ONNX files that run where tensorsim is not installed."""

import io
import logging
import os
import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, first_line
from tensorsim.files import complete_file, write_bytes
from tensorsim.onnx_operations import translations
from tensorsim.protocols import check_instance

__all__ = ["ComplexPairs", "to_onnx", "to_torchscript"]


def to_torchscript(module: nn.Module, path: str | os.PathLike[str]) -> None:
    """Script a stage or a whole pipeline in evaluation mode and save it.

    The file loads with ``torch.jit.load`` in a process without tensorsim and takes other batch sizes, clip
    lengths and people counts.

    Args:
        module: the module; its training mode, and that of every module in it, is left as it was.
        path: file to write; it appears only when complete.

    Raises:
        TensorsimError: not a module, the path is a folder, or the module contains a stage that cannot be scripted,
            such as ``OnnxHeatmaps``; TorchScript's own error is the cause.
    """
    check_instance(module, nn.Module, "to_torchscript")
    if os.path.isdir(path):
        raise TensorsimError(f"{os.fspath(path)}: is a folder, expected a file to write")
    training = [part for part in module.modules() if part.training]
    with warnings.catch_warnings():
        # TorchScript is deprecated upstream; the caller has asked for it.
        warnings.filterwarnings("ignore", message=r".*torch\.jit.*deprecated")
        try:
            scripted = torch.jit.script(module.eval())
        except TensorsimError:
            raise
        except Exception as error:  # TorchScript's errors share no base class
            raise TensorsimError(
                f"to_torchscript: got a {type(module).__name__} that TorchScript cannot compile "
                f"({first_line(error)})"
            ) from error
        finally:
            for part in training:
                part.training = True
        # Not straight into the file: torch crashes the process when the disk is full.
        content = io.BytesIO()
        torch.jit.save(scripted, content)
        write_bytes(path, content.getbuffer())


def to_onnx(
    module: nn.Module,
    path: str | os.PathLike[str],
    example: Sequence[Tensor],
    dynamic: dict[int, dict[int, str]] | None = None,
    outputs: Sequence[str] = (),
) -> None:
    """Export a stage in evaluation mode to an ONNX file, for ONNX Runtime and other runtimes.

    Args:
        module: takes tensors and returns a tensor or a tuple of them; its training mode is left as it was. ONNX has no
            complex numbers: see :class:`ComplexPairs` for stages that use them.
        path: file to write; it appears only when complete.
        example: inputs with the shapes that the file is for.
        dynamic: names of the dimensions that may vary in size, by input and dimension: ``{0: {0: "batch"}}``.
            A dimension of size 0 or 1 in the example cannot be dynamic.
        outputs: names of the outputs.

    Raises:
        TensorsimError: not a module, the path is a folder, the example is a single tensor, dynamic dimensions that the
            example does not have, or an operation that ONNX lacks.
    """
    check_instance(module, nn.Module, "to_onnx")
    if isinstance(example, Tensor):
        raise TensorsimError("to_onnx: got a tensor as example, expected a tuple of the inputs")
    if os.path.isdir(path):
        raise TensorsimError(f"{os.fspath(path)}: is a folder, expected a file to write")
    shapes: Any = None
    if dynamic:
        for i, dimensions in dynamic.items():
            for d, name in dimensions.items():
                if not (0 <= i < len(example) and 0 <= d < example[i].dim()):
                    raise TensorsimError(
                        f"to_onnx: got dimension {d} of input {i} for {name}, expected one of the example, from 0"
                    )
                if example[i].shape[d] < 2:
                    raise TensorsimError(
                        f"to_onnx: got {example[i].shape[d]} for the dynamic dimension {name}, expected at least 2"
                    )
        shapes = tuple(
            {d: torch.export.Dim(name) for d, name in dynamic.get(i, {}).items()} for i in range(len(example))
        )
    training = [part for part in module.modules() if part.training]
    with warnings.catch_warnings():
        # The exporter warns about its own internals.
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
        try:
            program = torch.onnx.export(
                module.eval(),
                tuple(example),
                dynamo=True,
                dynamic_shapes=shapes,
                output_names=list(outputs) or None,
                custom_translation_table=translations(),
                verbose=False,
            )
        except Exception as error:  # the exporter's errors share no base class
            cause = first_line(error.__cause__ or error)
            raise TensorsimError(
                f"to_onnx: got a {type(module).__name__} that ONNX cannot express ({cause})"
            ) from error
        finally:
            for part in training:
                part.training = True
        if program is None:
            raise TensorsimError(f"to_onnx: got no program for {type(module).__name__}, expected one")
        with complete_file(path) as scratch:
            program.save(str(scratch))


class ComplexPairs(nn.Module):
    """Wraps a stage with complex input or output so that it uses pairs (..., 2) of real and imaginary part.

    Args:
        stage: takes a complex tensor and returns a tensor, complex or real.
    """

    def __init__(self, stage: nn.Module) -> None:
        super().__init__()
        self.stage = stage

    def forward(self, pairs: Tensor) -> Tensor:
        """Apply the stage to pairs (..., 2); a complex result is returned as pairs too."""
        found = self.stage(torch.view_as_complex(pairs))
        return torch.view_as_real(found) if found.is_complex() else found
