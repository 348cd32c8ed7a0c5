"""Scatterers -> echo -> maps."""

from tensorsim.radar.doppler import DopplerTimeMap
from tensorsim.radar.echo import EchoSynthesizer
from tensorsim.radar.mti import MovingTargetIndicator
from tensorsim.radar.noise import ReceiverNoise
from tensorsim.radar.range_profile import RangeProfile
from tensorsim.radar.ridges import RidgeExtractor
from tensorsim.radar.simulator import RadarSimulator

__all__ = [
    "DopplerTimeMap",
    "EchoSynthesizer",
    "MovingTargetIndicator",
    "RadarSimulator",
    "RangeProfile",
    "ReceiverNoise",
    "RidgeExtractor",
]
