"""Reading video, keypoints and motion capture; writing video and sound; rendered people; labelled data sets."""

from tensorsim.data.blazepose import load_keypoints
from tensorsim.data.clip import Clip, read_video
from tensorsim.data.coco import Keypoints2D, load_coco_keypoints
from tensorsim.data.motion_files import load_motion, place
from tensorsim.data.sets.build import build_dataset
from tensorsim.data.sets.outputs import OutputConfig
from tensorsim.data.sets.reading import MapDataset, MapStream, SimulatedMaps, collate_maps
from tensorsim.data.sets.recipe import DatasetRecipe, RadarView, SourceConfig, SplitConfig, StorageConfig
from tensorsim.data.sets.transforms import AddNoise, RandomShift, SignFold, SpecAugment
from tensorsim.data.sets.variations import VariationConfig
from tensorsim.data.skeletons import Motion
from tensorsim.data.sound import Sound, doppler_sound, slow_time_signal, write_sound
from tensorsim.data.video import VideoReader
from tensorsim.data.video_writer import VideoWriter, write_video
from tensorsim.geometry.framing import camera_on
from tensorsim.render.renderer import PersonRenderer, RenderedVideo

__all__ = [
    "AddNoise",
    "Clip",
    "DatasetRecipe",
    "Keypoints2D",
    "MapDataset",
    "MapStream",
    "Motion",
    "OutputConfig",
    "PersonRenderer",
    "RadarView",
    "RandomShift",
    "RenderedVideo",
    "SignFold",
    "SimulatedMaps",
    "Sound",
    "SourceConfig",
    "SpecAugment",
    "SplitConfig",
    "StorageConfig",
    "VariationConfig",
    "VideoReader",
    "VideoWriter",
    "build_dataset",
    "camera_on",
    "collate_maps",
    "doppler_sound",
    "load_coco_keypoints",
    "load_keypoints",
    "load_motion",
    "place",
    "read_video",
    "slow_time_signal",
    "write_sound",
    "write_video",
]
