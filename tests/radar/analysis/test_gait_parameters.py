import math

import numpy as np
import pytest
import torch

from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.people import nominal_people
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.radar.analysis.gait_parameters import GaitEstimator
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.noise import ReceiverNoise
from tests.stage import StageTester

SPEED = torch.linspace(-9, 9, 181).double()
RATE = 40.0


def gait(torso=1.2, limb=3.0, steps=1.8, seconds=4.0, noise=0.0, seed=0, sharpness=1):
    """A map (F, K) by hand: a line at the torso, and a leg that swings up to ``limb`` once a step."""
    t = np.arange(round(seconds * RATE)) / RATE
    swing = torso + (limb - torso) * np.sin(np.pi * steps * t) ** (2 * sharpness)
    speed = SPEED.numpy()[:, None]
    power = np.exp(-(((speed - torso) / 0.1) ** 2))
    for part in np.linspace(0, 1, 15)[1:]:
        power = power + 0.005 * np.exp(-(((speed - torso - part * (swing - torso)) / 0.1) ** 2))
    power = power + noise * np.random.default_rng(seed).exponential(size=power.shape)
    return torch.from_numpy(np.sqrt(power))


class TestGaitEstimator(StageTester):
    gradient_arguments = ()  # medians, percentiles and the largest bin

    def make(self):
        return GaitEstimator(SPEED, RATE)

    def inputs(self, batch, dtype):
        count = math.prod(batch)
        maps = [gait(1.0 + 0.1 * i, 2.5 + 0.2 * i, 1.5 + 0.2 * i, 3.0) for i in range(count)]
        return (torch.stack(maps).view(*batch, *maps[0].shape).to(dtype),)

    def bad_inputs(self):
        return [
            ((torch.ones(181),), r"\(\.\.\., 181 Doppler bins"),
            ((torch.ones(100, 80),), r"\[100, 80\]"),
            ((torch.ones(181, 20),), "at least 40 frames"),
            ((torch.ones(181, 80, dtype=torch.int64),), "floating"),
            ((torch.ones(0, 181, 80),), "doppler_time: got an empty tensor"),
            ((torch.full((181, 80), math.nan),), "doppler_time: got NaN"),
        ]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("torso", "limb", "steps"), [(1.2, 3.0, 1.8), (0.8, 2.2, 1.4), (3.2, 6.8, 2.8)])
def test_reads_what_was_drawn(torso, limb, steps, sign):
    drawn = gait(torso, limb, steps)
    found = GaitEstimator(sign * SPEED, RATE)(drawn)
    assert float(found.torso_m_s) == pytest.approx(torso, abs=0.15)
    assert float(found.step_hz) == pytest.approx(steps, rel=0.03)
    # 95 % of the amplitude lie below a limb that is spread from the torso to its tip.
    assert torso + 0.6 * (limb - torso) < float(found.limb_m_s) < limb + 0.1


def test_noise_floor_and_fading_do_not_show():
    clean = GaitEstimator(SPEED, RATE)(gait())
    faded = gait(noise=1e-4) * torch.logspace(0, -1, 160)
    noisy = GaitEstimator(SPEED, RATE)(faded)
    assert float(noisy.torso_m_s) == pytest.approx(float(clean.torso_m_s), abs=0.1)
    assert float(noisy.limb_m_s) == pytest.approx(float(clean.limb_m_s), abs=0.3)
    assert float(noisy.step_hz) == pytest.approx(1.8, rel=0.05)


def test_a_second_bump_is_no_second_step():
    power, half = gait(steps=1.7, sharpness=6).square(), round(RATE / 1.7 / 2)
    double = power + 0.6 * power.roll(half, -1)  # a weaker bump between two steps
    assert float(GaitEstimator(SPEED, RATE)(double.sqrt()).step_hz) == pytest.approx(1.7, rel=0.05)


