"""Any COCO-17 heat-map network in an ONNX file, behind HRNet's interface."""

import os
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor, nn

from tensorsim.config import COCO_KEYPOINTS
from tensorsim.errors import TensorsimError, check_floating, check_rank
from tensorsim.vision.pose2d.hrnet import IMAGENET_MEAN, IMAGENET_STD, normalise


class OnnxHeatmaps(nn.Module):
    """A heat-map network run by ONNX Runtime: (N, 3, H, W) RGB crops in [0, 1] -> (N, 17, H/4, W/4) heat
    maps.

    The file's one input must take ImageNet-normalised RGB, N or 1 crops at a time, and its first output must
    be the heat maps. It runs on the CPU in float32, has no gradients, and neither scripts nor exports. Pickles and
    copies hold the path, and open the file again on use.

    Args:
        path: the ``.onnx`` file.

    Attributes:
        input_size: (H, W) of the crops it takes; (256, 192) where the file does not fix it.

    Raises:
        TensorsimError: no ONNX Runtime, a file that it cannot read, inputs or outputs of another layout,
            crops of another size; also when it is scripted.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__()
        self.path = Path(path).absolute()
        self._session: Any = None
        inputs, outputs = self.session.get_inputs(), self.session.get_outputs()
        shape, maps = inputs[0].shape, outputs[0].shape
        # Dynamic sizes are names or None.
        fits = len(inputs) == 1 and len(shape) == 4 and len(maps) == 4
        fits = (
            fits
            and _is(shape[1], 3)
            and _is(maps[1], len(COCO_KEYPOINTS))
            and inputs[0].type == "tensor(float)"
        )
        if not fits or (isinstance(shape[0], int) and shape[0] != 1):
            described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
            raise TensorsimError(
                f"{self.path}: got {described} -> {outputs[0].name} {maps}, "
                "expected one float input (N or 1, 3, H, W) and heat maps (N or 1, 17, H/4, W/4) first"
            )
        self.one_by_one = isinstance(shape[0], int)
        fixed = isinstance(shape[2], int) and isinstance(shape[3], int)
        self.input_size: tuple[int, int] = (shape[2], shape[3]) if fixed else (256, 192)
        self.fixed_size = fixed
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    @property
    def session(self) -> Any:
        """The ``onnxruntime.InferenceSession``, opened on first use."""
        if self._session is None:
            self._session = _open(self.path)
        return self._session

    def forward(self, crops: Tensor) -> Tensor:
        """(N, 3, H, W) RGB in [0, 1] -> (N, 17, H/4, W/4), of the crops' type and device."""
        check_floating(crops, "OnnxHeatmaps crops")
        check_rank(crops, 4, "OnnxHeatmaps crops", "(N, 3, H, W) RGB in [0, 1]")
        height, width = self.input_size if self.fixed_size else (crops.shape[2], crops.shape[3])
        if crops.shape[1:] != (3, height, width):
            raise TensorsimError(
                f"OnnxHeatmaps crops: got shape {list(crops.shape)}, expected (N, 3, {height}, {width})"
            )
        if crops.shape[0] == 0:
            return crops.new_zeros(0, len(COCO_KEYPOINTS), height // 4, width // 4)
        inputs = normalise(crops.detach(), self.mean, self.std).float().cpu().contiguous().numpy()
        name = self.session.get_inputs()[0].name
        output = [self.session.get_outputs()[0].name]
        batches = [inputs[i : i + 1] for i in range(len(inputs))] if self.one_by_one else [inputs]
        maps = [torch.from_numpy(self.session.run(output, {name: batch})[0]) for batch in batches]
        return torch.cat(maps).to(crops)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_session": None}

    def __prepare_scriptable__(self) -> NoReturn:
        raise TensorsimError(
            f"OnnxHeatmaps({self.path.name}): cannot be scripted: ONNX Runtime runs it, so it is an edge and "
            "not a node of the graph; expected an HRNet (HRNet.from_pretrained) as the pose network"
        )


def _is(size: Any, expected: int) -> bool:
    return not isinstance(size, int) or size == expected


def _open(path: Path) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise TensorsimError(
            "OnnxHeatmaps: got no ONNX Runtime; install it with `pip install onnxruntime`"
        ) from error
    if not path.is_file():
        raise TensorsimError(f"{path}: got no such file, expected an ONNX network")
    try:
        return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime's own exceptions share no base class
        raise TensorsimError(f"{path}: got a file that ONNX Runtime cannot read ({error})") from error
