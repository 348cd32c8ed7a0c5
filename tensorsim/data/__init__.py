"""Films and motion files in, rendered people, films and sound out."""

from tensorsim.data.clip import Clip, read_video
from tensorsim.data.coco import Keypoints2D, load_coco_keypoints
from tensorsim.data.motion_files import load_motion, place
from tensorsim.data.skeletons import Motion
from tensorsim.data.sound import Sound, doppler_sound, slow_time_signal, write_sound
from tensorsim.data.video import VideoReader, VideoWriter, write_video
from tensorsim.geometry.framing import camera_on
from tensorsim.render.renderer import PersonRenderer, RenderedVideo

__all__ = [
    "Clip",
    "Keypoints2D",
    "Motion",
    "PersonRenderer",
    "RenderedVideo",
    "Sound",
    "VideoReader",
    "VideoWriter",
    "camera_on",
    "doppler_sound",
    "load_coco_keypoints",
    "load_motion",
    "place",
    "read_video",
    "slow_time_signal",
    "write_sound",
    "write_video",
]
