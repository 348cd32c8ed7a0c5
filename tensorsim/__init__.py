"""tensorsim: what a radar would have seen of the people in a video.

One graph of ``nn.Module`` stages on batched tensors: video -> people -> 2D joints -> 3D joints -> smooth motion ->
FMCW echo -> range-time -> Doppler-time -> ridges -> activity label. ``VideoToDoppler`` covers the graph up to the maps,
``VideoToActivity`` up to the label; ``vision``, ``motion``, ``radar``, ``enhance`` and ``recognition`` hold the stages.
``data`` reads and writes films, motion and data sets; ``export`` writes TorchScript and ONNX files.

Equations of the paper, RadHARSimulator V2 (arXiv 2511.09022), and where to find them (see ``tensorsim.paper``):
"""

# isort: off
from tensorsim import process  # first: the command sets up its threads before torch is loaded

# isort: on
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from tensorsim.paper import table as _paper_table

if TYPE_CHECKING:
    from tensorsim import data, enhance, export, motion, radar, recognition, vision
    from tensorsim.config import (
        ACTIVITIES,
        COCO_KEYPOINTS,
        JOINT_RCS_M2,
        JOINTS,
        CameraConfig,
        ClutterConfig,
        FloorConfig,
        InterferenceConfig,
        PoseConfig,
        ProcessingConfig,
        RadarConfig,
        ReceiverConfig,
        SceneConfig,
        SimulationConfig,
        SmoothingConfig,
        TrackerConfig,
        WallConfig,
    )
    from tensorsim.exceptions import TensorsimError, TensorsimWarning
    from tensorsim.live import LiveFrame, LiveSimulator
    from tensorsim.pipeline import PoseToDoppler, VideoToActivity, VideoToDoppler, VideoToPose
    from tensorsim.types import Detections, Pose, RadarMaps, Recognition, Simulation, Tracks

__version__ = "0.1.0"
__doc__ = f"{__doc__}{_paper_table()}\n"

__all__ = [
    "ACTIVITIES",
    "COCO_KEYPOINTS",
    "JOINTS",
    "JOINT_RCS_M2",
    "CameraConfig",
    "ClutterConfig",
    "Detections",
    "FloorConfig",
    "InterferenceConfig",
    "LiveFrame",
    "LiveSimulator",
    "Pose",
    "PoseConfig",
    "PoseToDoppler",
    "ProcessingConfig",
    "RadarConfig",
    "RadarMaps",
    "ReceiverConfig",
    "Recognition",
    "SceneConfig",
    "Simulation",
    "SimulationConfig",
    "SmoothingConfig",
    "TensorsimError",
    "TensorsimWarning",
    "TrackerConfig",
    "Tracks",
    "VideoToActivity",
    "VideoToDoppler",
    "VideoToPose",
    "WallConfig",
    "data",
    "enhance",
    "export",
    "motion",
    "radar",
    "recognition",
    "vision",
]

#: Modules whose public names are available here as well.
_HOMES = ("exceptions", "config", "types", "pipeline", "live")

if not TYPE_CHECKING:  # type checkers take the imports above

    def __getattr__(name: str) -> Any:
        """Import a submodule or public name on first use."""
        if find_spec(f"{__name__}.{name}") is not None:
            return import_module(f"{__name__}.{name}")
        homes = (import_module(f"{__name__}.{home}") for home in _HOMES if name in __all__)
        for home in homes:
            if hasattr(home, name):
                globals()[name] = getattr(home, name)
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    # The command prints its help and option errors without spending seconds on importing torch.
    if not process.is_command():
        for _name in __all__:
            __getattr__(_name)
