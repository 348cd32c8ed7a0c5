"""What runs the networks on a processor: ONNX Runtime, OpenVINO, or torch."""

import torch
from torch import nn

from tensorsim.device import multiplies_bfloat16
from tensorsim.errors import TensorsimError
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.onnx_engine import OnnxDetector, OnnxPose, Runtime, import_failure
from tensorsim.vision.pose2d.crops import OpenCVBoxCrop
from tensorsim.vision.pose2d.onnx_file import OnnxFile
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose

#: What runs the detector and the pose network, by engine. The detector stays in float32: in bfloat16 or in integers its
#: boxes would shift, and keypoints would be several times as far off.
_RUNTIMES: dict[str, tuple[Runtime, Runtime]] = {
    "onnxruntime": ("onnxruntime", "onnxruntime"),
    "openvino": ("openvino", "openvino-bfloat16"),
    "int8": ("onnxruntime", "int8"),
}
ENGINES = ("auto", *_RUNTIMES, "torch")


def chosen_engine(engine: str, device: torch.device) -> str:
    """The engine that runs the networks on this device if ``engine`` is asked for; ``"auto"`` is the fastest one.

    That is OpenVINO where it can be imported and the processor has instructions for bfloat16, otherwise ONNX Runtime.
    """
    if device.type != "cpu":
        return "torch"
    if engine != "auto":
        return engine
    fast = multiplies_bfloat16(device) and import_failure("openvino") is None
    return "openvino" if fast else "onnxruntime"


def run_by(engine: str, detector: nn.Module, pose: nn.Module) -> tuple[nn.Module, nn.Module]:
    """The two stages with their networks run by an engine; stages that are not this package's are unchanged.

    Args:
        engine: ``"onnxruntime"`` runs both in float32; ``"int8"`` the pose network in 8-bit integers; ``"openvino"``
            the pose network in bfloat16 on processors with instructions for it; ``"torch"`` changes nothing;
            ``"auto"`` is the one of :func:`chosen_engine`.
        detector, pose: the stages; network and crops inside of ``pose`` are replaced.

    Raises:
        TensorsimError: no such engine.
    """
    if engine not in ENGINES:
        raise TensorsimError(f"engine: got {engine!r}, expected one of {', '.join(ENGINES)}")
    engine = chosen_engine(engine, torch.device("cpu"))
    if engine == "torch":
        return detector, pose
    of_detector, of_pose = _RUNTIMES[engine]
    if isinstance(detector, RTMDet):
        detector = OnnxDetector(detector, of_detector).eval()
    if isinstance(pose, TopDownPose):
        holder = pose.network if isinstance(pose.network, FlipTest) else pose
        if not isinstance(holder.network, OnnxFile | OnnxPose):
            holder.network = OnnxPose(holder.network, of_pose).eval()
        pose.crop, pose.wide_crop = (
            OpenCVBoxCrop((crop.height, crop.width), crop.padding) for crop in (pose.crop, pose.wide_crop)
        )
    return detector, pose
