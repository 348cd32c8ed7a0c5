"""The smoother against filterpy, against the closed form of its frequency response, and its conventions."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tensorsim.errors import TensorsimError
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.vision.smoothing.kalman import KalmanSmoother
from tests.stage import StageTester

#: Noises of the original's control panel.
PANEL = {"process_noise": 0.001, "measurement_noise": 0.01}


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


class TestKnownErrors(TestKalmanSmoother):
    """With estimates that count: enough frames in a row, and errors known beforehand of some joints."""

    batched_arguments = (0, 1, 3)
    gradient_arguments = (0, 3)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        joints, valid = random_joints(*batch, 16, 3, dtype=dtype), random_valid(*batch, 16, 3, share=0.95)
        known = torch.rand(*batch, 16, 3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
        return joints, valid, 25.0, 0.06 * known.to(dtype)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        joints, valid, fps, known = self.inputs((2,), torch.float32)
        return [
            ((joints, valid, fps, known[..., :2]), "noise_std_m: got shape"),
            ((joints, valid, fps, known[:1]), "noise_std_m: got shape"),
            ((joints, valid, fps, known.long()), "noise_std_m: got dtype"),
            ((joints, valid, fps, known * torch.nan), "noise_std_m"),
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
    response = KalmanSmoother(**PANEL)(impulse, None, 30.0)[:, 0, 0].numpy()
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
        smoother = KalmanSmoother(**PANEL, mode=mode)
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
        ({"mode": "backward"}, "expected one of rts, forward"),
    ],
)
def test_refuses_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        KalmanSmoother(**settings)


def in_numpy(z: np.ndarray, q: np.ndarray, r: np.ndarray, fps: float) -> np.ndarray:
    """Smoothed positions of one coordinate (T,) under noises q, r (T,): normal equations instead of recursions.

    The states x(t) minimise the squared measurement errors, process noises and deviation from the prior, each over
    its covariance.
    """
    frames, dt = len(z), 1.0 / fps
    f = np.array([[1.0, dt], [0.0, 1.0]])
    information, right = np.zeros((2 * frames, 2 * frames)), np.zeros(2 * frames)
    information[:2, :2] += np.diag([1.0 / (1e4 * r[0]), 1.0 / 3.0**2])
    right[0] += z[0] / (1e4 * r[0])
    for t in range(frames):
        information[2 * t, 2 * t] += 1.0 / r[t]
        right[2 * t] += z[t] / r[t]
        if t > 0:
            step = np.hstack([-f, np.eye(2)])
            weight = np.linalg.inv(q[t] * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
            two = slice(2 * t - 2, 2 * t + 2)
            information[two, two] += step.T @ weight @ step
    return np.linalg.solve(information, right)[::2]


def noises_in_numpy(z: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """The estimates that the class describes, of one joint (T, 3) seen throughout: q (T,) and r (3,)."""
    sixth = np.abs(np.diff(z, n=6, axis=0))
    middle = np.sort(sixth, axis=0)[(len(sixth) - 1) // 2]
    r = 1.5 * (1.4826 * middle) ** 2 / 924 + 0.0005**2
    m, frames = round(0.13 * fps), len(z)
    centre = np.arange(m, frames - m)
    each = (z[centre + m] - 2 * z[centre] + z[centre - m]) ** 2 - 6 * r
    each = each.mean(axis=1) / (2 / 3 * (m / fps) ** 3)
    radius = int(3 * 0.15 * fps) + 1
    q = np.empty(frames)
    for t in range(frames):
        near = np.abs(centre - t) <= radius
        weight = np.exp(-0.5 * ((centre[near] - t) / (0.15 * fps)) ** 2)
        q[t] = max((weight @ each[near] + 0.3) / (weight.sum() + 1), 0.3)
    return q, r


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_adaptive_equals_numpy(fps: float) -> None:
    motion = ActivityGenerator().generate("Kicking", seed=4, duration_s=2.0, rate_hz=fps).joints[0]
    deviation = torch.tensor([0.01, 0.03, 0.005], dtype=torch.float64)
    noisy = motion + deviation * torch.randn(
        motion.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64
    )
    smooth = KalmanSmoother()(noisy, None, fps)
    for joint in (1, 4, 10, 13):
        z = noisy[:, joint].numpy()
        q, r = noises_in_numpy(z, fps)
        for axis in range(3):
            expected = in_numpy(z[:, axis], q, np.full(len(z), r[axis]), fps)
            np.testing.assert_allclose(smooth[:, joint, axis].numpy(), expected, rtol=0, atol=1e-7)


def speeds(joints: torch.Tensor, fps: float) -> torch.Tensor:
    return (joints[2:] - joints[:-2]).norm(dim=-1) * fps / 2


@pytest.mark.parametrize("hz", [1.0, 2.0, 3.0, 4.0, 5.0])
@pytest.mark.parametrize("amplitude", [0.001, 0.05, 0.4])
@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.5, -0.7, 0.6)])
def test_exact_joints_pass_up_to_5_hz(hz: float, amplitude: float, direction: tuple[float, ...]) -> None:
    t = torch.arange(180, dtype=torch.float64) / 30.0
    wave = amplitude * torch.sin(2 * math.pi * hz * t + 0.4)
    joints = wave[:, None, None] * torch.tensor(direction, dtype=torch.float64)
    smooth = KalmanSmoother()(joints, None, 30.0)[:, 0] @ torch.tensor(direction, dtype=torch.float64)
    tone = torch.exp(-2j * math.pi * hz * t)[30:150]
    assert float(((smooth[30:150] * tone).sum() / (wave[30:150] * tone).sum()).abs()) > 0.9


@pytest.mark.parametrize(
    ("activity", "joint", "least_m_s"), [("Punching", 4, 4.0), ("Punching", 7, 4.0), ("Kicking", 13, 5.5)]
)
def test_punch_and_kick_keep_their_peak_speed(activity: str, joint: int, least_m_s: float) -> None:
    motion = ActivityGenerator().generate(activity, seed=100, duration_s=4.0, rate_hz=30.0).joints[0]
    truth = float(speeds(motion[:, joint], 30.0).max())
    assert truth > least_m_s
    for joints in (motion, motion.float()):
        assert float(speeds(KalmanSmoother()(joints, None, 30.0)[:, joint], 30.0).max()) > 0.97 * truth


@pytest.mark.parametrize("deviation_m", [0.003, 0.01, 0.02, 0.03])
def test_adapts_better_than_any_noise_fixed_in_the_panel(deviation_m: float) -> None:
    error: dict[str, float] = {"panel": 0.0, "adaptive": 0.0, "raw": 0.0}
    for i, activity in enumerate(("Punching", "Kicking", "Sitting Down", "Walking", "Walking to Falling")):
        motion = ActivityGenerator().generate(activity, seed=i, duration_s=4.0, rate_hz=30.0).joints[0]
        noise = torch.randn(motion.shape, generator=torch.Generator().manual_seed(i), dtype=torch.float64)
        noisy = motion + deviation_m * noise
        for name, out in (
            ("panel", KalmanSmoother(**PANEL)(noisy, None, 30.0)),
            ("adaptive", KalmanSmoother()(noisy, None, 30.0)),
            ("raw", noisy),
        ):
            error[name] += float(speeds(out - motion, 30.0).square().mean())
    assert error["adaptive"] < 0.8 * error["panel"]
    assert error["adaptive"] < 0.3 * error["raw"]


def test_known_errors_smooth_what_looks_like_motion() -> None:
    """An error that wanders within a second has no jitter; given its size, the smoother removes more of it."""
    t = torch.arange(120, dtype=torch.float64) / 30.0
    wandering = 0.03 * torch.sin(2 * math.pi * 3.0 * t).reshape(-1, 1, 1).expand(120, 1, 3)
    alone = KalmanSmoother()(wandering, None, 30.0).square().mean()
    known = KalmanSmoother()(wandering, None, 30.0, torch.full((120, 1, 1), 0.1)).square().mean()
    assert float(alone) > 0.95 * float(wandering.square().mean())
    assert float(known) < 0.2 * float(wandering.square().mean())


def test_flickering_joint_is_smoothed_as_the_noisiest_of_the_body() -> None:
    generator = torch.Generator().manual_seed(6)
    noisy = 0.02 * torch.randn(60, 2, 3, generator=generator, dtype=torch.float64)
    valid = torch.ones(60, 2, dtype=torch.bool)
    valid[::4, 1] = False  # never long enough in a row for an estimate
    smooth = KalmanSmoother()(noisy, valid, 30.0)
    assert float(smooth[:, 1].square().mean()) < 0.35 * 0.02**2