@pytest.mark.parametrize("speed_m_s", [0.8, 1.1, 1.4])
@pytest.mark.parametrize("limbs", [False, True])
def test_steps_of_generated_walks(speed_m_s, limbs):
    """Bodies of points and of ellipsoids: knee and ankle of one swing do not pass for two steps."""
    radar = PRESETS["infineon-bgt24mtr12"].radar
    walk = ActivityGenerator().generate(
        "walking", people=nominal_people(1, speed_m_s=speed_m_s), rate_hz=radar.prf_hz
    )
    scatterers = LimbScatterers(radar.tx_m, radar.rx_m) if limbs else JointScatterers()
    scene = scatterers(walk.joints, torch.ones(walk.joints.shape[:2]).double())
    doppler = DopplerTimeMap(radar, window_s=0.15)
    maps = doppler(RangeProfile(radar)(EchoSynthesizer(radar)(*scene)))
    found = GaitEstimator(doppler.doppler_hz * radar.doppler_wavelength_m / 2, doppler.frame_rate_hz)(maps)
    ankles = [walk.joints[0, :, JOINTS.index(f"{side}_ankle"), 1].numpy() for side in ("right", "left")]
    gap = ankles[0] - ankles[1]
    strides = np.abs(np.fft.rfft((gap - gap.mean()) * np.hanning(len(gap)), 1 << 17))
    step_hz = 2 * np.fft.rfftfreq(1 << 17, 1 / radar.prf_hz)[strides.argmax()]
    assert float(found.step_hz) == pytest.approx(step_hz, rel=0.05)
    assert float(found.torso_m_s) == pytest.approx(speed_m_s, rel=0.25 if limbs else 0.45)  # bright points


@pytest.mark.parametrize(("limbs", "lost"), [(False, 0.1), (True, 0.25)])
def test_noise_adds_no_speed(limbs, lost):
    """A simulated walk at 0 to 40 dB per IF sample: torso, steps, and limbs over torso stay those without noise.

    Thin limbs are up to 25 dB below the torso, so that at 0 dB their tips are lost in the noise.
    """
    radar = PRESETS["infineon-bgt24mtr12"].radar
    walk = ActivityGenerator().generate(
        "walking", people=nominal_people(1, speed_m_s=1.1), rate_hz=radar.prf_hz
    )
    scatterers = LimbScatterers(radar.tx_m, radar.rx_m) if limbs else JointScatterers()
    beat = EchoSynthesizer(radar)(*scatterers(walk.joints, torch.ones(walk.joints.shape[:2]).double()))
    doppler, profile = DopplerTimeMap(radar, window_s=0.15), RangeProfile(radar, gate_m=(1.0, 6.0))
    estimator = GaitEstimator(doppler.doppler_hz * radar.doppler_wavelength_m / 2, doppler.frame_rate_hz)
    clean = estimator(doppler(profile(beat)))
    ratio = float(clean.limb_m_s / clean.torso_m_s)
    for snr_db in (0.0, 10.0, 40.0):
        torch.manual_seed(0)
        noisy = estimator(doppler(profile(ReceiverNoise(snr_db)(beat))))
        assert float(noisy.torso_m_s) == pytest.approx(float(clean.torso_m_s), rel=0.1)
        assert float(noisy.step_hz) == pytest.approx(float(clean.step_hz), rel=0.06)
        assert (1 - lost) * ratio < float(noisy.limb_m_s / noisy.torso_m_s) < 1.08 * ratio


def test_two_sides_are_one():
    one_sided, both = gait(), gait()
    both = (both.square() + both.flip(0).square()).sqrt()  # what a real signal gives
    a, b = GaitEstimator(SPEED, RATE)(one_sided), GaitEstimator(SPEED, RATE)(both)
    assert float(a.torso_m_s) == pytest.approx(float(b.torso_m_s), abs=0.05)
    assert float(a.step_hz) == pytest.approx(float(b.step_hz), rel=0.01)


def test_silence_has_no_gait():
    found = GaitEstimator(SPEED, RATE)(torch.zeros(181, 80))
    assert all(bool((x == 0).all()) for x in found)


def test_silence_before_and_after_a_walk_changes_nothing():
    walk = gait()
    silence = torch.zeros(181, 40, dtype=torch.float64)
    found = GaitEstimator(SPEED, RATE)(torch.cat((silence, walk, silence), -1))
    alone = GaitEstimator(SPEED, RATE)(walk)
    assert float(found.torso_m_s) == pytest.approx(float(alone.torso_m_s))
    assert float(found.limb_m_s) == pytest.approx(float(alone.limb_m_s))
    assert float(found.step_hz) == pytest.approx(float(alone.step_hz), rel=0.03)
    assert not found.torso_track_m_s[:40].any()


def test_bad_arguments():
    with pytest.raises(TensorsimError, match="speed_m_s"):
        GaitEstimator(torch.zeros(5), RATE)
    with pytest.raises(TensorsimError, match="frame_rate_hz"):
        GaitEstimator(SPEED, 5.0)
    with pytest.raises(TensorsimError, match="frame_rate_hz"):
        GaitEstimator(SPEED, -1.0)
