"""A short video as one tensor."""

import os
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.data.frame_times import nearest_frames
from tensorsim.data.video import VideoReader


class Clip(NamedTuple):
    """A video in memory, in the form that :class:`tensorsim.VideoToDoppler` takes.

    Attributes:
        video: (1, T, 3, H, W) uint8 RGB.
        fps: frames per second.
    """

    video: Tensor
    fps: float


def read_video(
    path: str | os.PathLike[str],
    fps: float | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    stride: int = 1,
) -> Clip:
    """Read a video, or part of it, into memory: 0.9 MB per frame of 640x480 pixels.

    ``tensorsim simulate`` and :class:`VideoReader` read videos of any length in pieces. If the frames are unevenly
    spaced, those nearest to evenly spaced times are taken, so that the duration is right; ``simulate`` is more
    accurate then, since it interpolates between frames.

    Args:
        path, fps, start_s, end_s, stride: see :class:`VideoReader`.

    Returns:
        The pair (video (1, T, 3, H, W) uint8 RGB, fps).

    Raises:
        TensorsimError: see :class:`VideoReader`.

    Example:
        >>> video, fps = read_video("clip.mp4", end_s=1.0)
        >>> video.shape, fps
        (torch.Size([1, 30, 3, 48, 64]), 30.0)
    """
    reader = VideoReader(path, fps, start_s, end_s, stride)
    video = torch.cat(list(reader.chunks(64)))
    if reader.uneven_times_s is not None:
        video = video[nearest_frames(reader.uneven_times_s, reader.fps)]
    return Clip(video.unsqueeze(0), reader.fps)
