"""Frame times of a video: whether they are evenly spaced, their rate, and the nearest frame to each even time."""

import torch
from torch import Tensor

from tensorsim.vision.smoothing.even_time import even_count

#: Frames are unevenly spaced if they are more than this many seconds and this many frames off an even grid.
_UNEVEN_S, _UNEVEN_FRAMES = 0.05, 1.5


class FilmClock:
    """Times of the frames of a video, read one after the other.

    A frame has its time in the file, relative to the first frame, or ``k / fps`` if that is within a quarter of a
    frame (files round times), and from where the file's times stop increasing.

    Args:
        fps: frames per second stated by the file.
        own_times: whether to use the file's times; otherwise frames are evenly spaced.

    Attributes:
        last_s: time of the last frame queried.

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
        """Time in seconds from the start for the next frame, number ``index``, whose time in the file is ``own_s``."""
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
    """Largest deviation in seconds of frame times (T,) from ``fps`` frames per second; 0 if it is small.

    Also 0 for times that do not increase, as in files without times.
    """
    if times_s.numel() < 3 or not bool((times_s.diff() > 0).all()):
        return 0.0
    even = torch.arange(times_s.numel(), dtype=times_s.dtype) / fps
    late_s = float((times_s - times_s[0] - even).abs().max())
    return late_s if late_s > max(_UNEVEN_S, _UNEVEN_FRAMES / fps) else 0.0


def usual_fps(times_s: Tensor) -> float:
    """Frames per second of increasing times (T,), ignoring pauses.

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
