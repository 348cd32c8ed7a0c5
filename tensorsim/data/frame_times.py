"""Times of the frames of a film: whether they are even, and which frame is nearest to each even time."""

import torch
from torch import Tensor

#: Frames whose times differ from even ones by more than so many seconds and so many frames are at uneven times.
_UNEVEN_S, _UNEVEN_FRAMES = 0.05, 1.5


def unevenness_s(times_s: Tensor, fps: float) -> float:
    """How far the times (T,) of frames are from ``fps`` frames per second at most, in seconds; 0 where that is little.

    Also 0 for times that do not increase, as of files without times.
    """
    if times_s.numel() < 3 or not bool((times_s.diff() > 0).all()):
        return 0.0
    even = torch.arange(times_s.numel(), dtype=times_s.dtype) / fps
    late_s = float((times_s - times_s[0] - even).abs().max())
    return late_s if late_s > max(_UNEVEN_S, _UNEVEN_FRAMES / fps) else 0.0


def nearest_frames(times_s: Tensor, fps: float) -> Tensor:
    """The frame nearest to each of the times ``k / fps`` from the first to the last of ``times_s`` (T,): (T',) int64.

    >>> nearest_frames(torch.tensor([0.0, 0.1, 0.5]), fps=10.0)
    tensor([0, 1, 1, 2, 2, 2])
    """
    since = times_s - times_s[0]
    count = int(float(since[-1]) * fps + 1e-3) + 1
    middles = (since[1:] + since[:-1]) / 2
    return torch.searchsorted(middles, torch.arange(count, dtype=since.dtype) / fps, right=True)
