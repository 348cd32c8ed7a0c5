"""Scatterers -> echo -> maps."""

from tensorsim.radar import metrics
from tensorsim.radar.antenna import CosineAntenna, TabulatedAntenna
from tensorsim.radar.array import AngleMapper, AngleMaps, align_transmitters
from tensorsim.radar.closed_form import RangeBinSynthesizer
from tensorsim.radar.doppler import DopplerTimeMap, RangeDopplerVideo
from tensorsim.radar.echo import EchoSynthesizer, SideChannels
from tensorsim.radar.gait import BulkDopplerCompensation, CadenceVelocityDiagram
from tensorsim.radar.gait_parameters import GaitEstimator, GaitParameters
from tensorsim.radar.mti import MovingTargetIndicator
from tensorsim.radar.noise import ReceiverNoise
from tensorsim.radar.presets import (
    PRESETS,
    RadarScene,
    load_radar_yaml,
    load_scene_yaml,
    radar_scene,
    save_radar_yaml,
)
from tensorsim.radar.range_profile import FollowingGate, RangeProfile
from tensorsim.radar.ridges import PathRidgeExtractor, RidgeExtractor
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synchrosqueeze import SynchrosqueezedMap

__all__ = [
    "PRESETS",
    "AngleMapper",
    "AngleMaps",
    "BulkDopplerCompensation",
    "CadenceVelocityDiagram",
    "CosineAntenna",
    "DopplerTimeMap",
    "EchoSynthesizer",
    "FollowingGate",
    "GaitEstimator",
    "GaitParameters",
    "MovingTargetIndicator",
    "PathRidgeExtractor",
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
