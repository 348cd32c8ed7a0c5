"""The pipeline that joins the stages: video -> pose -> motion -> echo -> maps -> label.

Each class is one ``nn.Module`` made of stages; every stage can be replaced by another with the same interface.
``forward`` processes whole clips in memory and can be scripted; the methods that it calls are public so that a long
video can be streamed through them piece by piece (see ``tensorsim.streaming``).
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
