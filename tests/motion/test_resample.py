from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.motion.resample import PoseResampler
from tests.stage import StageTester, assert_same


def motion(shape: tuple[int, ...], dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    return (torch.randn(shape, generator=generator, dtype=torch.float64) + 3).to(dtype)


class TestSplineResampler(StageTester):
    def make(self) -> nn.Module:
        return PoseResampler(97.0)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return motion((*batch, 7, 2, 3), dtype), 24.0

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        joints = torch.zeros(1, 5, 14, 3)
        return [
            ((joints[:, :1], 30.0), r"shape \[1, 1, 14, 3\] with 1 frames, expected .* at least 2"),
            ((joints[:, :0], 30.0), r"with 0 frames"),
            ((joints[..., :2], 30.0), r"shape \[1, 5, 14, 2\], expected \(\.\.\., T, J, 3\)"),
            ((joints[0, 0], 30.0), r"shape \[14, 3\], expected \(\.\.\., T, J, 3\)"),
            ((joints.long(), 30.0), r"expected a real floating point tensor"),
            ((joints * float("nan"), 30.0), r"joints: got NaN or infinite values"),
            ((joints, 0.0), r"fps: got 0.0, expected a positive finite number"),
            ((joints, -30.0), r"fps: got -30.0"),
            ((joints, float("nan")), r"fps: got nan"),
            ((joints, 1e6), r"got 5 frames at 1000000.0 fps, expected a clip that holds a pulse at 97.0 Hz"),
        ]

    def test_scripted_refuses_the_same(self) -> None:
        scripted = torch.jit.script(self.make())
        for args, _ in self.bad_inputs():
            with pytest.raises(torch.jit.Error, match="TensorsimError"):
                scripted(*args)


class TestLinearResampler(TestSplineResampler):
    def make(self) -> nn.Module:
        return PoseResampler(97.0, method="linear")


@settings(deadline=None, max_examples=50)
@given(frames=st.integers(3, 60), fps=st.floats(5, 120), prf=st.floats(50, 2000))
def test_spline_equals_scipy(frames: int, fps: float, prf: float) -> None:
    joints = motion((2, frames, 2, 3))
    actual = PoseResampler(prf)(joints, fps).numpy()
    time, pulse_time = np.arange(frames) / fps, np.arange(actual.shape[-3]) / prf
    inside = pulse_time <= time[-1]
    spline = CubicSpline(time, joints.numpy(), axis=-3, bc_type="natural")
    np.testing.assert_allclose(actual[:, inside], spline(pulse_time[inside]), rtol=0, atol=1e-11)
    # Beyond the last frame, the body continues as it moved there.
    after = (pulse_time[~inside] - time[-1])[:, None, None]
    onwards = joints.numpy()[:, -1:] + spline(time[-1], 1)[:, None] * after
    np.testing.assert_allclose(actual[:, ~inside], onwards, rtol=0, atol=1e-11)


def test_spline_of_a_ten_minute_clip_equals_scipy() -> None:
    joints, fps = motion((18000, 1, 3)), 30.0
    resampler = PoseResampler(8192.0)
    coefficients = resampler.coefficients(joints, fps)
    start = resampler.pulses(18000, fps) - 30000
    actual = resampler.evaluate(coefficients, fps, start, start + 29000).numpy()
    spline = CubicSpline(np.arange(18000) / fps, joints.numpy(), bc_type="natural")
    np.testing.assert_allclose(actual, spline(np.arange(start, start + 29000) / 8192.0), rtol=0, atol=1e-9)


def test_linear_equals_numpy() -> None:
    joints, fps, prf = motion((9, 2, 3)), 25.0, 312.0
    actual = PoseResampler(prf, method="linear")(joints, fps).numpy()
    time = np.arange(actual.shape[0]) / prf
    inside = time <= 8 / fps
    for joint, axis in np.ndindex(2, 3):
        expected = np.interp(time, np.arange(9) / fps, joints.numpy()[:, joint, axis])
        np.testing.assert_allclose(actual[inside, joint, axis], expected[inside], rtol=0, atol=1e-12)
    steps = np.diff(actual[~inside], axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to((joints[-1] - joints[-2]) * fps / prf, steps.shape))


def test_clip_lasts_all_its_frames() -> None:
    """Convention: 120 frames at 30 fps are 4 s, 32 768 pulses; pulse m is at m / PRF, frame k at k / fps."""
    joints = motion((120, 14, 3), torch.float32)
    pulses = PoseResampler(8192.0)(joints, 30.0)
    assert pulses.shape == (32768, 14, 3)
    assert_same(PoseResampler(240.0)(joints, 30.0)[::8], joints.double(), atol=1e-14)
    assert PoseResampler(8192.0).pulses(71, 50 / 3) == 34898  # 34897.92


def test_result_is_float64_for_the_phase_of_the_carrier() -> None:
    for dtype in (torch.float32, torch.float64, torch.float16):
        assert PoseResampler(64.0)(motion((4, 1, 3), dtype), 30.0).dtype == torch.float64


def test_acceleration_is_continuous_and_exact() -> None:
    """On a swinging limb the spline's velocity is right to 1e-3; that of straight lines is wrong by 10 %."""
    fps, prf = 30.0, 3000.0
    phase = 2 * np.pi * 1.2
    joints = torch.from_numpy(0.3 * np.sin(phase * np.arange(60) / fps)).reshape(-1, 1, 1).expand(-1, 1, 3)
    time = (np.arange(round(60 / fps * prf) - 1) + 0.5) / prf
    truth = 0.3 * phase * np.cos(phase * time)
    middle = slice(1000, -1000)

    def velocity_error(method: str) -> float:
        position = PoseResampler(prf, method=method)(joints, fps)[:, 0, 0].numpy()
        return float(np.abs(np.diff(position) * prf - truth)[middle].max() / truth.max())

    assert velocity_error("spline") < 1e-3
    assert velocity_error("linear") > 0.1
    jumps = np.diff(PoseResampler(prf)(joints, fps)[:, 0, 0].numpy(), n=3) * prf**3
    assert (
        np.abs(jumps[middle]).max() < 1.2 * 0.3 * phase**3
    )  # a break of acceleration would be PRF times that


def test_pieces_equal_the_whole() -> None:
    joints, fps = motion((2, 11, 3, 3)), 30.0
    for method in ("spline", "linear"):
        resampler = PoseResampler(500.0, method=method)
        whole = resampler(joints, fps)
        coefficients = resampler.coefficients(joints, fps)
        assert coefficients.shape == (2, 2, 11, 3, 3)
        for start, stop in ((0, 1), (7, 93), (93, 183), (5, 5)):
            piece = resampler.evaluate(coefficients, fps, start, stop)
            assert_same(piece, whole[:, start:stop])


def test_coefficients_are_positions_and_accelerations() -> None:
    fps = 50.0
    time = torch.arange(101, dtype=torch.float64) / fps
    joints = torch.sin(2 * time).reshape(-1, 1, 1).expand(-1, 1, 3)
    position, acceleration = PoseResampler(100.0).coefficients(joints, fps).unbind(-4)
    assert_same(position, joints)
    assert_same(acceleration[20:-20], (-4 * joints)[20:-20], atol=1e-3)


def test_large_batches_take_the_same_way_in_small_pieces() -> None:
    joints = motion((40, 5, 14, 3))
    resampler = PoseResampler(2000.0)
    assert_same(resampler(joints, 30.0)[7], resampler(joints[7], 30.0), atol=1e-14)


def test_no_people() -> None:
    assert PoseResampler(100.0)(torch.zeros(2, 0, 30, 14, 3), 30.0).shape == (2, 0, 100, 14, 3)


def test_two_frames_are_a_straight_line() -> None:
    joints = torch.tensor([0.0, 1.0], dtype=torch.float64).reshape(2, 1, 1).expand(2, 1, 3)
    expected = torch.arange(8, dtype=torch.float64) / 4
    assert_same(PoseResampler(8.0)(joints, 2.0)[:, 0, 1], expected, atol=1e-15)


def test_real_motion_between_frames(shared_data: Any) -> None:
    """Every fourth frame of measured motion gives the others back, better than straight lines do."""
    with np.load(shared_data / "mocap" / "cmu_14joints_120hz.npz") as clips:
        # The slower clips hold more jitter than bends, and no interpolant has an edge on jitter.
        for name in (n for n in clips.files if n.startswith(("jumping", "running"))):
            truth = torch.from_numpy(clips[name][1:]).double()
            truth = truth[: 4 * (truth.shape[0] // 4)]
            error = {
                method: float(
                    (PoseResampler(120.0, method=method)(truth[::4], 30.0) - truth)[8:-8].square().mean()
                )
                for method in ("spline", "linear")
            }
            assert error["spline"] < 0.7 * error["linear"], name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0,), "prf_hz: got 0.0, expected a positive finite number"),
        ((float("inf"),), "prf_hz: got inf"),
        ((100.0, "cubic"), "method: got 'cubic', expected one of spline, linear"),
    ],
)
def test_refuses_bad_settings(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        PoseResampler(*arguments)


def test_refuses_pulses_that_are_not_there() -> None:
    resampler = PoseResampler(100.0)
    coefficients = resampler.coefficients(torch.zeros(30, 1, 3), 30.0)
    for start, stop in ((-1, 5), (5, 4), (0, 101)):
        with pytest.raises(
            TensorsimError, match=f"got pulses {start} to {stop}, expected a range within 0 to 100"
        ):
            resampler.evaluate(coefficients, 30.0, start, stop)
    with pytest.raises(TensorsimError, match=r"coefficients: got shape \[30, 1, 3\]"):
        resampler.evaluate(torch.zeros(30, 1, 3), 30.0, 0, 5)
