"""Scatterers -> echo -> maps."""

from tensorsim.radar.analysis import metrics
from tensorsim.radar.analysis.gait import BulkDopplerCompensation, CadenceVelocityDiagram
from tensorsim.radar.analysis.gait_parameters import GaitEstimator, GaitParameters
from tensorsim.radar.presets import (
    PRESETS,
    RadarScene,
    load_radar_yaml,
    load_scene_yaml,
    radar_scene,
    save_radar_yaml,
)
from tensorsim.radar.processing.array import AngleMapper, AngleMaps, align_transmitters
from tensorsim.radar.processing.cfar import CfarDetector
from tensorsim.radar.processing.doppler import DopplerTimeMap, RangeDopplerVideo
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.point_cloud import PointCloud, Points
from tensorsim.radar.processing.range_profile import FollowingGate, RangeProfile
from tensorsim.radar.processing.ridges import PathRidgeExtractor, RidgeExtractor
from tensorsim.radar.processing.synchrosqueeze import SynchrosqueezedMap
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.antenna import CosineAntenna, TabulatedAntenna
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.continuous_wave import ContinuousWaveEcho
from tensorsim.radar.synthesis.echo import EchoSynthesizer, SideChannels
from tensorsim.radar.synthesis.noise import ReceiverNoise

__all__ = [
    "PRESETS",
    "AngleMapper",
    "AngleMaps",
    "BulkDopplerCompensation",
    "CadenceVelocityDiagram",
    "CfarDetector",
    "ContinuousWaveEcho",
    "CosineAntenna",
    "DopplerTimeMap",
    "EchoSynthesizer",
    "FollowingGate",
    "GaitEstimator",
    "GaitParameters",
    "MovingTargetIndicator",
    "PathRidgeExtractor",
    "PointCloud",
    "Points",
    "RadarScene",
    "RadarSimulator",
    "RangeBinSynthesizer",
    "RangeDopplerVideo",
    "RangeProfile",
    "ReceiverNoise",
    "RidgeExtractor",
    "SideChannels",
    "SynchrosqueezedMap",
    "TabulatedAntenna",
    "align_transmitters",
    "load_radar_yaml",
    "load_scene_yaml",
    "metrics",
    "radar_scene",
    "save_radar_yaml",
]
