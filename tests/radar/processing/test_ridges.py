"""Ridges: the largest local maxima of each frame, and which of them belong together."""

import itertools

import numpy as np
import pytest
import torch

from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.ridges import PathRidgeExtractor, RidgeExtractor, best_path
from tests.stage import StageTester


def bumps(tracks, heights, bins=128, width=3.0):
    """A map (F, K) of Gaussian bumps around tracks (C, K) with heights (C, K)."""
    axis = np.arange(bins)[:, None, None]
    return torch.as_tensor((heights * np.exp(-(((axis - tracks) / width) ** 2))).sum(1), dtype=torch.float64)


class TestRidgeExtractor(StageTester):
    least_bins = 3

    def make(self):
        return RidgeExtractor(3)

    def inputs(self, batch, dtype):
        generator = torch.Generator().manual_seed(4)
        return (torch.rand(*batch, 32, 9, generator=generator).to(dtype),)

    def bad_inputs(self):
        x = self.inputs((), torch.float32)[0]
        hole = x.clone()
        hole[3, 2] = float("nan")
        return [
            ((x[: self.least_bins - 1],), f"at least {self.least_bins} bins"),
            ((x[:, :0],), "one frame"),
            ((x[0],), "map: got shape"),
            ((x.long(),), "map: got dtype"),
            ((hole,), "map: got NaN"),
        ]


def test_peaks_equal_scipy():
    from scipy.signal import find_peaks

    x = np.random.default_rng(0).random((64, 40))
    ridges = RidgeExtractor(4)(torch.as_tensor(x))
    for k in range(40):
        circle = np.concatenate((x[-1:, k], x[:, k], x[:1, k]))  # the Doppler axis closes on itself
        peaks = find_peaks(circle)[0] - 1
        expected = peaks[np.argsort(-x[peaks, k])][:4]
        assert sorted(ridges.indices[:, k].tolist()) == sorted(expected.tolist())
        np.testing.assert_array_equal(ridges.magnitudes[:, k], x[ridges.indices[:, k], k])


def test_crossing_strengths_do_not_swap_rows():
    """Two lines whose order of strength changes; rows follow the lines, not the strength."""
    k = np.arange(50)
    tracks = np.stack((30 + 0.2 * k, 80 - 0.3 * k, np.full(50, 110.0)))
    heights = np.stack((1 + 0.5 * np.sin(k), 1 + 0.5 * np.cos(2 * k), np.full(50, 0.3)))
    indices = RidgeExtractor(3)(bumps(tracks, heights)).indices.numpy()
    for row in indices:
        distance = np.abs(row[None] - tracks).max(1)
        assert distance.min() <= 1.0  # one track from first to last frame
    assert {int(np.abs(row[None] - tracks).max(1).argmin()) for row in indices} == {0, 1, 2}


def test_permutations_are_the_cheapest():
    x = torch.rand(48, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(7))
    for count in (1, 2, 4):
        indices = RidgeExtractor(count)(x).indices.numpy()
        for before, after in itertools.pairwise(indices.T):

            def cost(order, before=before, after=after):
                jump = np.abs(after[list(order)] - before)
                return np.minimum(jump, 48 - jump).sum()

            best = min(cost(order) for order in itertools.permutations(range(count)))
            assert cost(range(count)) == best


def test_long_clips_are_connected_in_pieces_that_fit_together():
    """Six ridges of 400 frames take several blocks; every frame continues the one before."""
    tracks = np.arange(10, 120, 20)[:, None] + np.zeros((1, 400), dtype=int)
    heights = np.random.default_rng(0).uniform(0.5, 1.0, tracks.shape)
    indices = RidgeExtractor(6)(bumps(tracks, heights)).indices
    assert torch.equal(indices, indices[:, :1].expand(-1, 400))


def test_rows_start_in_the_order_of_strength():
    k = np.arange(5)
    tracks = np.stack((20 + 0 * k, 60 + 0 * k, 100 + 0 * k))
    heights = np.stack((0.5 + 0 * k, 1.0 + 0 * k, 0.7 + 0 * k))
    assert RidgeExtractor(3)(bumps(tracks, heights)).indices[:, 0].tolist() == [60, 100, 20]


def test_too_few_maxima_repeat_the_largest():
    k = np.arange(6)
    x = bumps(np.stack((40 + k,)), np.ones((1, 6)))
    ridges = RidgeExtractor(3)(x)
    assert torch.equal(ridges.indices, torch.as_tensor(np.stack([40 + k] * 3)))
    assert torch.equal(RidgeExtractor(2)(torch.zeros(16, 4)).indices, torch.full((2, 4), 8))  # zero Doppler
    assert torch.equal(RidgeExtractor(2)(torch.ones(16, 4)).magnitudes, torch.ones(2, 4))


