"""Video -> people with smooth 3D joints: detection, tracking, 2D pose, lifting, position, smoothing."""

import copy
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.skeleton import coco_to_body, mid_hips, trunk_lean
from tensorsim.config import CameraConfig, PoseConfig, SimulationConfig
from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_positive,
    check_rank,
    check_replaced,
    check_score,
    check_size,
    is_autocast,
)
from tensorsim.ops import times_as_fast
from tensorsim.pipeline.networks import pretrained_detector, pretrained_lifter, pretrained_pose, top_down
from tensorsim.protocols import check_detections, check_instance, check_part
from tensorsim.types import Detections, Pose, Tracks
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.metric_pose import MetricPose, cut_off_beside
from tensorsim.vision.lifting.range_rate import RangeRate
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
from tensorsim.vision.lifting.walking_legs import WalkingLegs
from tensorsim.vision.smoothing.along_time import brief_gaps, crossed_within, gaps_with, where_any
from tensorsim.vision.smoothing.even_time import even_count, to_even_time
from tensorsim.vision.smoothing.kalman import KalmanSmoother
from tensorsim.vision.smoothing.noise import keypoint_noise, noise_with_depth
from tensorsim.vision.smoothing.outliers import limit_speed, without_jumps
from tensorsim.vision.smoothing.sides import SteadySides
from tensorsim.vision.tracking.tracker import GNNTracker


