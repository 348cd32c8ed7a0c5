"""Range-correlated phase noise against 4 sin^2(pi f tau) L(f), and numbers drawn by their place."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.synthesis.counter_noise import normal, uniform
from tensorsim.radar.synthesis.phase_noise import PhaseNoise, interpolated_level
from tests.stage import StageTester, assert_same

RADAR = RadarConfig()


def beat(bin_number: float, pulses: int) -> Tensor:
    """IF (M, 400) complex128 of a path whose beat is at a bin, not necessarily whole."""
    phase = 2 * np.pi * bin_number * torch.arange(400, dtype=torch.float64) / 400
    return torch.polar(torch.ones_like(phase), phase).expand(pulses, 400)


class TestPhaseNoise(StageTester):
    def make(self) -> nn.Module:
        return PhaseNoise(RadarConfig(chirp_s=1.6e-6))

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(3)
        x = torch.randn(*batch, 6, 16, dtype=torch.complex128, generator=generator)
        return (x if dtype == torch.float64 else x.to(torch.complex64),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        x = self.inputs((), torch.float32)[0]
        return [
            ((x.real,), "IF: got dtype"),
            ((x[..., :8],), r"IF: got shape \[6, 8\], expected .*16 samples"),
            ((x[:0],), "IF: got shape"),
        ]


@pytest.mark.parametrize("bin_number", [2.67, 10.0, 60.5, 150.3])
def test_density_in_closed_form(bin_number: float) -> None:
    """White phase noise of -100 dBc/Hz, seen through a Hamming window at several offsets from the beat."""
    window = torch.hamming_window(400, periodic=False, dtype=torch.float64)
    clean = beat(bin_number, 3000)
    noise = PhaseNoise(RADAR, (1e4, 1e7), (-100.0, -100.0))(clean) - clean
    density = (
        torch.fft.fft(noise * window).abs().square().mean(0) / window.square().sum() / RADAR.sample_rate_hz
    )
    delay = bin_number * 25e3 / RADAR.slope_hz_per_s
    for k in (20, 40, 80, 120, 180):
        if abs(k - bin_number) > 5:
            expected = 1e-10 * 4 * np.sin(np.pi * (k - bin_number) * 25e3 * delay) ** 2
            assert 10 * np.log10(float(density[k - 1 : k + 2].mean()) / expected) == pytest.approx(0, abs=0.4)


def test_level_between_offsets() -> None:
    offsets, levels = torch.tensor([1e4, 1e6]).double(), torch.tensor([-70.0, -100.0]).double()
    found = interpolated_level(torch.tensor([1.0, 1e4, 1e5, 1e6, 1e8]).double(), offsets, levels)
    np.testing.assert_allclose(found.numpy(), [-70, -70, -85, -100, -100], atol=1e-9)


def test_slope_of_the_level_is_seen() -> None:
    """-20 dB per decade of L cancels the square of the frequency in 4 sin^2: noise is white about the beat."""
    clean = beat(30.0, 4000)
    noise = PhaseNoise(RADAR, (1e4, 1e8), (-80.0, -160.0))(clean) - clean
    density = torch.fft.fft(noise).abs().square().mean(0)
    near, far = float(density[38:48].mean()), float(density[150:190].mean())
    assert 10 * np.log10(near / far) == pytest.approx(0, abs=0.3)


def test_delay_zero_has_no_noise() -> None:
    clean = beat(0.0, 50)
    assert_same(PhaseNoise(RADAR, level_dbc_hz=(-40.0,) * 4)(clean), clean, atol=1e-9)


def test_pieces_join() -> None:
    clean, module = beat(60.0, 40), PhaseNoise(RADAR)
    whole = module(clean)
    pieces = [module(clean[a:b], a) for a, b in ((0, 1), (1, 25), (25, 40))]
    assert torch.equal(torch.cat(pieces), whole)
    assert not torch.equal(PhaseNoise(RADAR, seed=1)(clean), whole)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"offsets_hz": (1e5, 1e4, 1e6, 1e7)}, "offsets_hz: got"),
        ({"offsets_hz": (0.0, 1e4, 1e6, 1e7)}, "offsets_hz: got"),
        ({"level_dbc_hz": (-80.0,)}, "level_dbc_hz: got .* expected 4"),
    ],
)
def test_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        PhaseNoise(RADAR, **options)


# ---- numbers by their place ------------------------------------------------------------------------------


def test_uniform_numbers() -> None:
    from scipy.stats import kstest

    numbers = uniform(0, torch.arange(2000), 50).numpy()
    assert kstest(numbers.ravel(), "uniform").pvalue > 1e-3
    assert len(np.unique(numbers)) == numbers.size
    for a, b in ((numbers[1:], numbers[:-1]), (numbers[:, 1:], numbers[:, :-1])):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.015
    other = uniform(1, torch.arange(2000), 50).numpy()
    assert abs(np.corrcoef(numbers.ravel(), other.ravel())[0, 1]) < 0.015


def test_normal_numbers() -> None:
    from scipy.stats import kstest

    numbers = normal(3, torch.arange(1500), 41).numpy()
    assert numbers.shape == (1500, 41)
    assert kstest(numbers.ravel(), "norm").pvalue > 1e-3
    assert np.abs(np.corrcoef(numbers.T) - np.eye(41)).max() < 0.13


def test_numbers_belong_to_their_pulse() -> None:
    assert torch.equal(normal(0, torch.arange(7, 12), 5), normal(0, torch.arange(20), 5)[7:12])


def test_offsets_below_one_hertz_are_offsets() -> None:
    assert PhaseNoise(RADAR, (0.5, 1e6), (-60.0, -100.0))(beat(10.0, 2)).isfinite().all()
