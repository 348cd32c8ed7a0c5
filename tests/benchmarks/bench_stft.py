"""The Doppler-time map against ``scipy.signal.ShortTimeFFT`` in the same run.

Both take every range bin's STFT, sum its power over range and take the root. SciPy is given its data in the layout
and the precision that it likes best, and its batches clip by clip: its own zero padding takes at most two dimensions.
``OMP_NUM_THREADS=1 python tests/benchmarks/bench_stft.py``
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import hann

from tensorsim.config import RadarConfig
from tensorsim.radar.doppler import DopplerTimeMap

ROUNDS = 7


def medians(ours: Callable[[], object], peer: Callable[[], object]) -> tuple[float, float]:
    """Milliseconds of each, taken in turn."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS + 1):
        for function, column in zip((ours, peer), times, strict=True):
            start = time.perf_counter()
            function()
            column.append(time.perf_counter() - start)
    own, other = (statistics.median(column[1:]) * 1e3 for column in times)  # the first round warms up
    return own, other


def scipy_map(stft: ShortTimeFFT, clip: np.ndarray, first: int, last: int) -> np.ndarray:
    """The map (F, K) of one clip (R, M), frames ``first`` to ``last``."""
    spectrum = stft.stft(clip, p0=first, p1=last)
    return np.sqrt((spectrum.real**2 + spectrum.imag**2).sum(0))


def main() -> None:
    torch.set_grad_enabled(False)
    print(f"torch {torch.__version__}, {torch.get_num_threads()} thread(s), complex64")
    scenes = (("free space", RadarConfig.free_space()), ("through-wall", RadarConfig.through_wall()))
    for name, radar in scenes:
        stage = DopplerTimeMap(radar)
        stft = ShortTimeFFT(
            hann(stage.length, sym=False).astype(np.float32),
            stage.hop,
            radar.prf_hz,
            fft_mode="centered",
            mfft=stage.bins,
        )
        for batch, seconds, bins in ((1, 4.0, 1), (1, 4.0, 200), (64, 4.0, 1), (64, 1.0, 8)):
            pulses = round(seconds * radar.prf_hz)
            generator = torch.Generator().manual_seed(0)
            profiles = torch.randn(batch, bins, pulses, dtype=torch.complex64, generator=generator)
            series = profiles.conj().resolve_conj().numpy()
            frames = stage.frames(pulses)
            first = 0  # the first slice of SciPy's that is wholly inside
            while stft.t(pulses, p0=first, p1=first + 1)[0] * radar.prf_hz < stft.m_num_mid - 0.5:
                first += 1
            last = first + frames
            x = profiles.transpose(1, 2)
            own, other = medians(
                lambda: stage(x),  # noqa: B023
                lambda: [scipy_map(stft, clip, first, last) for clip in series],  # noqa: B023
            )
            print(
                f"{name:<13} {batch:3d} clip(s) x {bins:3d} range bins, {frames:4d} frames of {stage.bins}:"
                f" {own:9.2f} ms   SciPy {other:9.2f} ms   ratio {other / own:6.2f}"
            )


if __name__ == "__main__":
    main()
