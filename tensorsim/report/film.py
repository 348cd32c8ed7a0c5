"""The film of a report: small pictures embedded in the page, or a separate film if there are too many."""

import base64
from pathlib import Path
from typing import Any

import numpy as np

from tensorsim.data.video_writer import VideoWriter

#: A film of at most this many frames is embedded in the page as JPEG pictures of at most this many bytes in total.
MOST_FRAMES, MOST_BYTES = 900, 8_000_000
WIDTH = 480
QUALITIES = (75, 55, 35, 20, 10)
BESIDE = "report.webm"


class FilmStrip:
    """Collects the pictures of a film, reduced to :data:`WIDTH` pixels.

    Args:
        folder: folder of the report; a long film is written there as :data:`BESIDE`.
        frames: number of frames to come.
        fps: frames per second.

    Raises:
        TensorsimError: see :class:`~tensorsim.data.video_writer.VideoWriter`.
    """

    def __init__(self, folder: Path, frames: int, fps: float) -> None:
        self.pictures: list[str] = []
        self.size = (0, 0)
        self._budget = MOST_BYTES // max(frames, 1)
        self._beside = VideoWriter(folder / BESIDE, fps) if frames > MOST_FRAMES else None

    def __enter__(self) -> "FilmStrip":
        if self._beside is not None:
            self._beside.__enter__()
        return self

    def __exit__(self, *failure: Any) -> None:
        if self._beside is not None:
            self._beside.__exit__(*failure)

    def add(self, frame: np.ndarray) -> None:
        """Append a frame (H, W, 3) uint8 RGB."""
        import cv2

        height, width = frame.shape[:2]
        scale = min(1.0, WIDTH / width)
        self.size = (max(1, round(width * scale)), max(1, round(height * scale)))
        # Halved by area averages, then bilinear: a sixth of the time of area averages at a fractional ratio.
        small = frame
        while small.shape[1] >= 2 * self.size[0] and small.shape[0] >= 2 * self.size[1]:
            small = cv2.resize(
                small, (small.shape[1] // 2, small.shape[0] // 2), interpolation=cv2.INTER_AREA
            )
        small = cv2.resize(small, self.size, interpolation=cv2.INTER_LINEAR)
        if self._beside is not None:
            self._beside.add(small)
        else:
            self.pictures.append(base64.b64encode(_jpeg(small, self._budget)).decode())

    def content(self) -> dict[str, Any]:
        """The data on the film for the page."""
        width, height = self.size
        beside = None if self._beside is None else BESIDE
        return {"width": width, "height": height, "pictures": self.pictures, "beside": beside}


def _jpeg(frame: np.ndarray, budget: int) -> bytes:
    """A picture as JPEG with the best quality that fits the budget; if none does, the lowest quality."""
    import cv2

    bgr = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    for quality in QUALITIES:
        data = bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
        if len(data) <= budget:
            break
    return data
