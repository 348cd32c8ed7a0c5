"""Joints at video rate -> scatterers at pulse rate."""

from tensorsim.motion.body13 import Body13Scatterers
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.savgol import SavitzkyGolay
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.motion.shadowing import Shadowing

__all__ = [
    "Body13Scatterers",
    "JointScatterers",
    "LimbScatterers",
    "PoseResampler",
    "SavitzkyGolay",
    "Shadowing",
]
