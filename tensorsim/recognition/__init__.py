"""Activity recognition: SPNet, SPGNet and their rivals, and the conversion of radar maps to their input images."""

from tensorsim.recognition.adfe_net import ADFENet, DopplerEnhancement
from tensorsim.recognition.ccln import CCLN
from tensorsim.recognition.diat_radharnet import DIATRadHARNet
from tensorsim.recognition.fourier_net import FourierNet, GlobalFilterNet
from tensorsim.recognition.labels import LabelSet
from tensorsim.recognition.map_image import MapToImage, ridge_map
from tensorsim.recognition.mc_gclu import MCGCLU
from tensorsim.recognition.mrw_cn import MRWCN
from tensorsim.recognition.networks import CLASSIFIERS
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.recognition.spgnet import SPGNet
from tensorsim.recognition.spnet import SPNet
from tensorsim.recognition.spnet_dense import SPNetDense
from tensorsim.recognition.timeline import Window, label_windows

__all__ = [
    "CCLN",
    "CLASSIFIERS",
    "MCGCLU",
    "MRWCN",
    "ADFENet",
    "ActivityRecognizer",
    "DIATRadHARNet",
    "DopplerEnhancement",
    "FourierNet",
    "GlobalFilterNet",
    "LabelSet",
    "MapToImage",
    "SPGNet",
    "SPNet",
    "SPNetDense",
    "Window",
    "label_windows",
    "ridge_map",
]
