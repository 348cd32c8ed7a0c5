"""Video in, synthetic people, motion files, results out."""

from tensorsim.data.coco import Keypoints2D, load_coco_keypoints
from tensorsim.data.motion_files import load_motion, place
from tensorsim.data.skeletons import Motion
from tensorsim.data.video import VideoReader, write_video
from tensorsim.geometry.framing import camera_on
from tensorsim.render.renderer import PersonRenderer, RenderedVideo

__all__ = [
    "Keypoints2D",
    "Motion",
    "PersonRenderer",
    "RenderedVideo",
    "VideoReader",
    "camera_on",
    "load_coco_keypoints",
    "load_motion",
    "place",
    "write_video",
]
