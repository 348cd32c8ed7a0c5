"""What runs the networks on a processor: ONNX Runtime, torch in bfloat16, or torch as it is."""

import torch
from torch import nn

from tensorsim.device import multiplies_bfloat16
from tensorsim.errors import TensorsimError
from tensorsim.vision.bfloat16 import Bfloat16Pose
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.onnx_engine import OnnxDetector, OnnxPose
from tensorsim.vision.pose2d.onnx_file import OnnxFile
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose

ENGINES = ("auto", "bfloat16", "onnxruntime", "int8", "torch")


def run_by(engine: str, detector: nn.Module, pose: nn.Module) -> tuple[nn.Module, nn.Module]:
    """The same two stages with their networks run by an engine, as far as they are of this package.

    Args:
        engine: ``"torch"``; ``"onnxruntime"``; ``"int8"`` or ``"bfloat16"``, which are ONNX Runtime with the pose
            network in 8-bit integers or in bfloat16 (the detector is not: its boxes would move); ``"auto"``, which is
            ``"bfloat16"`` where the processor has instructions for it, elsewhere ``"onnxruntime"``.
        detector, pose: the stages; networks inside of ``pose`` are replaced.

    Raises:
        TensorsimError: no such engine.
    """
    if engine not in ENGINES:
        raise TensorsimError(f"engine: got {engine!r}, expected one of {', '.join(ENGINES)}")
    if engine == "auto":
        engine = "bfloat16" if multiplies_bfloat16(torch.device("cpu")) else "onnxruntime"
    if engine == "torch":
        return detector, pose
    if isinstance(detector, RTMDet):
        detector = OnnxDetector(detector).eval()
    if isinstance(pose, TopDownPose):
        holder = pose.network if isinstance(pose.network, FlipTest) else pose
        network = holder.network
        if not isinstance(network, OnnxFile | OnnxPose | Bfloat16Pose):
            small = (
                Bfloat16Pose(network) if engine == "bfloat16" else OnnxPose(network, int8=engine == "int8")
            )
            holder.network = small.eval()
    return detector, pose
