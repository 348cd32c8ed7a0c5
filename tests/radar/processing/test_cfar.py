"""CFAR detection against a loop over cells in NumPy, and its rate of false alarms."""

import math

import numpy as np
import pytest
import torch

from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.cfar import (
    CfarDetector,
    cell_averaging_factor,
    ordered_statistic_factor,
)
from tests.stage import StageTester


def exponential(*shape, seed=0, dtype=torch.float64):
    return torch.empty(shape, dtype=torch.float64).exponential_(
        generator=torch.Generator().manual_seed(seed)
    ).to(dtype)  # fmt: skip


def reference(power, guard, training, factor, rank=None, modes=("wrap", "reflect")):
    """Thresholds cell by cell."""
    reach = (guard[0] + training[0], guard[1] + training[1])
    padded = np.pad(power, ((reach[0],) * 2, (0, 0)), mode=modes[0])
    padded = np.pad(padded, ((0, 0), (reach[1],) * 2), mode=modes[1])
    out = np.empty_like(power)
    for i in range(power.shape[0]):
        for j in range(power.shape[1]):
            block = padded[i : i + 2 * reach[0] + 1, j : j + 2 * reach[1] + 1].copy()
            block[
                reach[0] - guard[0] : reach[0] + guard[0] + 1, reach[1] - guard[1] : reach[1] + guard[1] + 1
            ] = np.nan
            cells = np.sort(block[~np.isnan(block)])
            out[i, j] = factor * (cells.mean() if rank is None else cells[rank - 1])
    return out


class TestCfarDetector(StageTester):
    gradient_arguments = ()  # a detection has no gradient; the threshold has, below

    def make(self):
        return CfarDetector((1, 0), (3, 2), false_alarm=0.05)

    def inputs(self, batch, dtype):
        return (exponential(*batch, 12, 9, dtype=dtype),)

    def bad_inputs(self):
        x = exponential(12, 9)
        return [
            ((x[0],), "power: got shape"),
            ((x.expand(0, 12, 9),), "power: got an empty tensor"),
            ((x[:4],), r"power: got shape \[4, 9\], expected more than the 4 x 2"),
            ((-x,), "power: got a minimum of"),
            ((x * float("nan"),), "power: got NaN"),
            ((x.long(),), "power: got dtype"),
        ]


class TestOrderedStatistic(TestCfarDetector):
    def make(self):
        return CfarDetector((1, 0), (3, 2), false_alarm=0.05, method="ordered-statistic", rank=0.6)


@pytest.mark.parametrize("method", ["cell-averaging", "ordered-statistic"])
def test_thresholds_equal_a_loop_over_cells(method):
    guard, training = (2, 1), (3, 2)
    power = exponential(20, 11, seed=3)
    stage = CfarDetector(guard, training, 0.01, method, rank=0.7)
    cells = 11 * 7 - 5 * 3
    assert stage.cells == cells
    rank = round(0.7 * cells) if method == "ordered-statistic" else None
    factor = (
        cells * (0.01 ** (-1 / cells) - 1)
        if rank is None
        else ordered_statistic_factor(0.01, cells, round(0.7 * cells))
    )
    expected = reference(power.numpy(), guard, training, factor, rank)
    np.testing.assert_allclose(stage.threshold(power).numpy(), expected, rtol=1e-12)
    assert torch.equal(stage(power), power > torch.from_numpy(expected))


def test_edges_wrap_or_reflect_as_asked():
    power = exponential(9, 10, seed=4)
    stage = CfarDetector((0, 1), (1, 3), 0.1, edges=("reflect", "circular"))
    expected = reference(power.numpy(), (0, 1), (1, 3), stage.factor, modes=("reflect", "wrap"))
    np.testing.assert_allclose(stage.threshold(power).numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("method", "looks"), [("cell-averaging", 1), ("cell-averaging", 8), ("ordered-statistic", 1)]
)
@pytest.mark.parametrize("false_alarm", [0.1, 0.01])
def test_false_alarms_in_noise_come_at_the_rate_asked_for(method, looks, false_alarm):
    noise = exponential(8, looks, 256, 128, seed=1).mean(1)
    stage = CfarDetector((1, 1), (2, 2), false_alarm, method, edges=("circular", "circular"), looks=looks)
    rate = float(stage(noise).double().mean())
    # Neighbours share reference cells: the deviation is a few times that of independent cells.
    assert rate == pytest.approx(
        false_alarm, abs=5 * math.sqrt(false_alarm / noise.numel()) + 0.02 * false_alarm
    )


def test_factors_have_their_closed_forms():
    # One reference cell: P = 1 / (1 + a) for both.
    assert cell_averaging_factor(0.2, 1) == pytest.approx(4.0)
    assert ordered_statistic_factor(0.2, 1, 1) == pytest.approx(4.0)
    # Of two looks x = a / (N + a) has P = (1 - x)^(2 N) (1 + 2 N x).
    x = cell_averaging_factor(0.01, 16, 2) / (16 + cell_averaging_factor(0.01, 16, 2))
    assert (1 - x) ** 32 * (1 + 32 * x) == pytest.approx(0.01)
    # The smallest of N: P = N / (N + a).
    assert ordered_statistic_factor(0.01, 16, 1) == pytest.approx(16 * 99)


def test_a_target_is_found_and_does_not_mask_itself():
    power = exponential(40, 30, seed=2)
    power[20, 15] = 200.0
    assert bool(CfarDetector((1, 1), (6, 6), 1e-6)(power)[20, 15])
    threshold = CfarDetector((1, 1), (6, 6), 1e-6).threshold(power)
    assert float(threshold[20, 15]) == pytest.approx(13.8 * 1.0, rel=0.25)


def test_the_threshold_is_differentiable():
    power = exponential(1, 8, 7).requires_grad_(True)
    assert torch.autograd.gradcheck(CfarDetector((0, 0), (2, 1), 0.1).double().threshold, (power,))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"guard": (-1, 0), "training": (1, 1)}, "guard: got -1"),
        ({"guard": 1, "training": (1, 1)}, "guard: got 1, expected cells along both axes"),
        ({"guard": (1, 1), "training": (1, 1, 1)}, "training: got .*, expected cells along both axes"),
        ({"guard": (0, 0), "training": (1, 1), "false_alarm": "low"}, "false_alarm low"),
        ({"guard": (1, 1), "training": (0, 0)}, "at least one training cell"),
        ({"guard": (0, 0), "training": (1, 1), "false_alarm": 1.0}, "false_alarm 1.0"),
        ({"guard": (0, 0), "training": (1, 1), "false_alarm": 0.0}, "false_alarm 0.0"),
        ({"guard": (0, 0), "training": (1, 1), "rank": 1.0}, "rank 1.0, expected both between 0 and 1"),
        ({"guard": (0, 0), "training": (1, 1), "rank": 0.0}, "rank 0.0, expected both between 0 and 1"),
        ({"guard": (0, 0), "training": (1, 1), "method": "greatest-of"}, "greatest-of"),
        ({"guard": (0, 0), "training": (1, 1), "edges": ("zero", "reflect")}, "edges"),
        ({"guard": (0, 0), "training": (1, 1), "looks": 0}, "looks: got 0"),
        (
            {"guard": (0, 0), "training": (1, 1), "looks": 2, "method": "ordered-statistic"},
            "looks: got 2 with the method 'ordered-statistic', expected 1",
        ),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(TensorsimError, match=message):
        CfarDetector(**settings)
