"""What networks in ONNX files have in common: a session that is opened on first use, and that they do not script."""

import os
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_floating, check_rank
from tensorsim.vision.pose2d.hrnet import IMAGENET_MEAN, IMAGENET_STD, normalise


class OnnxFile(nn.Module):
    """A network of crops that ONNX Runtime runs on the CPU in float32, without gradients.

    The file's one input must take ImageNet-normalised RGB, N or 1 crops at a time. Pickles and copies hold the path,
    and open the file again on use. It neither scripts nor exports.

    Args:
        path: the ``.onnx`` file.
        expected: outputs that it should have, for messages.
        threads: of ONNX Runtime for one crop; None takes all cores.

    Attributes:
        input_size: (H, W) of the crops it takes; (256, 192) where the file does not fix it.

    Raises:
        TensorsimError: no ONNX Runtime, a file that it cannot read, inputs of another layout, crops of another size;
            also when it is scripted.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, path: str | os.PathLike[str], expected: str, threads: int | None = None) -> None:
        super().__init__()
        self.path, self.expected, self.threads = Path(path).absolute(), expected, threads
        self._session: Any = None
        inputs = self.session.get_inputs()
        shape = inputs[0].shape
        # Dynamic sizes are names or None.
        fits = len(inputs) == 1 and len(shape) == 4 and is_size(shape[1], 3)
        if not fits or inputs[0].type != "tensor(float)" or (isinstance(shape[0], int) and shape[0] != 1):
            self.refuse()
        self.one_by_one = isinstance(shape[0], int)
        self.fixed_size = isinstance(shape[2], int) and isinstance(shape[3], int)
        self.input_size: tuple[int, int] = (shape[2], shape[3]) if self.fixed_size else (256, 192)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    def refuse(self) -> NoReturn:
        """Say what the file has and what was expected."""
        inputs, outputs = self.session.get_inputs(), self.session.get_outputs()
        described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
        given = ", ".join(f"{o.name} {o.shape}" for o in outputs)
        raise TensorsimError(
            f"{self.path}: got {described} -> {given}, expected one float input (N or 1, 3, H, W) and {self.expected}"
        )

    @property
    def session(self) -> Any:
        """The ``onnxruntime.InferenceSession``, opened on first use."""
        if self._session is None:
            self._session = open_session(self.path, self.threads)
        return self._session

    def run_on(self, crops: Tensor, outputs: list[str]) -> list[Tensor]:
        """These outputs for crops (N, 3, H, W) RGB in [0, 1], N >= 1."""
        inputs = normalise(crops.detach(), self.mean, self.std).float().cpu().contiguous().numpy()
        name = self.session.get_inputs()[0].name
        batches = [inputs[i : i + 1] for i in range(len(inputs))] if self.one_by_one else [inputs]
        found = [self.session.run(outputs, {name: batch}) for batch in batches]
        return [torch.from_numpy(np.concatenate(parts)).to(crops) for parts in zip(*found, strict=True)]

    def check_crops(self, crops: Tensor) -> tuple[int, int]:
        """Height and width of crops; refuses those that the file does not accept."""
        name = f"{type(self).__name__} crops"
        check_floating(crops, name)
        check_rank(crops, 4, name, "(N, 3, H, W) RGB in [0, 1]")
        height, width = self.input_size if self.fixed_size else (crops.shape[2], crops.shape[3])
        if crops.shape[1:] != (3, height, width):
            raise TensorsimError(f"{name}: got shape {list(crops.shape)}, expected (N, 3, {height}, {width})")
        return height, width

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_session": None}

    def __prepare_scriptable__(self) -> NoReturn:
        raise TensorsimError(
            f"{type(self).__name__}({self.path.name}): cannot be scripted, because ONNX Runtime runs "
            "it and it is not part of the graph; expected an HRNet (HRNet.from_pretrained) as the pose network"
        )


def is_size(size: Any, expected: int) -> bool:
    """Whether a size of a file's input or output is this one, or not fixed."""
    return not isinstance(size, int) or size == expected


def open_session(path: Path, threads: int | None = None) -> Any:
    """The ``onnxruntime.InferenceSession`` of a file on the CPU, with this many threads or one for each core.

    Raises:
        TensorsimError: no ONNX Runtime, no such file, or one that it cannot read.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise TensorsimError(
            f"{path.name}: ONNX Runtime is not installed; install it with `pip install onnxruntime`"
        ) from error
    if not path.is_file():
        raise TensorsimError(f"{path}: no such file, expected an ONNX network")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 0 if threads is None else threads
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime's own exceptions share no base class
        raise TensorsimError(f"{path}: got a file that ONNX Runtime cannot read ({error})") from error
