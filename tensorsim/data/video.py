"""Video files in and out, through OpenCV: whatever its build decodes, streamed in chunks."""

import math
import os
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tensorsim.errors import TensorsimError, TensorsimWarning, check_positive

#: A file that announces so many frames per second has a broken header (1000 and 90000 are clock rates).
ABSURD_FPS = 1000.0


class VideoReader:
    """A film as chunks of frames; every pass over it starts anew, so it can be read several times.

    Frame k is at ``k / fps`` of the file. Frames are decoded one after the other from the first, also to
    reach ``start_s``: seeking is not exact in every format. Frames are turned upright as the file says.

    Args:
        path: a file that OpenCV decodes (mp4, avi, gif, ...).
        fps: frames per second of the film, instead of those that the file announces.
        start_s, end_s: keep the frames at ``start_s <= k / fps < end_s``.
        stride: keep every stride-th of them.

    Attributes:
        path: of the file.
        fps: frames per second of what is read: the film's divided by ``stride``.
        height, width: of the frames, in pixels.
        frame_count: frames to expect by what the file announces, None if it does not say; the film may have
            fewer.

    Example:
        >>> reader = VideoReader("clip.mp4", start_s=1.0)
        >>> for frames in reader.chunks(32):  # (n, 3, H, W) uint8 RGB
        ...     ...

    Raises:
        TensorsimError: no such file, no frame in it that OpenCV decodes, a frame rate that is neither
            sensible nor given, or a range without frames.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        fps: float | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
        stride: int = 1,
    ) -> None:
        self.path = Path(path)
        if fps is not None:
            check_positive(fps, "fps")
        if stride < 1:
            raise TensorsimError(f"stride: got {stride}, expected 1 or more")
        start_s = 0.0 if start_s is None else start_s
        if not 0 <= start_s < math.inf:
            raise TensorsimError(f"start_s: got {start_s}, expected a number of seconds from 0 on")
        if end_s is not None and not end_s > start_s:
            raise TensorsimError(
                f"end_s: got {end_s}, expected a number of seconds above the start, {start_s}"
            )
        if not self.path.exists():
            raise TensorsimError(f"{self.path}: no such file, expected a video")
        if not self.path.is_file():
            raise TensorsimError(f"{self.path}: got a folder, expected a video file")

        with self._opened() as capture:
            file_fps, announced = _properties(capture)
            if fps is None and not 0 < file_fps < ABSURD_FPS:
                raise TensorsimError(
                    f"{self.path}: the file announces {file_fps} frames per second, expected a positive "
                    f"number below {ABSURD_FPS:g}; give the frame rate as fps"
                )
            film_fps = float(file_fps if fps is None else fps)
            self._stride = stride
            self._first = _frame_at(start_s, film_fps)
            self._end = None if end_s is None or end_s == math.inf else _frame_at(end_s, film_fps)
            skipped = _skip(capture, self._first)
            found, frame = capture.read() if skipped == self._first else (False, np.empty((0, 0)))
        if not found and skipped:
            raise TensorsimError(
                f"{self.path}: got a start of {start_s} s, expected less than its length of "
                f"{skipped / film_fps:.3f} s ({skipped} frames at {film_fps:g} fps)"
            )
        if not found:
            raise TensorsimError(f"{self.path}: got no frame that OpenCV can decode, expected a video")
        if self._end is not None and self._end <= self._first:
            raise TensorsimError(
                f"{self.path}: no frame lies between {start_s} and {end_s} s at {film_fps:g} fps"
            )
        self.fps = film_fps / stride
        self.height: int = frame.shape[0]
        self.width: int = frame.shape[1]
        self._announced = announced
        self.frame_count = (
            None if announced is None else max(1, -(-(self._stop(announced) - self._first) // stride))
        )

    def chunks(self, size: int) -> Iterator[Tensor]:
        """The frames in order, at most ``size`` at a time: (n, 3, H, W) uint8 RGB on the CPU, n >= 1.

        A film that ends before the frames that its file announces (a cut-off download) gives what is there,
        with a TensorsimWarning.

        Raises:
            TensorsimError: a size below 1, or a film whose frames change their size.
        """
        if size < 1:
            raise TensorsimError(f"chunks: got a size of {size} frames, expected 1 or more")
        return self._chunks(size)

    def _chunks(self, size: int) -> Iterator[Tensor]:
        import cv2

        with self._opened() as capture:
            index = _skip(capture, self._first)
            buffer = np.empty((size, self.height, self.width, 3), np.uint8)
            filled = 0
            while (self._end is None or index < self._end) and capture.grab():
                if (index - self._first) % self._stride == 0:
                    found, frame = capture.retrieve()
                    if not found:
                        break
                    if frame.shape != buffer.shape[1:]:
                        raise TensorsimError(
                            f"{self.path}: frame {index} has shape {frame.shape}, "
                            f"expected {buffer.shape[1:]} as the first"
                        )
                    cv2.cvtColor(frame, cv2.COLOR_BGR2RGB, dst=buffer[filled])
                    filled += 1
                index += 1
                if filled == size:
                    yield _planes(buffer)
                    filled = 0
            if filled:
                yield _planes(buffer[:filled])
        if self._announced is not None:
            expected = self._stop(self._announced)
            # Containers count by duration and are often a frame or two off.
            if expected - index > max(2, 0.02 * expected):
                warnings.warn(
                    f"{self.path}: got {index} frames, expected {expected} as the file announces: "
                    f"it seems cut off",
                    TensorsimWarning,
                    stacklevel=2,
                )

    def _stop(self, announced: int) -> int:
        return announced if self._end is None else min(announced, self._end)

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        import cv2

        with _quiet_opencv():
            capture = cv2.VideoCapture(str(self.path))
        try:
            if not capture.isOpened():
                raise TensorsimError(f"{self.path}: OpenCV cannot read this, expected a video")
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            yield capture
        finally:
            capture.release()


def write_video(path: str | os.PathLike[str], frames: Iterable[np.ndarray], fps: float) -> None:
    """Write a film; the file appears when it is complete, or not at all.

    Args:
        path: ending in ``.mp4`` (MPEG-4) or another container that OpenCV writes with this codec.
        frames: (H, W, 3) uint8 RGB, all of one size; an odd height or width gets its last row or column
            twice, because the codec halves the colours.
        fps: frames per second.

    Raises:
        TensorsimError: no frames, frames of another kind or of several sizes, or a file that OpenCV cannot
            write.
    """
    import cv2

    check_positive(fps, "fps")
    path = Path(path)
    if not path.parent.is_dir():
        raise TensorsimError(f"{path}: no such folder {path.parent}, expected one to write into")
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".writing-") as folder:
        partial = Path(folder) / path.name
        writer, shape = cv2.VideoWriter(), None
        try:
            for frame in frames:
                is_image = frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[-1] == 3
                if not is_image or frame.shape != (shape or frame.shape):
                    raise TensorsimError(
                        f"write_video: got a frame of {frame.dtype} {frame.shape}, "
                        f"expected uint8 {shape or '(H, W, 3)'}"
                    )
                height, width = frame.shape[:2]
                if shape is None:
                    shape = frame.shape
                    _open_writer(writer, partial, fps, (width + width % 2, height + height % 2))
                bgr = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
                writer.write(cv2.copyMakeBorder(bgr, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE))
        finally:
            writer.release()
        if shape is None:
            raise TensorsimError(f"{path}: got no frames, expected at least one")
        os.replace(partial, path)


def _open_writer(writer: Any, path: Path, fps: float, size: tuple[int, int]) -> None:
    import cv2

    with _quiet_opencv():
        opened = writer.open(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    if not opened:
        raise TensorsimError(
            f"{path.name}: OpenCV cannot write this file at {fps:g} frames per second, expected a name ending in .mp4 "
            "and a usual rate"
        )


def _planes(frames: np.ndarray) -> Tensor:
    """(n, H, W, 3) of a buffer that is used again -> (n, 3, H, W) of its own."""
    return torch.from_numpy(frames).permute(0, 3, 1, 2).clone(memory_format=torch.contiguous_format)


def _properties(capture: Any) -> tuple[float, int | None]:
    """Frames per second and number of frames that a file announces (None if it does not)."""
    import cv2

    count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    return capture.get(cv2.CAP_PROP_FPS), int(count) if 0 < count < 1e9 else None


def _frame_at(seconds: float, fps: float) -> int:
    """The first frame k with ``k / fps >= seconds``, up to rounding."""
    return math.ceil(seconds * fps - 1e-6)


def _skip(capture: Any, count: int) -> int:
    """Decode and drop up to ``count`` frames; returns how many there were."""
    for index in range(count):
        if not capture.grab():
            return index
    return count


@contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Keep the log of OpenCV and its FFmpeg off stderr: damage becomes an exception or a warning of ours."""
    # FFmpeg's level is read once, by the first film of the process.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    from cv2.utils import logging

    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)
