"""Read video files through OpenCV, streamed in chunks."""

import math
import os
import warnings
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tensorsim.data.frame_times import FilmClock, nearest_frames, unevenness_s, usual_fps
from tensorsim.errors import TensorsimError, TensorsimWarning, check_positive
from tensorsim.files import check_name
from tensorsim.limits import RANGES, check_range
from tensorsim.threads import ahead, shared

#: Memory in MB for keeping the frames of a video that is read several times: 12 s of 720p at 30 frames per second.
KEPT_MB = 1000.0
#: A file that states this many frames per second has a broken header (1000 and 90000 are clock rates).
ABSURD_FPS = 1000.0

_JPEG = b"\xff\xd8\xff"
#: First bytes of video files and their offsets: FFmpeg would also open playlists, which refer to other files and URLs.
_CONTAINERS = (
    *((4, kind) for kind in (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")),  # mp4, mov, 3gp
    (8, b"AVI "),
    (0, b"\x1a\x45\xdf\xa3"),  # Matroska, WebM
    (0, b"GIF8"),
    (0, b"\x47"),  # MPEG-2 transport stream
    (4, b"\x47"),  # the same with time stamps (m2ts)
    (0, b"\x00\x00\x01"),  # MPEG program and elementary streams
    (0, b"\x00\x00\x00\x01"),
    (0, b"FLV"),
    (0, b"OggS"),
    (0, b"\x30\x26\xb2\x75"),  # Windows Media
    (0, b"YUV4MPEG2 "),
    (0, b"DKIF"),  # IVF
    (0, b"\x06\x0e\x2b\x34"),  # MXF
    (0, _JPEG),  # one image after another
)


class VideoReader:
    """A video as chunks of frames; every pass starts from the beginning, so it can be read several times.

    Frame k is at ``k / fps`` unless the file gives it another time (see
    :class:`~tensorsim.data.frame_times.FilmClock`); ``uneven_times_s`` holds the actual times. Frames are decoded in
    order from the first, even to reach ``start_s``: seeking is not exact in every format. Frames are rotated upright
    as stated by the file.

    Args:
        path: an mp4, mov, 3gp, mkv, webm, avi, gif, mpg, ts, flv, ogv, wmv, mxf, mjpeg, y4m or ivf that OpenCV decodes.
        fps: frames per second of the video, overriding the file's.
        start_s, end_s: keep frames from ``start_s`` up to but not including ``end_s``, in seconds of the video.
        stride: keep every stride-th of them.
        kept_mb: a video whose frames fit into this many megabytes stays in memory after the first pass and is not
            decoded again for passes in chunks of the same size or a divisor of it.

    Attributes:
        path: path of the file.
        fps: frames per second of what is read: that of the video divided by ``stride``. For the video it is the rate
            stated by the file or, if the frames are unevenly spaced, their rate without pauses.
        height, width: size of the frames, in pixels.
        frame_count: expected number of frames according to the file, None if not stated; there may be fewer.
        duration_s: expected duration in seconds, likewise.
        uneven_times_s: (n,) float64 times in seconds of the frames read, known once all have been read, if they are
            unevenly spaced (a GIF with a pause, a phone that saves power); None if they are even or ``fps`` was
            given.

    Example:
        >>> reader = VideoReader("clip.mp4", start_s=1.0)
        >>> for frames in reader.chunks(32):
        ...     print(frames.dtype, frames.shape)
        torch.uint8 torch.Size([32, 3, 48, 64])
        torch.uint8 torch.Size([3, 3, 48, 64])

    Raises:
        TensorsimError: no such file, an unsupported type, a single image, no frame that OpenCV can decode, no sensible
            frame rate in the file and none given, or a range without frames.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        fps: float | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
        stride: int = 1,
        kept_mb: float = 0.0,
    ) -> None:
        self.path = Path(path)
        start_s = 0.0 if start_s is None else start_s
        _check_cut(fps, start_s, end_s, stride)
        _check_is_film(self.path)
        self._stride, self._own_times = stride, fps is None
        self._end_s = math.inf if end_s is None or end_s > RANGES["time"].high else end_s
        if _begins_with(self.path, [(0, _JPEG)]):
            with self._opened() as capture:
                if not (capture.grab() and capture.grab()):
                    raise TensorsimError(f"{self.path}: got a single picture, expected a video")
        with self._opened() as capture:
            file_fps, announced = properties(capture)
            if fps is None and not 0 < file_fps < ABSURD_FPS:
                raise TensorsimError(
                    f"{self.path}: the file states {file_fps} frames per second, expected a positive "
                    f"number below {ABSURD_FPS:g}; give the frame rate as fps"
                )
            film_fps, length_s = float(file_fps if fps is None else fps), None
            if fps is None:
                times_s = self._times_in_file(start_s)
                # For a video with a long pause the file states the mean rate.
                if unevenness_s(times_s, film_fps) and usual_fps(times_s) < ABSURD_FPS:
                    film_fps = usual_fps(times_s)
                    length_s = float(times_s[-1] - times_s[0]) + 1 / film_fps
            self._film_fps = film_fps
            clock = self._clock()
            self._first, at_s = _first_from(capture, clock, start_s - 1e-6 / film_fps)
            found, frame = (False, np.empty((0, 0))) if at_s is None else capture.retrieve()
        if not found and self._first:
            raise TensorsimError(
                f"{self.path}: got a start of {start_s} s, expected less than its length of "
                f"{clock.last_s + 1 / film_fps:.3f} s ({self._first} frames at {film_fps:g} fps)"
            )
        if not found or at_s is None:
            raise TensorsimError(f"{self.path}: got no frame that OpenCV can decode, expected a video")
        if self._is_after(at_s):
            raise TensorsimError(
                f"{self.path}: no frame lies between {start_s} and {end_s} s at {film_fps:g} fps"
            )
        self.fps = film_fps / stride
        self.height: int = frame.shape[0]
        self.width: int = frame.shape[1]
        for side in (self.height, self.width):
            check_range(side, "image side", f"{self.path}: frames of {self.width}x{self.height} pixels")
        self.uneven_times_s: Tensor | None = None
        self._announced = announced
        self.frame_count = (
            None if announced is None else max(1, -(-(self._stop(announced) - self._first) // stride))
        )
        if length_s is None and self.frame_count is not None:
            length_s = self.frame_count / self.fps
        self.duration_s = length_s
        self._most_kept = int(kept_mb * 1e6 / frame.nbytes)
        self._kept: list[Tensor] = []

    def chunks(self, size: int) -> Iterator[Tensor]:
        """The frames in order, at most ``size`` at a time: (n, 3, H, W) uint8 RGB on the CPU, n >= 1, channels last.

        They are decoded in a separate thread, two chunks ahead.

        A video with fewer frames than its file states (a truncated download) yields those that exist, with a
        TensorsimWarning. Unevenly spaced frames are yielded as they come, with a TensorsimWarning, and their times
        are in ``uneven_times_s`` afterwards; :meth:`even_chunks` yields them at even times.

        Raises:
            TensorsimError: a size below 1, or frames that change size.
        """
        if size < 1:
            raise TensorsimError(f"chunks: got a size of {size} frames, expected 1 or more")
        if self._kept and self._kept[0].shape[0] % size == 0:
            return (part for chunk in self._kept for part in chunk.split(size))
        fits = self.frame_count is not None and self.frame_count <= self._most_kept
        return ahead(self._keeping(size) if fits else self._chunks(size))

    def even_chunks(self, size: int) -> Iterator[Tensor]:
        """As :meth:`chunks`, but if ``uneven_times_s`` is known, the frames nearest to evenly spaced times.

        A frame shown for long is repeated; one shown only briefly may be left out.
        """
        if self.uneven_times_s is None:
            yield from self.chunks(size)
            return
        index = nearest_frames(self.uneven_times_s, self.fps)
        done = 0
        for frames in self.chunks(size):
            here = index[(index >= done) & (index < done + frames.shape[0])] - done
            for part in here.split(size):
                yield frames[part]
            done += frames.shape[0]

    def _keeping(self, size: int) -> Generator[Tensor, None, None]:
        """The chunks, which are kept in memory once the pass is complete."""
        kept: list[Tensor] = []
        count = 0
        for chunk in self._chunks(size):
            count += chunk.shape[0]
            if count > self._most_kept:  # more than the file states
                kept.clear()
            else:
                kept.append(chunk)
            yield chunk
        self._kept = kept

    def timed_frames(self) -> Iterator[tuple[float, Tensor]]:
        """The frames one at a time: the time of each in seconds of the video, and the frame (3, H, W) uint8 RGB.

        Warnings and errors are those of :meth:`chunks`, except for uneven times.
        """
        import cv2

        frames = (
            (time_s, torch.from_numpy(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)).permute(2, 0, 1))
            for time_s, _, frame in self._decoded()
        )
        return ahead(frames)

    def _chunks(self, size: int) -> Generator[Tensor, None, None]:
        import cv2

        def empty() -> Tensor:
            # NumPy would ask for huge pages, which can take the kernel several times as long to find.
            return torch.empty(size, self.height, self.width, 3, dtype=torch.uint8)

        buffer, filled = empty(), 0
        times_s: list[float] = []
        for _, own_s, frame in self._decoded():
            times_s.append(own_s)
            cv2.cvtColor(frame, cv2.COLOR_BGR2RGB, dst=buffer[filled].numpy())
            filled += 1
            if filled == size:
                yield buffer.permute(0, 3, 1, 2)
                buffer, filled = empty(), 0
        if filled:
            yield buffer[:filled].permute(0, 3, 1, 2)
        self._keep_times(torch.tensor(times_s, dtype=torch.float64))

    def _decoded(self) -> Generator[tuple[float, float, np.ndarray], None, None]:
        """For each kept frame: its time, its time in the file, both in seconds, and the frame (H, W, 3) BGR."""
        import cv2

        shape = self.height, self.width, 3
        with self._opened() as capture:
            clock, index, ended = self._clock(), 0, False
            while capture.grab():
                own_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                time_s = clock.time_s(index, own_s)
                ended = self._is_after(time_s) and index >= self._first
                if ended:
                    break
                if index >= self._first and (index - self._first) % self._stride == 0:
                    found, frame = capture.retrieve()
                    if not found:
                        break
                    if frame.shape != shape:
                        raise TensorsimError(
                            f"{self.path}: frame {index} has shape {frame.shape}, expected {shape} like the first"
                        )
                    yield time_s, own_s, frame
                index += 1
        if self._announced is not None and not ended:
            expected = self._stop(self._announced)
            # Frame counts in containers come from the duration and are often a frame or two off.
            if expected - index > max(2, 0.02 * expected):
                warnings.warn(
                    f"{self.path}: got {index} frames, expected {expected} as the file states: "
                    "it seems to be truncated",
                    TensorsimWarning,
                    stacklevel=2,
                )

    def _keep_times(self, times_s: Tensor) -> None:
        """Store the times of unevenly spaced frames, and warn about them."""
        late_s = unevenness_s(times_s, self.fps) if self._own_times else 0.0
        self.uneven_times_s = times_s if late_s else None
        if late_s:
            warnings.warn(
                f"{self.path}: its frames are up to {late_s:.2f} s away from even times at {self.fps:.4g} per second: "
                "motion is interpolated to these times; give fps to treat the frames as evenly spaced",
                TensorsimWarning,
                stacklevel=3,
            )

    def _times_in_file(self, start_s: float) -> Tensor:
        """Ascending times (n,) in seconds, as in the file, of the frames to keep (stride aside), without decoding."""
        import cv2

        times_s: list[float] = []
        with self._opened() as capture:
            capture.set(cv2.CAP_PROP_FORMAT, -1)
            while capture.grab():
                times_s.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
                # Frames decoded later may be shown earlier, by less than a second.
                if times_s[-1] - times_s[0] > self._end_s + 1:
                    break
        times = torch.tensor(sorted(times_s), dtype=torch.float64)
        since = times - times[:1]
        return times[(since >= start_s) & (since < self._end_s)]

    def _stop(self, announced: int) -> int:
        """Index after the last frame to keep, if frames are evenly spaced."""
        if self._end_s == math.inf:
            return announced
        return min(announced, math.ceil(self._end_s * self._film_fps - 1e-6))

    def _clock(self) -> FilmClock:
        """A new clock; it only counts frames if a frame rate was given in place of the file's."""
        return FilmClock(self._film_fps, self._own_times)

    def _is_after(self, time_s: float) -> bool:
        return time_s >= self._end_s - 1e-6 / self._film_fps

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        import cv2

        with opening():
            capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        try:
            if not capture.isOpened():
                raise TensorsimError(f"{self.path}: OpenCV cannot read this, expected a video")
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            yield capture
        finally:
            capture.release()


def _check_cut(fps: float | None, start_s: float, end_s: float | None, stride: int) -> None:
    """Refuse reader arguments that are out of range."""
    if fps is not None:
        check_positive(fps, "fps")
        check_range(fps, "frame rate", "fps")
    check_range(stride, "stride", "stride")
    if not 0 <= start_s < math.inf:
        raise TensorsimError(f"start_s: got {start_s}, expected a number of seconds from 0 on")
    if end_s is not None and not end_s > start_s:
        raise TensorsimError(f"end_s: got {end_s}, expected a number of seconds above the start, {start_s}")
    check_range(start_s, "time", "start_s")


def _check_is_film(path: Path) -> None:
    """Refuse a path that is not a file, and a file that does not begin like a video."""
    check_name(path, "path")
    if not path.exists():
        raise TensorsimError(f"{path}: no such file, expected a video")
    if not path.is_file():
        raise TensorsimError(f"{path}: got a folder, expected a video file")
    if not _begins_with(path, _CONTAINERS):
        raise TensorsimError(f"{path}: unsupported file type, expected a video (mp4, mov, mkv, avi, ...)")


def _begins_with(path: Path, marks: Iterable[tuple[int, bytes]]) -> bool:
    """Whether any of these byte sequences is at its offset in a file."""
    with path.open("rb") as file:
        head = file.read(16)
    return any(head[at : at + len(kind)] == kind for at, kind in marks)


def properties(capture: Any) -> tuple[float, int | None]:
    """Frames per second and number of frames stated by a file (None if not stated)."""
    import cv2

    count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    return capture.get(cv2.CAP_PROP_FPS), int(count) if 0 < count < 1e9 else None


def _first_from(capture: Any, clock: FilmClock, start_s: float) -> tuple[int, float | None]:
    """Advance to the first frame at or after ``start_s``; returns its index and time, or the frame count and None.

    The frame is grabbed, not retrieved.
    """
    import cv2

    index = 0
    while capture.grab():
        at_s = clock.time_s(index, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        if at_s >= start_s:
            return index, at_s
        index += 1
    return index, None


@shared
@contextmanager
def silent_log() -> Iterator[None]:
    """Silence OpenCV's log."""
    from cv2.utils import logging

    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)


@shared
@contextmanager
def opening() -> Iterator[None]:
    """Open videos without OpenCV's and FFmpeg's log on stderr, and with FFmpeg limited to the file protocol."""
    # FFmpeg's log level is read once, when the process opens its first video.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    options = os.environ.get("OPENCV_FFMPEG_CAPTURE_OPTIONS")
    # Whatever a file refers to, FFmpeg opens only local files.
    os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = "protocol_whitelist;file"
    try:
        with silent_log():
            yield
    finally:
        if options is None:
            del os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"]
        else:
            os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = options
