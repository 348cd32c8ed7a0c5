"""Times of the frames of a film: whether they are even, how often they come, and which is nearest to each even time."""

import torch
from torch import Tensor

from tensorsim.vision.smoothing.even_time import even_count

#: Frames whose times differ from even ones by more than this many seconds and this many frames are at uneven times.
_UNEVEN_S, _UNEVEN_FRAMES = 0.05, 1.5


class FilmClock:
    """Times of the frames of a film as they are read one after the other.

    A frame is where the file has it, counted from the first one; at ``k / fps`` where that is within a quarter of a
    frame (files round times), and in files whose times do not increase.

    Args:
        fps: frames per second that the file announces.
        own_times: whether the file's times count; otherwise frames are evenly spaced.

    Attributes:
        last_s: time of the last frame that was asked for.

    Example:
        >>> clock = FilmClock(10.0)
        >>> [clock.time_s(k, own_s) for k, own_s in enumerate((0.0, 0.11, 2.1))]
        [0.0, 0.1, 2.1]
    """

    def __init__(self, fps: float, own_times: bool = True) -> None:
        self.last_s = 0.0
        self._fps, self._own_times = fps, own_times
        self._first_own_s, self._last_own_s = 0.0, 0.0

    def time_s(self, index: int, own_s: float) -> float:
        """Seconds from the start of the film of frame ``index``, the next one, to which the file gives ``own_s``."""
        if index == 0:
            self._first_own_s = own_s
        elif own_s <= self._last_own_s:
            self._own_times = False
        self._last_own_s = own_s
        even_s, since_s = index / self._fps, own_s - self._first_own_s
        far = abs(since_s - even_s) > 0.25 / self._fps
        self.last_s = since_s if self._own_times and far else even_s
        return self.last_s


def unevenness_s(times_s: Tensor, fps: float) -> float:
    """How far the times (T,) of frames are from ``fps`` frames per second at most, in seconds; 0 where that is little.

    Also 0 for times that do not increase, as of files without times.
    """
    if times_s.numel() < 3 or not bool((times_s.diff() > 0).all()):
        return 0.0
    even = torch.arange(times_s.numel(), dtype=times_s.dtype) / fps
    late_s = float((times_s - times_s[0] - even).abs().max())
    return late_s if late_s > max(_UNEVEN_S, _UNEVEN_FRAMES / fps) else 0.0


def usual_fps(times_s: Tensor) -> float:
    """Frames per second of increasing times (T,), where pauses do not count.

    >>> usual_fps(torch.tensor([0.0, 0.5, 1.0, 30.0, 30.5]))
    2.0
    """
    steps_s = times_s.double().diff()
    return round(1 / float(steps_s[steps_s < 1.5 * steps_s.median()].mean()), 6)


def nearest_frames(times_s: Tensor, fps: float) -> Tensor:
    """The frame nearest to each of the times ``k / fps`` from the first to the last of ``times_s`` (T,): (T',) int64.

    >>> nearest_frames(torch.tensor([0.0, 0.1, 0.5]), fps=10.0)
    tensor([0, 1, 1, 2, 2, 2])
    """
    since = times_s - times_s[0]
    count = int(even_count(since[-1], fps))
    middles = (since[1:] + since[:-1]) / 2
    return torch.searchsorted(middles, torch.arange(count, dtype=since.dtype) / fps, right=True)
