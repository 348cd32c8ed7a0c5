"""The picture of a live simulation: the camera frame with people, the scrolling map, labels over time."""

import numpy as np
import torch

from tensorsim import plot
from tensorsim.live.labels import LastColumns, LiveLabel
from tensorsim.live.simulator import LiveFrame, LiveSimulator

WIDTH, MAP_HEIGHT, STRIP_HEIGHT = 640, 240, 26
#: Seconds of the map shown.
SHOWN_S = 10.0
#: A person at 9 m, relative to one at 3 m (amplitude).
FAR_AWAY = 1 / 9
_COLOURS = ((70, 110, 180), (170, 100, 60), (80, 140, 80), (150, 80, 150), (120, 120, 60), (60, 130, 140))


class LiveView:
    """Draws the output of a :class:`~tensorsim.LiveSimulator` frame by frame.

    The map is drawn in dB below its peak, but at least that of a person far away, so that the noise of an empty scene
    stays weak.

    Args:
        simulator: the source of the frames.
        style: colours and dynamic range.
        top_speed_m_s: the map shows Doppler frequencies of speeds up to this.
    """

    def __init__(
        self, simulator: LiveSimulator, style: plot.MapStyle | None = None, top_speed_m_s: float = 6.0
    ) -> None:
        style = plot.MapStyle() if style is None else style
        radar = simulator.radar.simulator
        self.threshold = simulator.config.pose.keypoint_threshold
        self.range_db = style.dynamic_range_db
        self.table = (plot.colormap(style.colormap)(np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)
        self.rows = np.abs(simulator.doppler_hz) <= 2 * top_speed_m_s / radar.radar.doppler_wavelength_m
        self.least_peak = FAR_AWAY * plot.person_peaks(radar)["doppler_time"]
        self.top_hz = float(simulator.doppler_hz[self.rows].max())
        self.columns = round(SHOWN_S * radar.doppler.frame_rate_hz)
        self.map = LastColumns(self.columns)
        self.labels: list[LiveLabel] = []

    def add(self, new: LiveFrame) -> None:
        """Take the columns and the label of a frame, including a missed one."""
        self.map.push(new.doppler_time[torch.from_numpy(self.rows)])
        if new.label is not None:
            self.labels.append(new.label)

    def draw(self, new: LiveFrame, image: np.ndarray, dropped: int) -> np.ndarray:
        """The picture (H, 640, 3) uint8 RGB of the frame (h, w, 3) uint8 RGB that was added last."""
        self.labels = [label for label in self.labels if label.end_s > new.time_s - SHOWN_S]
        return np.concatenate([self._film(new, image, dropped), self._map(new), self._strip(new)])

    def _film(self, new: LiveFrame, image: np.ndarray, dropped: int) -> np.ndarray:
        import cv2

        if new.people:
            boxes, keypoints, scores = (
                torch.stack([getattr(person, name) for person in new.people]).float().numpy()
                for name in ("box", "keypoints", "scores")
            )
            present = np.array([person.present for person in new.people])
            image = plot.draw_people(image, boxes, keypoints, scores, present, self.threshold)
        small = cv2.resize(image, (WIDTH, round(image.shape[0] * WIDTH / image.shape[1])))
        text = f"{new.time_s:.1f} s   delay {new.delay_s:.2f} s   dropped {dropped}"
        small[:26] = small[:26] // 4  # a dark bar behind the text
        cv2.putText(small, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        return small

    def _map(self, new: LiveFrame) -> np.ndarray:
        """The last seconds of the Doppler-time map, now at the right edge."""
        import cv2

        shown = np.zeros((int(self.rows.sum()), self.columns), np.float32)
        if self.map.parts:
            last = self.map.result().numpy()
            shown[:, self.columns - last.shape[1] :] = last
        peak = max(float(shown.max()), self.least_peak)
        level = plot.decibels(shown, self.range_db, peak) / self.range_db + 1
        small = cv2.resize(level[::-1], (WIDTH, MAP_HEIGHT), interpolation=cv2.INTER_AREA)
        picture = self.table[(small * 255).astype(np.uint8)]
        cv2.line(picture, (0, MAP_HEIGHT // 2), (WIDTH, MAP_HEIGHT // 2), (150, 150, 150), 1)
        for text, y in (
            (f"+{self.top_hz:.0f} Hz, approaching", 14),
            (f"-{self.top_hz:.0f} Hz", MAP_HEIGHT - 6),
        ):
            cv2.putText(
                picture, text, (6, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA
            )
        return picture

    def _strip(self, new: LiveFrame) -> np.ndarray:
        """A strip of labels, each drawn over its last second."""
        import cv2

        strip = np.full((STRIP_HEIGHT, WIDTH, 3), 40, np.uint8)

        def at(time_s: float) -> int:
            return round((1 - (new.time_s - time_s) / SHOWN_S) * WIDTH)

        for before, label in zip([None, *self.labels], self.labels, strict=False):
            left = at(label.end_s - 1.0 if before is None else before.end_s)
            right = WIDTH if label is self.labels[-1] else at(label.end_s)
            colour = _COLOURS[sum(map(ord, label.label)) % len(_COLOURS)]
            cv2.rectangle(strip, (left, 0), (right, STRIP_HEIGHT), colour, -1)
            if before is None or before.label != label.label:
                text = f"{label.label} {100 * label.probability:.0f} %"
                place = (max(left, 0) + 4, STRIP_HEIGHT - 8)
                cv2.putText(
                    strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA
                )
        return strip
