"""Frames in real time: from a camera, a stream, or a film played at its own rate."""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tensorsim.data.video import VideoReader, silent_log
from tensorsim.errors import TensorsimError, check_positive

#: Length of the queue of frames for the consumer; older ones are dropped.
WAITING = 2
#: Frames by which a camera may run ahead of its rate, because late frames arrive in bursts.
AHEAD = 2
_STREAMS = ("rtsp://", "rtsps://", "rtmp://", "http://", "https://", "udp://", "tcp://")


class Grabbed(NamedTuple):
    """A frame (3, H, W) uint8 RGB, and how many frames are missing before it: dropped, or absent from the source."""

    frame: Tensor
    missing: int


@dataclass
class _State:
    """State of the thread that grabs frames: how many frames were dropped, whether it has ended, whether it should
    end, and the error that ended it."""

    dropped: int = 0
    ended: bool = False
    closed: bool = False
    error: Exception | None = None


class Camera:
    """Frames of a camera at a constant rate; those that arrive while the consumer is busy are dropped and counted.

    Frames that a source with uneven frame times lacks count as missing too, but not as dropped.

    Args:
        source: the number of a camera, the address of a stream, or a file.
        fps: frames per second instead of the rate that the source reports (30 if it reports none).
        every_frame: for files: wait for the consumer instead of dropping frames; playback is not in real time.
        loops: for files: how many times the film is played.

    Attributes:
        fps: frames per second.
        dropped: frames dropped before the last one delivered.

    Raises:
        TensorsimError: a source that cannot be opened, or ``every_frame`` of one that does not wait.
    """

    def __init__(
        self, source: str, fps: float | None = None, every_frame: bool = False, loops: int = 1
    ) -> None:
        if fps is not None:
            check_positive(fps, "fps")
        self.source, self.every_frame, self.loops, self.dropped = source, every_frame, loops, 0
        self.is_file = not source.isdecimal() and not source.lower().startswith(_STREAMS)
        if not self.is_file and every_frame:
            raise TensorsimError(
                f"--every-frame: got the camera {source}, expected a file: a camera does not wait"
            )
        if self.is_file:
            self.reader = VideoReader(Path(source), fps=fps)
            self.fps = self.reader.fps
        else:
            self.capture, self.fps = _opened(source, fps)

    def frames(self) -> Iterator[Grabbed]:
        """The frames until the source ends.

        Raises:
            TensorsimError: a camera or stream that stops.
        """
        if self.every_frame:
            yield from self._counted(self._film())
            return
        waiting: deque[tuple[int, Tensor | None]] = deque(maxlen=WAITING)
        arrived = Condition()
        state = _State()
        thread = Thread(target=self._grab, args=(waiting, arrived, state), daemon=True)
        thread.start()
        try:
            yield from self._counted(self._waited_for(waiting, arrived, state))
        finally:
            state.closed = True
            thread.join(timeout=2.0)

    @staticmethod
    def _counted(numbered: Iterator[tuple[int, Tensor]]) -> Iterator[Grabbed]:
        """Frames with the number of frames missing before each."""
        last = -1
        for index, frame in numbered:
            missing, last = index - last - 1, index
            yield Grabbed(frame, missing)

    def _waited_for(
        self, waiting: deque[tuple[int, Tensor | None]], arrived: Condition, state: "_State"
    ) -> Iterator[tuple[int, Tensor]]:
        """Frames with their numbers, taken from the queue."""
        while True:
            with arrived:
                arrived.wait_for(lambda: waiting or state.ended)
                if not waiting:
                    if state.error is not None:
                        raise state.error
                    return
                index, frame = waiting.popleft()
                self.dropped = state.dropped
            if frame is None:
                raise TensorsimError(f"{self.source}: the camera gave no more frames")
            yield index, frame

    def _grab(self, waiting: deque[tuple[int, Tensor | None]], arrived: Condition, state: "_State") -> None:
        """Put frames with their numbers into the queue as they arrive; runs in a thread."""
        start = time.monotonic()
        try:
            for index, frame in self._film() if self.is_file else self._live(state):
                if self.is_file:
                    time.sleep(max(0.0, start + index / self.fps - time.monotonic()))
                with arrived:
                    state.dropped += len(waiting) == WAITING
                    waiting.append((index, frame))
                    arrived.notify()
                if state.closed:
                    break
        except Exception as error:  # raised again where the frames are taken
            state.error = error
        finally:
            with arrived:
                state.ended = True
                arrived.notify()

    def _film(self) -> Iterator[tuple[int, Tensor]]:
        """Frames of the file, numbered by their times."""
        first = 0
        for _ in range(self.loops):
            index = first - 1
            for time_s, frame in self.reader.timed_frames():
                index = max(index + 1, first + round(time_s * self.fps))
                yield index, frame
            first = index + 1

    def _live(self, state: "_State") -> Iterator[tuple[int, Tensor | None]]:
        """Frames numbered by their arrival times after the first one; None once there are no more.

        Frames that arrive faster than the constant rate are dropped: otherwise people would seem to move too slowly.
        """
        import cv2

        start, last = 0.0, -1
        try:
            while True:
                found, frame = self.capture.read()
                if not found:
                    yield last + 1, None
                    return
                now = time.monotonic()
                if last < 0:
                    start = now  # a camera may take a second to start
                clock = round((now - start) * self.fps)
                if clock < last + 1 - AHEAD:
                    state.dropped += 1
                    continue
                last = max(last + 1, clock)
                yield last, torch.from_numpy(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)).permute(2, 0, 1)
        finally:
            self.capture.release()


def _opened(source: str, fps: float | None) -> tuple[Any, float]:
    """The capture of a camera or stream, and its frames per second."""
    import cv2

    with silent_log():
        capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
    if not capture.isOpened():
        raise TensorsimError(
            f"--camera: {source} cannot be opened, expected a camera's number, a stream or a film"
        )
    announced = capture.get(cv2.CAP_PROP_FPS)
    return capture, fps or (announced if 1 <= announced <= 240 else 30.0)
