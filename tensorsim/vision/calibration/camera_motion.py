"""Whether and how the camera of a film moves: how the background shifts from picture to picture."""

import math
import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tensorsim.errors import TensorsimWarning, check_positive

#: Pictures are compared at this width at most, in pixels, and at this interval in seconds.
_WIDTH, _STEP_S = 320, 0.1
#: With fewer corners than this, or a smaller share of them that agree on one motion, the motion is unclear.
_LEAST_POINTS, _LEAST_SHARE = 12, 0.5
#: If the motion is unclear in more than this share of the pictures, the camera's direction counts as unknown.
_MOST_UNCLEAR = 0.1
#: A camera moves if the background shifts by more than this share of the picture's width within a second.
MOVING_SHARE = 0.02


class BackgroundMotion:
    """How far the background of a film shifts within a second, from pictures that are given one after the other.

    Corners outside people's boxes are tracked from picture to picture (pyramidal Lucas-Kanade, forward and backward),
    and one similarity (shift, turn, zoom) is fitted to them by RANSAC: things that move on their own are outliers. The
    similarities of a second are composed; their shift is the root mean square over the picture, so that turns and
    zooms count as well. Seconds with a picture in which too few corners agree (a cut, a bare wall) are skipped.

    Args:
        fps: frames per second of the film.
        step_s: seconds between the pictures that are compared; 0 compares all.

    Attributes:
        width, height: of the pictures, in pixels.
        shift_px_s: the largest shift within a second, in pixels of the film; None while no second is known.

    Raises:
        TensorsimError: a rate that is not positive.
    """

    def __init__(self, fps: float, step_s: float = _STEP_S) -> None:
        check_positive(fps, "fps")
        self._every = max(1, round(step_s * fps))
        self._second = max(1, round(fps / self._every))  # steps
        self._per_s = fps / (self._every * self._second)
        self._index = 0
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # picture and where background is
        self._steps: list[
            np.ndarray | None
        ] = []  # (3, 3) from picture to picture, in pixels of the compared ones
        self._scale = 1.0
        self.width = self.height = 0
        self.shift_px_s: float | None = None

    def add(self, frames: Tensor, boxes: Tensor, valid: Tensor) -> None:
        """Look at further frames.

        Args:
            frames: (n, 3, H, W) uint8 RGB on the CPU.
            boxes: (n, P, 4) ``xyxy`` pixels of the people in them.
            valid: (n, P) bool.
        """
        for frame, people, there in zip(frames, boxes.cpu(), valid.cpu(), strict=True):
            if self._index % self._every == 0:
                self._look(frame, people[there].double().numpy())
            self._index += 1

    def _look(self, frame: Tensor, boxes: np.ndarray) -> None:
        """Follow the background from the last picture to this one."""
        import cv2

        self.height, self.width = frame.shape[1:]
        self._scale = min(1.0, _WIDTH / self.width)
        size = (round(frame.shape[2] * self._scale), round(frame.shape[1] * self._scale))
        # The green channel is most of the brightness.
        green = cv2.extractChannel(frame.permute(1, 2, 0).numpy(), 1)
        picture = cv2.resize(green, size, interpolation=cv2.INTER_AREA)
        background = np.full(picture.shape, 255, np.uint8)
        for x1, y1, x2, y2 in boxes * self._scale:
            margin = 0.1 * max(x2 - x1, y2 - y1)
            left, top, right, bottom = (
                max(0, int(v)) for v in (x1 - margin, y1 - margin, x2 + margin + 1, y2 + margin + 1)
            )
            background[top:bottom, left:right] = 0
        last, self._last = self._last, (picture, background)
        if last is None:
            return
        self._steps.append(similarity_of(*last, picture, background))
        second = [step for step in self._steps[-self._second :] if step is not None]
        if len(second) == self._second:
            shift = _mean_shift(second, picture.shape) / self._scale * self._per_s
            self.shift_px_s = max(shift, self.shift_px_s or 0.0)

    def steps(self) -> Tensor | None:
        """How the background moves to each compared picture from the one before; None if that is unclear.

        Returns:
            (n, 4) float64 as :func:`~tensorsim.vision.calibration.stabilisation.camera_path` takes it, no motion where
            too few corners agree. None if that is so for more than a tenth of the steps.
        """
        unclear = sum(step is None for step in self._steps)
        if len(self._steps) == 0 or unclear > _MOST_UNCLEAR * len(self._steps):
            return None
        middle = np.array([(self.width - 1) / 2, (self.height - 1) / 2])
        rows = [np.zeros(4)]
        for step in self._steps:
            step = np.eye(3) if step is None else step
            # Compared pictures are resized: their pixel k is the film's (k + 0.5) / scale - 0.5.
            at = (middle + 0.5) * self._scale - 0.5
            shift = (step[:2, :2] @ at + step[:2, 2] - at) / self._scale
            rows.append(
                np.array([*shift, math.atan2(step[1, 0], step[0, 0]), math.log(math.hypot(*step[:2, 0]))])
            )
        return torch.from_numpy(np.stack(rows))

    def moves(self) -> bool:
        """Whether the camera moves: the background shifts by more than :data:`MOVING_SHARE` in a second."""
        return self.shift_px_s is not None and self.shift_px_s > MOVING_SHARE * self.width

    def warn(self, made_still: bool = False) -> None:
        """Issue a TensorsimWarning if the camera moves; it says whether its turns and zooms are taken out."""
        if self.moves():
            effect = (
                "its turns and zooms are taken out of the motion of people, but not where it is carried along"
                if made_still
                else "that is not taken out of the motion of people"
            )
            warnings.warn(
                f"the camera moves: the background shifts by up to {self.shift_px_s:.0f} pixels per second, in "
                f"pictures {self.width} pixels wide; {effect}",
                TensorsimWarning,
                stacklevel=2,
            )


