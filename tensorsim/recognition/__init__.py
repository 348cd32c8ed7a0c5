"""Maps -> label: SPNet, its light sibling, and the picture of a map that they see."""

from tensorsim.recognition.map_image import MapToImage, ridge_map
from tensorsim.recognition.picture_net import PictureNet
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.recognition.spnet import SPNet

__all__ = ["ActivityRecognizer", "MapToImage", "PictureNet", "SPGNet", "SPNet", "ridge_map"]
