"""The detector and the pose network by path or name, as used by several commands."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tensorsim.commands.arguments import Option
from tensorsim.exceptions import TensorsimError

Engine = Literal["auto", "onnxruntime", "openvino", "int8", "torch"]


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """Which networks find people in films."""

    detector: Option[str] = None
    """Person detector: RTMDet as .pth, .safetensors or .onnx, or a name from `tensorsim models list`. Default:
    $TENSORSIM_DETECTOR if set, else the shipped one."""
    pose: Option[str] = None
    """Pose network with COCO-17 heatmaps: HRNet as .pth, .safetensors or a name from `tensorsim models list`, or any
    such network as .onnx. Default: $TENSORSIM_POSE if set, else the shipped one."""
    flip_test: Option[bool] = None
    """Also run the pose network on the mirror image of each person: more accurate, at twice the cost. Default: on."""
    engine: Engine = "auto"
    """What runs the networks on the CPU. ONNX Runtime takes half the time of torch, after exporting the networks once
    to the user's cache. Faster but less exact: "openvino" (pip install openvino) runs the pose network in bfloat16 on
    CPUs that support it, "int8" in 8-bit integers. auto: OpenVINO if it is installed and the CPU supports bfloat16,
    else ONNX Runtime. A GPU always uses torch."""


def default_networks(detector: str | None, pose: str | None) -> tuple[Path, Path]:
    """Files of the detector and of the pose network.

    Each is the one given (a path, or a name of ``tensorsim models list``), else that of the environment variable
    ``TENSORSIM_DETECTOR`` or ``TENSORSIM_POSE``, else the shipped one.

    Raises:
        TensorsimError: none of these exists.
    """
    return _located("detector", detector, "RTMDet", "AcfDetector"), _located("pose", pose, "HRNet", "CPM")


def _located(role: str, source: str | None, *networks: str) -> Path:
    from tensorsim.registry import locate

    variable = f"TENSORSIM_{role.upper()}"
    try:
        path = locate(source or os.environ.get(variable) or None, *networks)
    except TensorsimError as error:
        raise TensorsimError(f"--{role}: {error} (here, or in ${variable})") from None
    if not path.is_file():
        raise TensorsimError(f"--{role}: {path} is not a file")
    return path


def load_networks(detector: Path, pose: Path, flip_test: bool, engine: str = "torch") -> tuple[Any, Any]:
    """The two modules from these files, run by this engine; see :func:`tensorsim.pipeline.pretrained_pose`.

    Raises:
        TensorsimError: files are damaged, unsafe or of another network.
    """
    from tensorsim.pipeline.networks import pretrained_detector, pretrained_pose
    from tensorsim.vision.engines import run_by

    return run_by(engine, pretrained_detector(detector), pretrained_pose(pose, flip_test))
