"""Activity recognition: SPNet and SPGNet, and the conversion of radar maps to their input images."""

from tensorsim.recognition.labels import LabelSet
from tensorsim.recognition.map_image import MapToImage, ridge_map
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.recognition.spnet import SPNet

__all__ = ["ActivityRecognizer", "LabelSet", "MapToImage", "SPGNet", "SPNet", "ridge_map"]
