"""Laws that hold for every scene: each is tried on scenes that hypothesis makes up."""

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings

from tensorsim.config import WallConfig
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.radar.scenes import SMALL, swinging

few = settings(max_examples=8, deadline=None, derandomize=True)
seeds = st.integers(0, 2**31)
counts = st.integers(1, 6)
WALL = WallConfig(center_m=(0.0, 0.12, 1.5))
RANGE_PROFILE = RangeProfile(SMALL).double()
DOPPLER = DopplerTimeMap(SMALL).double()


def scene(seed, scatterers, pulses=40, speed_m_s=-0.6):
    """Positions (M, S, 3) and RCS (S,), both float64."""
    positions = swinging(pulses, scatterers, SMALL.prf_hz, 2.0, speed_m_s, seed)
    rcs = np.random.default_rng(seed + 1).uniform(0.05, 1.0, scatterers)
    return torch.from_numpy(positions), torch.from_numpy(rcs)


def echo(radar=SMALL, wall=None):
    return EchoSynthesizer(radar, wall, multipath=wall is not None).double()


def profiles(positions, rcs):
    return RANGE_PROFILE(echo()(positions, rcs))


def assert_close(actual, expected, relative=1e-11):
    scale = float(expected.abs().max())
    assert scale > 0
    torch.testing.assert_close(actual, expected, rtol=0.0, atol=relative * scale)


@few
@given(seed=seeds, scatterers=counts, doublings=st.integers(-6, 6), wall=st.sampled_from([None, WALL]))
def test_amplitude_is_the_root_of_the_cross_section(seed, scatterers, doublings, wall):
    positions, rcs = scene(seed, scatterers)
    synthesizer = echo(wall=wall)
    # Powers of two scale floating point numbers without rounding, so linear means equal here.
    assert torch.equal(
        synthesizer(positions, rcs * 4.0**doublings), synthesizer(positions, rcs) * 2.0**doublings
    )


@few
@given(seed=seeds, scatterers=st.integers(2, 6), split=st.integers(1, 5), wall=st.sampled_from([None, WALL]))
def test_echoes_superpose(seed, scatterers, split, wall):
    positions, rcs = scene(seed, scatterers)
    synthesizer, split = echo(wall=wall), min(split, scatterers - 1)
    apart = synthesizer(positions[:, :split], rcs[:split]) + synthesizer(positions[:, split:], rcs[split:])
    assert_close(synthesizer(positions, rcs), apart)


@few
@given(seed=seeds, scatterers=st.integers(2, 6), wall=st.sampled_from([None, WALL]))
def test_order_of_scatterers_does_not_matter(seed, scatterers, wall):
    positions, rcs = scene(seed, scatterers)
    order = torch.randperm(scatterers, generator=torch.Generator().manual_seed(seed))
    synthesizer = echo(wall=wall)
    assert_close(synthesizer(positions[:, order], rcs[order]), synthesizer(positions, rcs))


@few
@given(seed=seeds, scatterers=counts)
def test_transmitter_and_receiver_are_exchangeable(seed, scatterers):
    positions, rcs = scene(seed, scatterers)
    exchanged = replace(SMALL, tx_m=SMALL.rx_m, rx_m=SMALL.tx_m)
    assert_close(echo(exchanged)(positions, rcs), echo()(positions, rcs))


@few
@given(seed=seeds, scatterers=counts, offset=st.tuples(*[st.floats(-5, 5)] * 3))
def test_only_differences_of_places_matter(seed, scatterers, offset):
    positions, rcs = scene(seed, scatterers)
    moved = replace(
        SMALL,
        tx_m=tuple(a + b for a, b in zip(SMALL.tx_m, offset, strict=True)),
        rx_m=tuple(a + b for a, b in zip(SMALL.rx_m, offset, strict=True)),
    )
    shifted = positions + torch.tensor(offset, dtype=torch.float64)
    assert_close(echo(moved)(shifted, rcs), echo()(positions, rcs))


@few
@given(seed=seeds, factor=st.floats(1.1, 4.0))
def test_power_falls_with_the_fourth_power_of_range(seed, factor):
    positions, rcs = scene(seed, 1)
    positions = positions + torch.tensor([0.0, 1.0, 0.0])  # clear of the antenna
    radar = replace(SMALL, tx_m=(0.0, 0.0, 0.0), rx_m=(0.0, 0.0, 0.0))
    near, far = (echo(radar)(k * positions, rcs).abs().square() for k in (1.0, factor))
    torch.testing.assert_close(far, near / factor**4, rtol=1e-9, atol=0.0)
    doubled = echo(radar)(2 * positions, rcs).abs().square()
    torch.testing.assert_close(doubled, near / 16, rtol=1e-9, atol=0.0)


