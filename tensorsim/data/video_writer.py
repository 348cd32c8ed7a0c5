"""Write video files through OpenCV, frame by frame."""

import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tensorsim.data.video import opening, properties, silent_log
from tensorsim.errors import TensorsimError, check_positive
from tensorsim.files import NotWrittenError, check_name, writing
from tensorsim.threads import shared


class VideoWriter:
    """Writes a video frame by frame; the file appears when it is complete, or not at all.

    Args:
        path: ending in ``.mp4`` (MPEG-4), ``.webm`` (VP8, which browsers play) or another container that OpenCV writes
            with MPEG-4. For an odd height or width the last row or column is repeated, because the codecs halve the
            colour resolution.
        fps: frames per second.

    Example:
        >>> with VideoWriter("grey.mp4", fps=10.0) as film:
        ...     for _ in range(3):
        ...         film.add(np.full((48, 64, 3), 128, np.uint8))

    Raises:
        TensorsimError: no frames, frames of the wrong type or of different sizes, or a file that OpenCV cannot write.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float) -> None:
        check_positive(fps, "fps")
        self.path, self.fps, self.count = Path(path), fps, 0
        check_name(self.path, "path")
        if not self.path.parent.is_dir():
            raise TensorsimError(
                f"{self.path}: no such folder {self.path.parent}, expected one to write into"
            )
        self._shape: tuple[int, ...] | None = None

    def __enter__(self) -> "VideoWriter":
        import cv2

        with writing(self.path):
            self._folder = tempfile.TemporaryDirectory(dir=self.path.parent, prefix=".writing-")
        self._partial = Path(self._folder.name) / self.path.name
        self._writer = cv2.VideoWriter()
        return self

    def add(self, frame: np.ndarray) -> None:
        """Append a frame (H, W, 3) uint8 RGB, of the same size as the first."""
        import cv2

        is_image = frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[-1] == 3
        if not is_image or frame.shape != (self._shape or frame.shape):
            raise TensorsimError(
                f"write_video: got a frame of {frame.dtype} {frame.shape}, "
                f"expected uint8 {self._shape or '(H, W, 3)'}"
            )
        height, width = frame.shape[:2]
        if self._shape is None:
            self._shape = frame.shape
            _open_writer(self._writer, self._partial, self.fps, (width + width % 2, height + height % 2))
        bgr = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
        if height % 2 or width % 2:
            bgr = cv2.copyMakeBorder(bgr, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        self.count += 1  # an interrupt after the write must not leave the frame uncounted
        with silent_log():  # a full disk is noticed at the end
            self._writer.write(bgr)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._folder:
            self._writer.release()
            if kind is not None:
                return
            if self.count == 0:
                raise TensorsimError(f"{self.path}: got no frames, expected at least one")
            # OpenCV does not report failed writes, as on a full disk; missing frames are noticed on reading.
            if _frames_in(self._partial) != self.count:
                raise NotWrittenError(self.path, "the film is not whole; is the disk full?")
            with writing(self.path):
                os.replace(self._partial, self.path)


def write_video(path: str | os.PathLike[str], frames: Iterable[np.ndarray], fps: float) -> None:
    """Write frames (H, W, 3) uint8 RGB as a video: see :class:`VideoWriter` for arguments and errors."""
    with VideoWriter(path, fps) as film:
        for frame in frames:
            film.add(frame)


def _frames_in(path: Path) -> int | None:
    """Number of frames stated by a complete file; None for an incomplete one."""
    import cv2

    with opening():
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        return properties(capture)[1] if capture.isOpened() else None
    finally:
        capture.release()


def _open_writer(writer: Any, path: Path, fps: float, size: tuple[int, int]) -> None:
    import cv2

    codec = "VP80" if path.suffix.lower() == ".webm" else "mp4v"
    # OpenCV warns that WebM uses another tag for its own codec, and takes that one.
    with opening(), _silent_stderr():
        opened = writer.open(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), fps, size)
    if not opened:
        raise TensorsimError(
            f"{path.name}: OpenCV cannot write this file at {fps:g} frames per second, expected a name ending in .mp4 "
            "and a usual rate"
        )


@shared
@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard what libraries print to the standard error of the process."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
