"""How well people are lifted, from keypoints to smoothed joints, with known camera and height."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import mid_hips
from tensorsim.config import CameraConfig
from tensorsim.evaluation.camera import known_camera
from tensorsim.evaluation.films import CAMERA, FPS, HEIGHT, WIDTH
from tensorsim.pipeline import VideoToPose
from tensorsim.training.film_errors import films_of
from tensorsim.training.lifter_motion import KINDS, MotionPool
from tensorsim.training.lifter_views import Draw, before_camera, seen_in, windows_of
from tensorsim.types import Tracks
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.metric_pose import MetricPose
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
from tensorsim.vision.lifting.videopose3d import VideoPose3D, VideoPoseLifter

#: Frames of a window (3 s), and people in front of each camera.
FRAMES, PEOPLE = 90, 48
#: Cameras: degrees below level, metres above the floor, horizontal field of view in degrees.
CAMERAS = ((0.0, 1.0, 60.0), (12.0, 1.8, 75.0), (28.0, 2.8, 60.0))
#: Wrists and ankles, whose speeds stand out most in the radar maps.
ENDS = (4, 7, 10, 13)
#: Peaks are these quantiles of the speed over time, and count from this speed on.
_PEAK, _SLOWEST_M_S = 0.98, 0.5


class LiftErrors(NamedTuple):
    """Errors of lifted people; lower is better, except for ``peak``, ``within`` and ``radial``, which are 1 at best.

    Attributes:
        depth_cm: mean absolute error along the horizontal line of sight of the joints about the hips.
        joints_cm: mean distance of the joints about the hips.
        range_percent: mean absolute error of the distance of the hips from the camera.
        peak: median ratio of estimated and true peak speeds of wrists and ankles.
        within: share of these in which the ratio is within 20 %.
        speed_m_s: mean error of the velocity of all joints.
        radial: share of the velocity of wrists and ankles along the line of sight that is recovered: the slope of
            estimated over true velocities.
    """

    depth_cm: float
    joints_cm: float
    range_percent: float
    peak: float
    within: float
    speed_m_s: float
    radial: float


class Seen(NamedTuple):
    """People in front of one camera: keypoints as :class:`~tensorsim.evaluation.films.Observed`, and the truth.

    Attributes:
        camera: the camera.
        extent: width and height of the picture.
        heights: heights of the P people, metres.
        joints: (P, T, 14, 3) true joints in the world.
        boxes, keypoints, scores, valid: see :class:`~tensorsim.evaluation.films.Observed`.
    """

    camera: CameraConfig
    extent: tuple[int, int]
    heights: tuple[float, ...]
    joints: Tensor
    boxes: Tensor
    keypoints: Tensor
    scores: Tensor
    valid: Tensor


#: Makes the lifter for people in front of a camera.
MakeLifter = Callable[[Seen], nn.Module]


def views(pool: MotionPool, kinds: tuple[str, ...], errors: bool, seed: int = 0) -> Iterator[Seen]:
    """People of some kinds of motion in front of each of ``CAMERAS``."""
    chosen = torch.isin(pool.kind, torch.tensor([list(KINDS).index(kind) for kind in kinds]))
    some = MotionPool(*(field[chosen] for field in pool))
    for i, numbers in enumerate(CAMERAS):
        camera, extent = known_camera(*numbers), (640, 480)
        draw = Draw(PEOPLE, torch.Generator().manual_seed(seed * 100 + i))
        joints, height, fps = windows_of(some, FRAMES, draw, FPS)
        view = before_camera(joints, camera, extent, draw)
        window = seen_in(view, height, fps, draw, errors)
        yield Seen(
            camera, extent, tuple(height.tolist()), view.joints + torch.tensor(camera.position_m),
            window.boxes, window.keypoints, window.scores, window.valid,
        )  # fmt: skip


def watched(folder: Path) -> Iterator[Seen]:
    """The person in each film of ``tensorsim evaluate truth --settings c`` in which the networks found one."""
    for _, clip, found in films_of(folder):
        if clip.present and found.valid.shape[0] > 0:
            one = int(found.valid.sum(dim=-1).argmax())
            yield Seen(
                CAMERA, (WIDTH, HEIGHT), (clip.height_m,), clip.joints(FPS).float()[None],
                *(field[one : one + 1] for field in (found.boxes, found.keypoints, found.scores, found.valid)),
            )  # fmt: skip


def nearest(seen: Seen) -> nn.Module:
    """Nearest matching."""
    return NearestPoseLifter(pitch_rad=seen.camera.pitch_rad).eval()


def temporal(lifter: TemporalLifter) -> MakeLifter:
    """The network of a lifter."""

    def make(seen: Seen) -> nn.Module:
        return lifter.seen_by(seen.camera, seen.heights)

    return make


def video_pose(network: VideoPose3D) -> MakeLifter:
    """VideoPose3D as a lifter."""

    def make(seen: Seen) -> nn.Module:
        return VideoPoseLifter(network, seen.extent[1], seen.extent[0])

    return make


@torch.inference_mode()
def lifted(make: MakeLifter, seen: Seen, range_rate: bool = False) -> tuple[Tensor, Tensor]:
    """Joints (P, T, 14, 3) that the pipeline makes of keypoints, and the frames (P, T) where they are valid.

    With ``range_rate``, speeds along the line of sight are corrected by :class:`~tensorsim.vision.RangeRate`.
    """
    nothing = nn.Identity()
    stage = VideoToPose(
        nothing,
        nothing,
        lifter=make(seen),
        metric_pose=MetricPose(seen.camera, seen.heights),
        range_rate=range_rate,
    ).eval()
    tracks = Tracks(seen.boxes[None], seen.valid[None], seen.valid[None])
    pose = stage.lift(tracks, seen.keypoints[None], seen.scores[None], seen.extent[1], seen.extent[0], FPS)
    return pose.joints[0], pose.valid[0]


def _peaks(joints: Tensor, valid: Tensor) -> Tensor:
    """(4,) peak speeds of wrists and ankles of one person (T, 14, 3)."""
    speed = torch.diff(joints[:, ENDS], dim=0).norm(dim=-1) * FPS
    return speed[valid[1:] & valid[:-1]].quantile(_PEAK, dim=0)


def judge(make: MakeLifter, people: Iterator[Seen], range_rate: bool = False) -> LiftErrors:
    """Mean errors over people, see :func:`lifted`; frames in which a person is not tracked do not count."""
    sums, radial = torch.zeros(5, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    ratios = []
    for seen in people:
        found, valid = lifted(make, seen, range_rate)
        found, true = found.double(), seen.joints.double()
        place = true.new_tensor(seen.camera.position_m)
        sight = nn.functional.normalize((mid_hips(true) - place) * true.new_tensor([1.0, 1.0, 0.0]), dim=-1)
        error = (found - mid_hips(found)[..., None, :]) - (true - mid_hips(true)[..., None, :])
        depth = (error * sight[..., None, :]).sum(dim=-1).abs().mean(dim=-1)
        away = (mid_hips(true) - place).norm(dim=-1)
        off = ((mid_hips(found) - place).norm(dim=-1) / away - 1).abs()
        moved = torch.diff(found - true, dim=1).norm(dim=-1).mean(dim=-1) * FPS
        moved = torch.cat([moved[:, :1], moved], dim=1)
        approach, truly = (
            (torch.diff(joints[..., ENDS, :], dim=1) * sight[:, 1:, None]).sum(dim=-1)[
                valid[:, 1:] & valid[:, :-1]
            ]
            for joints in (found, true)
        )
        radial += torch.stack([(approach * truly).sum(), truly.square().sum()])
        columns = torch.stack([torch.ones_like(depth), depth, error.norm(dim=-1).mean(dim=-1), off, moved])
        sums += columns[:, valid].sum(dim=-1)
        for one, other, there in zip(found, true, valid, strict=True):
            if int((there[1:] & there[:-1]).sum()) >= FPS:
                peak, truth = _peaks(one, there), _peaks(other, there)
                ratios.append((peak / truth.clamp(min=1e-3))[truth >= _SLOWEST_M_S])
    mean = (sums[1:] / sums[0].clamp(min=1.0)).tolist()
    ratio = torch.cat(ratios) if ratios else torch.ones(1)
    return LiftErrors(
        100 * mean[0],
        100 * mean[1],
        100 * mean[2],
        float(ratio.median()),
        float(((ratio - 1).abs() <= 0.2).double().mean()),
        mean[3],
        float(radial[0] / radial[1].clamp(min=1e-12)),
    )