class VideoToPose(nn.Module):
    """Video -> people with metric 3D joints.

    Detects in every ``detection_interval``-th frame and in the last one, tracks, estimates COCO-17 keypoints in
    every frame, lifts them to 3D, places them in the world and smooths them. From 45 frames per second the detector
    runs about as often per second as at 30, because the tracker's limits are counted in frames with detections.

    Args:
        detector: images -> :class:`~tensorsim.types.Detections`, e.g. :class:`tensorsim.vision.RTMDet`.
        pose: crops -> heat maps, e.g. :class:`tensorsim.vision.HRNet`, which is also applied to the mirror image;
            or a module (frames, boxes, valid) -> (keypoints, scores), e.g. :class:`tensorsim.vision.TopDownPose`.
        person_height_m: body heights in metres by person (order of appearance); the last one applies to all further
            people. Default 1.80 and 1.70.
        initial_distance_m: known distance of each person in the first good frames; calibrates the focal length.
        camera: position, orientation and focal length of the camera.
        keypoint_threshold: score from which a keypoint counts as seen.
        detection_interval: run the detector on every n-th frame (panel: 2), less often from 45 frames per second.
        fewest_joints: how many of the 14 joints must be seen for a frame to be used.
        brief_gap_s: a joint hidden for at most this many seconds is predicted by the smoother.
        frames_per_batch: frames that go through a network at once; bounds memory.
        tracker, lifter, metric_pose, smoother: replacements for the default stages; the default ``lifter`` is the
            shipped :class:`~tensorsim.vision.TemporalLifter`. A ``metric_pose`` has its own heights, distances and
            camera.
        bone_fit: a :class:`~tensorsim.vision.lifting.bone_fit.BoneFit` between ``metric_pose`` and ``smoother``, for
            exact keypoints; None leaves it out.
        walking_legs: with a :class:`~tensorsim.vision.TemporalLifter`, give the legs of people who walk the steps of a
            gait model where they are seen too little; see :class:`~tensorsim.vision.WalkingLegs`.
        range_rate: with a :class:`~tensorsim.vision.TemporalLifter`, a :class:`~tensorsim.vision.MetricPose` in its
            camera mode and no ``bone_fit``, correct how fast people come closer or move away by how they move; see
            :class:`~tensorsim.vision.RangeRate`.

    Raises:
        TensorsimError: numbers out of range; a ``metric_pose`` together with heights, distances or a camera; parts that
            are not suitable stages.
    """

    asks_for_edges: Final[bool]

    def __init__(
        self,
        detector: nn.Module,
        pose: nn.Module,
        person_height_m: tuple[float, ...] | None = None,
        initial_distance_m: tuple[float, ...] | None = None,
        camera: CameraConfig | None = None,
        keypoint_threshold: float = 0.3,
        detection_interval: int = 2,
        fewest_joints: int = 5,
        brief_gap_s: float = 0.25,
        frames_per_batch: int = 8,
        tracker: nn.Module | None = None,
        lifter: nn.Module | None = None,
        metric_pose: nn.Module | None = None,
        smoother: nn.Module | None = None,
        bone_fit: nn.Module | None = None,
        walking_legs: bool = True,
        range_rate: bool = False,
    ) -> None:
        super().__init__()
        self.detection_interval = check_count(detection_interval, "detection_interval")
        self.frames_per_batch = check_count(frames_per_batch, "frames_per_batch")
        self.fewest_joints = check_count(fewest_joints, "fewest_joints", 1, 14)
        check_score(keypoint_threshold, "keypoint_threshold")
        self.detector = check_part(detector, "detector")
        self.pose = top_down(pose)
        self.tracker = check_part(GNNTracker() if tracker is None else tracker, "tracker")
        if metric_pose is None:
            heights = PoseConfig().person_height_m if person_height_m is None else person_height_m
            metric_pose = MetricPose(camera, heights, initial_distance_m, keypoint_threshold)
        else:
            ignored = {
                "person_height_m": person_height_m,
                "initial_distance_m": initial_distance_m,
                "camera": camera,
            }
            check_replaced("metric_pose", {name: value is not None for name, value in ignored.items()})
            check_instance(metric_pose, nn.Module, "metric_pose")
        if lifter is None:
            lifter = _lifter_beside(metric_pose, keypoint_threshold)
        # A temporal lifter takes more than the others: COCO keypoints, boxes, the image size.
        self.temporal = lifter if isinstance(lifter, TemporalLifter) else None
        self.lifter = None if self.temporal is not None else check_part(lifter, "lifter")
        self.metric_pose = metric_pose
        # A replacement is called with the common arguments only. TorchScript compiles just one of the two calls.
        self.asks_for_edges = isinstance(metric_pose, MetricPose)
        known = metric_pose.camera if isinstance(metric_pose, MetricPose) else CameraConfig()
        self.camera_m = known.position_m
        self.sides = SteadySides(threshold=keypoint_threshold)
        if bone_fit is not None:
            check_instance(bone_fit, nn.Module, "bone_fit")
        self.bone_fit = bone_fit
        self.smoother = check_part(KalmanSmoother() if smoother is None else smoother, "smoother")
        # A matched pose brings its own legs.
        self.walking_legs = WalkingLegs() if walking_legs and self.temporal is not None else None
        # Made for the errors of ranges from sizes, as the temporal lifter finds them.
        by_size = isinstance(metric_pose, MetricPose) and metric_pose.mode == "camera"
        corrected = range_rate and by_size and self.temporal is not None and bone_fit is None
        self.range_rate = RangeRate.from_pretrained().requires_grad_(False) if corrected else None
        self.keypoint_threshold = keypoint_threshold
        self.brief_gap_s = brief_gap_s
        #: People hidden for longer are absent until they are seen again.
        self.longest_gap_s = 1.0
        #: People who must have moved faster than this (m/s) while hidden are absent after just ``brief_gap_s``.
        self.hidden_speed_m_s = 3.0
        #: The temporal lifter's errors persist over time; only this share varies between frames, as noise does.
        self.noise_share = 0.03
        #: Joints that are not seen are noisier by this factor: they are guessed anew in every frame.
        self.hidden_noise = 3.0
        #: Joints of people who lie, the trunk horizontal, are noisier by this factor: networks find them less well.
        self.lying_noise = 5.0
        #: No joint moves faster than this, in m/s: in a hard kick the foot reaches 10 to 12.
        self.top_speed_m_s = 12.0
        #: Lowest mean score of a person's seen keypoints; in boxes around furniture it is about 0.4.
        self.least_score = 0.5

    @classmethod
    def from_config(
        cls, config: SimulationConfig, detector: nn.Module | None = None, pose: nn.Module | None = None
    ) -> "VideoToPose":
        """The stage described by a configuration, in evaluation mode, its networks frozen.

        Args:
            config: its ``tracking``, ``pose`` and ``smoothing``.
            detector, pose: networks to use instead of those that the configuration names.

        Raises:
            TensorsimError: weights that do not exist or belong to another network.
        """
        tracking, people, smoothing = config.tracking, config.pose, config.smoothing
        if detector is None:
            detector = pretrained_detector(tracking.detector)
        if pose is None:
            pose = pretrained_pose(people.network, people.flip_test)
        stage = cls(
            detector,
            top_down(pose, people.flip_test),
            keypoint_threshold=people.keypoint_threshold,
            detection_interval=tracking.detection_interval,
            fewest_joints=people.fewest_joints,
            walking_legs=people.walking_legs,
            range_rate=people.range_rate,
            brief_gap_s=smoothing.brief_gap_s,
            tracker=GNNTracker(
                max_tracks=tracking.max_tracks,
                confirm_hits=tracking.confirm_hits,
                confirm_window=tracking.confirm_window,
                delete_misses=tracking.delete_misses,
                delete_window=tracking.delete_window,
                assignment_threshold=tracking.assignment_threshold,
                min_box_px=tracking.min_box_px,
                process_noise=tracking.process_noise,
                measurement_noise=tracking.measurement_noise,
            ),
            lifter=pretrained_lifter(people),
            metric_pose=MetricPose(
                people.camera,
                people.person_height_m,
                people.initial_distance_m,
                people.keypoint_threshold,
                mode=people.position,
            ),
            smoother=KalmanSmoother(mode=smoothing.mode),
        )
        return stage.eval().requires_grad_(False)

    def seen_by(self, camera: CameraConfig, known: bool = True) -> "VideoToPose":
        """The same stage, with the same networks, for another camera, known or estimated from a film.

        Raises:
            TensorsimError: a lifter or metric pose of another class, which may have no camera.
        """
        lifter = self.lifter if self.temporal is None else self.temporal
        if not isinstance(lifter, (NearestPoseLifter, TemporalLifter)) or not isinstance(
            self.metric_pose, MetricPose
        ):
            raise TensorsimError(
                f"seen_by: got {type(lifter).__name__} and {type(self.metric_pose).__name__}, expected "
                "NearestPoseLifter or TemporalLifter, and MetricPose"
            )
        other = copy.copy(self)
        other._modules = dict(self._modules)
        if isinstance(lifter, TemporalLifter):
            other.temporal = lifter.seen_by(camera, known=known)
        else:
            other.lifter = lifter.tilted(camera.pitch_rad, camera.roll_rad)
        other.metric_pose = self.metric_pose.seen_by(camera)
        other.camera_m = camera.position_m
        return other.eval()

    def forward(
        self, video: Tensor, fps: float, lengths: Tensor | None = None, times_s: Tensor | None = None
    ) -> Pose:
        """Estimate the people of whole clips.

        Args:
            video: (B, T, 3, H, W) RGB, uint8 or float in [0, 1].
            fps: frames per second.
            lengths: (B,) frames of each clip when shorter ones are padded; None takes all T.
            times_s: (B, T) increasing times in seconds of frames that are not evenly spaced: people are interpolated to
                ``fps`` frames per second, see :func:`~tensorsim.vision.smoothing.even_time.to_even_time`. None: even.

        Raises:
            TensorsimError: wrong rank or channels, fewer than 2 frames, fps not positive, times that do not increase;
                in eager code also ``torch.autocast``, and detector boxes in half precision.
        """
        check_rank(video, 5, "video", "(B, T, 3, H, W)")
        check_size(video, 2, 3, "video", "(B, T, 3, H, W)")
        check_positive(fps, "fps")
        if is_autocast(video):
            raise TensorsimError(
                "video: got it under torch.autocast, expected it off: it would round positions in pixels and metres"
            )
        b, t, height, width = video.shape[0], video.shape[1], video.shape[3], video.shape[4]
        if b == 0 or t < 2:
            raise TensorsimError(
                f"video: got shape {list(video.shape)}, expected at least 1 clip of at least 2 frames"
            )
        present = self.frames_present(b, t, lengths, video.device)
        observed = self.observed_frames(present, fps)

        frames = video.flatten(0, 1)
        detections = self.detect(frames[observed.flatten()])
        tracks = self.follow(detections, observed)

        people = tracks.valid.shape[1]
        boxes = tracks.boxes.transpose(1, 2).reshape(b * t, people, 4)
        valid = tracks.valid.transpose(1, 2).reshape(b * t, people)
        keypoints, scores = self.estimate(frames, boxes, valid)
        keypoints = keypoints.reshape(b, t, people, 17, 2).transpose(1, 2)
        scores = scores.reshape(b, t, people, 17).transpose(1, 2)
        counts = present.sum(dim=-1)
        if times_s is not None:
            tracks, keypoints, scores = to_even_time(tracks, keypoints, scores, times_s, fps)
            last_s = times_s.gather(1, counts.to(times_s.device)[:, None] - 1) - times_s[:, :1]
            counts = even_count(last_s[:, 0], fps)
        return self.lift_each_length(tracks, keypoints, scores, counts, height, width, fps)

    def frames_present(self, clips: int, frames: int, lengths: Tensor | None, device: torch.device) -> Tensor:
        """(B, T) bool: the frames that belong to a clip rather than its padding."""
        index = torch.arange(frames, device=device)
        if lengths is None:
            return (index >= 0).expand(clips, frames)
        check_rank(lengths, 1, "lengths", "(B,)")
        if lengths.shape[0] != clips or bool((lengths < 1).any()) or bool((lengths > frames).any()):
            counts: list[int] = lengths.tolist()
            raise TensorsimError(f"lengths: got {counts}, expected {clips} counts from 1 to {frames}")
        return index < lengths.to(device).unsqueeze(-1)

    def interval_at(self, fps: float) -> int:
        """The n of 'every n-th frame' in which the detector runs at this frame rate."""
        return self.detection_interval * times_as_fast(fps)

    def observed_frames(self, present: Tensor, fps: float) -> Tensor:
        """(B, T) bool: frames in which the detector runs, every n-th and the last of each clip."""
        index = torch.arange(present.shape[-1], device=present.device)
        last = present.sum(dim=-1, keepdim=True) - 1
        return present & ((index % self.interval_at(fps) == 0) | (index == last))

    def detect(self, frames: Tensor) -> Detections:
        """Detect in frames (n, 3, H, W), ``frames_per_batch`` at a time."""
        parts: list[Detections] = []
        for start in range(0, frames.shape[0], self.frames_per_batch):
            found = self.detector(frames[start : start + self.frames_per_batch])
            if not torch.jit.is_scripting():
                check_detections(found)
            parts.append(Detections(found.boxes, found.scores, found.labels, found.valid))
        return joined(parts)

    def follow(self, detections: Detections, observed: Tensor) -> Tracks:
        """Track the detections (n, K) of the ``observed`` frames (B, T), n = observed.sum(), in row-major order."""
        clips, frames = observed.shape[0], observed.shape[1]
        index = torch.nonzero(observed.flatten()).squeeze(-1)
        count = detections.boxes.shape[1]
        boxes = detections.boxes.new_zeros(clips * frames, count, 4)
        scores = detections.scores.new_zeros(clips * frames, count)
        labels = detections.labels.new_zeros(clips * frames, count)
        valid = detections.valid.new_zeros(clips * frames, count)
        boxes[index] = detections.boxes
        scores[index] = detections.scores
        labels[index] = detections.labels
        valid[index] = detections.valid
        whole = Detections(
            boxes.unflatten(0, [clips, frames]),
            scores.unflatten(0, [clips, frames]),
            labels.unflatten(0, [clips, frames]),
            valid.unflatten(0, [clips, frames]),
        )
        tracks = self.tracker(whole, observed)
        # The last frame of a clip is observed, so all after the last observed frame is padding.
        within = (observed.flip(-1).cumsum(-1).flip(-1) > 0).unsqueeze(1)
        return Tracks(tracks.boxes * within.unsqueeze(-1), tracks.valid & within, tracks.matched & within)

    def estimate(self, frames: Tensor, boxes: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints (n, P, 17, 2) and scores (n, P, 17) for boxes (n, P, 4) in frames (n, 3, H, W)."""
        keypoints: list[Tensor] = []
        scores: list[Tensor] = []
        for start in range(0, frames.shape[0], self.frames_per_batch):
            stop = start + self.frames_per_batch
            k, s = self.pose(frames[start:stop], boxes[start:stop], valid[start:stop])
            keypoints.append(k)
            scores.append(s)
        return torch.cat(keypoints), torch.cat(scores)

    def is_person(self, scores: Tensor, valid: Tensor, fps: float) -> Tensor:
        """Whether the pose network sees a person in a quarter of the frames of a track, or for a whole second.

        Somebody lying after a fall has low scores, perhaps for most of a long video.

        Args:
            scores: (B, P, T, 17) of the keypoints.
            valid: (B, P, T) bool.
            fps: frames per second.

        Returns:
            (B, P) bool.
        """
        seen = (scores >= self.keypoint_threshold).to(scores.dtype)
        mean = (scores * seen).sum(dim=-1) / seen.sum(dim=-1).clamp(min=1.0)
        good = valid & (mean >= self.least_score)
        often = 4 * good.sum(dim=-1) >= valid.sum(dim=-1).clamp(min=1)
        second = int(fps) + 1
        if good.shape[-1] < second:
            return often
        return often | good.unfold(-1, second, 1).all(dim=-1).any(dim=-1)

    def lift_each_length(
        self,
        tracks: Tracks,
        keypoints: Tensor,
        scores: Tensor,
        counts: Tensor,
        height: int,
        width: int,
        fps: float,
    ) -> Pose:
        """:meth:`lift` for clips padded to T frames, each on its own, since filters would otherwise see the padding.

        Args:
            tracks, keypoints, scores, height, width, fps: see :meth:`lift`.
            counts: (B,) frames of each clip.

        Returns:
            People; in the padding, joints repeat the last frame and nobody is valid.
        """
        frames = keypoints.shape[2]
        lengths: list[int] = torch.unique(counts).tolist()
        rows: list[Tensor] = []
        joints: list[Tensor] = []
        keypoints, scores, valid = keypoints.clone(), scores.clone(), torch.zeros_like(tracks.valid)
        for n in lengths:
            row = torch.nonzero(counts.to(valid.device) == n)[:, 0]
            part = Tracks(tracks.boxes[row, :, :n], tracks.valid[row, :, :n], tracks.matched[row, :, :n])
            pose = self.lift(part, keypoints[row, :, :n], scores[row, :, :n], height, width, fps)
            rows.append(row)
            joints.append(
                torch.cat([pose.joints, pose.joints[:, :, -1:].expand(-1, -1, frames - n, -1, -1)], dim=2)
            )
            keypoints[row, :, :n] = pose.keypoints
            scores[row, :, :n] = pose.keypoint_scores
            valid[row, :, :n] = pose.valid
        return Pose(tracks.boxes, keypoints, scores, torch.cat(joints)[torch.cat(rows).argsort()], valid)

    def lift(
        self, tracks: Tracks, keypoints: Tensor, scores: Tensor, height: int, width: int, fps: float
    ) -> Pose:
        """Tracks and COCO keypoints (B, P, T, 17, 2) in images of this size -> smooth joints in the world."""
        keypoints, scores = self.sides(keypoints, scores, tracks.valid, fps)
        body, body_scores = coco_to_body(keypoints, scores, self.keypoint_threshold)
        # Joints below the threshold get no weight in the match: the network guesses what it cannot see.
        reliable = (body_scores >= self.keypoint_threshold) & tracks.valid.unsqueeze(-1)
        body_scores = body_scores * reliable
        # A lone foot at the edge of the image does not determine a pose: the smoother predicts such frames.
        usable = where_any(tracks.valid & (reliable.sum(dim=-1) >= self.fewest_joints), tracks.valid)
        usable = usable & self.is_person(scores, tracks.valid, fps).unsqueeze(-1)
        if self.temporal is not None:
            found = self.temporal(keypoints, scores, tracks.boxes, usable, height, width, fps)
            lifted = self.temporal.in_picture(found, body, body_scores, height, width, fps)
            noise = self.noise_share * found.deviation
            noise = torch.where(reliable.unsqueeze(-1), noise, self.hidden_noise * noise)
            if self.bone_fit is None:
                body = lifted.keypoints
            else:  # made for exact keypoints, which stay where they are even where the lifter doubts them
                body = torch.where(reliable.unsqueeze(-1), body, lifted.keypoints)
        else:
            assert self.lifter is not None
            lifted = self.lifter(body, body_scores)
            noise = keypoint_noise(body_scores, lifted.scale)
        if self.asks_for_edges:
            cut_off = cut_off_beside(tracks.boxes, width)
            joints, seen = self.metric_pose(
                body, body_scores, lifted, usable, height, width, fps, None, cut_off
            )
        else:
            joints, seen = self.metric_pose(body, body_scores, lifted, usable, height, width, fps)
        if self.temporal is None:
            noise = noise_with_depth(noise, lifted.deviation, joints, torch.tensor(self.camera_m).to(joints))
        elif self.bone_fit is None:
            lying = trunk_lean(joints.detach())
            noise = noise * (1 + (self.lying_noise - 1) * lying)[..., None, None]
        usable = usable & seen.any(dim=-1)  # without frames whose size is implausible
        if self.bone_fit is not None:
            joints = self.bone_fit(joints, seen & usable.unsqueeze(-1), fps)
        # A hidden person stays in the scene over short gaps, unless the hips would have moved too far meanwhile.
        hidden = brief_gaps(usable, int(self.longest_gap_s * fps))
        hidden = hidden & crossed_within(mid_hips(joints), usable, self.hidden_speed_m_s / fps)
        # Somebody tracked to the left or right edge of the image and back was outside it in between.
        hidden = hidden & ~gaps_with(cut_off_beside(tracks.boxes, width) & tracks.valid, usable)
        there = usable | brief_gaps(usable, int(self.brief_gap_s * fps)) | hidden
        # The smoother predicts a joint that is hidden briefly. Over a longer gap the prediction would drift: there the
        # joint of the matched pose replaces it, as long as the person is in the scene.
        in_scene = usable.unsqueeze(-1).expand_as(seen)
        predicted = brief_gaps(seen.transpose(-1, -2), int(self.brief_gap_s * fps)).transpose(-1, -2)
        measured = without_jumps(joints, in_scene & ~predicted, fps, self.top_speed_m_s)
        joints = self.smoother(joints, measured, fps, noise)
        if self.range_rate is not None:
            joints = self.range_rate(joints, reliable, there, torch.tensor(self.camera_m).to(joints), fps)
        if self.walking_legs is not None:
            joints = self.walking_legs(joints, reliable, there, fps)
        joints = limit_speed(joints, fps, self.top_speed_m_s)
        return Pose(tracks.boxes, keypoints, scores, joints, tracks.valid & there)


def joined(parts: list[Detections]) -> Detections:
    """Concatenate detections (n, K) of several detector calls, padded to their largest K."""
    most = max([part.valid.shape[1] for part in parts])
    boxes: list[Tensor] = []
    scores: list[Tensor] = []
    labels: list[Tensor] = []
    valid: list[Tensor] = []
    for part in parts:
        missing = most - part.valid.shape[1]
        boxes.append(F.pad(part.boxes, [0, 0, 0, missing]))
        scores.append(F.pad(part.scores, [0, missing]))
        labels.append(F.pad(part.labels, [0, missing]))
        valid.append(F.pad(part.valid, [0, missing]))
    return Detections(torch.cat(boxes), torch.cat(scores), torch.cat(labels), torch.cat(valid))


def _lifter_beside(metric_pose: nn.Module, keypoint_threshold: float) -> TemporalLifter:
    """The shipped lifter, in float64 and frozen, for the camera and heights of a metric pose, or default ones."""
    camera, heights = CameraConfig(), PoseConfig().person_height_m
    if isinstance(metric_pose, MetricPose):
        camera, heights = metric_pose.camera, tuple(metric_pose.heights.tolist())
    lifter = TemporalLifter.from_pretrained(None, camera, heights, keypoint_threshold)
    return lifter.double().requires_grad_(False)
