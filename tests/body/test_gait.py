"""Boulic's walking against the published numbers, SciPy's interpolant, and how people walk."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from tensorsim.body.gait import boulic_gait, cycle_s, pelvis_roll, periodic_pchip, stance_share
from tensorsim.errors import TensorsimError

FIELDS = ("hip", "knee", "ankle", "shoulder", "elbow", "trunk", "pelvis", "translation")


def gait(speed: float, phases: list[float]) -> dict[str, Tensor]:
    """One walker; angles in degrees."""
    out = boulic_gait(
        torch.tensor(speed, dtype=torch.float64), torch.tensor(phases, dtype=torch.float64)
    )._asdict()
    return {k: v if k == "translation" else torch.rad2deg(v) for k, v in out.items()}


def reference_curve(x: list[float], y: list[float], phase: np.ndarray) -> np.ndarray:
    """SciPy's PCHIP through three periods of the points."""
    points = np.array(sorted((a % 1.0, b) for a, b in zip(x, y, strict=True)))
    x3 = np.concatenate([points[:, 0] + k for k in (-2, -1, 0, 1, 2)])
    return np.asarray(PchipInterpolator(x3, np.tile(points[:, 1], 5))(phase % 1.0))


def test_interpolant_is_scipys() -> None:
    generator = np.random.default_rng(0)
    phase = np.linspace(-1.3, 2.7, 401)
    for count in (2, 3, 5, 8):
        x = np.sort(generator.uniform(0, 1, count))
        y = generator.standard_normal(count)
        actual = periodic_pchip(torch.tensor(x), torch.tensor(y), torch.tensor(phase))
        expected = reference_curve(list(x), list(y), phase)
        np.testing.assert_allclose(actual.numpy(), expected, rtol=0, atol=1e-12)


def test_interpolant_of_many_curves_equals_a_loop_and_has_gradients() -> None:
    x = torch.rand(3, 4, dtype=torch.float64).sort(dim=-1).values
    y, phase = torch.randn(3, 4, dtype=torch.float64), torch.rand(3, 9, dtype=torch.float64)
    whole = periodic_pchip(x, y, phase)
    for i in range(3):
        torch.testing.assert_close(whole[i], periodic_pchip(x[i], y[i], phase[i]))
    y.requires_grad_(True)
    phase.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda y, p: periodic_pchip(x, y, p), (y, phase), fast_mode=True)


# Control points worked out by hand from the published table at one speed of each range.
PUBLISHED = {
    0.4: {
        "hip": ([0.5, 0.9], [-12, 20]),
        "knee": ([0.17, 0.4, 0.75, 1], [3, 3, 56, 3]),
        "elbow": ([0.05, 0.5, 0.9], [5.4, 16.6, 7]),
    },
    0.9: {
        "hip": ([0.5, 0.9], [-15, 25]),
        "knee": ([0.17, 0.4, 0.75, 1], [3, 3, 70, 3]),
        "elbow": ([0.05, 0.505, 0.9], [10, 32, 12.5]),
    },
    2.15: {
        "hip": ([0.0, 0.5, 0.9], [27.5, -15, 28]),
        "knee": ([0.145, 0.4, 0.725, 0.985], [14, 3, 67.5, 4.5]),
        "elbow": ([0.05, 0.53, 0.85], [11, 57, 14]),
    },
}


@pytest.mark.parametrize("speed", PUBLISHED)
def test_joint_curves_are_the_published_ones(speed: float) -> None:
    phase = np.linspace(0, 1, 101)
    actual = gait(speed, list(phase))
    for joint, (x, y) in PUBLISHED[speed].items():
        for side, shift in ((0, 0.0), (1, 0.5)):
            expected = reference_curve(x, y, phase + shift)
            np.testing.assert_allclose(actual[joint][:, side].numpy(), expected, rtol=0, atol=1e-5)


def test_ankle_at_a_medium_speed() -> None:
    share = 0.752 - 0.143 * math.sqrt(0.9) / 1.346
    actual = gait(0.9, [0.0, 0.08, 0.5, share, 0.85])["ankle"][:, 0]
    np.testing.assert_allclose(actual.numpy(), [-3, -18, 8, -20, -3], atol=1e-5)


def test_translations_are_the_published_ones() -> None:
    t = np.linspace(0, 1, 50)
    for speed in (0.3, 1.0):
        quick = speed > 0.5
        # Slow walkers sway to the same side as quick ones, against the printed sign.
        lateral = 0.032 if quick else 0.128 * speed - 0.128 * speed**2
        forward = -0.021 if quick else 0.084 * speed**2 - 0.084 * speed
        share = 0.752 - 0.143 * math.sqrt(speed) / 1.346
        actual = gait(speed, list(t))["translation"].numpy()
        tau = 2 * math.pi
        np.testing.assert_allclose(actual[:, 0], lateral * np.sin(tau * (t - 0.1)), atol=1e-6)
        np.testing.assert_allclose(
            actual[:, 1], forward * np.sin(tau * (2 * t + 2 * (0.625 - share))), atol=1e-6
        )
        a = 0.015 * speed
        np.testing.assert_allclose(actual[:, 2], -a + a * np.sin(tau * (2 * t - 0.35)), atol=1e-6)


