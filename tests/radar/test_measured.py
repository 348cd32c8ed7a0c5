"""Simulated gait beside measured gait. People, rooms and sensors differ, so the bounds are those of physics."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import JOINT_RCS_M2, JOINTS, RadarConfig
from tensorsim.motion.resample import PoseResampler
from tensorsim.radar.analysis.gait_parameters import GaitEstimator, GaitParameters
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.echo import EchoSynthesizer

#: 24 GHz, 160 Hz per m/s. The measured radar does not sweep; a sweep of 10 MHz has range bins of 15 m.
CW = RadarConfig(
    carrier_hz=24e9,
    bandwidth_hz=10e6,
    sample_rate_hz=0.2e6,
    prf_hz=44100 / 15,
    tx_m=(0.0, 0.0, 1.0),
    rx_m=(0.0, 0.0, 1.0),
)
DOPPLER = DopplerTimeMap(CW, window_s=0.15)
GAIT = GaitEstimator(DOPPLER.doppler_hz * CW.doppler_wavelength_m / 2, CW.prf_hz / DOPPLER.hop)
WALKS = ("walking_1", "walking_2", "walking_4", "walking_5")
RUNS = ("running_1", "running_3", "running_4", "running_5")


def measured_map(shared_data, name) -> torch.Tensor:
    """Doppler-time map of a recorded real CW signal, which shows every speed on both sides."""
    from scipy.io import wavfile
    from scipy.signal import decimate

    rate, signal = wavfile.read(shared_data / "radar" / f"cw24ghz_{name}.wav")
    assert rate == 44100
    signal = decimate(decimate(signal - signal.mean(), 3, ftype="fir"), 5, ftype="fir")
    return DOPPLER(torch.from_numpy(signal + 0j).unsqueeze(-1))


def recorded_joints(shared_data, name, direction_deg=0.0, distance_m=4.0) -> torch.Tensor:
    """Joints (T, 14, 3) at 120 Hz of a walk whose middle is ``distance_m`` from the radar; 0 deg walks towards it."""
    with np.load(shared_data / "mocap" / "cmu_14joints_120hz.npz") as clips:
        joints = torch.from_numpy(clips[name].astype(np.float64)[1:])  # the first frame is a calibration pose
    middle = (joints[0] + joints[-1]).mean(0) / 2
    c, s = math.cos(math.radians(direction_deg)), math.sin(math.radians(direction_deg))
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    place = torch.stack((middle[0], middle[1], torch.zeros(())))
    return (joints - place) @ turn.T + torch.tensor([0.0, distance_m, 0.0])


def simulated_map(joints) -> torch.Tensor:
    positions = PoseResampler(CW.prf_hz)(joints, 120.0)
    rcs = torch.tensor(JOINT_RCS_M2, dtype=torch.float64)
    return DOPPLER(RangeProfile(CW)(EchoSynthesizer(CW)(positions, rcs)))


def joint_speeds(joints) -> torch.Tensor:
    """Radial speed (T - 1, 14) of each joint, positive = approaching."""
    return -(joints - torch.tensor(CW.tx_m)).norm(dim=-1).diff(dim=0) * 120.0


def stride_rate(joints) -> float:
    """Strongest frequency of the distance between the ankles along the walk."""
    right, left = (joints[:, JOINTS.index(f"{side}_ankle"), 1] for side in ("right", "left"))
    gap = (right - left) - (right - left).mean()
    spectrum = np.abs(np.fft.rfft(gap.numpy() * np.hanning(len(gap)), 16384))
    return float(np.fft.rfftfreq(16384, 1 / 120)[spectrum.argmax()])


def mean_gait(maps) -> GaitParameters:
    found = [GAIT(m) for m in maps]
    return GaitParameters(*(torch.stack([f[i] for f in found]).mean() for i in range(3)), *found[0][3:])


def test_measured_walk(shared_data):
    gait = GAIT(measured_map(shared_data, "walking"))
    assert 1.0 < float(gait.torso_m_s) < 1.6
    assert 0.9 < float(gait.step_hz) / 2 < 1.3
    assert 1.4 < float(gait.limb_m_s / gait.torso_m_s) < 2.5


def test_measured_run(shared_data):
    walk, run = (GAIT(measured_map(shared_data, name)) for name in ("walking", "running"))
    assert 1.8 < float(run.torso_m_s) < 4.5
    assert 1.1 < float(run.step_hz) / 2 < 1.8
    assert float(run.limb_m_s) > 1.5 * float(walk.limb_m_s)


@pytest.mark.parametrize("name", WALKS + RUNS)
def test_simulated_gait_is_that_of_the_joints(name, shared_data):
    joints = recorded_joints(shared_data, name)
    gait = GAIT(simulated_map(joints))
    hips = joint_speeds(joints)[:, [JOINTS.index("right_hip"), JOINTS.index("left_hip")]]
    assert float(gait.torso_m_s) == pytest.approx(float(hips.median()), rel=0.15)
    assert float(gait.step_hz) / 2 == pytest.approx(stride_rate(joints), rel=0.08)
    assert float(gait.limb_m_s) < float(joint_speeds(joints).max()) + 0.2


def test_simulated_gait_resembles_the_measured(shared_data):
    # People choose how fast they run; steps, and limbs beside the torso, go with the speed.
    for name, clips, speed in (("walking", WALKS, 0.15), ("running", RUNS, 0.4)):
        measured = GAIT(measured_map(shared_data, name))
        simulated = mean_gait(simulated_map(recorded_joints(shared_data, clip)) for clip in clips)
        assert float(simulated.torso_m_s) == pytest.approx(float(measured.torso_m_s), rel=speed)
        assert float(simulated.step_hz) == pytest.approx(float(measured.step_hz), rel=0.08)
        # Points at ankles shine brighter than shins: the simulated envelope is the wider one in a walk.
        limbs = [float(gait.limb_m_s / gait.torso_m_s) for gait in (simulated, measured)]
        assert limbs[0] == pytest.approx(limbs[1], rel=0.3)


class TestDirections:
    """Maps of measured walks in four directions carry no axes: only ratios are compared."""

    #: The row of 0 Hz, dark in all four maps. Rows below are approaching: the walk across starts there.
    ZERO = 128

    def read(self, shared_data, direction) -> torch.Tensor:
        """Magnitude (192, 246) with clutter at 0 Hz blanked."""
        from scipy.io import loadmat

        decibels = loadmat(shared_data / "radar" / f"mmrgait_walk_dir{direction:03d}.mat")["tfmap"]
        magnitude = torch.from_numpy(10 ** (decibels / 20))
        magnitude[self.ZERO - 2 : self.ZERO + 3] = 0
        return magnitude

    def estimator(self) -> GaitEstimator:
        # Any scale does: 20 rows to 1 m/s and 120 columns to 1 s put a walk where a walk belongs.
        return GaitEstimator((self.ZERO - torch.arange(192)) / 20, 120.0)

    def test_oblique_walk_is_slower_by_the_cosine(self, shared_data):
        measured = {d: float(self.estimator()(self.read(shared_data, d)).torso_m_s) for d in (0, 45, 315)}
        simulated = {
            d: mean_gait(simulated_map(recorded_joints(shared_data, w, d)) for w in WALKS).torso_m_s
            for d in (0, 45, 315)
        }
        for direction in (45, 315):
            ratio = measured[direction] / measured[0]
            assert 0.6 < ratio < 1.0
            assert float(simulated[direction] / simulated[0]) == pytest.approx(ratio, abs=0.16)

    def test_walk_across_changes_sign_in_the_middle(self, shared_data):
        measured = self.read(shared_data, 90).square()
        approaching, receding = measured[: self.ZERO].sum(0), measured[self.ZERO + 1 :].sum(0)
        share = approaching / (approaching + receding)
        assert float(share[:60].mean()) > 0.75
        assert float(share[-60:].mean()) < 0.35
        simulated = simulated_map(recorded_joints(shared_data, "walking_1", 90.0)).square()
        half = DOPPLER.bins // 2
        share = simulated[half + 1 :].sum(0) / (simulated[half + 1 :].sum(0) + simulated[1:half].sum(0))
        quarter = share.shape[0] // 4
        assert float(share[:quarter].mean()) > 0.75
        assert float(share[-quarter:].mean()) < 0.35

    @pytest.mark.parametrize("direction", [0, 45, 315])
    def test_steps_and_limbs(self, direction, shared_data):
        measured = self.estimator()(self.read(shared_data, direction))
        forwards = self.estimator()(self.read(shared_data, 0))
        assert float(measured.step_hz) == pytest.approx(float(forwards.step_hz), rel=0.1)
        assert 1.8 < float(measured.limb_m_s / measured.torso_m_s) < 3.2
