"""A room before a sensor that shakes: what the canceller leaves, against its closed form."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.clutter import RoomClutter, vibration_spectrum
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.stage import StageTester, assert_same


class TestRoomClutter(StageTester):
    gradient_atol = 1e-4

    def make(self) -> nn.Module:
        return RoomClutter(count=3, jitter_m=1e-3)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return ((torch.arange(6, dtype=torch.float64) / 128).expand(*batch, 6).to(dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [((torch.arange(6),), "time_s: got dtype"), ((torch.tensor(1.0),), "time_s: got shape")]


def one_reflector(jitter_m: float) -> RoomClutter:
    """Straight ahead at 3 m."""
    return RoomClutter(1, (0.0, 0.0), (3.0, 3.0), (1.0, 1.0), (1.0, 1.0), jitter_m)


@pytest.mark.parametrize("carrier_hz", [5.8e9, 24e9])
def test_residue_after_the_canceller(carrier_hz: float) -> None:
    """(4 pi / lambda)^2 sum_k a_k^2 (1 - cos(2 pi f_k / PRF)) of the power of a static reflector."""
    radar = RadarConfig(
        carrier_hz=carrier_hz,
        bandwidth_hz=1e6,
        chirp_s=4e-6,
        sample_rate_hz=1e6,
        prf_hz=200.0,
        tx_m=(0.0, 0.0, 1.0),
        rx_m=(0.0, 0.0, 1.0),
    )
    room = one_reflector(10e-6)
    scene = room(torch.arange(12000, dtype=torch.float64) / 200.0)
    profiles = RangeProfile(radar)(EchoSynthesizer(radar)(*scene)).to(torch.complex128)[:, :1]
    left = MovingTargetIndicator("two-pulse")(profiles).abs().square().mean()
    share = float(left / profiles.abs().square().mean())
    frequency, amplitude = room.vibration.frequency_hz[1], room.vibration.amplitude  # along y
    moved = (amplitude.square() * (1 - torch.cos(2 * np.pi * frequency / 200.0))).sum()
    expected = (4 * np.pi / radar.doppler_wavelength_m) ** 2 * float(moved)
    assert 10 * np.log10(share / expected) == pytest.approx(0, abs=0.5)


def test_a_still_sensor_leaves_nothing() -> None:
    positions, rcs = one_reflector(0.0)(torch.arange(50, dtype=torch.float64) / 100)
    assert torch.equal(positions, positions[:1].expand_as(positions))
    assert torch.equal(rcs, torch.ones_like(rcs))


def test_spectrum_of_vibration() -> None:
    """An octave costs 6 dB, and the rms along each axis is as asked."""
    from scipy.signal import welch

    room = RoomClutter(1, jitter_m=10e-6)
    time = torch.arange(2**16, dtype=torch.float64) / 256
    place = room(time)[0][:, 0]
    np.testing.assert_allclose(place.std(0).numpy(), 10e-6, rtol=0.1)
    density = np.mean([welch(place[:, i].numpy(), 256, nperseg=2048)[1] for i in range(3)], axis=0)
    hz = np.arange(len(density)) / 8

    def level(low: float) -> float:
        return float(10 * np.log10(density[(hz >= low) & (hz < 2 * low)].mean()))

    assert level(4.0) - level(16.0) == pytest.approx(12.0, abs=2.5)
    assert float(vibration_spectrum(torch.tensor(4.0)) / vibration_spectrum(torch.tensor(8.0))) == 4


def test_the_room_and_its_pieces() -> None:
    room, time = RoomClutter(40, seed=2), torch.arange(60, dtype=torch.float64) / 100
    positions, rcs = room(time)
    low, high = positions[0].amin(0), positions[0].amax(0)
    assert bool((low > torch.tensor([-2.6, 0.9, -0.1])).all())
    assert bool((high < torch.tensor([2.6, 7.1, 2.6])).all())
    assert 0.1 <= float(rcs.min()) < 0.3
    assert 3 < float(rcs.max()) <= 10
    assert_same(
        torch.cat([room(time[a:b])[0] for a, b in ((0, 1), (1, 25), (25, 60))]), positions, atol=1e-12
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count: got 0"),
        ({"y_m": (5.0, 1.0)}, "y_m: got"),
        ({"rcs_m2": (0.0, 1.0)}, "rcs_m2: got"),
        ({"jitter_m": -1.0}, "rms: got -1.0"),
    ],
)
def test_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        RoomClutter(**options)
