"""The smoother against filterpy, against the closed form of its frequency response, and its conventions."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tensorsim.errors import TensorsimError
from tensorsim.vision.smoothing.kalman import KalmanSmoother
from tests.stage import StageTester


def random_joints(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Random walks (..., T, J, 3), metres."""
    steps = torch.randn(*shape, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return (0.05 * steps.cumsum(-3) + 1.0).to(dtype)


def random_valid(*shape: int, share: float = 0.7) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(2)) < share


class TestKalmanSmoother(StageTester):
    batched_arguments = (0, 1)

    def make(self) -> nn.Module:
        return KalmanSmoother()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return random_joints(*batch, 9, 4, dtype=dtype), random_valid(*batch, 9, 4), 25.0

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        joints, valid, fps = self.inputs((2,), torch.float32)
        broken = joints.clone()
        broken[valid] = torch.nan
        return [
            ((joints.long(), valid, fps), "joints: got dtype"),
            ((joints[0, 0], valid[0, 0], fps), r"\(\.\.\., T, J, 3\)"),
            ((joints[..., :2], valid, fps), r"\(\.\.\., T, J, 3\)"),
            ((joints[:, :0], valid[:, :0], fps), "at least one frame"),
            ((joints, valid[:, :-1], fps), "valid: got"),
            ((joints, valid.float(), fps), "expected bool"),
            ((broken, valid, fps), "NaN"),
            ((joints, valid, 0.0), "fps"),
            ((joints, valid, math.nan), "fps"),
        ]


class TestForwardFilter(TestKalmanSmoother):
    def make(self) -> nn.Module:
        return KalmanSmoother(mode="forward")


