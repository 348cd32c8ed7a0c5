"""Clips with motion known at every instant, from the generator or from motion capture."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from tensorsim.body.skeleton import body_height, mid_hips
from tensorsim.config import ACTIVITIES
from tensorsim.data.motion_files import load_motion, motion_keys, place
from tensorsim.data.skeletons import Motion
from tensorsim.errors import TensorsimError
from tensorsim.files import sha256_of
from tensorsim.motion.activities import ActivityGenerator, activity_index
from tensorsim.motion.resample import PoseResampler

#: Length of the paper's clips.
CLIP_S = 4.0
#: Captured motion starts with its hips at this y.
CAPTURE_RANGE_M = 4.0


@dataclass(frozen=True)
class ActivityClip:
    """A generated person who performs one of the twelve activities.

    Attributes:
        row: name of the class, which is the clip's row in the table.
        name: name of the clip within the row.
        seed: seed of the generator and of the random numbers of a film of it.
    """

    row: str
    name: str
    seed: int
    duration_s: float = CLIP_S

    @cached_property
    def height_m(self) -> float:
        """Standing height of the body."""
        people = ActivityGenerator().generate(self.row, seed=self.seed, duration_s=0.1).people
        return float(people.height_m[0])

    @property
    def present(self) -> bool:
        """Whether there is a person."""
        return activity_index(self.row) != 0

    def joints(self, rate_hz: float) -> Tensor:
        """The true joints (T, 14, 3) float64 in m at ``k / rate_hz``, evaluated, not resampled."""
        motion = ActivityGenerator().generate(
            self.row, seed=self.seed, duration_s=self.duration_s, rate_hz=rate_hz
        )
        return motion.joints[0]


@dataclass(frozen=True)
class CapturedClip:
    """Captured motion; between frames, the natural cubic spline through them counts as the truth.

    Attributes:
        row, name: see :class:`ActivityClip`.
        motion: one person on the floor, cut to the clip.
        source: origin of the motion: digest of the file, and the frame rate given.
        seed: seed of the random numbers of a film of it.
    """

    row: str
    name: str
    motion: Motion
    source: str = ""
    seed: int = 0

    @cached_property
    def height_m(self) -> float:
        """Standing height of the body, from its legs and trunk."""
        return float(body_height(self.motion.joints).median())

    @property
    def duration_s(self) -> float:
        """Length of the clip."""
        return self.motion.joints.shape[1] / self.motion.fps

    @property
    def present(self) -> bool:
        """Whether there is a person."""
        return True

    def joints(self, rate_hz: float) -> Tensor:
        """The true joints (T, 14, 3) float64 in m at ``k / rate_hz``."""
        return PoseResampler(rate_hz)(self.motion.joints[0].double(), self.motion.fps)


Clip = ActivityClip | CapturedClip


def activity_clips(activities: tuple[str, ...], count: int, seed: int) -> dict[str, list[Clip]]:
    """``count`` clips of each activity (default all), numbered from ``seed``, by row; all of different people."""
    indices = [activity_index(name) for name in activities] or list(range(len(ACTIVITIES)))
    return {
        ACTIVITIES[i]: [
            ActivityClip(ACTIVITIES[i], str(k), k * len(ACTIVITIES) + i) for k in range(seed, seed + count)
        ]
        for i in indices
    }


def captured_clips(path: Path, count: int, fps: float | None = None) -> list[Clip]:
    """The first ``count`` motions of a file, at most 4 s of each, 4 m away.

    The first frame of a capture is skipped: it is often a calibration pose.

    Args:
        path: ``.bvh`` or ``.npz``; from an ``.npz`` with several motions, the first person of each.
        count: largest number of clips.
        fps: frames per second, overrides that of the file; required if the file has none.

    Raises:
        TensorsimError: see :func:`tensorsim.data.motion_files.load_motion`; no motion is long enough.
    """
    clips: list[Clip] = []
    keys = motion_keys(path)
    source = f"{sha256_of(path)} {fps}"
    for key in keys:
        motion = load_motion(path, key, fps)
        stop = 1 + int(CLIP_S * motion.fps)
        motion = Motion(motion.joints[:1, 1:stop], motion.valid[:1, 1:stop], motion.fps)
        if motion.joints.shape[1] < 0.5 * motion.fps or not bool(motion.valid.all()):
            continue
        motion = place(motion, CAPTURE_RANGE_M)
        clips.append(CapturedClip(path.stem, key or path.stem, _kept_away(motion), source))
    if not clips:
        raise TensorsimError(f"{path}: got no motion of at least half a second, expected one")
    return clips[:count]


def _kept_away(motion: Motion, nearest_m: float = 1.5, farthest_m: float = 7.0) -> Motion:
    """Motion moved along y by the least amount that keeps it within the generator's ranges; the nearest one has
    priority."""
    y = mid_hips(motion.joints)[..., 1]
    shift = (farthest_m - y.max()).clamp(max=0.0)
    shift = torch.maximum(shift, nearest_m - y.min())
    return motion._replace(joints=motion.joints + torch.stack([0 * shift, shift, 0 * shift]))
