"""The camera of a film, from the people who stand and walk in it."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import CameraConfig
from tensorsim.errors import (
    check_count,
    check_image_size,
    check_keypoints,
    check_per_person,
    check_positive,
    check_score,
)
from tensorsim.ops import of_person
from tensorsim.vision.calibration.camera_fit import Bodies, fit_camera
from tensorsim.vision.calibration.upright import (
    LEAN,
    LEAN_SPREAD,
    PACE,
    PACE_SPREAD,
    STANDING,
    WALK_RATIO,
    WALK_RATIO_SPREAD,
    WALKING,
    cadence,
    ends_of_body,
    is_upright,
    steadily,
    still_beside_others,
    walking_share,
)
from tensorsim.vision.smoothing.along_time import local_linear


class CameraEstimate(NamedTuple):
    """The cameras of clips as estimated from the people in them, with standard deviations.

    Attributes:
        pitch_rad: (...) upward tilt of the optical axis.
        roll_rad: (...) about the optical axis, positive = clockwise as the camera sees it.
        height_m: (...) above the floor.
        horizontal_fov_rad: (...) field of view.
        pitch_sd_rad, roll_sd_rad, height_sd_m, horizontal_fov_sd_rad: (...) standard deviations.
        frames: (...) int64 number of frames of upright people used; with 0 the estimate is the prior.
    """

    pitch_rad: Tensor
    roll_rad: Tensor
    height_m: Tensor
    horizontal_fov_rad: Tensor
    pitch_sd_rad: Tensor
    roll_sd_rad: Tensor
    height_sd_m: Tensor
    horizontal_fov_sd_rad: Tensor
    frames: Tensor


#: Typical field of view of a camera along the longer side of its pictures.
USUAL_FOV_RAD = math.radians(60.0)


def horizontal_fov(along_longer_rad: Tensor, height: int, width: int) -> Tensor:
    """Horizontal field of view in radians, given the one along the longer side of pictures of this size."""
    return 2 * torch.atan(torch.tan(along_longer_rad / 2) * width / max(width, height))


def with_reserve(
    found: CameraEstimate, height: int, width: int, good_rad: float = math.radians(5.0)
) -> CameraEstimate:
    """Estimates shrunk towards a level camera 1.5 m above the floor, the more so the less certain their pitch.

    A few steps of a walk may fit a camera that looks steeply down as well as a level one. An estimate whose pitch has
    a standard deviation of ``good_rad`` or less stays as it is. Otherwise pitch and roll are multiplied by
    ``(good_rad / deviation)^2``, and so are the deviations of the logarithm of the height from that of 1.5 m, and of
    the field of view from 60 degrees along the longer side of pictures of ``height`` and ``width`` pixels.
    """
    share = (good_rad / found.pitch_sd_rad).square().clamp(max=1.0)
    usual_fov = horizontal_fov(found.pitch_rad.new_tensor(USUAL_FOV_RAD), height, width)
    return found._replace(
        pitch_rad=share * found.pitch_rad,
        roll_rad=share * found.roll_rad,
        height_m=1.5 * (found.height_m / 1.5) ** share,
        horizontal_fov_rad=usual_fov + share * (found.horizontal_fov_rad - usual_fov),
    )


def _across(cameras: Tensor, height: int, width: int) -> Tensor:
    """Cameras (..., 4) with the last element, field of view along the longer side, made the horizontal one."""
    fov = horizontal_fov(cameras[..., 3:], height, width)
    return torch.cat([cameras[..., :3], fov], dim=-1)


def camera_config(found: CameraEstimate, radar_ahead_m: float = 0.0) -> CameraConfig:
    """The camera of one clip, looking along +y, above the radar at the origin or behind it.

    Args:
        found: estimate of one clip; each field has one element.
        radar_ahead_m: how far in front of the camera the radar stands.
    """
    return CameraConfig(
        horizontal_fov_rad=float(found.horizontal_fov_rad),
        position_m=(0.0, -radar_ahead_m, float(found.height_m)),
        pitch_rad=float(found.pitch_rad),
        roll_rad=float(found.roll_rad),
    )


def camera_row(found: CameraEstimate | None) -> dict[str, Any] | None:
    """The camera of one clip as result files state it: degrees and metres, each with its standard deviation."""
    if found is None:
        return None
    row: dict[str, Any] = {"frames": int(found.frames)}
    for name, value, sd in (
        ("pitch_deg", found.pitch_rad, found.pitch_sd_rad),
        ("roll_deg", found.roll_rad, found.roll_sd_rad),
        ("horizontal_fov_deg", found.horizontal_fov_rad, found.horizontal_fov_sd_rad),
    ):
        row[name] = [round(math.degrees(float(angle)), 1) for angle in (value, sd)]
    row["height_m"] = [round(float(length), 2) for length in (found.height_m, found.height_sd_m)]
    return row


class CameraCalibrator(nn.Module):
    """Tilt, roll, height and field of view of a still camera from people who stand and walk in its picture.

    People are modelled as upright bodies of known or typical height on a level floor (see
    :mod:`tensorsim.vision.calibration.camera_fit`). Where they carry little information, the estimate stays near the
    prior (pitch 0 +- 20 degrees, roll 0 +- 3, height 1.5 m within a factor of 1.6, field of view 60 +- 15 degrees
    along the longer side of the picture); one person who walks through the scene is enough to determine everything.
    The estimated camera height scales with the height of the people. However long somebody stays in one place, that
    is one observation: errors of keypoints there do not average out. A person who never moves while others do may be
    an object that looks like a person, and is ignored.

    Args:
        person_height_m: standing heights in the order of the people; the last one applies to all further people.
        height_sd_m: standard deviation of these heights: 0.08 m for people of unknown height, less for known ones.
        keypoint_threshold: score from which a keypoint counts. The usual 0.3 is too low for this: keypoints with
            low scores are biased (feet below the picture are found at its edge), and all frames share one camera.
        most_frames: at most this many of the frames in which somebody is upright are used: evenly spread ones, or in
            long films evenly spread windows of six seconds.

    Shapes:
        keypoints (..., P, T, 17, 2) pixels, scores (..., P, T, 17), valid (..., P, T) bool, image height and width in
        pixels, frames per second -> :class:`CameraEstimate` of shape (...). Computed in float64 without gradients.

    Raises:
        TensorsimError: heights that are not positive, wrong shapes, NaN.
    """

    stature: Tensor
    starts: Tensor
    mean: Tensor
    deviation: Tensor
    standing: Tensor
    walking: Tensor

    def __init__(
        self,
        person_height_m: tuple[float, ...] = (1.70,),
        height_sd_m: float = 0.08,
        keypoint_threshold: float = 0.6,
        most_frames: int = 120,
    ) -> None:
        super().__init__()
        check_per_person(person_height_m, "CameraCalibrator.person_height_m")
        check_positive(height_sd_m, "CameraCalibrator.height_sd_m")
        check_score(keypoint_threshold, "CameraCalibrator.keypoint_threshold")
        check_count(most_frames, "CameraCalibrator.most_frames")
        self.height_sd_m = height_sd_m
        self.keypoint_threshold = keypoint_threshold
        self.most_frames = most_frames
        degree = math.pi / 180
        self.lean, self.lean_spread = LEAN, LEAN_SPREAD
        self.pace, self.pace_spread = PACE, PACE_SPREAD
        self.walk_ratio, self.walk_ratio_spread = WALK_RATIO, WALK_RATIO_SPREAD
        self.least_rhythm = 0.4  # share of a sinusoid in the steps from which a cadence is trusted
        self.correlation_s = 0.4  # after which the errors of a body are no longer correlated
        self.smoothing_s = 0.25
        self.most_people = 12  # with the most independent observations; further people add little
        self.path = 0.25  # body heights moved in the image that count as a new observation
        # Pitch, roll, logarithm of the height, field of view along the longer side.
        mean = [0.0, 0.0, math.log(1.5), USUAL_FOV_RAD]
        deviation = [20 * degree, 3 * degree, 0.45, 15 * degree]
        self.register_buffer("standing", torch.tensor(STANDING, dtype=torch.float64), persistent=False)
        self.register_buffer("walking", torch.tensor(WALKING, dtype=torch.float64), persistent=False)
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float64), persistent=False)
        self.register_buffer("deviation", torch.tensor(deviation, dtype=torch.float64), persistent=False)
        self.register_buffer("stature", torch.tensor(person_height_m, dtype=torch.float64), persistent=False)
        starts = [
            [pitch * degree, 0.0, math.log(1.5), fov * degree]
            for pitch in (0, -12, -25, -40)
            for fov in (45, 60, 80)
        ]
        self.register_buffer("starts", torch.tensor(starts, dtype=torch.float64), persistent=False)

    def forward(
        self,
        keypoints: Tensor,
        scores: Tensor,
        valid: Tensor,
        image_height: int,
        image_width: int,
        fps: float,
    ) -> CameraEstimate:
        """Keypoints, scores, valid, image size, frame rate -> the cameras of the clips."""
        check_keypoints(keypoints, scores, valid, 4, "(..., P, T, 17, 2) keypoints in pixels")
        check_image_size(image_height, image_width)
        check_positive(fps, "fps")
        shape = keypoints.shape[:-4]
        people, frames = keypoints.shape[-4], keypoints.shape[-3]
        clips = valid[..., 0, 0].numel() if people * frames > 0 else 0
        found: list[Tensor] = []
        with torch.no_grad():
            for clip in range(clips):
                found.append(
                    self._fit(
                        keypoints.reshape(-1, people, frames, 17, 2)[clip].double(),
                        scores.reshape(-1, people, frames, 17)[clip].double(),
                        valid.reshape(-1, people, frames)[clip],
                        image_height,
                        image_width,
                        fps,
                    )
                )
        if clips == 0:
            mean, deviation = self._expected(image_height, image_width)
            table = self._row(mean, deviation, self.mean.new_zeros(1))
            table = table.expand(list(shape) + [9])  # noqa: RUF005  # TorchScript has no stars
        else:
            table = torch.stack(found).reshape(list(shape) + [9])  # noqa: RUF005
        columns = table[..., :8].to(keypoints.dtype)
        return CameraEstimate(
            columns[..., 0], columns[..., 1], columns[..., 2], columns[..., 3],
            columns[..., 4], columns[..., 5], columns[..., 6], columns[..., 7],
            table[..., 8].long(),
        )  # fmt: skip

    def _fit(
        self, keypoints: Tensor, scores: Tensor, valid: Tensor, height: int, width: int, fps: float
    ) -> Tensor:
        """Means, deviations and number of frames (9,) of the camera of one clip of keypoints (P, T, 17, 2)."""
        people = valid.shape[0]
        upright = steadily(is_upright(keypoints, scores, self.keypoint_threshold), valid, fps)
        ends = ends_of_body(keypoints)
        upright = upright & ~still_beside_others(ends, valid)[:, None]
        count = upright.sum().reshape(1).double()
        walking = walking_share(keypoints, upright, fps)
        cycles_hz, rhythm = cadence(keypoints, walking, fps)
        sigma = self.smoothing_s * fps
        weights = upright.double()
        smooth: list[Tensor] = []
        for end in range(2):
            for axis in range(2):
                smooth.append(local_linear(ends[:, :, end, axis], weights, sigma))
        ends = torch.stack(smooth, dim=-1).unflatten(-1, [2, 2])
        chosen, apart, every = self._looked_at(upright, fps)
        ends, upright, walking = ends[:, chosen], upright[:, chosen] & ~apart, walking[:, chosen]
        independent = self._independent(ends, upright, every / fps)
        # Each person has their own parameters, and time and memory grow with the square of the number of people.
        told = independent[:, 0, 0] * upright.sum(dim=-1)
        most = told.argsort(descending=True, stable=True)[: self.most_people].sort()[0]

        stature = of_person(self.stature, torch.arange(people, device=valid.device))
        ends, upright, walking, independent = ends[most], upright[most], walking[most], independent[most]
        stature, cycles_hz, rhythm = stature[most], cycles_hz[most], rhythm[most]
        middle = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64, device=valid.device)
        image = torch.where(upright[..., None, None], (ends - middle) / (width / 2), 0.1)
        size = torch.linalg.vector_norm(image[..., 0, :] - image[..., 1, :], dim=-1)
        bodies = Bodies(
            image,
            upright,
            stature[:, None, None] * (self.standing + walking[..., None] * (self.walking - self.standing)),
            walking,
            ((0.02 * size).square() + (2.0 / (width / 2)) ** 2).sqrt(),
        )
        nothing = torch.zeros_like(stature)
        stepping = rhythm >= self.least_rhythm
        pace = (torch.where(stepping, self.walk_ratio * cycles_hz.square(), self.pace) * stature).log()
        of_camera, camera_sd = self._expected(height, width)
        mean = torch.cat([of_camera, nothing, pace, self.lean * stature])
        pace_sd = torch.where(stepping, self.walk_ratio_spread, nothing + self.pace_spread)
        deviation = torch.cat([camera_sd, self.height_sd_m / stature, pace_sd, self.lean_spread * stature])
        rest = torch.cat([nothing, pace, self.lean * stature]).expand(self.starts.shape[0], -1)
        at, covariance, cost = fit_camera(
            torch.cat([_across(self.starts, height, width), rest], dim=-1),
            mean,
            deviation,
            bodies,
            fps / every,
            independent,
        )
        best = int(cost.argmin())
        return self._row(at[best, :4], torch.diagonal(covariance[best])[:4].sqrt(), count)

    def _expected(self, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Prior mean and deviation (4,) of a camera with pictures of this size, in the parameters of the fit."""
        mean = _across(self.mean, height, width)
        # Derivative of the horizontal field of view with respect to that along the longer side.
        slope = mean[3:].sin() / self.mean[3:].sin()
        return mean, torch.cat([self.deviation[:3], slope * self.deviation[3:]])

    def _looked_at(self, upright: Tensor, fps: float) -> tuple[Tensor, Tensor, int]:
        """Frames to fit, out of those within half a second of a frame in which somebody is upright.

        Args:
            upright: (P, T) bool.
            fps: frames per second.

        Returns:
            Indices (n,) of the frames in steps of at most a quarter of a second; which of these (n,) only separate
            two windows of a long film; and the step in frames.
        """
        about = int(0.5 * fps + 0.5)
        somebody = upright.any(dim=0).double()[None, None]
        index = torch.nonzero(torch.max_pool1d(somebody, 2 * about + 1, 1, about)[0, 0])[:, 0]
        count = index.shape[0]
        every = max(min(-(-count // self.most_frames), int(fps / 4)), 1)
        index = index[::every]
        apart = torch.zeros_like(index, dtype=torch.bool)
        if index.shape[0] <= self.most_frames:
            return index, apart, every
        # Windows of six seconds of a long film; the first second only separates each from the window before.
        length = min(int(6 * fps / every + 0.5), self.most_frames)
        windows = max(self.most_frames // length, 1)
        start = torch.linspace(0, index.shape[0] - length, windows, device=index.device).long()
        within = torch.arange(length, device=index.device)
        apart = (within < fps / every).expand(windows, length).flatten()
        return index[(start[:, None] + within).flatten()], apart, every

    def _row(self, at: Tensor, sd: Tensor, count: Tensor) -> Tensor:
        """Pitch, roll, height in m, field of view, their deviations, and the number of frames (9,)."""
        height = at[2:3].exp()
        return torch.cat([at[:2], height, at[3:], sd[:2], height * sd[2:3], sd[3:], count])

    def _independent(self, ends: Tensor, upright: Tensor, dt: float) -> Tensor:
        """Independent observations per frame (P, 1, 1): one at the start, one for every :attr:`path` travelled.

        Args:
            ends: (P, T, 2, 2) pixels.
            upright: (P, T) bool.
            dt: seconds between frames.
        """
        step = max(int(self.correlation_s / dt + 0.5), 1)
        at, there = ends[:, ::step], upright[:, ::step]
        size = torch.linalg.vector_norm(at[..., 0, :] - at[..., 1, :], dim=-1).clamp(min=1.0)
        way = torch.linalg.vector_norm(at[:, 1:] - at[:, :-1], dim=-1).amax(dim=-1) / size[:, 1:]
        path = (way * (there[:, 1:] & there[:, :-1]).to(way.dtype)).sum(dim=-1)
        share = (1.0 + path / self.path) / upright.sum(dim=-1).clamp(min=1)
        return share.clamp(max=min(dt / self.correlation_s, 1.0))[:, None, None]