def by_filterpy(
    z: np.ndarray, valid: np.ndarray, fps: float, **noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Forward and smoothed positions of one joint (T, 3) by filterpy, all six states in one filter."""
    from filterpy.kalman import KalmanFilter

    dt, q = 1.0 / fps, noise["process_noise"] * 30.0**3
    each = np.eye(3)
    kf = KalmanFilter(dim_x=6, dim_z=3)
    kf.F = np.kron([[1.0, dt], [0.0, 1.0]], each)
    kf.H = np.kron([[1.0, 0.0]], each)
    kf.Q = np.kron(q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), each)
    kf.R = noise["measurement_noise"] * each
    kf.P = np.kron(np.diag([1e4 * noise["measurement_noise"], 3.0**2]), each)
    kf.x = np.concatenate([z[np.argmax(valid)], np.zeros(3)])[:, None]
    states, covariances = [], []
    for t in range(len(z)):
        if t > 0:
            kf.predict()
        kf.update(z[t][:, None] if valid[t] else None)
        states.append(kf.x.copy())
        covariances.append(kf.P.copy())
    smoothed = kf.rts_smoother(np.array(states), np.array(covariances))[0]
    return np.array(states)[:, :3, 0], smoothed[:, :3, 0]


@pytest.mark.parametrize("fps", [16.67, 30.0, 60.0])
@pytest.mark.parametrize("case", ["all", "gaps", "late start", "early end", "one frame"])
@pytest.mark.parametrize("noise", [(0.001, 0.01), (0.1, 1e-4)])
def test_equals_filterpy(fps: float, case: str, noise: tuple[float, float]) -> None:
    joints = random_joints(40, 2)
    valid = torch.ones(40, 2, dtype=torch.bool)
    if case == "gaps":
        valid = random_valid(40, 2, share=0.5)
    if case == "late start":
        valid[:9] = False
    if case == "early end":
        valid[-12:] = False
    if case == "one frame":
        valid[:] = False
        valid[17] = True
    noises = {"process_noise": noise[0], "measurement_noise": noise[1]}
    hidden = torch.where(valid.unsqueeze(-1), joints, torch.nan)
    forward = KalmanSmoother(mode="forward", **noises)(hidden, valid, fps)
    smooth = KalmanSmoother(**noises)(hidden, valid, fps)
    for j in range(2):
        expected = by_filterpy(joints[:, j].numpy(), valid[:, j].numpy(), fps, **noises)
        np.testing.assert_allclose(forward[:, j].numpy(), expected[0], rtol=0, atol=1e-8)
        np.testing.assert_allclose(smooth[:, j].numpy(), expected[1], rtol=0, atol=1e-8)


def test_frequency_response_is_the_closed_form_and_the_documented_bandwidth() -> None:
    impulse = torch.zeros(1201, 1, 3, dtype=torch.float64)
    impulse[600] = 1.0
    response = KalmanSmoother()(impulse, None, 30.0)[:, 0, 0].numpy()
    np.testing.assert_allclose(response, response[::-1], rtol=0, atol=1e-12)  # zero phase
    size = 1 << 17
    gain = np.abs(np.fft.rfft(response, size))
    hz = np.fft.rfftfreq(size, 1 / 30.0)
    # Wiener: signal over signal plus noise, the signal being white acceleration integrated and sampled.
    w = 2 * np.pi * hz[1:] / 30.0
    signal = 0.001 * (4.0 + 2.0 * np.cos(w)) / 6.0 / (2.0 - 2.0 * np.cos(w)) ** 2
    np.testing.assert_allclose(gain[1:], signal / (signal + 0.01), rtol=0, atol=1e-6)
    assert hz[np.argmax(gain < 0.5**0.5)] == pytest.approx(2.15, abs=0.01)
    assert hz[np.argmax(gain < 0.5)] == pytest.approx(2.69, abs=0.01)


def test_forward_sees_the_past_only_and_rts_sees_all_and_errs_less() -> None:
    t = torch.arange(120, dtype=torch.float64) / 30.0
    truth = torch.sin(2 * math.pi * t).reshape(-1, 1, 1).expand(120, 1, 3)
    noisy = truth + 0.1 * torch.randn(120, 1, 3, dtype=torch.float64)
    later = noisy.clone()
    later[60:] += 1.0
    error = {}
    for mode in ("rts", "forward"):
        smoother = KalmanSmoother(mode=mode)
        out = smoother(noisy, None, 30.0)
        unmoved = torch.equal(smoother(later, None, 30.0)[:60], out[:60])
        assert unmoved == (mode == "forward")
        error[mode] = float((out - truth).square().mean().sqrt())
    assert error["rts"] < 0.6 * error["forward"] < 0.06


def test_constant_velocity_passes_unchanged_also_where_not_measured() -> None:
    t = torch.arange(60, dtype=torch.float64) / 30.0
    joints = (torch.tensor([0.3, -1.2, 0.1], dtype=torch.float64) * t[:, None] + 2.0).unsqueeze(1)
    valid = torch.ones(60, 1, dtype=torch.bool)
    valid[20:35] = False
    valid[55:] = False
    out = KalmanSmoother(initial_speed=100.0)(joints, valid, 30.0)
    torch.testing.assert_close(out, joints, rtol=0, atol=1e-3)


def test_before_the_first_measurement() -> None:
    joints = random_joints(20, 1)
    valid = torch.ones(20, 1, dtype=torch.bool)
    valid[:6] = False
    forward = KalmanSmoother(mode="forward")(joints, valid, 30.0)
    assert torch.equal(forward[:6], joints[6:7].expand(6, 1, 3))
    smooth = KalmanSmoother()(joints, valid, 30.0)
    assert (smooth[:6] - smooth[6]).norm(dim=-1).max() < 1.0
    assert not torch.equal(smooth[0], smooth[5])


def test_never_seen_is_zero_and_never_nan() -> None:
    joints = torch.full((2, 10, 3, 3), torch.nan)
    valid = torch.zeros(2, 10, 3, dtype=torch.bool)
    joints[0, 4:6, 1], valid[0, 4:6, 1] = 1.5, True
    for mode in ("rts", "forward"):
        out = KalmanSmoother(mode=mode)(joints, valid, 30.0)
        assert torch.isfinite(out).all()
        assert (out[1] == 0).all()
        assert (out[0, :, [0, 2]] == 0).all()
        torch.testing.assert_close(out[0, 4:6, 1], torch.full((2, 3), 1.5))


def test_gradient_is_finite_and_zero_where_not_valid() -> None:
    joints = random_joints(12, 2)
    valid = random_valid(12, 2, share=0.6)
    joints[~valid] = torch.nan
    joints.requires_grad_(True)
    KalmanSmoother()(joints, valid, 30.0).square().sum().backward()
    assert torch.isfinite(joints.grad).all()
    assert (joints.grad[~valid] == 0).all()
    assert (joints.grad[valid] != 0).all()


def test_float32_keeps_float64_accuracy_far_from_the_origin() -> None:
    joints = random_joints(300, 3) + 100.0
    exact = KalmanSmoother()(joints, None, 30.0)
    assert (KalmanSmoother()(joints.float(), None, 30.0) - exact).abs().max() < 2e-5


def test_one_frame_and_no_people_pass() -> None:
    joints = random_joints(2, 1, 4)
    torch.testing.assert_close(KalmanSmoother()(joints, None, 30.0), joints)
    assert KalmanSmoother()(joints[:0], None, 30.0).shape == (0, 1, 4, 3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"process_noise": 0.0}, "process_noise"),
        ({"measurement_noise": -1.0}, "measurement_noise"),
        ({"initial_speed": math.inf}, "initial_speed"),
        ({"mode": "backward"}, "'rts' or 'forward'"),
    ],
)
def test_refuses_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        KalmanSmoother(**settings)
