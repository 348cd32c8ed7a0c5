"""What runs the networks on a processor: ONNX Runtime, torch in bfloat16, or torch as it is."""

from collections.abc import Callable
from functools import partial

from torch import nn

from tensorsim.errors import TensorsimError
from tensorsim.vision.bfloat16 import Bfloat16Pose
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.onnx_engine import OnnxDetector, OnnxPose
from tensorsim.vision.pose2d.onnx_file import OnnxFile
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose

#: What runs a heat-map network in the place of torch, by engine.
_POSE_BY: dict[str, Callable[[nn.Module], nn.Module]] = {
    "onnxruntime": OnnxPose,
    "bfloat16": Bfloat16Pose,
    "int8": partial(OnnxPose, int8=True),
}
ENGINES = (*_POSE_BY, "torch")


def run_by(engine: str, detector: nn.Module, pose: nn.Module) -> tuple[nn.Module, nn.Module]:
    """The same two stages with their networks run by an engine, as far as they are of this package.

    Args:
        engine: ``"torch"`` changes nothing. The others run the detector in ONNX Runtime in float32, as its boxes would
            move otherwise, and the pose network in ONNX Runtime in float32 (``"onnxruntime"``) or in 8-bit integers
            (``"int8"``), or in torch in bfloat16 (``"bfloat16"``).
        detector, pose: the stages; networks inside of ``pose`` are replaced.

    Raises:
        TensorsimError: no such engine.
    """
    if engine not in ENGINES:
        raise TensorsimError(f"engine: got {engine!r}, expected one of {', '.join(ENGINES)}")
    if engine == "torch":
        return detector, pose
    if isinstance(detector, RTMDet):
        detector = OnnxDetector(detector).eval()
    if isinstance(pose, TopDownPose):
        holder = pose.network if isinstance(pose.network, FlipTest) else pose
        if not isinstance(holder.network, OnnxFile | OnnxPose | Bfloat16Pose):
            holder.network = _POSE_BY[engine](holder.network).eval()
    return detector, pose
