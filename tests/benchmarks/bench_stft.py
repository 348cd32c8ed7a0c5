"""The Doppler-time map against three peers in the same run, on as many threads, all warmed up; medians.

All take every range bin's STFT, sum its power over range and take the root. The peers: ``scipy.signal.ShortTimeFFT``
clip by clip, since its own zero padding takes at most two dimensions; ``scipy.fft`` of all frames of a batch at once,
whose ``workers`` are the threads; and plain torch, :func:`tensorsim.radar.doppler_time_map`, the formula written with
``torch.stft``. Each is given its data in the layout and the precision that it likes best.
``OMP_NUM_THREADS=1 python -m tests.benchmarks.bench_stft [--cpu] [--quick]``; ``--quick`` takes smaller batches.
"""

import sys

import numpy as np
import scipy.fft
import torch
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import hann

from tensorsim.config import RadarConfig
from tensorsim.radar.processing.doppler import DopplerTimeMap, doppler_time_map
from tests.benchmarks.timing import chosen_clock, host, medians

ROUNDS = 7
#: Clips, their length in seconds, and range bins.
SIZES = ((1, 4.0, 1), (1, 4.0, 200), (64, 4.0, 1), (64, 1.0, 8))
QUICK = ((1, 4.0, 1), (1, 1.0, 200), (16, 4.0, 1), (16, 1.0, 8))


def scipy_map(stft: ShortTimeFFT, clip: np.ndarray, frames: int) -> np.ndarray:
    """The map (F, K) of one clip (R, M); SciPy centres frame 0 at sample 0 by default."""
    spectrum = stft.stft(clip, p0=0, p1=frames, k_offset=stft.m_num_mid)
    return np.sqrt((spectrum.real**2 + spectrum.imag**2).sum(0))


def batched_map(series: np.ndarray, window: np.ndarray, hop: int, bins: int) -> np.ndarray:
    """The maps (B, F, K) of clips (B, R, M), all frames in one transform."""
    frames = np.lib.stride_tricks.sliding_window_view(series, len(window), axis=-1)[..., ::hop, :] * window
    spectrum = scipy.fft.fft(frames, bins, workers=torch.get_num_threads(), overwrite_x=True)
    power = (spectrum.real**2 + spectrum.imag**2).sum(1)
    return np.fft.fftshift(np.sqrt(power), axes=-1).swapaxes(-2, -1)


def compare(name: str, radar: RadarConfig, batch: int, seconds: float, bins: int) -> None:
    """Print median times of one size and the ratios to ours; peers that give another map are an error."""
    clock, stage = chosen_clock(), DopplerTimeMap(radar)
    window = hann(stage.length, sym=False).astype(np.float32)
    stft = ShortTimeFFT(window, stage.hop, radar.prf_hz, fft_mode="centered", mfft=stage.bins)
    pulses = round(seconds * radar.prf_hz)
    generator = torch.Generator().manual_seed(0)
    profiles = torch.randn(batch, bins, pulses, dtype=torch.complex64, generator=generator)
    series = profiles.conj().resolve_conj().numpy()
    x = profiles.transpose(1, 2)
    functions = {
        "own": lambda: stage(x),
        "SciPy's ShortTimeFFT": lambda: [scipy_map(stft, clip, stage.frames(pulses)) for clip in series],
        "scipy.fft, batched": lambda: batched_map(series, window, stage.hop, stage.bins),
        "plain torch": lambda: doppler_time_map(x, stage.window.float(), stage.hop, stage.bins),
    }
    expected = functions["own"]().numpy()
    for peer in functions.values():
        np.testing.assert_allclose(np.stack(list(peer())), expected, rtol=1e-3, atol=1e-3 * expected.max())
    # What no map by torch can beat: its transforms alone, in blocks that stay in the cache.
    block = torch.randn(2**16 // stage.bins, stage.bins, dtype=torch.complex64, generator=generator)
    blocks = -(-batch * bins * stage.frames(pulses) // len(block))

    def transforms() -> None:
        for _ in range(blocks):
            torch.fft.fft(block)

    *took, bound = medians([*functions.values(), transforms], ROUNDS, clock)
    times = dict(zip(functions, took, strict=True))
    peers = ", ".join(
        f"{peer} {time * 1e3:.2f} ms ({time / times['own']:.2f})"
        for peer, time in times.items()
        if peer != "own"
    )
    print(
        f"{name}, {batch} clip(s) x {bins} range bins, {stage.frames(pulses)} frames of {stage.bins}: "
        f"own {times['own'] * 1e3:.2f} ms, of which transforms {bound * 1e3:.2f} ms; {peers}",
        flush=True,
    )


def main() -> None:
    """All sizes in both scenes."""
    torch.set_grad_enabled(False)
    print(f"{host()}, {chosen_clock().__name__}, complex64; in brackets how many times as long as ours")
    for name, radar in (
        ("free space", RadarConfig.free_space()),
        ("through wall", RadarConfig.through_wall()),
    ):
        for batch, seconds, bins in QUICK if "--quick" in sys.argv else SIZES:
            compare(name, radar, batch, seconds, bins)


if __name__ == "__main__":
    main()