@few
@given(seed=seeds, scatterers=counts, frames=st.integers(1, 5))
def test_time_shift_is_frame_shift(seed, scatterers, frames):
    positions, rcs = scene(seed, scatterers, DOPPLER.length + 9 * DOPPLER.hop)
    whole = DOPPLER(profiles(positions, rcs))
    later = DOPPLER(profiles(positions[frames * DOPPLER.hop :], rcs))
    assert_close(later, whole[:, frames:])


@few
@given(seed=seeds, scatterers=counts, frames=st.integers(1, 8))
def test_time_reversal_mirrors_the_doppler_map(seed, scatterers, frames):
    # A periodic Hann window is symmetric about its sample L / 2, hence one pulse more.
    positions, rcs = scene(seed, scatterers, DOPPLER.length + 1 + (frames - 1) * DOPPLER.hop)
    forwards, backwards = DOPPLER(profiles(positions, rcs)), DOPPLER(profiles(positions.flip(0), rcs))
    mirrored = backwards.flip(1)
    # The bin at -PRF / 2 comes first and has no partner; 0 Hz stays where it is.
    assert_close(mirrored[1:].flip(0), forwards[1:], 1e-10)
    assert_close(mirrored[0], forwards[0], 1e-10)


@few
@given(speed=st.floats(0.3, 3.0), distance=st.floats(1.6, 2.4))
def test_mirrored_radial_motion_flips_the_sign_of_doppler(speed, distance):
    t = (torch.arange(DOPPLER.length).double() - (DOPPLER.length - 1) / 2) / SMALL.prf_hz
    peaks = []
    for velocity in (-speed, speed):
        positions = torch.stack((0 * t, distance + velocity * t, 1.5 + 0 * t), -1).unsqueeze(1)
        column = DOPPLER(profiles(positions, torch.ones(1).double()))[:, 0]
        peaks.append(float(DOPPLER.doppler_hz[column.argmax()]))
    approaching, receding = peaks
    assert approaching > 0
    assert receding == pytest.approx(-approaching, abs=float(DOPPLER.doppler_hz.diff()[0]))


@few
@given(seed=seeds, scatterers=counts, window=st.sampled_from([None, "hamming", "hann", "blackman"]))
def test_range_transform_keeps_energy(seed, scatterers, window):
    positions, rcs = scene(seed, scatterers, 5)
    samples, profile = echo()(positions, rcs), RangeProfile(SMALL, window).double()
    alternating = 1 - 2 * (torch.arange(samples.shape[-1]) % 2)  # brings the upper half of the bins down
    energy = profile(samples).abs().square().sum() + profile(samples * alternating).abs().square().sum()
    expected = samples.shape[-1] * (samples * profile.window).abs().square().sum()
    torch.testing.assert_close(energy, expected, rtol=1e-12, atol=0.0)


@few
@given(seed=seeds, scatterers=counts)
def test_doppler_map_keeps_energy(seed, scatterers):
    positions, rcs = scene(seed, scatterers, DOPPLER.length + 3 * DOPPLER.hop)
    ranges = profiles(positions, rcs)
    energy = DOPPLER(ranges).square().sum(0)
    hann = 0.5 - 0.5 * torch.cos(2 * torch.pi * torch.arange(DOPPLER.length).double() / DOPPLER.length)
    for frame in range(4):
        piece = ranges[frame * DOPPLER.hop :][: DOPPLER.length]
        expected = DOPPLER.bins * (piece * hann.unsqueeze(-1)).abs().square().sum()
        torch.testing.assert_close(energy[frame], expected, rtol=1e-11, atol=0.0)


@few
@given(seed=seeds, scatterers=counts, doublings=st.integers(-4, 4))
def test_simulator_is_homogeneous(seed, scatterers, doublings):
    positions, rcs = scene(seed, scatterers)
    simulator = RadarSimulator(SMALL, snr_db=None).double()
    once, scaled = simulator(positions, rcs), simulator(positions, rcs * 4.0**doublings)
    for name in ("range_time", "range_time_mti", "doppler_time", "ridge_magnitudes"):
        assert_close(getattr(scaled, name), getattr(once, name) * 2.0**doublings, 1e-12)
    assert torch.equal(scaled.ridges, once.ridges)
