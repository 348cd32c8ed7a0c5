"""Joints at video rate -> scatterers at pulse rate."""

from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.savgol import SavitzkyGolay
from tensorsim.motion.scatterers import JointScatterers

__all__ = ["JointScatterers", "PoseResampler", "SavitzkyGolay"]
