"""What runs the networks on a processor: ONNX Runtime, OpenVINO, or torch."""

from torch import nn

from tensorsim.errors import TensorsimError
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.onnx_engine import OnnxDetector, OnnxPose, Runtime
from tensorsim.vision.pose2d.onnx_file import OnnxFile
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose

#: What runs the detector and the pose network, by engine. The detector stays in float32: in bfloat16 or in integers its
#: boxes would shift, and keypoints would be several times as far off.
_RUNTIMES: dict[str, tuple[Runtime, Runtime]] = {
    "onnxruntime": ("onnxruntime", "onnxruntime"),
    "openvino": ("openvino", "openvino-bfloat16"),
    "int8": ("onnxruntime", "int8"),
}
ENGINES = (*_RUNTIMES, "torch")


def run_by(engine: str, detector: nn.Module, pose: nn.Module) -> tuple[nn.Module, nn.Module]:
    """The two stages with their networks run by an engine; stages that are not this package's are unchanged.

    Args:
        engine: ``"onnxruntime"`` runs both in float32; ``"int8"`` the pose network in 8-bit integers; ``"openvino"``
            the pose network in bfloat16 on processors with instructions for it; ``"torch"`` changes nothing.
        detector, pose: the stages; networks inside of ``pose`` are replaced.

    Raises:
        TensorsimError: no such engine.
    """
    if engine not in ENGINES:
        raise TensorsimError(f"engine: got {engine!r}, expected one of {', '.join(ENGINES)}")
    if engine == "torch":
        return detector, pose
    of_detector, of_pose = _RUNTIMES[engine]
    if isinstance(detector, RTMDet):
        detector = OnnxDetector(detector, of_detector).eval()
    if isinstance(pose, TopDownPose):
        holder = pose.network if isinstance(pose.network, FlipTest) else pose
        if not isinstance(holder.network, OnnxFile | OnnxPose):
            holder.network = OnnxPose(holder.network, of_pose).eval()
    return detector, pose
