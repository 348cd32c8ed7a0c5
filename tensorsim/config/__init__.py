"""Frozen configurations: one dataclass per concern, joined in :class:`SimulationConfig`.

Defaults follow the control panel of the original application (RadHARSimulator V2) except: the tracker's measurement
noise is 0.0004 (panel: 0.01), there is no Savitzky-Golay filter (panel: 0.25 s), no initial distances are assumed
(panel: 4.00 and 0.50 m), a network lifts people (paper: the nearest pose; the nearest lifter here averages 128), and
the wall touches the antenna plane. Formulas of the paper that are physically incorrect are replaced by correct ones;
:meth:`SimulationConfig.paper` follows the paper literally.
"""

from tensorsim.config.camera import CameraConfig
from tensorsim.config.checks import Vector
from tensorsim.config.names import ACTIVITIES, COCO_KEYPOINTS, JOINT_RCS_M2, JOINTS
from tensorsim.config.people import PoseConfig, SmoothingConfig, TrackerConfig
from tensorsim.config.processing import ProcessingConfig
from tensorsim.config.radar import SPEED_OF_LIGHT_M_S, RadarConfig
from tensorsim.config.receiver import ClutterConfig, InterferenceConfig, ReceiverConfig
from tensorsim.config.scene import SceneConfig
from tensorsim.config.simulation import SimulationConfig
from tensorsim.config.surroundings import FloorConfig, WallConfig

__all__ = [
    "ACTIVITIES",
    "COCO_KEYPOINTS",
    "JOINTS",
    "JOINT_RCS_M2",
    "SPEED_OF_LIGHT_M_S",
    "CameraConfig",
    "ClutterConfig",
    "FloorConfig",
    "InterferenceConfig",
    "PoseConfig",
    "ProcessingConfig",
    "RadarConfig",
    "ReceiverConfig",
    "SceneConfig",
    "SimulationConfig",
    "SmoothingConfig",
    "TrackerConfig",
    "Vector",
    "WallConfig",
]
