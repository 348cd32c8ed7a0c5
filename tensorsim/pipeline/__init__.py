"""The pipeline that joins the stages: video -> pose -> motion -> echo -> maps -> label.

Each class is one ``nn.Module`` made of stages; every stage can be replaced by another with the same interface.
``forward`` works on whole clips in memory and scripts; the methods it is made of are public so that a long film can be
streamed through them piece by piece (see ``tensorsim.streaming``).
"""

from tensorsim.pipeline.graph import VideoToActivity, VideoToDoppler, warn_of_empty_clips
from tensorsim.pipeline.maps import PoseToDoppler
from tensorsim.pipeline.networks import pretrained_pose
from tensorsim.pipeline.pose import VideoToPose

__all__ = [
    "PoseToDoppler",
    "VideoToActivity",
    "VideoToDoppler",
    "VideoToPose",
    "pretrained_pose",
    "warn_of_empty_clips",
]
