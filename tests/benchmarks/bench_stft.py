"""The Doppler-time map against ``scipy.signal.ShortTimeFFT`` in the same run.

Both take every range bin's STFT, sum its power over range and take the root. SciPy is given its data in the layout
and the precision that it likes best, and its batches clip by clip: its own zero padding takes at most two dimensions.
``OMP_NUM_THREADS=1 python -m tests.benchmarks.bench_stft [--cpu]``
"""

import numpy as np
import torch
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import hann

from tensorsim.config import RadarConfig
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tests.benchmarks.timing import chosen_clock, host, medians

ROUNDS = 7


def scipy_map(stft: ShortTimeFFT, clip: np.ndarray, first: int, last: int) -> np.ndarray:
    """The map (F, K) of one clip (R, M), frames ``first`` to ``last``."""
    spectrum = stft.stft(clip, p0=first, p1=last)
    return np.sqrt((spectrum.real**2 + spectrum.imag**2).sum(0))


def main() -> None:
    torch.set_grad_enabled(False)
    clock = chosen_clock()
    print(f"{host()}, {clock.__name__}, complex64")
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
                [
                    lambda: stage(x),  # noqa: B023
                    lambda: [scipy_map(stft, clip, first, last) for clip in series],  # noqa: B023
                ],
                ROUNDS,
                clock,
            )
            print(
                f"{name:<13} {batch:3d} clip(s) x {bins:3d} range bins, {frames:4d} frames of {stage.bins}:"
                f" {own * 1e3:9.2f} ms   SciPy {other * 1e3:9.2f} ms   ratio {other / own:6.2f}"
            )


if __name__ == "__main__":
    main()
