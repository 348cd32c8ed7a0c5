"""Estimates of noise against noise and motion whose sizes are known."""

import math

import pytest
import torch

from tensorsim.vision.smoothing.kalman import KalmanSmoother
from tensorsim.vision.smoothing.noise import acceleration_density, jitter, keypoint_noise, noise_with_depth

FPS = 30.0


@pytest.mark.parametrize("order", [4, 6])
def test_jitter_is_the_deviation_of_noise_and_not_of_movement(order: int) -> None:
    generator = torch.Generator().manual_seed(0)
    time = torch.arange(400, dtype=torch.float64) / FPS
    path = torch.stack([torch.sin(2 * torch.pi * time), 0.5 * time], dim=-1)
    valid = torch.ones(400, dtype=torch.bool)
    assert float(jitter(path, valid, order).max()) < 0.003
    noisy = path + 0.05 * torch.randn(path.shape, generator=generator, dtype=torch.float64)
    assert jitter(noisy, valid, order).tolist() == pytest.approx([0.05, 0.05], rel=0.2)
    assert jitter(noisy[:order], valid[:order], order).tolist() == [0, 0]
    valid[::order] = False
    assert jitter(noisy, valid, order).tolist() == [0, 0]


@pytest.mark.parametrize("noise_m", [0.0, 0.01])
def test_density_of_simulated_white_acceleration(noise_m: float) -> None:
    density, dt, frames = 5.0, 1 / FPS, 6000
    generator = torch.Generator().manual_seed(1)
    white = torch.randn(2, frames, 3, generator=generator, dtype=torch.float64)
    # The exact increments of position and velocity (Bar-Shalom et al., section 6.2.2) by their Cholesky factor.
    q = density * torch.tensor([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], dtype=torch.float64)
    factor = torch.linalg.cholesky(q)
    velocity = (factor[1, 0] * white[0] + factor[1, 1] * white[1]).cumsum(0)
    steps = factor[0, 0] * white[0]
    steps[1:] += dt * velocity[:-1]
    x = steps.cumsum(0)
    x = x + noise_m * torch.randn(frames, 3, generator=generator, dtype=torch.float64)
    valid = torch.ones(frames, dtype=torch.bool)
    found = acceleration_density(x, valid, torch.full_like(x, noise_m**2), FPS, 0.13, 0.15, 0.3)
    assert found.shape == (frames, 1)
    assert float(found.mean()) == pytest.approx(density, rel=0.15)


def test_density_follows_motion_in_time_and_is_least_where_nothing_moves() -> None:
    time = torch.arange(150, dtype=torch.float64) / FPS
    moving = (time > 2.0) & (time < 3.0)
    x = torch.where(moving, 0.3 * torch.sin(2 * math.pi * 2.0 * (time - 2.0)), 0.0)[:, None]
    valid = torch.ones(150, dtype=torch.bool)
    found = acceleration_density(x, valid, torch.zeros_like(x), FPS, 0.13, 0.15, 0.3)[:, 0]
    assert float(found[75]) > 100.0
    assert found[:30].tolist() == pytest.approx([0.3] * 30, rel=1e-9)
    assert acceleration_density(x, ~valid, torch.zeros_like(x), FPS, 0.13, 0.15, 0.3).unique().tolist() == [
        0.3
    ]
    assert acceleration_density(x[:8], valid[:8], x[:8], FPS, 0.13, 0.15, 0.3).unique().tolist() == [0.3]


def test_keypoint_noise_by_hand() -> None:
    scores = torch.tensor([[1.0, 0.5, 0.0], [1.2, 0.25, 0.9]])
    found = keypoint_noise(scores, torch.tensor([180.0, 17.5]), 1.76)
    half = 0.5 * 1.76 / 17.5  # far away a pixel is larger than a cell
    expected = torch.tensor([[0.0171875, 0.034375, 0.0859375], [half, 4 * half, half / 0.9]])
    torch.testing.assert_close(found, expected[..., None])


def test_noise_of_depth_by_hand() -> None:
    noise = torch.full((1, 2, 1), 0.03)
    joints = torch.tensor([[[1.0, 4.0, 1.0], [4.0, 5.0, 1.0]]])  # straight ahead, and to the side by 3 and 4
    found = noise_with_depth(noise, torch.tensor([[0.16, 0.4]]), joints, torch.tensor([1.0, 1.0, 1.0]), 1.0)
    aside, ahead = math.hypot(0.03, 0.06), math.hypot(0.03, 0.08)
    torch.testing.assert_close(found, torch.tensor([[[0.03, 0.05, 0.03], [aside, ahead, 0.03]]]))


def test_uncertain_depths_are_smoothed_and_what_the_picture_shows_is_not() -> None:
    """A wrist moves across the picture at 2 Hz; its depth, which is not known, jumps by 10 cm every sixth frame."""
    time = torch.arange(120, dtype=torch.float64) / FPS
    swing = 0.2 * torch.sin(2 * math.pi * 2.0 * time)
    jumps = 0.05 * torch.where(torch.arange(120) // 6 % 2 == 0, 1.0, -1.0).double()
    joints = torch.stack([swing, 4.0 + jumps, torch.ones_like(time)], dim=-1)[:, None]
    noise = torch.full((120, 1, 1), 0.02, dtype=torch.float64)
    camera = torch.zeros(3, dtype=torch.float64)
    inside = slice(20, 100)

    def smooth(deviation: float) -> tuple[float, float]:
        spread = torch.full((120, 1), deviation, dtype=torch.float64)
        found = KalmanSmoother()(joints, None, FPS, noise_with_depth(noise, spread, joints, camera))[
            inside, 0
        ]
        speed = found[:, 1].diff().abs().max() * FPS
        return float(found[:, 0].square().mean() / swing[inside].square().mean()) ** 0.5, float(speed)

    (gain, speed), (_, before) = smooth(0.2), smooth(0.0)
    assert gain > 0.9
    assert speed < 0.5 * before
