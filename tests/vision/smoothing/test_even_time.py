"""Frames at uneven times against NumPy's interpolation, and whole films at even and uneven times."""

import numpy as np
import pytest
import torch
from torch import Tensor

import tensorsim as ts
from tensorsim.types import Tracks
from tensorsim.vision.lifting.pose_library import load_pose_library
from tensorsim.vision.smoothing.even_time import to_even_time
from tests.film import RectangleDetector, StandingPose, film
from tests.stage import assert_same

FPS = 20.0


def uneven(frames: int, seed: int, clips: int = 1) -> Tensor:
    """Times (clips, frames) of frames that come 10 to 100 ms after each other."""
    generator = torch.Generator().manual_seed(seed)
    steps = 0.01 + 0.09 * torch.rand(clips, frames - 1, generator=generator, dtype=torch.float64)
    return torch.cat([torch.zeros(clips, 1), steps.cumsum(1)], dim=1) + 3.0


def seen(clips: int, people: int, frames: int) -> tuple[Tracks, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    valid = torch.rand(clips, people, frames, generator=generator) < 0.8
    boxes = 100 * torch.rand(clips, people, frames, 4, generator=generator)
    keypoints = 100 * torch.rand(clips, people, frames, 17, 2, generator=generator)
    return (
        Tracks(boxes * valid[..., None], valid, valid & True),
        keypoints,
        torch.rand(keypoints.shape[:-1], generator=generator),
    )


def test_equals_numpy() -> None:
    tracks, keypoints, scores = seen(2, 3, 40)
    times = uneven(40, 1, clips=2)
    moved, at, low = to_even_time(tracks, keypoints, scores, times, FPS)
    for clip in range(2):
        since = (times[clip] - times[clip, 0]).numpy()
        even = np.arange(at.shape[2]) / FPS
        inside = even <= since[-1]
        for values, result in ((keypoints, at), (tracks.boxes, moved.boxes)):
            columns = values[clip].movedim(1, -1).flatten(0, -2).numpy()
            expected = np.stack([np.interp(even, since, column) for column in columns])
            found = result[clip].movedim(1, -1).flatten(0, -2).numpy()
            if result is moved.boxes:  # of those who are there
                expected = expected * moved.valid[clip].repeat_interleave(4, dim=0).numpy()
            np.testing.assert_allclose(
                found[:, inside], expected[:, inside], atol=0.2
            )  # 1e-3 of a frame is a frame
        after = np.searchsorted(since, even, side="right").clip(1, 39)
        both = tracks.valid[clip, :, after - 1] & tracks.valid[clip, :, after]
        between = inside & (np.abs(even[:, None] - since).min(1) > 1e-3)
        assert torch.equal(moved.valid[clip][:, between], both[:, between])
        assert not moved.valid[clip][:, ~inside].any()
        lower = torch.minimum(scores[clip][:, after - 1], scores[clip][:, after])
        assert torch.equal(low[clip][:, between], lower[:, between])


def test_even_times_change_nothing() -> None:
    tracks, keypoints, scores = seen(1, 2, 30)
    times = torch.arange(30, dtype=torch.float64)[None] / FPS + 7.0
    moved = to_even_time(tracks, keypoints, scores, times, FPS)
    assert_same((*moved[0], *moved[1:]), (*tracks, keypoints, scores), atol=1e-5)


def test_one_frame_and_no_rate_are_refused() -> None:
    times = torch.zeros(1, 1)
    with pytest.raises(ts.TensorsimError, match=r"got shape \[1, 1, 1\], expected at least 2 frames"):
        to_even_time(*seen(1, 1, 1), times, FPS)
    with pytest.raises(ts.TensorsimError, match="fps: got 0"):
        to_even_time(*seen(1, 1, 5), torch.arange(5.0)[None], 0.0)


def test_scripted_equals_eager() -> None:
    arguments = (*seen(2, 2, 12), uneven(12, 2, clips=2), 15.0)
    scripted = torch.jit.script(to_even_time)(*arguments)
    eager = to_even_time(*arguments)
    assert_same((*scripted[0], *scripted[1:]), (*eager[0], *eager[1:]), atol=0.0)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (torch.zeros(1, 5), "do not increase"),
        (torch.arange(5.0), r"got shape \[5\], expected \[1, 5\]"),
        (torch.arange(4.0)[None], r"got shape \[1, 4\], expected \[1, 5\]"),
        (torch.tensor([[0.0, 1.0, 2.0, 3.0, float("nan")]]), "NaN"),
    ],
)
def test_bad_times_are_refused(times: Tensor, message: str) -> None:
    with pytest.raises(ts.TensorsimError, match=message):
        to_even_time(*seen(1, 1, 5), times, FPS)


def test_a_film_at_uneven_times_gives_the_motion_of_one_at_even_times() -> None:
    """A person walks away at 1.2 m/s; the film pauses, and its frames jitter."""
    lifter = ts.vision.NearestPoseLifter(load_pose_library()[::40])  # fewer poses, for time
    stage = ts.VideoToPose(
        RectangleDetector(), StandingPose(), person_height_m=(1.75,), detection_interval=1, lifter=lifter
    ).eval()
    jitter = uneven(60, 3)[0] - 3.0
    times = torch.where(torch.arange(60) < 30, jitter, jitter + 1.0)
    even = torch.arange(int(float(times[-1]) * FPS) + 1) / FPS

    def walk(at: Tensor) -> Tensor:
        return film((4.0 + 1.2 * at)[None], torch.full((1, len(at)), 0.2))[None]

    with torch.no_grad():
        expected = stage(walk(even), FPS)
        found = stage(walk(times), FPS, times_s=times[None])
        mistaken = stage(walk(times), FPS)
    assert found.joints.shape == expected.joints.shape
    inner = slice(5, -5)
    error = (found.joints - expected.joints)[:, :, inner].norm(dim=-1)
    assert float(error.mean()) < 0.06
    speed = found.joints[0, 0, inner, :, 1].diff(dim=0).mean() * FPS
    assert float(speed) == pytest.approx(1.2, abs=0.1)
    wrong = mistaken.joints[0, 0, inner, :, 1].diff(dim=0).mean() * FPS
    assert abs(float(wrong) - 1.2) > 0.2  # taken as evenly spaced
