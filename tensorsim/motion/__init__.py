"""Joints at video rate -> scatterers at pulse rate."""

from tensorsim.body.gait import boulic_gait
from tensorsim.body.skeleton import body_to_coco
from tensorsim.motion.activities import ActivityGenerator, GeneratedMotion, activity_index
from tensorsim.motion.body13 import Body13Scatterers
from tensorsim.motion.body_scatterers import BodyScatterers
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.people import People, PeopleConfig
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.savgol import SavitzkyGolay
from tensorsim.motion.scatterers import JointScatterers, visibility_fade
from tensorsim.motion.shadowing import Shadowing
from tensorsim.motion.sway import PosturalSway
from tensorsim.motion.vital_signs import VitalSigns

__all__ = [
    "ActivityGenerator",
    "Body13Scatterers",
    "BodyScatterers",
    "GeneratedMotion",
    "JointScatterers",
    "LimbScatterers",
    "People",
    "PeopleConfig",
    "PoseResampler",
    "PosturalSway",
    "SavitzkyGolay",
    "Shadowing",
    "VitalSigns",
    "activity_index",
    "body_to_coco",
    "boulic_gait",
    "visibility_fade",
]
