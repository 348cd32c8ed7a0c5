"""Continuous wave: the first sample of each pulse of the frequency-modulated echo, and its definition."""

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S, RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.synthesis.continuous_wave import ContinuousWaveEcho
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.radar.scenes import SceneCase, joint_rcs, swinging, tensors

# A sweep so narrow that its residual video phase, half of slope times delay squared, is below 1e-11 cycles.
RADAR = RadarConfig(carrier_hz=24e9, bandwidth_hz=1.0, chirp_s=40e-6, sample_rate_hz=1e6, prf_hz=2000.0)


def make(antenna_gain_dbi=RADAR.antenna_gain_dbi):
    return ContinuousWaveEcho(RADAR.carrier_hz, RADAR.tx_m, RADAR.rx_m, antenna_gain_dbi)


class TestContinuousWaveEcho(SceneCase):
    scatterers = 4

    def make(self):
        return ContinuousWaveEcho(2e9, (-0.1, 0.0, 1.5), (0.1, 0.0, 1.5), 10.0)


def test_equals_the_first_sample_of_the_modulated_echo():
    p, rcs = tensors(swinging(300, 14, RADAR.prf_hz), joint_rcs())
    p[7, 3] = torch.tensor(RADAR.tx_m)  # legs are a wavelength over 4 pi long at least
    expected = EchoSynthesizer(RADAR).double()(p, rcs)[:, 0]
    torch.testing.assert_close(make().double()(p, rcs), expected, rtol=1e-9, atol=1e-12)


def test_equals_the_radar_equation():
    p, rcs = np.array([[[0.3, 2.5, 1.1]]]), 0.7
    wavelength = SPEED_OF_LIGHT_M_S / RADAR.carrier_hz
    r1, r2 = (np.linalg.norm(p[0, 0] - np.array(a)) for a in (RADAR.tx_m, RADAR.rx_m))
    gain = 10 ** (RADAR.antenna_gain_dbi / 10)
    amplitude = np.sqrt(gain**2 * wavelength**2 * rcs / ((4 * np.pi) ** 3 * r1**2 * r2**2))
    expected = amplitude * np.exp(2j * np.pi * (r1 + r2) / wavelength)
    echo = make().double()(torch.from_numpy(p), torch.tensor([rcs], dtype=torch.float64))
    np.testing.assert_allclose(echo.numpy(), [expected], rtol=1e-9)


def test_the_gradient_by_a_cross_section_of_zero_is_zero():
    p, rcs = tensors(swinging(5, 2, RADAR.prf_hz), np.zeros(2))
    rcs.requires_grad_()
    torch.view_as_real(make().double()(p, rcs)).sum().backward()
    assert rcs.grad.tolist() == [0.0, 0.0]


def test_the_phase_of_an_approaching_target_decreases():
    y = 3.0 - 1.5 * torch.arange(100, dtype=torch.float64) / RADAR.prf_hz
    p = torch.stack([0 * y, y, 1.5 + 0 * y], dim=-1)[:, None]
    phase = np.unwrap(np.angle(make().double()(p, torch.ones(1, dtype=torch.float64)).numpy()))
    hz = np.diff(phase).mean() * RADAR.prf_hz / (2 * np.pi)
    # Antennas 0.2 m apart see a little less than the full speed.
    assert hz == pytest.approx(-2 * 1.5 * RADAR.carrier_hz / SPEED_OF_LIGHT_M_S, rel=2e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, (0, 0, 1), (0, 0, 1)), "carrier_hz"),
        ((1e9, (0, 0), (0, 0, 1)), "tx_m"),
        ((1e9, (0, 0, 1), (0, 0, 1), float("nan")), "antenna_gain_dbi: got nan"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(TensorsimError, match=message):
        ContinuousWaveEcho(*arguments)
