"""tensorsim: what a radar would have seen of the people in a video."""

from tensorsim.config import ACTIVITIES, COCO_KEYPOINTS, JOINT_RCS_M2, JOINTS, CameraConfig, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, TensorsimWarning

__version__ = "0.1.0"
