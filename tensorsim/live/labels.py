"""Activities in real time: the recognizer classifies the last seconds of the maps."""

from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.radar.simulator import RadarSimulator
from tensorsim.recognition import ActivityRecognizer
from tensorsim.recognition.timeline import NOT_SURE, STEP_S, WINDOW_S
from tensorsim.types import RadarMaps


class LiveLabel(NamedTuple):
    """The activity of the last seconds: start, end, name and probability."""

    start_s: float
    end_s: float
    label: str
    probability: float


class LastColumns:
    """The last columns (rows, n) of a growing map."""

    def __init__(self, columns: int) -> None:
        self.columns = max(1, columns)
        self.parts: list[Tensor] = []

    def push(self, fresh: Tensor) -> None:
        """Append columns (rows, k)."""
        if fresh.shape[-1]:
            self.parts.append(fresh)
        while sum(part.shape[-1] for part in self.parts[1:]) >= self.columns:
            del self.parts[0]

    def result(self) -> Tensor:
        """The last columns, at most ``columns`` of them."""
        return torch.cat(self.parts, dim=-1)[:, -self.columns :]


class LiveLabels:
    """Labels the last four seconds once a second.

    Args:
        recognizer: recognizer for the simulator's radar.
        simulator: the simulator that makes the maps.
        least_probability: labels with a lower probability become "not sure".
    """

    def __init__(
        self, recognizer: ActivityRecognizer, simulator: RadarSimulator, least_probability: float = 0.0
    ) -> None:
        self.recognizer, self.simulator, self.least_probability = recognizer, simulator, least_probability
        self.doppler_time = LastColumns(round(WINDOW_S * simulator.doppler.frame_rate_hz))
        range_rate_hz = simulator.radar.prf_hz / simulator.range_time_block
        self.range_time_mti = LastColumns(round(WINDOW_S * range_rate_hz))
        self.due_s = WINDOW_S

    def push(self, doppler_time: Tensor, range_time_mti: Tensor, end_s: float) -> LiveLabel | None:
        """Append columns that end at ``end_s``; returns a label when one is due."""
        self.doppler_time.push(doppler_time)
        self.range_time_mti.push(range_time_mti)
        if end_s < self.due_s:
            return None
        self.due_s += STEP_S
        window, moving = self.doppler_time.result(), self.range_time_mti.result()
        ridges = self.simulator.ridges(window)
        maps = RadarMaps(moving, moving, window, ridges.indices, ridges.magnitudes, torch.zeros(()))
        probabilities = self.recognizer.probabilities(maps)
        best = int(probabilities.argmax())
        probability = float(probabilities[best])
        name = self.recognizer.class_names[best] if probability >= self.least_probability else NOT_SURE
        return LiveLabel(end_s - WINDOW_S, end_s, name, probability)
