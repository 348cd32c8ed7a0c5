"""Micro-Doppler as sound: approaching motion in the left channel, receding motion in the right one."""

import math
import os
import wave
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError, check_positive, check_rank
from tensorsim.files import complete_file
from tensorsim.radar.processing.doppler import coherent_sum
from tensorsim.radar.simulator import RadarSimulator

#: If the highest Doppler frequency is in this range it is played unchanged; otherwise it is scaled to ``_TOP_HZ``.
_UNCHANGED_HZ = (1000.0, 8000.0)
_TOP_HZ = 4000.0
#: Window of the time stretching in seconds: shorter than a step, about as long as a kick.
_WINDOW_S = 0.1


class Sound(NamedTuple):
    """Stereo sound.

    Attributes:
        waveform: (2, n) float32 in [-1, 1]: approaching, receding.
        rate_hz: samples per second.
        scale: ratio of sound frequency to Doppler frequency.
    """

    waveform: Tensor
    rate_hz: int
    scale: float


def slow_time_signal(
    simulator: RadarSimulator, source: Callable[[int, int], tuple[Tensor, Tensor]], pulses: int
) -> Tensor:
    """The echo of a scene as one complex number per pulse, after moving target indication, without noise.

    Args:
        simulator: computes the range profiles, which are summed coherently over range.
        source: as in ``RadarSimulator.stream``: ``source(start, stop)`` gives positions (stop - start, S, 3) in metres
            and RCS (S,) or (stop - start, S) in m^2.
        pulses: number of pulses of the scene.

    Returns:
        (M,) complex, conjugated so that positive frequencies mean approaching, as in the Doppler-time map; a
        two-pulse canceller leaves one pulse fewer than ``pulses``.

    Raises:
        TensorsimError: fewer pulses than the moving target indicator needs. The source's output is not checked.
    """
    samples, bins = simulator.radar.samples_per_chirp, simulator.range_profile.range_m.shape[0]
    parts = []
    for start in range(0, pulses, simulator.recorder.pulse_chunk):
        positions, rcs = source(start, min(start + simulator.recorder.pulse_chunk, pulses))
        rcs = rcs.expand(positions.shape[:-1])
        profiles = simulator.recorder.engine(positions[None], rcs[None], start)[0]
        parts.append(coherent_sum(profiles[..., :bins], samples)[0])  # for an array, the first channel
    # The indicator is linear along the pulses and the same in all range bins, so it can follow the sum over range.
    return simulator.mti(torch.cat(parts))[:, 0].conj().resolve_conj()


def doppler_sound(signal: Tensor, prf_hz: float, scale: float | None = None, rate_hz: int = 16_000) -> Sound:
    """Turn a slow-time signal into sound of the same duration, with every frequency multiplied by ``scale``.

    Positive Doppler, motion towards the radar, is heard on the left and negative Doppler on the right. If
    ``scale`` is not 1, a phase vocoder stretches the signal in time and the sound is played that much faster
    (Flanagan and Golden, *Phase Vocoder*, Bell System Technical Journal 45, 1966).

    Args:
        signal: (M,) complex, one number per pulse, free of clutter: see :func:`slow_time_signal`.
        prf_hz: pulses per second.
        scale: ratio of sound frequency to Doppler frequency. Default: 1 if half the PRF is between 1 and 8 kHz, else
            such that half the PRF becomes 4 kHz.
        rate_hz: samples per second of the sound.

    Returns:
        The sound, with a peak of 0.9; silence for a signal of zeros.

    Raises:
        TensorsimError: a signal that is not complex (M,), a number that is not positive, no torchaudio.
    """
    check_rank(signal, 1, "signal", "(pulses,)")
    if not signal.is_complex() or signal.numel() == 0:
        raise TensorsimError(
            f"signal: got {signal.dtype} of {signal.numel()} pulses, expected a complex tensor of at least one"
        )
    check_positive(prf_hz, "prf_hz")
    check_positive(rate_hz, "rate_hz")
    if scale is None:
        audible = _UNCHANGED_HZ[0] <= prf_hz / 2 <= _UNCHANGED_HZ[1]
        scale = 1.0 if audible else 2 * _TOP_HZ / prf_hz
    check_positive(scale, "scale")
    resample, phase_vocoder = _torchaudio()
    length = max(1, round(signal.shape[0] * rate_hz / prf_hz))
    channels = _stretched(_by_direction(signal), prf_hz, scale, phase_vocoder)
    given, wanted = _rates(prf_hz * scale / rate_hz)
    waveform = resample(channels, given, wanted)[:, :length]
    waveform = torch.nn.functional.pad(waveform, (0, length - waveform.shape[1]))
    peak = waveform.abs().max()
    return Sound(waveform.float() * (0.9 / peak if peak > 0 else 0.0), rate_hz, scale)


