"""Causal poses: from the keypoints of a frame to joints in the world, filtered with past frames only."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import coco_to_body, lowest_ankle, mid_hips
from tensorsim.vision.lifting.metric_pose import MetricPose, cut_off_beside, lowered
from tensorsim.vision.smoothing.kalman import KalmanState, constant_velocity_predict, kalman_update

#: Variance of an unknown position, in units of the variance of a measurement.
_WIDE = 1e4


class PoseState(NamedTuple):
    """What is known about P people from earlier frames.

    Attributes:
        size: logarithm of the height in pixels of the standing body (P, 1), filtered.
        joints: (P, 14, 3) m, filtered.
        lows: (P, n) heights of the lower ankle in the last frames, the newest last; NaN where unknown.
        shown: (P, 14, 3) m, the most recent output joints.
        hidden: (P, 14) frames since each joint was last seen.
        frames: (P,) usable frames so far.
        good: (P,) usable frames so far in which the pose network was confident of a person.
        missed: (P,) frames since the last usable one.
    """

    size: KalmanState
    joints: KalmanState
    lows: Tensor
    shown: Tensor
    hidden: Tensor
    frames: Tensor
    good: Tensor
    missed: Tensor


class CausalPose(nn.Module):
    """Lifts, places and filters people frame by frame.

    Each frame is lifted on its own. The size of the body (and so the range) and each joint pass through a forward
    constant-velocity Kalman filter. The floor is a low quantile of the height of the lower ankle in the last frames.
    A joint that is hidden briefly is predicted; over a longer gap it is taken from the matched pose.

    Args:
        lifter: joints (P, T, 14, 2), weights -> Lifted, each frame on its own (``temporal=0``).
        metric_pose: places them in the world; for a calibrated camera, so that it estimates no floor.
        fps: frames per second.
        keypoint_threshold, fewest_joints, least_score, brief_gap_s, top_speed_m_s: see
            :class:`~tensorsim.VideoToPose`.
    """

    def __init__(
        self,
        lifter: nn.Module,
        metric_pose: MetricPose,
        fps: float,
        keypoint_threshold: float = 0.3,
        fewest_joints: int = 5,
        least_score: float = 0.5,
        brief_gap_s: float = 0.25,
        top_speed_m_s: float = 12.0,
    ) -> None:
        super().__init__()
        self.lifter, self.metric_pose, self.fps = lifter, metric_pose, fps
        self.keypoint_threshold, self.fewest_joints = keypoint_threshold, fewest_joints
        self.least_score, self.top_speed_m_s = least_score, top_speed_m_s
        self.brief_gap = int(brief_gap_s * fps)
        self.floor_frames = max(1, int(metric_pose.floor_window_s * fps))
        self.floor_quantile = 0.15
        self.least_width = 0.2  # of a box cut by the edge of the picture, relative to its height
        # Gain -3 dB at 1 Hz: for sizes with 4 % error and people who start to walk within half a second.
        self.size_density, self.size_noise, self.size_speed = 0.1, 0.04**2, 0.3
        self.unknown = 0.1 * _WIDE * self.size_noise  # variance from which a size counts as unknown
        # Gain -3 dB at 4 Hz: m^2/s^3, and 3 cm of keypoint error, see noise.keypoint_noise.
        self.joint_density, self.joint_noise, self.initial_speed = 27.0, 0.03**2, 3.0

    def begin(self, people: int) -> PoseState:
        """The state of people who have not been seen yet."""
        zeros = torch.zeros(people, 14, 3, dtype=torch.float64)
        never = torch.zeros(people, dtype=torch.int64)
        return PoseState(
            _unknown(zeros[:, 0, :1], self.size_noise, self.size_speed),
            _unknown(zeros, self.joint_noise, self.initial_speed),
            torch.full((people, self.floor_frames), float("nan"), dtype=torch.float64),
            zeros,
            torch.full((people, 14), 10**6),
            never,
            never,
            never + 10**6,
        )

    def forward(
        self,
        state: PoseState,
        keypoints: Tensor,
        scores: Tensor,
        boxes: Tensor,
        there: Tensor,
        height: int,
        width: int,
    ) -> PoseState:
        """The state after a frame.

        Args:
            state: of P people.
            keypoints: (P, 17, 2) pixels.
            scores: (P, 17).
            boxes: (P, 4) pixels, ``xyxy``; the size of a body cut by the left or right edge of the picture has a low
                weight.
            there: (P,) bool, the people with keypoints; the others are predicted.
            height, width: size of the picture.
        """
        if not bool(there.any()):
            # Lifting and placing take longer than a frame lasts, and the results would not be used.
            size = self._predicted(state.size, self.size_density)
            lows = torch.cat([state.lows[:, 1:], torch.full_like(state.lows[:, :1], torch.nan)], dim=-1)
            seen = torch.zeros_like(state.hidden, dtype=torch.bool)
            return self._after(state, state.shown, seen, there, there, scores, size, lows)
        body, body_scores = coco_to_body(keypoints, scores, self.keypoint_threshold)
        reliable = (body_scores >= self.keypoint_threshold) & there[:, None]
        body_scores = body_scores * reliable
        cut_off = cut_off_beside(boxes, width)
        # A few joints, or a strip of somebody leaving the picture, do not determine a pose.
        fewest = torch.where(cut_off, self.metric_pose.whole_body_joints, self.fewest_joints)
        inside = boxes[:, 2].clamp(max=width) - boxes[:, 0].clamp(min=0)
        strip = cut_off & (inside < self.least_width * (boxes[:, 3] - boxes[:, 1]))
        count = reliable.sum(dim=-1)
        usable = there & (count >= fewest) & ~strip
        lifted = self.lifter(body[:, None], body_scores[:, None])

        whole = usable & (count >= self.metric_pose.whole_body_joints)
        whole = whole & (lifted.distance[:, 0] < self.metric_pose.poor_fit)
        first = whole & ((state.size.p00[:, 0] >= self.unknown) | (state.missed > self.brief_gap))
        size = self._filtered(
            state.size,
            lifted.scale.clamp(min=1.0).log(),
            self.size_density,
            torch.where(cut_off[:, None], 25 * self.size_noise, self.size_noise).double(),
            self.size_speed,
            whole[:, None],
            first[:, None],
        )
        usable = usable & (size.p00[:, 0] < self.unknown)
        placed, seen = self.metric_pose(
            body[:, None],
            body_scores[:, None],
            lifted._replace(scale=size.position.exp().to(lifted.scale)),
            usable[:, None],
            height,
            width,
            self.fps,
        )
        placed, seen = placed[:, 0].double(), seen[:, 0]
        low = torch.where(usable, lowest_ankle(placed), torch.nan)
        lows = torch.cat([state.lows[:, 1:], low[:, None]], dim=-1)
        placed = lowered(placed, torch.nanquantile(lows, self.floor_quantile, dim=-1).nan_to_num())
        return self._after(state, placed, seen, usable, cut_off, scores, size, lows)

    def _after(
        self,
        state: PoseState,
        placed: Tensor,
        seen: Tensor,
        usable: Tensor,
        cut_off: Tensor,
        scores: Tensor,
        size: KalmanState,
        lows: Tensor,
    ) -> PoseState:
        """The state after joints (P, 14, 3) that were placed in the world."""
        hidden = torch.where(seen, 0, state.hidden + 1)
        measured = usable[:, None] & (seen | (hidden > self.brief_gap))
        newly = usable & (state.missed > self.brief_gap)
        # Joints beyond the edge of the picture move with the hips: nothing else is known about them.
        along = state.shown + (mid_hips(placed) - mid_hips(state.shown))[:, None]
        beyond = cut_off[:, None] & usable[:, None] & ~seen & ~newly[:, None]
        placed, measured = torch.where(beyond[..., None], along, placed), measured | beyond
        joints = self._filtered(
            state.joints,
            placed,
            self.joint_density,
            torch.tensor(self.joint_noise, dtype=torch.float64),
            self.initial_speed,
            measured[..., None],
            (newly[:, None] & measured)[..., None],
        )
        missed = torch.where(usable, 0, state.missed + 1)
        # Over a longer gap the prediction would drift away, so the body stays where it is.
        step = (joints.position - state.shown) * (missed <= self.brief_gap)[:, None, None]
        length = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
        limit = (self.top_speed_m_s / self.fps / length.clamp(min=1e-9)).clamp(max=1.0)
        shown = torch.where(newly[:, None, None], joints.position, state.shown + step * limit)
        strong = (scores >= self.keypoint_threshold).to(scores.dtype)
        mean = (scores * strong).sum(dim=-1) / strong.sum(dim=-1).clamp(min=1.0)
        good = state.good + (usable & (mean >= self.least_score)).to(torch.int64)
        return PoseState(
            size, joints, lows, shown, hidden, state.frames + usable.to(torch.int64), good, missed
        )

    def present(self, state: PoseState) -> Tensor:
        """Who is in the scene, (P,) bool: seen recently, and a person in at least a quarter of the usable frames."""
        return (state.frames > 0) & (state.missed <= self.brief_gap) & (4 * state.good >= state.frames)

    def _filtered(
        self,
        state: KalmanState,
        measured: Tensor,
        density: float,
        noise: Tensor,
        speed: float,
        valid: Tensor,
        first: Tensor,
    ) -> KalmanState:
        """Prediction by one frame and update; where ``first``, the filter starts with this measurement."""
        predicted = self._predicted(state, density)
        begun = _unknown(measured.double(), noise, speed)
        prior = KalmanState(*(torch.where(first, a, b) for a, b in zip(begun, predicted, strict=True)))
        return kalman_update(prior, measured.double(), noise, valid.double())

    def _predicted(self, state: KalmanState, density: float) -> KalmanState:
        """The state one frame later."""
        q = torch.full([1], density, dtype=torch.float64)
        return constant_velocity_predict(state, q, 1 / self.fps)


def _unknown(place: Tensor, noise: float | Tensor, speed: float) -> KalmanState:
    """A state (..., D) near ``place`` but of wide variance, with velocities of standard deviation ``speed``."""
    wide = torch.zeros_like(place[..., :1]) + _WIDE * noise
    return KalmanState(
        place, torch.zeros_like(place), wide, torch.zeros_like(wide), torch.full_like(wide, speed**2)
    )
