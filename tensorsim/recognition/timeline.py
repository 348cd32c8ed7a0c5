"""Activities over time: a recognizer applied to windows of the maps."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError, check_positive
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.types import RadarMaps

#: Length of the clips that the shipped networks were trained on.
WINDOW_S = 4.0
STEP_S = 1.0
#: The label of a window whose most probable class is less probable than required.
NOT_SURE = "not sure"


class Window(NamedTuple):
    """The activity within a window of a scene.

    Attributes:
        start_s, end_s: seconds from the beginning of the maps.
        label: the most probable class, or :data:`NOT_SURE`.
        probabilities: of the classes of the recognizer, in their order.
        power: mean power of the columns of the Doppler-time map.
    """

    start_s: float
    end_s: float
    label: str
    probabilities: tuple[float, ...]
    power: float


def window_starts(duration_s: float, window_s: float = WINDOW_S, step_s: float = STEP_S) -> list[float]:
    """Start times of windows that cover a duration: every ``step_s``, with the last window at the end.

    The last window starts half a step to one and a half steps after the one before.

    A duration shorter than a window and a step gives one window, so that nearly the same part is not labelled twice.
    """
    check_positive(window_s, "window_s")
    check_positive(step_s, "step_s")
    if duration_s < window_s + step_s:
        return [0.0]
    last = duration_s - window_s
    starts = [step_s * k for k in range(math.floor(last / step_s + 1e-9) + 1)]
    # The last window ends with the scene; one that begins just before it would repeat it.
    return [*(start for start in starts if last - start >= step_s / 2), last]


@torch.no_grad()
def label_windows(
    recognizer: ActivityRecognizer,
    maps: RadarMaps,
    duration_s: float,
    window_s: float = WINDOW_S,
    step_s: float = STEP_S,
    least_probability: float = 0.0,
) -> list[Window]:
    """Label the windows of the maps of one scene.

    Args:
        recognizer: for the radar of the maps.
        maps: without batch dimensions.
        duration_s: of the scene; the columns of each map are spread over it evenly.
        window_s: length of a window.
        step_s: from one window to the next.
        least_probability: a window whose most probable class is less probable than this is :data:`NOT_SURE`. The
            default, 0.0, always gives the most probable class; the default of ``tensorsim simulate`` is 0.2.

    Raises:
        TensorsimError: maps with batch dimensions, or a length that is not positive.
    """
    windows = []
    for start_s, end_s, part in windows_of(maps, duration_s, window_s, step_s):
        probabilities = recognizer.probabilities(part)
        best = int(probabilities.argmax())
        sure = float(probabilities[best]) >= least_probability
        label = recognizer.class_names[best] if sure else NOT_SURE
        power = float(part.doppler_time.double().square().sum(dim=-2).mean())
        windows.append(Window(start_s, end_s, label, tuple(probabilities.tolist()), power))
    return windows


def windows_of(
    maps: RadarMaps, duration_s: float, window_s: float = WINDOW_S, step_s: float = STEP_S
) -> list[tuple[float, float, RadarMaps]]:
    """Start and end in seconds and the maps of each window of one scene; see :func:`label_windows`.

    Raises:
        TensorsimError: maps with batch dimensions, or a length that is not positive.
    """
    if maps.doppler_time.dim() != 2:
        raise TensorsimError(
            f"windows_of: got maps of shape {list(maps.doppler_time.shape)}, expected those of one scene (F, K)"
        )
    check_positive(duration_s, "duration_s")
    windows = []
    for start_s in window_starts(duration_s, window_s, step_s):
        end_s = min(start_s + window_s, duration_s) if duration_s >= window_s + step_s else duration_s
        windows.append((start_s, end_s, _part(maps, start_s / duration_s, end_s / duration_s)))
    return windows


def _part(maps: RadarMaps, start: float, end: float) -> RadarMaps:
    """The columns of maps between two fractions of their length."""

    def cut(x: Tensor) -> Tensor:
        columns = x.shape[-1]
        first = min(round(start * columns), columns - 1)
        return x[..., first : max(round(end * columns), first + 1)]

    columns = {
        name: cut(getattr(maps, name))
        for name in ("range_time", "range_time_mti", "doppler_time", "ridges", "ridge_magnitudes")
    }
    return maps._replace(**columns)


def scene_probabilities(windows: list[Window]) -> Tensor:
    """Mean probabilities (classes,) over the windows of a scene, weighted by their power; the plain mean if it is 0.

    The recognizer scales the picture of each window to its own peak, so it cannot see how weak an echo is. A window in
    which a person only stands still, or is gone after a fall, should have little influence on the result.
    """
    probabilities = torch.tensor([window.probabilities for window in windows], dtype=torch.float64)
    power = torch.tensor([window.power for window in windows], dtype=torch.float64)
    weights = power if bool(power.any()) else torch.ones_like(power)
    return weights @ probabilities / weights.sum()
