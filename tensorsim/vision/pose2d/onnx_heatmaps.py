"""Any COCO-17 heat-map network in an ONNX file, behind HRNet's interface."""

import os

from torch import Tensor

from tensorsim.config import COCO_KEYPOINTS
from tensorsim.vision.pose2d.onnx_file import OnnxFile, is_size


class OnnxHeatmaps(OnnxFile):
    """A heat-map network run by ONNX Runtime: (N, 3, H, W) RGB crops in [0, 1] -> (N, 17, H/4, W/4) heat
    maps.

    The file's first output must be the heat maps; see :class:`~tensorsim.vision.pose2d.onnx_file.OnnxFile` for its
    input and its attributes.

    Args:
        path: the ``.onnx`` file.
        threads: of ONNX Runtime for one crop; None takes all cores.

    Raises:
        TensorsimError: no ONNX Runtime, a file that it cannot read, inputs or outputs of another layout,
            crops of another size; also when it is scripted.
    """

    def __init__(self, path: str | os.PathLike[str], threads: int | None = None) -> None:
        super().__init__(path, "heat maps (N or 1, 17, H/4, W/4) first", threads)
        maps = self.session.get_outputs()[0].shape
        if len(maps) != 4 or not is_size(maps[1], len(COCO_KEYPOINTS)):
            self.refuse()

    def forward(self, crops: Tensor) -> Tensor:
        """(N, 3, H, W) RGB in [0, 1] -> (N, 17, H/4, W/4), of the crops' type and device."""
        height, width = self.check_crops(crops)
        if crops.shape[0] == 0:
            return crops.new_zeros(0, len(COCO_KEYPOINTS), height // 4, width // 4)
        return self.run_on(crops, [self.session.get_outputs()[0].name])[0]
