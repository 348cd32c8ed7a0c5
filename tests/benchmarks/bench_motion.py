"""Motion stages against SciPy in the same run. Batches go to SciPy as one array, and clip by clip.

``OMP_NUM_THREADS=1 python -m tests.benchmarks.bench_motion [--cpu]``
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.savgol import SavitzkyGolay
from tests.benchmarks.timing import chosen_clock, host, medians

ROUNDS = 15


def compare(name: str, ours: Callable[[], object], peer: Callable[[], object]) -> None:
    """Median of each, taken in turn, and how many times faster ours is."""
    own, other = medians([ours, peer], ROUNDS, chosen_clock())
    print(f"{name:<58} {own * 1e3:9.3f} ms   SciPy {other * 1e3:9.3f} ms   ratio {other / own:6.2f}")


def main() -> None:
    print(host())
    torch.set_grad_enabled(False)
    clip = torch.randn(120, 14, 3, dtype=torch.float64).cumsum(0)
    batch = torch.randn(64, 120, 14, 3, dtype=torch.float64).cumsum(1)
    pulses = torch.randn(32768, 14, 3, dtype=torch.float64).cumsum(0)

    for name, x, window in (
        ("SavitzkyGolay(11, 3), one clip of 120 frames", clip, 11),
        ("SavitzkyGolay(11, 3), 64 clips of 120 frames", batch, 11),
        ("SavitzkyGolay(2049, 3), 32768 pulses (as in the paper)", pulses, 2049),
    ):
        stage, array = SavitzkyGolay(window, 3), x.numpy()
        compare(name, lambda: stage(x), lambda: savgol_filter(array, window, 3, axis=-3))  # noqa: B023
        if x is batch:
            one_by_one = partial(lambda clips: [savgol_filter(c, 11, 3, axis=-3) for c in clips], list(array))
            compare("  against SciPy clip by clip", partial(stage, x), one_by_one)

    for prf_hz in (8192.0, 128.0):
        resampler = PoseResampler(prf_hz)
        frame_s, pulse_s = np.arange(120) / 30, np.arange(resampler.pulses(120, 30.0)) / prf_hz
        for name, x in (("one clip", clip), ("64 clips", batch)):
            if prf_hz > 1000 and x is batch:
                continue  # 700 MB of pulses
            compare(
                f"PoseResampler({prf_hz:g}), {name} of 120 frames to {len(pulse_s)} pulses",
                lambda: resampler(x, 30.0),  # noqa: B023
                lambda: CubicSpline(frame_s, x.numpy(), axis=-3, bc_type="natural")(pulse_s),  # noqa: B023
            )


if __name__ == "__main__":
    main()
