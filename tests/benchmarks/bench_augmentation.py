"""Changes of colours and quality in training against the same changes by kornia.augmentation.

python -m tests.benchmarks.bench_augmentation

Both change exposure, contrast, tint and saturation of every picture, and blur 15 % of them, add noise to 15 % and
compress 15 %. kornia works on batches of floats, ours on one picture of bytes after the other, as the processes of the
loader do.
"""

import kornia.augmentation as K
import numpy as np
import torch
from torch import Tensor

from tensorsim.training.colours import recoloured
from tests.benchmarks.timing import host, medians

PICTURES, SIDE, BATCH = 64, 320, 8


def kornia_sequence() -> torch.nn.Module:
    """The changes of :func:`tensorsim.training.colours.recoloured`."""
    return K.AugmentationSequential(
        K.ColorJiggle(brightness=(0.85, 1.15), contrast=(0.8, 1.2), saturation=(0.4, 1.5), p=1.0),
        K.RandomGamma((0.8, 1.25), p=1.0),
        K.RandomRGBShift(0.05, 0.05, 0.05, p=1.0),
        K.RandomGrayscale(p=0.05),
        K.RandomGaussianBlur((9, 9), (0.4, 1.5), p=0.15),
        K.RandomGaussianNoise(0.0, 0.05, p=0.15),
        K.RandomJPEG((15.0, 60.0), p=0.15),
        data_keys=["input"],
        same_on_batch=False,
    )


def main() -> None:
    """Print median times per picture."""
    import cv2

    cv2.setNumThreads(torch.get_num_threads())
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (PICTURES, SIDE // 8, SIDE // 8, 3), dtype=np.uint8)
    pictures = [cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC) for picture in coarse]
    batches = torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2).float().div(255).split(BATCH)
    sequence = kornia_sequence()
    torch.manual_seed(0)

    def own() -> list[np.ndarray]:
        return [recoloured(picture, rng) for picture in pictures]

    def other() -> list[Tensor]:
        return [sequence(batch) for batch in batches]

    own_s, other_s = medians([own, other], 5)
    own_ms, other_ms = own_s / PICTURES * 1e3, other_s / PICTURES * 1e3
    print(
        f"{host()}, {PICTURES} pictures of {SIDE}x{SIDE}: own {own_ms:.2f} ms, kornia {other_ms:.1f} ms per picture, "
        f"{other_s / own_s:.0f} times as long"
    )


if __name__ == "__main__":
    main()