@pytest.mark.parametrize(
    ("speed", "bow_deg"), [(0.3, 8 * 0.3 * 0.7), (0.1, 8 * 0.1 * 0.9), (0.5, 2.0), (1.0, 2.0)]
)
def test_trunk_bows_as_published(speed: float, bow_deg: float) -> None:
    t = np.linspace(0, 1, 50)
    expected = bow_deg * (1 - np.sin(2 * math.pi * (2 * t - 0.1)))
    np.testing.assert_allclose(gait(speed, list(t))["trunk"][:, 0].numpy(), expected, atol=1e-6)


def test_a_cycle_of_walking_takes_its_time() -> None:
    """At 1.1 m/s and 1.75 m of height: 1.19 s, 1.31 m, feet on the floor for 63 % of it."""
    speed = torch.tensor(1.1 / (0.491 * 1.75), dtype=torch.float64)
    assert float(cycle_s(speed)) == pytest.approx(1.19, abs=0.005)
    assert 1.1 * float(cycle_s(speed)) == pytest.approx(1.31, abs=0.01)
    assert float(stance_share(speed)) == pytest.approx(0.632, abs=0.002)


def test_phase_zero_is_the_heel_strike_of_the_right_foot() -> None:
    at = gait(1.2, [0.0, 0.3])
    assert at["hip"][0, 0] > 20 > -10 > at["hip"][0, 1]
    assert at["shoulder"][0, 0] < 0 < at["shoulder"][0, 1]  # the left arm goes with the right leg
    assert at["pelvis"][0, 1] > 0 > at["trunk"][0, 2]  # the right hip leads, shoulders turn against it
    assert at["translation"][1, 0] > 0.02  # in the middle of standing on the right foot, over it
    assert at["pelvis"][1, 0] < 0  # and the left side has dropped
    assert at["knee"][1, 1] > 50 > 10 > at["knee"][1, 0]  # while the left knee swings through


def test_halves_of_the_cycle_mirror_each_other() -> None:
    first, second = gait(1.2, [0.13, 0.4]), gait(1.2, [0.63, 0.9])
    for joint in ("hip", "knee", "ankle", "elbow", "shoulder"):
        torch.testing.assert_close(first[joint], second[joint].flip(-1), rtol=0, atol=1e-5)
    for field, odd in (("trunk", 2), ("pelvis", 1), ("translation", 0)):
        torch.testing.assert_close(first[field][:, odd], -second[field][:, odd])
    torch.testing.assert_close(first["pelvis"][:, 0], -second["pelvis"][:, 0])


def test_pelvis_roll_is_continuous_and_of_the_published_size() -> None:
    phase = torch.linspace(0, 2, 4001, dtype=torch.float64)
    roll = pelvis_roll(torch.tensor([1.0], dtype=torch.float64), phase)
    assert float(roll.diff().abs().max()) < 0.05
    assert float(roll.min()) == pytest.approx(-3.32, abs=1e-3)  # 1.66 RV twice, not the 0.01 RV of some ports
    assert float(roll.max()) == pytest.approx(3.32, abs=1e-3)


@pytest.mark.parametrize("border", [0.5, 1.3])
def test_ranges_of_speed_join(border: float) -> None:
    phases = [float(p) for p in np.linspace(0, 1, 41)]
    below, above = gait(border - 1e-4, phases), gait(border + 1e-4, phases)
    for field in ("knee", "ankle", "translation", "pelvis", "shoulder", "elbow"):
        tolerance = 1e-3 if field == "translation" else 0.15  # leg lengths, degrees
        torch.testing.assert_close(below[field], above[field], rtol=0, atol=tolerance, msg=field)
    # The hip's one peak becomes two points at 1.3, and the slope at the second is no longer zero.
    torch.testing.assert_close(below["hip"], above["hip"], rtol=0, atol=0.7)


def test_batch_equals_loop_and_float32_is_near() -> None:
    speed = torch.tensor([[0.3, 1.2], [2.0, 2.9]], dtype=torch.float64)
    phase = torch.rand(2, 2, 17, dtype=torch.float64)
    whole = boulic_gait(speed, phase)
    single = boulic_gait(speed[1, 0], phase[1, 0])
    for a, b in zip(whole, single, strict=True):
        torch.testing.assert_close(a[1, 0], b)
    for a, b in zip(whole, boulic_gait(speed.float(), phase.float()), strict=True):
        assert b.dtype == torch.float32
        torch.testing.assert_close(a.float(), b, rtol=0, atol=1e-4)
    for b in boulic_gait(speed, phase.float()):
        assert b.dtype == torch.float32


def test_gradients_against_finite_differences() -> None:
    phase = torch.tensor([0.03, 0.31, 0.72], dtype=torch.float64, requires_grad=True)
    speed = torch.tensor(1.1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda s, p: tuple(x for x in boulic_gait(s, p) if x.requires_grad), (speed, phase), fast_mode=True
    )


@pytest.mark.parametrize(
    ("speed", "phase", "message"),
    [
        (torch.tensor(0.0), torch.zeros(3), "relative_speed: got 0, expected above 0 and at most 3"),
        (torch.tensor([1.0, 3.1]), torch.zeros(2, 3), "relative_speed: got 3.1, expected"),
        (torch.tensor(float("nan")), torch.zeros(3), "relative_speed: got nan"),
        (torch.ones(2), torch.zeros(3), r"got speeds of shape \[2\] and phases of shape \[3\]"),
        (torch.tensor(1.0), torch.zeros(3, dtype=torch.int64), "phase: got dtype"),
        (torch.tensor(1.0), torch.full((3,), float("nan")), "phase: got NaN"),
    ],
)
def test_refuses(speed: Tensor, phase: Tensor, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        boulic_gait(speed, phase)
