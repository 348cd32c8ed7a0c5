"""Frames at uneven times: what is tracked in them, interpolated to even times."""

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError, check_finite, check_floating, check_positive, check_shape
from tensorsim.types import Tracks


def even_count(duration_s: Tensor, fps: float) -> Tensor:
    """Number of times ``k / fps`` from 0 to durations (...) in seconds, allowing for rounding: (...) int64."""
    return torch.floor(duration_s.double() * fps + 1e-3).long() + 1


def to_even_time(
    tracks: Tracks, keypoints: Tensor, scores: Tensor, times_s: Tensor, fps: float
) -> tuple[Tracks, Tensor, Tensor]:
    """Interpolate boxes and keypoints linearly in time, from the times of the frames to ``k / fps``.

    Between two frames a person is valid if valid in both, and a keypoint has the lower of its two scores. At the time
    of a frame its values are kept. During a pause, in which the film shows one frame for a long time, people move
    evenly to where they are in the next frame.

    Args:
        tracks: boxes (B, P, T, 4), validity and matches (B, P, T).
        keypoints: (B, P, T, 17, 2) pixels.
        scores: (B, P, T, 17).
        times_s: (B, T) seconds, increasing, also in the padding of a clip; only differences count.
        fps: frames per second of the result.

    Returns:
        Tracks, keypoints and scores at the ``T' = floor(duration * fps) + 1`` even times of the longest clip, the
        first of which is that of the first frame. After the last frame of a clip nobody is valid. Differentiable with
        respect to boxes, keypoints and scores.

    Raises:
        TensorsimError: times of another shape, not finite or not increasing, fewer than 2 frames, fps not positive.
    """
    clips, frames = tracks.valid.shape[0], tracks.valid.shape[2]
    check_positive(fps, "fps")
    if frames < 2:
        raise TensorsimError(
            f"tracks.valid: got shape {list(tracks.valid.shape)}, expected at least 2 frames"
        )
    check_floating(times_s, "times_s")
    check_shape(times_s, [clips, frames], "times_s")
    check_finite(times_s, "times_s")
    if bool((times_s.diff(dim=1) <= 0).any()):
        raise TensorsimError(
            "times_s: got times that do not increase from frame to frame, expected increasing ones"
        )
    since = (times_s - times_s[:, :1]).to(keypoints.device, torch.float64)
    count = int(even_count(since[:, -1].max(), fps))
    even = (torch.arange(count, dtype=torch.float64, device=since.device) / fps).expand(clips, count)
    after = torch.searchsorted(since, even.contiguous(), right=True).clamp(1, frames - 1)
    start, end = since.gather(1, after - 1), since.gather(1, after)
    share = ((even - start) / (end - start)).clamp(0.0, 1.0)
    # At the time of a frame, up to rounding, only that frame counts.
    share = torch.where(share < 1e-3, 0.0, torch.where(share > 1 - 1e-3, 1.0, share))

    here = _both(tracks.valid, after, share) & (even <= since[:, -1:] + 1e-3 / fps).unsqueeze(1)
    boxes = _linear(tracks.boxes, after, share) * here.unsqueeze(-1)
    moved = Tracks(boxes, here, _both(tracks.matched, after, share) & here)
    return moved, _linear(keypoints, after, share), _both(scores, after, share)


def _at(x: Tensor, frame: Tensor) -> Tensor:
    """(B, P, T, ...) in frames (B, T') of each clip: (B, P, T', ...)."""
    rest = list(x.shape[3:])
    index = frame.view([frame.shape[0], 1, frame.shape[1]] + [1] * len(rest))
    return torch.gather(x, 2, index.expand([x.shape[0], x.shape[1], frame.shape[1]] + rest))  # noqa: RUF005


def _like(share: Tensor, x: Tensor) -> Tensor:
    """Shares (B, T') reshaped to broadcast with (B, P, T', ...)."""
    return share.view([share.shape[0], 1, share.shape[1]] + [1] * (x.dim() - 3))


def _linear(x: Tensor, after: Tensor, share: Tensor) -> Tensor:
    return torch.lerp(_at(x, after - 1), _at(x, after), _like(share, x).to(x.dtype))


def _both(x: Tensor, after: Tensor, share: Tensor) -> Tensor:
    """The lower value of the two frames, or at the time of a frame its own value."""
    first, second, at = _at(x, after - 1), _at(x, after), _like(share, x)
    return torch.where(at == 0.0, first, torch.where(at == 1.0, second, torch.minimum(first, second)))
