"""Activity recognition: SPNet and SPGNet, and the conversion of radar maps to their input images."""

from tensorsim.recognition.labels import LabelSet
from tensorsim.recognition.map_image import MapToImage, ridge_map
from tensorsim.recognition.picture_net import PictureNet
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.recognition.spnet import SPNet
from tensorsim.recognition.timeline import Window, label_windows

__all__ = [
    "ActivityRecognizer",
    "LabelSet",
    "MapToImage",
    "PictureNet",
    "SPGNet",
    "SPNet",
    "Window",
    "label_windows",
    "ridge_map",
]