def test_axis_is_a_circle_and_plateaus_count_once():
    x = torch.zeros(16, 1)
    x[0], x[15], x[7], x[8] = 3.0, 2.0, 1.0, 1.0
    assert RidgeExtractor(2)(x).indices.flatten().tolist() == [0, 7]


@pytest.mark.parametrize("count", [0, 7, -1])
def test_bad_count(count):
    with pytest.raises(TensorsimError, match=f"count: got {count}"):
        RidgeExtractor(count)


class TestPathRidgeExtractor(TestRidgeExtractor):
    least_bins = 11

    def make(self):
        return PathRidgeExtractor(2, max_jump=5, band=3)


def test_best_path_equals_trying_all():
    gain = torch.rand(3, 6, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(5)) * 4
    jumps = torch.tensor([0, -1, 1, -2, 2])
    cost = 0.7 * jumps.double().square()
    actual = best_path(gain, jumps, cost)
    for b in range(3):
        best, worth = None, -np.inf
        for path in itertools.product(range(6), repeat=5):
            steps = [min((b - a) % 6, (a - b) % 6) for a, b in itertools.pairwise(path)]
            if max(steps) > 2:
                continue
            value = sum(float(gain[b, f, k]) for k, f in enumerate(path)) - 0.7 * sum(s * s for s in steps)
            if value > worth:
                best, worth = path, value
        assert actual[b].tolist() == list(best)


def faded(frames=60):
    """A strong slow line with a gap, a weaker one that crosses it later, and speckle 25 dB down everywhere."""
    k = np.arange(frames)
    tracks = np.stack((50 + 8 * np.sin(k / 12), 1.0 * k))
    heights = np.stack((np.where((k > 20) & (k < 32), 0.0, 1.0), np.full(frames, 0.3)))
    speckle = 0.1 * np.random.default_rng(0).rayleigh(0.5, (128, frames))
    return bumps(tracks, heights) + torch.as_tensor(speckle), tracks


def test_path_bridges_a_gap_and_holds_through_a_crossing():
    maps, tracks = faded()
    paths = PathRidgeExtractor(2, penalty_db=2.0, floor_db=30.0)(maps).indices.numpy()
    error = np.abs(paths[0] - tracks[0])
    assert error.max() <= 4  # also in the gap, where there is nothing but the crossing line and speckle
    assert np.median(error) <= 1
    assert (
        np.abs(paths[1] - tracks[1]) <= 3
    ).mean() > 0.85  # the band of the first covers it where they cross
    maxima = RidgeExtractor(2)(maps).indices.numpy()
    assert np.abs(maxima - tracks[0]).max(1).min() > 15  # no row of connected maxima keeps to the line


def test_paths_come_in_the_order_of_what_they_earn():
    k = np.arange(20)
    tracks = np.stack((20 + 0 * k, 60 + 0 * k, 100 + 0 * k))
    x = bumps(tracks, np.stack((0.5 + 0 * k, 1.0 + 0 * k, 0.7 + 0 * k)))
    ridges = PathRidgeExtractor(3)(x)
    assert ridges.indices[:, 7].tolist() == [60, 100, 20]
    np.testing.assert_allclose(ridges.magnitudes[:, 7], [1.0, 0.7, 0.5])


def test_path_goes_around_the_circle_of_doppler():
    k = np.arange(30)
    x = torch.zeros(64, 30)
    x[(50 + k) % 64, k] = 1.0  # aliases from the top to the bottom
    assert PathRidgeExtractor(1)(x).indices[0].tolist() == ((50 + k) % 64).tolist()


def test_dear_jumps_make_straight_paths():
    maps, _ = faded()
    loose, stiff = (PathRidgeExtractor(1, penalty_db=p)(maps).indices[0] for p in (0.01, 1e4))
    assert int(loose.diff().abs().max()) > int(stiff.diff().abs().max()) == 0


def test_path_in_silence_stays_put():
    ridges = PathRidgeExtractor(2)(torch.zeros(64, 5))
    assert int(ridges.indices.diff(dim=-1).abs().max()) == 0
    assert float(ridges.magnitudes.abs().max()) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "count: got 0, expected an integer from 1 to"),
        ({"max_jump": 0}, "max_jump: got 0"),
        ({"band": -1}, "band: got -1"),
        ({"penalty_db": 0.0}, "penalty_db: got 0.0"),
        ({"floor_db": float("nan")}, "floor_db: got nan"),
    ],
)
def test_bad_path_settings(arguments, message):
    with pytest.raises(TensorsimError, match=message):
        PathRidgeExtractor(**arguments)
