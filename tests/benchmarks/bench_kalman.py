"""KalmanSmoother against filterpy, a filter of six states per joint: 64 clips of 120 frames and 14 joints.

python -m tests.benchmarks.bench_kalman
"""

import numpy as np
import torch

from tensorsim.vision.smoothing.kalman import KalmanSmoother
from tests.benchmarks.timing import medians, seconds
from tests.vision.smoothing.test_kalman import by_filterpy

CLIPS, FRAMES, JOINTS, FPS = 64, 120, 14, 30.0
NOISE = {"process_noise": 0.001, "measurement_noise": 0.01}


def main() -> None:
    """Print median times and ratios."""
    torch.manual_seed(0)
    joints = (0.05 * torch.randn(CLIPS, FRAMES, JOINTS, 3, dtype=torch.float64)).cumsum(1)
    valid = torch.rand(CLIPS, FRAMES, JOINTS) < 0.9
    smoother = KalmanSmoother(**NOISE)
    peer_clips = 4  # filterpy takes its time: measured on 4 clips, scaled to all
    z, seen = joints[:peer_clips].numpy(), valid[:peer_clips].numpy()
    peer_out = np.empty_like(z)

    def peer() -> None:
        for b in range(peer_clips):
            for j in range(JOINTS):
                peer_out[b, :, j] = by_filterpy(z[b, :, j], seen[b, :, j], FPS, **NOISE)[1]

    peer_s = seconds(peer) * CLIPS / peer_clips
    print(f"{torch.get_num_threads()} threads; {CLIPS} clips x {FRAMES} frames x {JOINTS} joints")
    print(f"filterpy             {peer_s * 1e3:10.1f} ms (from {peer_clips} clips)")
    for name, module in (("eager", smoother), ("scripted", torch.jit.script(smoother))):
        for dtype in (torch.float64, torch.float32):
            x = joints.to(dtype)
            for _ in range(3):  # the scripted one compiles
                out = module(x, valid, FPS)
            (own_s,) = medians([lambda: module(x, valid, FPS)], 15)  # noqa: B023
            difference = np.abs(out[:peer_clips].numpy() - peer_out).max()
            label, ratio = f"{name} {str(dtype)[6:]}", peer_s / own_s
            print(
                f"{label:20s} {own_s * 1e3:10.1f} ms, {ratio:.0f} times faster, differs by {difference:.1e} m"
            )


if __name__ == "__main__":
    main()