def _rates(ratio: float) -> tuple[int, int]:
    """Two small integers whose ratio is within 0.1 % of this one.

    The memory of torchaudio's filter grows with their product: the exact ratio of a PRF such as 5165.02 Hz to the
    sound's sample rate would take terabytes. A change of pitch and time by 0.1 % is inaudible.
    """
    below_one = min(ratio, 1 / ratio)
    nearest = Fraction(below_one).limit_denominator(math.ceil(1000 + 1 / below_one))
    small, large = nearest.as_integer_ratio()
    return (small, large) if ratio <= 1 else (large, small)


def _by_direction(signal: Tensor) -> Tensor:
    """Complex (M,) to real (2, M): the parts with positive and with negative frequencies."""
    spectrum = torch.fft.fft(signal)
    frequency = torch.fft.fftfreq(signal.shape[0], device=signal.device)
    return torch.stack(
        [torch.fft.ifft(spectrum * (frequency > 0)), torch.fft.ifft(spectrum * (frequency < 0))]
    ).real


def _stretched(
    channels: Tensor, prf_hz: float, scale: float, phase_vocoder: Callable[[Tensor, float, Tensor], Tensor]
) -> Tensor:
    """Channels (2, M) made ``scale`` times longer with the same frequencies per sample."""
    if scale == 1.0:
        return channels
    size = 2 ** max(4, round(math.log2(_WINDOW_S * prf_hz)))
    hop = size // 8
    window = torch.hann_window(size, dtype=channels.dtype, device=channels.device)
    padded = torch.nn.functional.pad(channels, (size, size))  # so that a window fits into short signals too
    spectrum = torch.stft(padded, size, hop, window=window, return_complex=True)
    advance = torch.linspace(0, math.pi * hop, size // 2 + 1, dtype=channels.dtype, device=channels.device)
    longer = phase_vocoder(spectrum, 1 / scale, advance[:, None])
    stretched = torch.istft(longer, size, hop, window=window)
    first = round(size * scale)
    return stretched[:, first : first + round(channels.shape[1] * scale)]


def write_sound(path: str | os.PathLike[str], sound: Sound) -> None:
    """Write a 16-bit stereo wav file.

    Args:
        path: file to write; it appears only when complete.
        sound: waveform (2, n); values beyond [-1, 1] are clipped.

    Raises:
        TensorsimError: the disk is full, or the folder is not writable.
    """
    samples = (sound.waveform.clamp(-1, 1) * 32767).round().to(torch.int16)
    with complete_file(path) as scratch, wave.open(str(scratch), "wb") as file:
        file.setnchannels(samples.shape[0])
        file.setsampwidth(2)
        file.setframerate(sound.rate_hz)
        file.writeframes(samples.T.contiguous().cpu().numpy().astype("<i2").tobytes())


def _torchaudio() -> tuple[Callable[..., Tensor], Callable[..., Tensor]]:
    """``resample`` and ``phase_vocoder`` of torchaudio, imported only when used."""
    try:
        from torchaudio.functional import phase_vocoder, resample
    except (ImportError, OSError) as error:
        raise TensorsimError(
            f"torchaudio cannot be imported ({error}); reinstall it in the release of your torch: "
            "pip install --force-reinstall torch torchaudio"
        ) from error
    return resample, phase_vocoder
