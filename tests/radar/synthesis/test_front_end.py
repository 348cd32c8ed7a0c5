"""Receivers, rooms and other radars as options of a scene: each effect in the maps, against its closed form."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tensorsim.config import (
    ClutterConfig,
    InterferenceConfig,
    ProcessingConfig,
    RadarConfig,
    ReceiverConfig,
    SceneConfig,
    SimulationConfig,
)
from tensorsim.errors import TensorsimError
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.front_end import interfering_radar, oscillator
from tensorsim.radar.synthesis.interference import Interference
from tests.radar.scenes import SMALL, SceneCase, swinging, tensors
from tests.radar.test_simulator import TestRadarSimulator as SimulatorCase
from tests.stage import assert_same

CW = PRESETS["cw-24ghz"].radar
WINDOW = np.hanning(400)


def maps_of(radar: RadarConfig, positions: Tensor, receiver: ReceiverConfig, **scene: Any) -> Any:
    """Maps of scatterers of 1 m^2, free of noise unless ``scene`` says otherwise.

    The Hann window's side lobes are far below the floors that are measured here.
    """
    whole = SceneConfig(radar, **{"snr_db": None, "receiver": receiver} | scene)
    simulator = RadarSimulator(whole, processing=ProcessingConfig(range_window="hann"))
    return simulator(positions, torch.ones(positions.shape[-2]))


def mover(radar: RadarConfig, pulses: int, speed_m_s: float, range_m: float = 3.0) -> Tensor:
    """One point (M, 1, 3) in front of the radar."""
    t = torch.arange(pulses, dtype=torch.float64) / radar.prf_hz
    return torch.stack((0 * t, range_m + speed_m_s * t, 0 * t + 1.5), -1)[:, None]


class TestSimulatorWithReceiver(SimulatorCase):
    """Everything but the converter, whose steps finite differences would see."""

    float32_atol = 1e-3

    def make(self) -> RadarSimulator:
        receiver = ReceiverConfig(-93.0, 0.5, 0.02, 0.0)
        scene = SceneConfig(
            SMALL,
            clutter=ClutterConfig(3),
            interference=InterferenceConfig(),
            receiver=receiver,
            snr_db=None,
        )
        return RadarSimulator(scene, processing=ProcessingConfig(pulse_chunk=8))

    def bad_inputs(self) -> Any:
        return SceneCase.bad_inputs(self)

    @pytest.mark.slow  # compiles the whole simulator once more
    def test_scripted_equals_eager(self) -> None:
        super().test_scripted_equals_eager()

    def test_gradients_against_finite_differences(self) -> None:
        super(SimulatorCase, self).test_gradients_against_finite_differences()


@pytest.mark.parametrize(("gain_db", "degrees"), [(1.0, 0.0), (0.0, 6.0), (0.5, -4.0)])
def test_image_of_unequal_channels(gain_db: float, degrees: float) -> None:
    """An approaching target is seen receding as well, at the image rejection of the two channels."""
    receiver = ReceiverConfig(iq_imbalance_db=gain_db, iq_phase_rad=math.radians(degrees))
    power = maps_of(CW, mover(CW, 2048, -2.0), receiver).doppler_time.square().mean(-1)
    peak, zero = int(power.argmax()), len(power) // 2
    assert (peak - zero) * CW.prf_hz / len(power) == pytest.approx(2 * 2.0 / CW.doppler_wavelength_m, abs=10)
    g, phi = 10 ** (gain_db / 20), math.radians(degrees)
    ratio = (1 + 2 * g * math.cos(phi) + g * g) / (1 - 2 * g * math.cos(phi) + g * g)
    assert float(power[peak] / power[2 * zero - peak]) == pytest.approx(ratio, rel=0.05)


def test_real_receivers_have_mirror_symmetric_spectra() -> None:
    power = maps_of(CW, mover(CW, 2048, -2.0), ReceiverConfig(real=True)).doppler_time.square().mean(-1)
    both = maps_of(CW, mover(CW, 2048, -2.0), ReceiverConfig()).doppler_time.square().mean(-1)
    zero = len(power) // 2
    torch.testing.assert_close(
        power[zero + 1 :], power[1:zero].flip(0), rtol=0.05, atol=1e-3 * float(power.max())
    )
    assert float(power.max() / both.max()) == pytest.approx(0.25, rel=0.02)
    assert float(both[2 * zero - int(both.argmax())] / both.max()) < 1e-4


def test_real_receivers_have_the_noise_of_the_image_in_their_range_bins() -> None:
    """The ratio of samples is that asked for, that of range bins 3 dB below a receiver of two channels."""
    radar = RadarConfig.free_space()
    p = mover(radar, 900, 0.0, 80.5 * radar.range_resolution_m)
    found = []
    for receiver in (ReceiverConfig(adc_bits=24), ReceiverConfig(adc_bits=24, real=True)):
        torch.manual_seed(0)
        maps = maps_of(radar, p, receiver, snr_db=0.0)
        assert float(maps.snr_db) == pytest.approx(0.0, abs=0.05)
        power = maps.range_time.square().mean(1)
        found.append(float(power[78:84].max() / power[120:190].mean()))
    assert 10 * math.log10(found[1] / found[0]) == pytest.approx(-3.01, abs=0.3)


@pytest.mark.parametrize("bits", [1, 4, 8])
def test_converters_of_real_receivers_leave_the_missing_channel_out(bits: int) -> None:
    """The profile is that of the quantised I alone; a quantised 0 would be a constant Q of half a step."""
    radar = RadarConfig.free_space()
    p = mover(radar, 900, -1.0, 3.0)
    shown = maps_of(radar, p, ReceiverConfig(real=True, adc_bits=bits)).range_time.double().numpy()
    wave = EchoSynthesizer(radar)(p, torch.ones(1)).numpy().astype(complex)
    step = 2 * math.sqrt((abs(wave) ** 2).mean() * 10**1.2) / 2**bits
    most = 2 ** (bits - 1) - 0.5
    levels = np.clip(np.floor(wave.real / step) + 0.5, -most, most) * step
    expected = abs(np.fft.fft(levels * WINDOW)[:, :200]).T
    assert np.linalg.norm(shown - expected) / np.linalg.norm(expected) < 0.02


@pytest.mark.parametrize(("bits", "headroom_db"), [(8, 12.0), (10, 6.0), (12, 3.0)])
def test_quantisation_noise_floor(bits: int, headroom_db: float) -> None:
    """A wave of full scale has 6.02 bits + 1.76 dB, spread over all bins; headroom costs as much."""
    radar = RadarConfig.free_space()
    p = mover(radar, 900, -1.0, 3.01)
    maps = maps_of(radar, p, ReceiverConfig(adc_bits=bits, adc_headroom_db=headroom_db))
    echo = EchoSynthesizer(radar)(p, torch.ones(1)).abs().square().mean()
    noise = float(echo) * 10 ** (-(6.02 * bits + 1.76 - headroom_db) / 10)
    floor = float(maps.range_time[120:190].square().mean())
    assert 10 * np.log10(floor / (noise * (WINDOW**2).sum())) == pytest.approx(0, abs=0.7)


def test_saturation_makes_harmonics() -> None:
    """Far above full scale I and Q are square waves: the fifth harmonic has a fifth of the amplitude."""
    radar = RadarConfig.free_space()
    p = mover(radar, 900, 0.0, 20.5 * radar.range_resolution_m)
    shown = maps_of(radar, p, ReceiverConfig(adc_bits=12, adc_headroom_db=-40.0)).range_time.mean(1)
    assert float(shown[100:106].max() / shown[18:24].max()) == pytest.approx(0.2, rel=0.05)
    clean = maps_of(radar, p, ReceiverConfig(adc_bits=12)).range_time.mean(1)
    assert float(clean[100:106].max() / clean[18:24].max()) < 1e-3


@pytest.mark.parametrize("offset_db", [0.0, 20.0])
def test_offset_is_a_line_at_zero_range_that_the_canceller_takes_out(offset_db: float) -> None:
    radar = RadarConfig.free_space()
    p = mover(radar, 900, -1.0)
    maps, clean = (maps_of(radar, p, ReceiverConfig(dc_offset_db=level)) for level in (offset_db, None))
    echo = EchoSynthesizer(radar)(p, torch.ones(1)).abs().square().mean()
    expected = math.sqrt(float(echo) * 10 ** (offset_db / 10)) * WINDOW.sum()
    assert float(maps.range_time[0].mean()) == pytest.approx(expected, rel=0.01)
    peak = float(clean.range_time_mti.max())
    torch.testing.assert_close(maps.range_time_mti, clean.range_time_mti, rtol=0, atol=1e-4 * peak)


@pytest.mark.parametrize("level_dbc_hz", [-93.0, -80.0])
def test_phase_noise_pedestal(level_dbc_hz: float) -> None:
    """Density L(f) 4 sin^2(pi f tau) beside a target, L that of the level 1 MHz from the carrier."""
    radar = RadarConfig.free_space()
    p = mover(radar, 900, 0.0, 2.0)
    maps = maps_of(radar, p, ReceiverConfig(phase_noise_dbc_hz=level_dbc_hz))
    tau = 2 * math.hypot(2.0, 0.1) / 299792458.0
    bins = np.arange(53 + 30, 53 + 50)
    f = np.abs(bins - tau * radar.slope_hz_per_s * radar.chirp_s) * radar.sample_rate_hz / 400
    decade = np.interp(
        np.log10(f), [5, 6, 7], [13.0, 0.0, -20.0]
    )  # of the typical oscillator, relative to 1 MHz
    density = 10 ** ((level_dbc_hz + decade) / 10) * 4 * np.sin(np.pi * f * tau) ** 2
    echo = float(EchoSynthesizer(radar)(p, torch.ones(1)).abs().square().mean())
    expected = echo * density * radar.sample_rate_hz * (WINDOW**2).sum()
    found = maps.range_time[bins].square().mean(1).numpy()
    assert 10 * np.log10(found.sum() / expected.sum()) == pytest.approx(0, abs=0.5)


def test_phase_noise_of_interference_does_not_cancel() -> None:
    """The echo has the noise of range correlation, the interference that of two oscillators."""
    p, rcs = tensors(swinging(80, 3, 256.0), np.ones(3))
    other = InterferenceConfig((1.0, 5.0, 1.0), 1.4, 0.0, 1e-6)
    scene = SceneConfig(
        SMALL, interference=other, receiver=ReceiverConfig(phase_noise_dbc_hz=-80.0), snr_db=None
    )
    noise = oscillator(SMALL, -80.0, 0)
    heard = Interference(SMALL, interfering_radar(SMALL, other), 1e-6, 0.0, noise)
    samples = heard(noise(EchoSynthesizer(SMALL)(p, rcs)))
    assert_same(RadarSimulator(scene)(p, rcs).range_time, RangeProfile(SMALL)(samples).abs().T, atol=1e-5)


def test_room_is_seen_and_leaves_a_residue() -> None:
    p = mover(SMALL, 200, -1.0)
    room = ClutterConfig(12, jitter_m=50e-6)
    maps, bare = (maps_of(SMALL, p, ReceiverConfig(), clutter=c) for c in (room, None))
    still = maps_of(SMALL, p, ReceiverConfig(), clutter=ClutterConfig(12, jitter_m=0.0))
    assert float(maps.range_time.square().sum() / bare.range_time.square().sum()) > 2
    atol = 1e-4 * float(bare.range_time_mti.max())
    torch.testing.assert_close(still.range_time_mti, bare.range_time_mti, rtol=0, atol=atol)
    assert float((maps.range_time_mti - bare.range_time_mti).abs().max()) > 100 * atol
    # The noise stays that of the people's echo.
    noisy = [maps_of(SMALL, p, ReceiverConfig(), clutter=c, snr_db=10.0).snr_db for c in (room, None)]
    assert float(noisy[0]) == pytest.approx(float(noisy[1]), abs=0.2)


@pytest.mark.parametrize("reference", ["echo", "total"])
def test_both_engines_see_the_same_room(reference: str) -> None:
    scene = SceneConfig(SMALL, clutter=ClutterConfig(4), snr_db=20.0, noise_reference=reference)  # type: ignore[arg-type]
    p, rcs = tensors(swinging(60, 3, 256.0), np.ones(3))
    maps = []
    for engine in ("time", "range-bins"):
        torch.manual_seed(0)
        processing = ProcessingConfig(engine=engine)  # type: ignore[arg-type]
        maps.append(RadarSimulator(scene, processing=processing)(p, rcs))
    assert_same(maps[1][:3], maps[0][:3], atol=1e-5)


def test_interference_is_that_of_its_stage() -> None:
    p, rcs = tensors(swinging(80, 3, 256.0), np.ones(3))
    other = InterferenceConfig((1.0, 5.0, 1.0), 1.4, 0.0, 1e-6)
    scene = SceneConfig(SMALL, interference=other, snr_db=None)
    simulator = RadarSimulator(scene, processing=ProcessingConfig(pulse_chunk=16))
    radar = interfering_radar(SMALL, other)
    assert radar.chirp_s == pytest.approx(1.4 * SMALL.chirp_s)
    assert radar.slope_hz_per_s < SMALL.slope_hz_per_s
    heard = Interference(SMALL, radar, 1e-6, 0.0)(EchoSynthesizer(SMALL)(p, rcs))
    profiles = RangeProfile(SMALL)(heard)
    assert_same(simulator(p, rcs).range_time, profiles.abs().T, atol=1e-5)
    clean = RangeProfile(SMALL)(EchoSynthesizer(SMALL)(p, rcs))
    assert float((profiles - clean).abs().max()) > 0.01 * float(clean.abs().max())


def test_an_empty_room_with_a_converter_stays_empty() -> None:
    quiet = RadarSimulator(SceneConfig(SMALL, snr_db=None, receiver=ReceiverConfig(adc_bits=8)))
    maps = quiet(torch.zeros(50, 0, 3), torch.zeros(0))
    assert float(maps.range_time.abs().max()) == 0
    p, _ = tensors(swinging(50, 3, 256.0), np.ones(3))
    p.requires_grad_(True)
    quiet(p, torch.zeros(3)).range_time.sum().backward()
    assert p.grad is not None
    assert float(p.grad.abs().max()) == 0


def test_effects_need_the_engine_that_makes_samples() -> None:
    for scene in (
        SceneConfig(receiver=ReceiverConfig(adc_bits=8)),
        SceneConfig(interference=InterferenceConfig()),
    ):
        message = (
            "engine: got 'range-bins' with (adc_bits|interference), which act on samples; expected 'time'"
        )
        processing = ProcessingConfig(engine="range-bins")
        with pytest.raises(TensorsimError, match=message):
            SimulationConfig(scene, processing)
        with pytest.raises(TensorsimError, match=message):
            RadarSimulator(scene, processing=processing)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ReceiverConfig(phase_noise_dbc_hz=math.nan), "phase_noise_dbc_hz: got nan"),
        (lambda: ReceiverConfig(adc_bits=25), "adc_bits: got 25, expected bits of a converter from 1 to 24"),
        (lambda: ReceiverConfig(adc_bits=0), "adc_bits: got 0"),
        (lambda: ReceiverConfig(adc_headroom_db=1e6), "adc_headroom_db: got 1e"),
        (lambda: ClutterConfig(0), "reflectors: got 0"),
        (lambda: ClutterConfig(jitter_m=-1.0), "jitter_m: got -1.0"),
        (lambda: InterferenceConfig((1.0, 2.0)), "position_m: got"),  # type: ignore[arg-type]
        (lambda: InterferenceConfig(chirp_ratio=0.0), "chirp_ratio: got 0.0"),
        (
            lambda: RadarSimulator(SceneConfig(interference=InterferenceConfig(chirp_ratio=300.0))),
            r"InterferenceConfig.chirp_ratio: got 300, expected .* samples per chirp",
        ),
        (lambda: InterferenceConfig(delay_s=math.inf), "delay_s: got inf"),
        (lambda: SceneConfig(receiver=None), "SceneConfig.receiver: got None"),  # type: ignore[arg-type]
    ],
)
def test_refuses(make: Any, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        make()
