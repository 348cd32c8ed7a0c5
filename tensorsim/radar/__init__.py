"""Radar: echo synthesis from moving scatterers, signal processing to maps, and analysis of the maps."""

from tensorsim.config import SceneConfig as RadarScene
from tensorsim.radar.analysis import metrics
from tensorsim.radar.analysis.gait import BulkDopplerCompensation, CadenceVelocityDiagram
from tensorsim.radar.analysis.gait_parameters import GaitEstimator, GaitParameters
from tensorsim.radar.presets import (
    PRESETS,
    load_radar_yaml,
    load_scene_yaml,
    radar_scene,
    save_radar_yaml,
)
from tensorsim.radar.processing.ambiguity import gate_around
from tensorsim.radar.processing.array import AngleMapper, AngleMaps, align_transmitters
from tensorsim.radar.processing.cfar import CfarDetector
from tensorsim.radar.processing.doppler import DopplerTimeMap, RangeDopplerVideo, doppler_time_map
from tensorsim.radar.processing.mti import MovingTargetIndicator, two_pulse_canceller
from tensorsim.radar.processing.point_cloud import PointCloud, Points
from tensorsim.radar.processing.range_doppler import PointDetector, RangeDopplerAngle, RangeDopplerCube
from tensorsim.radar.processing.range_profile import FollowingGate, RangeProfile, range_profile
from tensorsim.radar.processing.ridges import PathRidgeExtractor, RidgeExtractor
from tensorsim.radar.processing.synchrosqueeze import SynchrosqueezedMap
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.antenna import CosineAntenna, TabulatedAntenna
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.clutter import RoomClutter
from tensorsim.radar.synthesis.continuous_wave import ContinuousWaveEcho
from tensorsim.radar.synthesis.dechirp import intermediate_frequency
from tensorsim.radar.synthesis.echo import EchoSynthesizer, SideChannels
from tensorsim.radar.synthesis.interference import Interference
from tensorsim.radar.synthesis.legs import mirror_delays
from tensorsim.radar.synthesis.noise import ReceiverNoise
from tensorsim.radar.synthesis.paths import radar_equation_amplitude
from tensorsim.radar.synthesis.phase_noise import PhaseNoise
from tensorsim.radar.synthesis.receiver import Converter, DcOffset, QuadratureImbalance, RealReceiver
from tensorsim.radar.synthesis.wall import two_way_wall_transmission

__all__ = [
    "PRESETS",
    "AngleMapper",
    "AngleMaps",
    "BulkDopplerCompensation",
    "CadenceVelocityDiagram",
    "CfarDetector",
    "ContinuousWaveEcho",
    "Converter",
    "CosineAntenna",
    "DcOffset",
    "DopplerTimeMap",
    "EchoSynthesizer",
    "FollowingGate",
    "GaitEstimator",
    "GaitParameters",
    "Interference",
    "MovingTargetIndicator",
    "PathRidgeExtractor",
    "PhaseNoise",
    "PointCloud",
    "PointDetector",
    "Points",
    "QuadratureImbalance",
    "RadarScene",
    "RadarSimulator",
    "RangeBinSynthesizer",
    "RangeDopplerAngle",
    "RangeDopplerCube",
    "RangeDopplerVideo",
    "RangeProfile",
    "RealReceiver",
    "ReceiverNoise",
    "RidgeExtractor",
    "RoomClutter",
    "SideChannels",
    "SynchrosqueezedMap",
    "TabulatedAntenna",
    "align_transmitters",
    "doppler_time_map",
    "gate_around",
    "intermediate_frequency",
    "load_radar_yaml",
    "load_scene_yaml",
    "metrics",
    "mirror_delays",
    "radar_equation_amplitude",
    "radar_scene",
    "range_profile",
    "save_radar_yaml",
    "two_pulse_canceller",
    "two_way_wall_transmission",
]
