"""Sound of motion: the Doppler frequency of a mover is heard in the channel of its direction."""

import sys
import wave
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import tensorsim as ts
from tensorsim.data.sound import Sound, _rates, doppler_sound, slow_time_signal, write_sound


def peak_hz(channel: Tensor, rate_hz: int) -> float:
    """Frequency of the largest value of a finely sampled spectrum, in NumPy."""
    samples = channel.double().numpy()
    spectrum = np.abs(np.fft.rfft(samples * np.hanning(len(samples)), 16 * len(samples)))
    return float(spectrum.argmax()) * rate_hz / (16 * len(samples))


def mover_signal(radar: ts.RadarConfig, speed_m_s: float, seconds: float) -> Tensor:
    simulator = ts.radar.RadarSimulator(radar)
    height = radar.tx_m[2]

    def source(start: int, stop: int) -> tuple[Tensor, Tensor]:
        time_s = torch.arange(start, stop) / radar.prf_hz
        positions = torch.stack([0 * time_s, 5.0 - speed_m_s * time_s, torch.full_like(time_s, height)], -1)
        return positions[:, None], torch.ones(1)

    return slow_time_signal(simulator, source, round(seconds * radar.prf_hz))


@pytest.mark.parametrize("preset", ["free_space", "through_wall"])
@pytest.mark.parametrize("speed_m_s", [1.5, -1.5])
def test_mover_is_heard_at_its_doppler_on_its_side(preset: str, speed_m_s: float) -> None:
    radar = getattr(ts.RadarConfig, preset)()
    sound = doppler_sound(mover_signal(radar, speed_m_s, 1.0), radar.prf_hz)
    assert sound.scale == pytest.approx(1.0 if preset == "free_space" else 62.5)
    # The antennas are 0.1 m beside the line of motion: the range changes a little less than the distance.
    expected = 2 * abs(speed_m_s) / radar.doppler_wavelength_m * sound.scale
    heard, other = (0, 1) if speed_m_s > 0 else (1, 0)
    assert peak_hz(sound.waveform[heard], sound.rate_hz) == pytest.approx(expected, rel=0.02)
    energy = sound.waveform.square().sum(1)
    assert energy[other] < 0.01 * energy[heard]
    assert sound.waveform.shape[1] == pytest.approx(sound.rate_hz, rel=0.01)
    assert float(sound.waveform.abs().max()) == pytest.approx(0.9)


def test_stretching_keeps_time_and_scales_pitch() -> None:
    prf_hz = 500.0
    time_s = torch.arange(1000, dtype=torch.float64) / prf_hz
    burst = torch.exp(2j * torch.pi * 60.0 * time_s) * ((time_s > 1.2) & (time_s < 1.6))
    sound = doppler_sound(burst, prf_hz, scale=5.0)
    level = sound.waveform[0].unfold(0, 800, 800).square().mean(1)  # in steps of 50 ms
    loud = torch.nonzero(level > 0.5 * level.max()).flatten() * 0.05
    assert float(loud.min()) == pytest.approx(1.2, abs=0.1)
    assert float(loud.max()) == pytest.approx(1.55, abs=0.1)
    assert peak_hz(sound.waveform[0], sound.rate_hz) == pytest.approx(300.0, abs=3.0)


@pytest.mark.parametrize("prf_hz", [2000.9, 5165.02, 7812.53])
def test_rates_that_are_not_round_are_resampled(prf_hz: float) -> None:
    """The exact ratio of 5165.02 Hz (radhar-iwr1443) to 16 kHz needs a filter of 800 GB."""
    time_s = torch.arange(round(2 * prf_hz)) / prf_hz
    sound = doppler_sound(torch.exp(-2j * torch.pi * 400.0 * time_s), prf_hz)
    assert sound.waveform.shape[1] == pytest.approx(32_000, abs=4)
    assert peak_hz(sound.waveform[1], sound.rate_hz) == pytest.approx(400.0, rel=1e-3)


def test_rates_are_small_and_near() -> None:
    for ratio in (*np.geomspace(1e-5, 1e5, 2001), 5165.02 / 16000, 1 / 3):
        given, wanted = _rates(float(ratio))
        assert given / wanted == pytest.approx(ratio, rel=1e-3)
        assert given * wanted <= 2000 * max(1000.0, 1 / ratio, ratio)


def test_wav_holds_both_channels(tmp_path: Path) -> None:
    waveform = torch.stack([torch.linspace(-1, 1, 50), torch.zeros(50)])
    write_sound(tmp_path / "doppler.wav", Sound(waveform, 8000, 1.0))
    with wave.open(str(tmp_path / "doppler.wav")) as file:
        assert (file.getnchannels(), file.getsampwidth(), file.getframerate()) == (2, 2, 8000)
        samples = np.frombuffer(file.readframes(50), "<i2").reshape(50, 2)
    assert np.allclose(samples / 32767, waveform.T, atol=1e-4)


def test_empty_scene_is_silent_and_wrong_signals_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    silence = doppler_sound(torch.zeros(400, dtype=torch.complex64), 128.0)
    assert not silence.waveform.any()
    with pytest.raises(ts.TensorsimError, match="expected a complex tensor"):
        doppler_sound(torch.zeros(400), 128.0)
    with pytest.raises(ts.TensorsimError, match="expected \\(pulses,\\)"):
        doppler_sound(torch.zeros(2, 400, dtype=torch.complex64), 128.0)
    monkeypatch.setitem(sys.modules, "torchaudio.functional", None)
    with pytest.raises(ts.TensorsimError, match="torchaudio cannot be imported"):
        doppler_sound(torch.ones(400, dtype=torch.complex64), 128.0)
