"""Filters along tracks, against NumPy."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tensorsim.vision.smoothing import along_time
from tensorsim.vision.smoothing.along_time import (
    brief_gaps,
    crossed_within,
    fill_gaps,
    gaps_with,
    local_linear,
    masked_median,
    raised_slowly,
    ridge_in_gaps,
    robust_smooth,
    running_quantile,
)


def test_local_linear_is_weighted_least_squares_at_every_frame() -> None:
    generator = np.random.default_rng(0)
    x, w = generator.standard_normal(40), generator.uniform(0.1, 1.0, 40)
    sigma, t = 3.0, np.arange(40)
    expected = []
    for centre in t:
        kernel = w * np.exp(-0.5 * ((t - centre) / sigma) ** 2) * (np.abs(t - centre) <= 13)
        a = np.stack([np.ones(40), t - centre], axis=1)
        root = np.sqrt(kernel)
        expected.append(np.linalg.lstsq(root[:, None] * a, root * x, rcond=None)[0][0])
    actual = local_linear(torch.tensor(x), torch.tensor(w), sigma)
    np.testing.assert_allclose(actual.numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("sigma", [0.01, 1.0, 9.0, 100.0])
def test_straight_lines_stay(sigma: float) -> None:
    line = 4.0 + 0.05 * torch.arange(50, dtype=torch.float64)
    torch.testing.assert_close(local_linear(line, torch.ones_like(line), sigma), line, atol=1e-4, rtol=0)
    valid = torch.rand(50) > 0.3
    valid[20:26] = False
    smooth = robust_smooth(torch.where(valid, line, torch.zeros_like(line)), valid, max(sigma, 3.0), 0.03)
    torch.testing.assert_close(smooth[valid], line[valid], atol=2e-2, rtol=0)


def test_the_ridge_is_that_of_ridge_regression() -> None:
    generator = np.random.default_rng(1)
    sigma, t = 3.0, np.arange(40)
    x, w, ridge = generator.standard_normal(40), generator.uniform(0.1, 1.0, 40), generator.uniform(0, 1, 40)
    expected = []
    for centre in t:
        kernel = w * np.exp(-0.5 * ((t - centre) / sigma) ** 2) * (np.abs(t - centre) <= 13)
        a = np.stack([np.ones(40), t - centre], axis=1)
        least = ridge[centre] * kernel.sum() * sigma**2
        expected.append(
            np.linalg.solve(a.T @ (kernel[:, None] * a) + np.diag([0.0, least]), a.T @ (kernel * x))[0]
        )
    actual = local_linear(torch.tensor(x), torch.tensor(w), sigma, torch.tensor(ridge))
    np.testing.assert_allclose(actual.numpy(), expected, atol=1e-5)


def test_only_gaps_have_a_ridge() -> None:
    weights = torch.ones(80, dtype=torch.float64)
    assert float(ridge_in_gaps(weights, 5.0).max()) == 0.0
    assert float(ridge_in_gaps(0.51 * weights, 5.0).max()) == 0.0
    assert ridge_in_gaps(0.01 * weights, 5.0).tolist() == pytest.approx([0.098] * 80)
    weights[30:70] = 1e-4
    ridge = ridge_in_gaps(weights, 5.0)
    assert float(ridge[:28].max()) == 0.0
    assert float(ridge[50]) > 1.0


def test_a_line_does_not_go_on_through_a_long_gap() -> None:
    """A person approaches for a second, then the range is unknown for two."""
    t = torch.arange(90, dtype=torch.float64) / 30
    coming = 5.0 - 1.5 * t.clamp(max=1.0)
    noise = 0.02 * torch.randn(90, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    smooth = robust_smooth(coming + noise, t < 1.0, 9.0, 0.03)
    assert float((smooth - coming)[:30].abs().max()) < 0.04
    # With the last slope it would be 1.5 m nearer one second later.
    assert float((smooth - coming)[60:].abs().max()) < 0.1


def test_outliers_do_not_bend_it() -> None:
    line = 4.0 + 0.05 * torch.arange(60, dtype=torch.float64)
    noisy = line + 0.02 * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noisy[[10, 11, 30, 31, 32, 50]] += 2.0
    everything = torch.ones(60, dtype=torch.bool)
    assert float((robust_smooth(noisy, everything, 6.0, 0.03) - line).abs().max()) < 0.05
    assert float((robust_smooth(noisy, everything, 6.0, 0.03, rounds=0) - line).abs().max()) > 0.3


def test_one_value_moves_the_result_by_less_than_itself() -> None:
    """Somebody bends down, with poor ranges, and then stands still for so long that the bend seems to be outliers."""
    generator = torch.Generator().manual_seed(0)
    frame = torch.arange(132, dtype=torch.float64)
    bends = (frame - 22).abs() < 10
    errors = torch.where(bends, 0.1, 0.002) * torch.randn(50, 132, generator=generator, dtype=torch.float64)
    track = 3.6 + 0.4 * torch.exp(-0.5 * ((frame - 22) / 5).square()) + errors
    moved = track.clone()
    moved[:, 19] += 0.02
    everything = torch.ones_like(track, dtype=torch.bool)
    change = robust_smooth(moved, everything, 5.4, 0.03) - robust_smooth(track, everything, 5.4, 0.03)
    assert float(change.abs().max()) < 0.02


def test_imprecise_values_count_little() -> None:
    """A quarter of the frames have the same error, which no robust weight detects; their precision reveals it."""
    line = 4.0 + 0.05 * torch.arange(60, dtype=torch.float64)
    bad = (torch.arange(60) >= 22) & (torch.arange(60) < 37)
    noisy = (
        line
        + 0.1 * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        + 0.6 * bad
    )
    everything = torch.ones(60, dtype=torch.bool)
    precision = torch.where(bad, 0.04, 1.0).double()
    assert float((robust_smooth(noisy, everything, 6.0, 0.03, precision=precision) - line).abs().max()) < 0.15
    assert float((robust_smooth(noisy, everything, 6.0, 0.03) - line).abs().max()) > 0.4
    same = robust_smooth(noisy, everything, 6.0, 0.03, precision=torch.ones(60, dtype=torch.float64))
    torch.testing.assert_close(same, robust_smooth(noisy, everything, 6.0, 0.03))


def test_single_frames_and_nothing_valid_are_finite() -> None:
    one = torch.tensor([[3.0]])
    torch.testing.assert_close(robust_smooth(one, torch.tensor([[True]]), 5.0, 0.03), one)
    assert bool(
        robust_smooth(torch.randn(2, 9), torch.zeros(2, 9, dtype=torch.bool), 3.0, 0.03).isfinite().all()
    )
    torch.testing.assert_close(running_quantile(one, 45, 0.2), one)


def test_running_quantile_is_numpys_nearest_rank() -> None:
    x = np.random.default_rng(0).standard_normal((2, 30))
    expected = np.empty_like(x)
    for t in range(30):
        inside = np.sort(x[:, max(t - 4, 0) : t + 5], axis=1)
        expected[:, t] = inside[:, round(0.3 * (inside.shape[1] - 1))]
    np.testing.assert_array_equal(running_quantile(torch.tensor(x), 9, 0.3).numpy(), expected)
    np.testing.assert_array_equal(running_quantile(torch.tensor(x), 200, 0.0)[:, 3].numpy(), x.min(axis=1))
    for shape in ((30,), (2, 1, 30), (1, 2, 1, 30)):
        several = torch.tensor(x[: int(np.prod(shape[:-1]))]).reshape(shape)
        found = running_quantile(several, 9, 0.3).reshape(-1, 30)
        np.testing.assert_array_equal(found.numpy(), expected[: len(found)])


def test_median_and_gaps_look_at_valid_frames_only() -> None:
    x = torch.tensor([[9.0, 1.0, 2.0, 7.0, 3.0], [1.0, 2.0, 3.0, 4.0, 5.0]])
    valid = torch.tensor([[False, True, True, False, True], [False] * 5])
    assert masked_median(x, valid).tolist() == [[2.0], [0.0]]
    assert fill_gaps(x, valid)[0].tolist() == [1.0, 1.0, 2.0, 2.0, 3.0]


def test_brief_gaps_lie_between_seen_frames() -> None:
    rows = ("..x.x...x..x.", ".............", "xxxxxxxxxxxxx")
    brief = ("...b.....bb..", ".............", ".............")
    seen = torch.tensor([[c == "x" for c in row] for row in rows])
    expected = torch.tensor([[c == "b" for c in row] for row in brief])
    assert torch.equal(brief_gaps(seen, 2), expected)
    assert not brief_gaps(seen, 0).any()


def test_a_gap_is_crossed_where_its_ends_are_near_enough() -> None:
    seen = torch.tensor([c == "x" for c in ".xx...x..xx.x."])
    # 4 m in four frames, 4 m in three, 1 m in two.
    places = [9.0, 0.0, 1.0, 9.0, 9.0, 9.0, 5.0, 9.0, 9.0, 9.0, 9.0, 0.0, 8.0, 9.0]
    position = torch.zeros(14, 2, dtype=torch.float64)
    position[:, 1] = torch.tensor(places)
    crossed = crossed_within(position, seen, 1.0)
    assert "".join("c" if c else "." for c in (crossed & ~seen).tolist()) == "...ccc.....c.."
    assert not crossed_within(position, torch.zeros_like(seen), 1.0).any()


def test_only_ratios_of_weights_count() -> None:
    x = torch.randn(30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = torch.linspace(0.1, 1.0, 30, dtype=torch.float64)
    expected = local_linear(x, weights, 2.0)
    torch.testing.assert_close(local_linear(x, 1e-7 * weights, 2.0), expected)
    assert torch.equal(local_linear(x, 0 * weights, 2.0), x), "where nothing counts the value stays"


def test_gaps_with_an_event() -> None:
    seen = torch.tensor([0, 1, 0, 0, 0, 1, 1, 0, 1, 0], dtype=torch.bool)
    event = torch.zeros_like(seen)
    assert not gaps_with(event, seen).any()
    event[[0, 3, 5, 9]] = (
        True  # before the first and after the last seen frame, and in a seen one, nothing counts
    )
    assert gaps_with(event, seen).nonzero()[:, 0].tolist() == [2, 3, 4]
    event[7] = True
    both = gaps_with(torch.stack([event, ~event]), seen.expand(2, -1))
    assert both[0].nonzero()[:, 0].tolist() == [2, 3, 4, 7]
    assert both[1].nonzero()[:, 0].tolist() == [2, 3, 4]
    assert not gaps_with(event, torch.zeros_like(seen)).any()


@pytest.mark.parametrize(("frames", "reach"), [(1, 3), (5, 3), (40, 0), (40, 4)])
def test_raised_slowly_is_a_mean_of_running_maxima(frames: int, reach: int) -> None:
    x = np.random.default_rng(0).random((2, 3, frames))
    window = np.arange(-reach, reach + 1)
    index = np.arange(frames)[:, None] + window
    inside = (index >= 0) & (index < frames)
    highest = np.where(inside, x[..., index.clip(0, frames - 1)], -np.inf).max(-1)
    expected = highest[..., index.clip(0, frames - 1)].mean(-1)
    found = raised_slowly(torch.from_numpy(x), reach)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)
    assert bool((found >= torch.from_numpy(x) - 1e-12).all())


def test_long_films_of_high_rates_are_smoothed_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three people for 25 s at 240 frames per second, smoothed over 1.5 s; torch copies every window."""
    x = torch.randn(3, 6000, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).cumsum(-1)
    weights = (x.cos() > 0).double()
    convolve, copies = torch.nn.functional.conv1d, []

    def noted(rows: Tensor, kernels: Tensor, **options: Any) -> Tensor:
        out = convolve(rows, kernels, **options)
        copies.append(out.numel() // kernels.shape[0] * kernels.shape[-1])
        return out

    monkeypatch.setattr(along_time.F, "conv1d", noted)
    smooth = local_linear(x, weights, 360.0)
    assert max(copies) <= 2**23 < 3 * 6000 * 2883
    monkeypatch.setattr(along_time, "_convolved", lambda w, k: convolve(w, k, padding=k.shape[-1] // 2))
    torch.testing.assert_close(smooth, local_linear(x, weights, 360.0), rtol=0, atol=1e-12)
