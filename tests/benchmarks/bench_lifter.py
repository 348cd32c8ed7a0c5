"""Search for nearest poses: time and memory against faiss and NumPy in the same run.

python -m tests.benchmarks.bench_lifter [poses] [frames] [--threads N] [--cpu]

Faiss is in an extra: `pip install -e ".[bench]"`. Its exact search (IndexFlatL2) compares the same 28 numbers, centred
projections of unit norm. Two pools: people at all headings, searched with walking people, and random numbers, in
which no search can leave anything out.
"""

import argparse
import resource
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.vision.lifting.pose_library import all_headings, standardise_poses
from tensorsim.vision.lifting.pose_search import PoseSearch, seen_along_depth
from tests.benchmarks.timing import chosen_clock, medians

try:
    import faiss
except ImportError:
    faiss = None  # type: ignore[assignment]

YAWS = 24


def numpy_search(keypoints: np.ndarray, library: np.ndarray, block: int = 65536) -> np.ndarray:
    """The paper's search (equal weights) in blocks with a running argmin."""
    best, index = np.full(len(keypoints), np.inf, np.float32), np.zeros(len(keypoints), np.int64)
    for start in range(0, len(library), block):
        distance = 2 - 2 * (keypoints @ library[start : start + block].T)
        found = distance.argmin(axis=1)
        value = distance[np.arange(len(keypoints)), found]
        index = np.where(value < best, found + start, index)
        best = np.minimum(best, value)
    return index


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def people(poses: int, frames: int) -> tuple[Tensor, Tensor]:
    """Sampled poses at all headings, and a walk: (poses, 14, 3) and (frames, 14, 3)."""
    library = all_headings(standardise_poses(sample_poses(poses // YAWS + 1)).float(), YAWS)[:poses]
    walk = ActivityGenerator().generate("walking", seed=5, duration_s=frames / 30).joints[0]
    return library, walk.float()


def noise(poses: int, frames: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(poses, 14, 3, generator=generator), torch.randn(frames, 14, 3, generator=generator)


def compare(name: str, library: Tensor, seen: Tensor, neighbours: int) -> None:
    keypoints = torch.stack([seen[..., 0], -seen[..., 2]], dim=-1)
    points, queries = seen_along_depth(library).numpy(), seen_along_depth(seen).numpy()
    equal = torch.ones(keypoints.shape[:2])
    varied = torch.rand(keypoints.shape[:2], generator=torch.Generator().manual_seed(1))
    start = time.perf_counter()
    search = PoseSearch(library, 1, neighbours, 2**22)
    built = time.perf_counter() - start
    before = peak_mib()
    answer = search(keypoints, equal).numpy()
    extra = peak_mib() - before
    peers: dict[str, Callable[[], np.ndarray]] = {}
    if neighbours == 1:
        peers["NumPy"] = lambda: numpy_search(queries, points)[:, None]
    if faiss is not None:
        flat = faiss.IndexFlatL2(28)
        flat.add(points)
        peers["faiss"] = lambda: flat.search(queries, neighbours)[1]
    own = [lambda: search(keypoints, equal), lambda: search(keypoints, varied)]
    took = medians([*own, *peers.values()], 5, chosen_clock())
    weighted = took.pop(1)
    print(
        f"{name}, {neighbours} nearest: {took[0]:.3f} s; pool sorted once in {built:.1f} s; +{extra:.0f} MiB peak"
    )
    for (peer, ask), time_s in zip(peers.items(), took[1:], strict=True):
        same = 100 * np.mean(answer == ask())
        print(f"  {peer} {time_s:.3f} s, ratio {time_s / took[0]:.2f}, same answers {same:.2f} %")
    print(
        f"  with a weight per joint and frame, as the pipeline calls it: {weighted:.3f} s, {weighted / took[0]:.1f} "
        "times as long (no peer has weights)",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("poses", type=int, nargs="?", default=1_877_420)
    parser.add_argument("frames", type=int, nargs="?", default=120)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--cpu", action="store_true", help="processor time instead of wall time")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"{options.poses} poses x {options.frames} frames, {options.threads} threads")
    if faiss is None:
        print("faiss is not installed (the extra 'bench' has it): compared with NumPy only")
    else:
        faiss.omp_set_num_threads(options.threads)
    for name, make in (("people", people), ("random numbers", noise)):
        library, seen = make(options.poses, options.frames)
        for neighbours in (1, 32):
            compare(name, library, seen, neighbours)


if __name__ == "__main__":
    main()