def similarity_of(
    before: np.ndarray, background_before: np.ndarray, after: np.ndarray, background_after: np.ndarray
) -> np.ndarray | None:
    """The similarity (3, 3) that maps the background of one picture to that of the next; None if unclear.

    Args:
        before, after: (h, w) uint8 brightness.
        background_before, background_after: (h, w) uint8, 255 where no person is.
    """
    import cv2

    corners: Any = cv2.goodFeaturesToTrack(before, 200, 0.01, 7, mask=background_before)
    if corners is None or len(corners) < _LEAST_POINTS:
        return None
    how: Any = {"winSize": (15, 15), "maxLevel": 4}
    no_guess: Any = None  # OpenCV's type stubs do not allow None here
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, no_guess, **how)
    returned, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, no_guess, **how)
    good = (found[:, 0] == 1) & (found_back[:, 0] == 1)
    good &= np.linalg.norm(returned - corners, axis=-1)[:, 0] < 0.5
    column, row = (moved[:, 0, k].round().astype(int).clip(0, after.shape[1 - k] - 1) for k in range(2))
    good &= background_after[row, column] > 0
    if good.sum() < _LEAST_POINTS:
        return None
    affine, agree = cv2.estimateAffinePartial2D(
        corners[good], moved[good], method=cv2.RANSAC, ransacReprojThreshold=1.0
    )
    if affine is None or agree.mean() < _LEAST_SHARE:
        return None
    return np.vstack([affine, [0.0, 0.0, 1.0]])


def _mean_shift(steps: list[np.ndarray], shape: tuple[int, ...]) -> float:
    """Root mean square displacement of four points inside a picture (h, w), in its pixels."""
    points = np.array([(x * shape[1], y * shape[0], 1.0) for x in (0.2, 0.8) for y in (0.2, 0.8)]).T
    moved = points
    for step in steps:
        moved = step @ moved
    return float(np.sqrt(np.square(moved - points).sum(axis=0).mean()))
