"""Nearest-match search: time and memory against NumPy in the same run.

python tests/benchmarks/bench_lifter.py [poses] [frames]
"""

import resource
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from tensorsim.vision.lifter import nearest_poses


def median_seconds(function: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def numpy_search(keypoints: np.ndarray, library: np.ndarray, block: int = 65536) -> np.ndarray:
    """The paper's search (equal weights): blocks of normalised projections, running argmin."""
    k = keypoints - keypoints.mean(axis=1, keepdims=True)
    k = (k / np.linalg.norm(k, axis=(1, 2), keepdims=True)).reshape(len(k), -1)
    best, index = np.full(len(k), np.inf, np.float32), np.zeros(len(k), np.int64)
    for start in range(0, len(library), block):
        p = library[start : start + block][..., [0, 2]] * np.array([1, -1], np.float32)
        p = p - p.mean(axis=1, keepdims=True)
        p = (p / np.linalg.norm(p, axis=(1, 2), keepdims=True)).reshape(len(p), -1)
        distance = 2 - 2 * (k @ p.T)
        found = distance.argmin(axis=1)
        value = distance[np.arange(len(k)), found]
        index = np.where(value < best, found + start, index)
        best = np.minimum(best, value)
    return index


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    poses = int(sys.argv[1]) if len(sys.argv) > 1 else 1_877_420
    frames = int(sys.argv[2]) if len(sys.argv) > 2 else 120
    generator = torch.Generator().manual_seed(0)
    library = torch.randn(poses, 14, 3, generator=generator).mul_(0.2)
    keypoints = torch.randn(frames, 14, 2, generator=generator)
    weights = torch.ones(frames, 14)
    before = peak_mib()
    ours = median_seconds(lambda: nearest_poses(keypoints, weights, library, 1, 1, 2**22), 3)
    extra = peak_mib() - before
    peer = median_seconds(lambda: numpy_search(keypoints.numpy(), library.numpy()), 3)
    answer = nearest_poses(keypoints, weights, library, 1, 1, 2**22)[:, 0].numpy()
    same = np.mean(answer == numpy_search(keypoints.numpy(), library.numpy()))
    print(f"{poses} poses x {frames} frames, {torch.get_num_threads()} threads")
    print(f"nearest_poses {ours:.2f} s, extra memory {extra:.0f} MiB over the pool")
    print(f"NumPy blocks  {peer:.2f} s, ratio {peer / ours:.2f}, same answer in {100 * same:.1f} % of frames")


if __name__ == "__main__":
    main()
