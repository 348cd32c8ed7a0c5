"""The expected picture: near that of the simulator for a moving body, and of one that is known in closed form."""

from dataclasses import replace

import pytest
import torch

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.pipeline import PoseToDoppler
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.recognition.map_image import MapToImage, scaled
from tensorsim.training.expected_map import ExpectedMap, noise_rows

FREE = PRESETS["free-space"]
RATE = 256.0


def decibels(power: torch.Tensor) -> torch.Tensor:
    return 40 * scaled(power[None], "db", 40.0)[0]


@pytest.mark.parametrize("snr_db", [None, 20.0])
def test_a_walk_looks_as_the_simulator_has_it(snr_db):
    motion = ActivityGenerator().generate("walking", batch=1, seed=1, duration_s=1.0, rate_hz=30.0)
    torch.manual_seed(0)
    stage = PoseToDoppler(RadarSimulator(replace(FREE, snr_db=snr_db)))
    simulated = stage.doppler_time(motion.joints[None], motion.valid[None], 30.0)[0]
    picture = decibels(MapToImage.doppler(FREE.radar, size=32).average(simulated.double().square()))
    joints = PoseResampler(RATE)(motion.joints, 30.0)
    points, rcs = JointScatterers()(joints, torch.ones(joints.shape[:2]))
    expected = decibels(ExpectedMap(FREE.radar, RATE, 32)(points, rcs, snr_db))
    assert float((picture - expected).abs().mean()) < 1.0
    # A picture of another time is not.
    assert float((picture - expected.flip(1)).abs().mean()) > 2.0


def test_one_point_at_constant_speed_is_one_row():
    radar = FREE.radar
    time = torch.arange(256, dtype=torch.float64) / RATE
    points = torch.zeros(256, 1, 3, dtype=torch.float64)
    points[:, 0, 1], points[:, 0, 2] = 4.0 - 1.5 * time, 1.5  # approaching at the height of the antennas
    picture = ExpectedMap(radar, RATE, 64)(points, torch.ones(256, 1), None)
    row = int((1.5 + 3.8) / (7.6 / 64))
    assert bool((picture.argmax(0) == row).all())
    assert float(picture[row].sum() / picture.sum()) > 0.98
    # Received power falls with the fourth power of range, here from 4 m to 2.5 m.
    assert float(picture[row, -1] / picture[row, 0]) == pytest.approx((3.92 / 2.58) ** 4, rel=0.05)


def test_nothing_is_seen_beyond_the_last_range_bin():
    points = torch.zeros(256, 1, 3, dtype=torch.float64)
    points[:, 0, 1] = 8.0 + torch.arange(256) / RATE
    assert float(ExpectedMap(FREE.radar, RATE, 32)(points, torch.ones(256, 1), None).max()) == 0.0


@pytest.mark.parametrize("scene", ["free-space", "through-wall"])
def test_rows_of_noise_are_those_of_the_indicator(scene):
    radar = PRESETS[scene].radar
    torch.manual_seed(0)
    pulses = 1200 if scene == "free-space" else 400
    profiles = torch.randn(8, pulses, 40, dtype=torch.complex64)
    image = MapToImage.doppler(radar, size=32)
    power = DopplerTimeMap(radar, overlap=0.5)(MovingTargetIndicator()(profiles)).double().square().mean(0)
    rows = image.rows(len(power)) @ power.mean(1)
    expected = noise_rows(radar, image)
    torch.testing.assert_close(rows / rows.sum(), expected / expected.sum(), rtol=0.08, atol=2e-5)


def test_refuses_arrays_and_clips_shorter_than_a_window():
    with pytest.raises(TensorsimError, match="several antennas"):
        ExpectedMap(RadarConfig(rx_m=((0.0, 0.0, 1.0), (0.01, 0.0, 1.0))), RATE, 32)
    with pytest.raises(TensorsimError, match="got 20 instants, expected more than the 26"):
        ExpectedMap(FREE.radar, RATE, 32)(torch.rand(20, 1, 3) + 1, torch.ones(20, 1), None)
