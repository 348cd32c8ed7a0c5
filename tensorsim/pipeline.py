"""The graph that joins the rooms: video -> pose -> motion -> echo -> maps.

Each class is one ``nn.Module`` made of the stages beside it; every stage can be replaced by another with the
same interface. ``forward`` works on whole clips in memory and scripts; the methods it is made of are public so
that a long film can be streamed through them piece by piece (see ``tensorsim.streaming``).
"""

import os
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import coco_to_body
from tensorsim.config import CameraConfig, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, TensorsimWarning, check_positive, check_rank, check_size
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.savgol import SavitzkyGolay
from tensorsim.motion.scatterers import JointScatterers, visibility_fade
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.types import Detections, Pose, RadarMaps, Recognition, Simulation, Tracks
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.metric_pose import MetricPose
from tensorsim.vision.pose2d.cpm import CPM
from tensorsim.vision.pose2d.hrnet import HRNet
from tensorsim.vision.pose2d.onnx_heatmaps import OnnxHeatmaps
from tensorsim.vision.pose2d.topdown import TopDownPose
from tensorsim.vision.smoothing.along_time import brief_gaps
from tensorsim.vision.smoothing.kalman import KalmanSmoother
from tensorsim.vision.tracking.tracker import GNNTracker


class VideoToPose(nn.Module):
    """Video -> people with metric 3D joints.

    Detects in every ``detection_interval``-th frame and in the last one, tracks, estimates COCO-17 keypoints in
    every frame, lifts them to 3D, places them in the world and smooths them.

    Args:
        detector: images -> :class:`~tensorsim.types.Detections`, e.g. :class:`tensorsim.vision.RTMDet`.
        pose: crops -> heat maps, e.g. :class:`tensorsim.vision.HRNet`; or a whole ``TopDownPose``.
        person_height_m: body heights in metres by person (order of appearance); the last one serves the rest.
        initial_distance_m: known distance of each person in the first good frames; calibrates the focal length.
        camera: where the camera stands and its focal length.
        keypoint_threshold: score from which a keypoint counts as seen.
        detection_interval: run the detector on every n-th frame (panel: 2).
        fewest_joints: of the 14, in a frame that says anything of the pose.
        brief_gap_s: a joint that hides for at most this many seconds coasts through the smoother.
        frames_per_batch: frames that go through a network at once; bounds memory.
        tracker, lifter, metric_pose, smoother: replacements of the default stages.
        bone_fit: a :class:`~tensorsim.vision.lifting.bone_fit.BoneFit` between ``metric_pose`` and ``smoother``, for
            keypoints that are exact; None leaves it out.

    Raises:
        TensorsimError: ``detection_interval`` or ``frames_per_batch`` below 1.
    """

    def __init__(
        self,
        detector: nn.Module,
        pose: nn.Module,
        person_height_m: tuple[float, ...] = (1.80, 1.70),
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
    ) -> None:
        super().__init__()
        for name, value in (
            ("detection_interval", detection_interval),
            ("frames_per_batch", frames_per_batch),
        ):
            if value < 1:
                raise TensorsimError(f"{name}: got {value}, expected at least 1")
        self.detector = detector
        self.pose = pose if isinstance(pose, TopDownPose) else TopDownPose(pose)
        self.tracker = tracker if tracker is not None else GNNTracker()
        self.lifter = lifter if lifter is not None else NearestPoseLifter()
        self.metric_pose = (
            metric_pose
            if metric_pose is not None
            else MetricPose(camera, person_height_m, initial_distance_m, keypoint_threshold)
        )
        self.bone_fit = bone_fit if bone_fit is not None else _AsPlaced()
        self.smoother = smoother if smoother is not None else KalmanSmoother()
        self.keypoint_threshold = keypoint_threshold
        self.detection_interval = detection_interval
        self.fewest_joints = fewest_joints
        self.brief_gap_s = brief_gap_s
        self.frames_per_batch = frames_per_batch

    def forward(self, video: Tensor, fps: float, lengths: Tensor | None = None) -> Pose:
        """Estimate the people of whole clips.

        Args:
            video: (B, T, 3, H, W) RGB, uint8 or float in [0, 1].
            fps: frames per second.
            lengths: (B,) frames of each clip when the shorter ones are padded; None takes all T.

        Raises:
            TensorsimError: wrong rank or channels, fewer than 2 frames, fps not positive.
        """
        check_rank(video, 5, "video", "(B, T, 3, H, W)")
        check_size(video, 2, 3, "video", "(B, T, 3, H, W)")
        check_positive(fps, "fps")
        b, t, height, width = video.shape[0], video.shape[1], video.shape[3], video.shape[4]
        if b == 0 or t < 2:
            raise TensorsimError(
                f"video: got shape {list(video.shape)}, expected at least 1 clip of at least 2 frames"
            )
        present = self.frames_present(b, t, lengths, video.device)
        observed = self.observed_frames(present)

        frames = video.flatten(0, 1)
        detections = self.detect(frames[observed.flatten()])
        tracks = self.follow(detections, observed)

        people = tracks.valid.shape[1]
        boxes = tracks.boxes.transpose(1, 2).reshape(b * t, people, 4)
        valid = tracks.valid.transpose(1, 2).reshape(b * t, people)
        keypoints, scores = self.estimate(frames, boxes, valid)
        keypoints = keypoints.reshape(b, t, people, 17, 2).transpose(1, 2)
        scores = scores.reshape(b, t, people, 17).transpose(1, 2)
        return self.lift(tracks, keypoints, scores, height, width, fps)

    def frames_present(self, clips: int, frames: int, lengths: Tensor | None, device: torch.device) -> Tensor:
        """(B, T) bool: the frames that belong to a clip rather than to its padding."""
        index = torch.arange(frames, device=device)
        if lengths is None:
            return (index >= 0).expand(clips, frames)
        check_rank(lengths, 1, "lengths", "(B,)")
        if lengths.shape[0] != clips or bool((lengths < 1).any()) or bool((lengths > frames).any()):
            counts: list[int] = lengths.tolist()
            raise TensorsimError(f"lengths: got {counts}, expected {clips} counts from 1 to {frames}")
        return index < lengths.to(device).unsqueeze(-1)

    def observed_frames(self, present: Tensor) -> Tensor:
        """(B, T) bool: frames in which the detector runs, every n-th and the last of each clip."""
        index = torch.arange(present.shape[-1], device=present.device)
        last = present.sum(dim=-1, keepdim=True) - 1
        return present & ((index % self.detection_interval == 0) | (index == last))

    def detect(self, frames: Tensor) -> Detections:
        """Detect in frames (n, 3, H, W), ``frames_per_batch`` at a time."""
        boxes: list[Tensor] = []
        scores: list[Tensor] = []
        labels: list[Tensor] = []
        valid: list[Tensor] = []
        for start in range(0, frames.shape[0], self.frames_per_batch):
            found = self.detector(frames[start : start + self.frames_per_batch])
            boxes.append(found.boxes)
            scores.append(found.scores)
            labels.append(found.labels)
            valid.append(found.valid)
        return Detections(torch.cat(boxes), torch.cat(scores), torch.cat(labels), torch.cat(valid))

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
        # The last frame of a clip is observed, so what follows the last observed frame is padding.
        within = (observed.flip(-1).cumsum(-1).flip(-1) > 0).unsqueeze(1)
        return Tracks(tracks.boxes * within.unsqueeze(-1), tracks.valid & within, tracks.matched & within)

    def estimate(self, frames: Tensor, boxes: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints (n, P, 17, 2) and scores (n, P, 17) of boxes (n, P, 4) in frames (n, 3, H, W)."""
        keypoints: list[Tensor] = []
        scores: list[Tensor] = []
        for start in range(0, frames.shape[0], self.frames_per_batch):
            stop = start + self.frames_per_batch
            k, s = self.pose(frames[start:stop], boxes[start:stop], valid[start:stop])
            keypoints.append(k)
            scores.append(s)
        return torch.cat(keypoints), torch.cat(scores)

    def lift(
        self, tracks: Tracks, keypoints: Tensor, scores: Tensor, height: int, width: int, fps: float
    ) -> Pose:
        """Tracks and COCO keypoints (B, P, T, 17, 2) of an image of this size -> smooth joints in the world."""
        body, body_scores = coco_to_body(keypoints, scores, self.keypoint_threshold)
        # Joints below the threshold have no say in the match: the network guesses what it cannot see.
        trusted = (body_scores >= self.keypoint_threshold) & tracks.valid.unsqueeze(-1)
        body_scores = body_scores * trusted
        # A foot alone at the edge of the picture does not tell a pose: such frames of a track coast.
        told = tracks.valid & (trusted.sum(dim=-1) >= self.fewest_joints)
        told = torch.where(told.any(dim=-1, keepdim=True), told, tracks.valid)
        lifted = self.lifter(body, body_scores)
        joints, seen = self.metric_pose(body, body_scores, lifted, told, height, width, fps)
        told = told & seen.any(dim=-1)  # less the frames that it does not believe
        joints = self.bone_fit(joints, seen & told.unsqueeze(-1), fps)
        # A joint that hides for a moment coasts. One that hides for longer would coast away: there the joint of
        # the pose that was found stands in for it, as long as the person is in the scene.
        in_scene = told.unsqueeze(-1).expand_as(seen)
        coasting = brief_gaps(seen.transpose(-1, -2), int(self.brief_gap_s * fps)).transpose(-1, -2)
        joints = self.smoother(joints, in_scene & ~coasting, fps)
        # Nobody is where no frame of a track shows a joint.
        return Pose(tracks.boxes, keypoints, scores, joints, tracks.valid & told.any(dim=-1, keepdim=True))


class _AsPlaced(nn.Module):
    """No :class:`~tensorsim.vision.lifting.bone_fit.BoneFit`."""

    def forward(self, joints: Tensor, seen: Tensor, fps: float) -> Tensor:
        return joints


class PoseToDoppler(nn.Module):
    """Joints at video rate -> maps of the radar: resample to the pulse rate, place scatterers, simulate.

    Several people of a clip are one scene: their scatterers are summed in one echo.

    Args:
        simulator: scatterers -> maps.
        resampler: video rate -> pulse rate; default the C2 spline at the PRF of the simulator's radar.
        pulse_smoother: optional filter along the pulses; the paper's is linear resampling and Savitzky-Golay.
        scatterers: joints -> scatterers; default one point per joint with the panel's RCS.
        denoiser: optional module on magnitude maps (..., H, W), e.g. ``tensorsim.enhance.MapDenoiser``. It cleans
            the shown maps; the Doppler-time map is computed from data that was not denoised.
    """

    def __init__(
        self,
        simulator: RadarSimulator,
        resampler: PoseResampler | None = None,
        pulse_smoother: SavitzkyGolay | None = None,
        scatterers: nn.Module | None = None,
        denoiser: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.simulator = simulator
        self.resampler = resampler if resampler is not None else PoseResampler(simulator.radar.prf_hz)
        # Pulses beside a piece of motion that the filter needs to give the same values as on the whole.
        self.halo = 0 if pulse_smoother is None else pulse_smoother.window
        self.pulse_smoother = pulse_smoother if pulse_smoother is not None else nn.Identity()
        self.scatterers = scatterers if scatterers is not None else JointScatterers()
        self.denoises = denoiser is not None
        self.denoiser = denoiser if denoiser is not None else nn.Identity()

    def forward(self, joints: Tensor, valid: Tensor, fps: float) -> RadarMaps:
        """Joints (B, P, T, 14, 3) in metres and their validity (B, P, T) -> maps of B scenes.

        Raises:
            TensorsimError: wrong shapes, fewer than 2 frames, fps not positive, motion too fast for the PRF.
        """
        coefficients = self.resampler.coefficients(joints, fps)
        pulses = self.resampler.pulses(joints.shape[2], fps)
        points, rcs = self.scene(coefficients, valid, fps, 0, pulses)
        return self.denoise(self.simulator(points, rcs))

    def scene(
        self, coefficients: Tensor, valid: Tensor, fps: float, start: int, stop: int
    ) -> tuple[Tensor, Tensor]:
        """Scatterers (B, M, S, 3) and their RCS (B, M, S) in pulses ``start`` to ``stop`` of the motion.

        Args:
            coefficients: of the resampler, for joints (B, P, T, 14, 3).
            valid: (B, P, T) bool.
            fps: frames per second.
            start, stop: half-open range of pulses.
        """
        pulses = self.resampler.pulses(valid.shape[2], fps)
        first, last = max(0, start - self.halo), min(pulses, stop + self.halo)
        positions = self.pulse_smoother(self.resampler.evaluate(coefficients, fps, first, last))
        positions = positions[:, :, start - first : stop - first]
        presence = visibility_fade(valid, fps, self.resampler.prf_hz, start, stop)
        points, rcs = self.scatterers(positions, presence)
        return points, rcs

    def denoise(self, maps: RadarMaps) -> RadarMaps:
        """Clean the processed maps and take the ridges again, if there is a denoiser."""
        if not self.denoises:
            return maps
        doppler_time = self.denoiser(maps.doppler_time)
        ridges = self.simulator.ridges(doppler_time)
        return RadarMaps(
            maps.range_time,
            self.denoiser(maps.range_time_mti),
            doppler_time,
            ridges.indices,
            ridges.magnitudes,
            maps.snr_db,
        )


class VideoToDoppler(nn.Module):
    """Video -> people, joints, echo and maps, as one graph.

    Args:
        detector, pose: the two networks, see :class:`VideoToPose`.
        radar: default the panel's free-space radar.
        wall: a slab between or behind; see :class:`tensorsim.radar.EchoSynthesizer`.
        multipath, leakage, wall_echo: paths of the scene beyond the direct one.
        snr_db: signal-to-noise ratio per IF sample of the targets' echo; None is free of noise. The noise is drawn
            from torch's global generator (``torch.manual_seed``).
        person_height_m, initial_distance_m, camera, detection_interval: see :class:`VideoToPose`.
        denoiser: see :class:`PoseToDoppler`.
        video_to_pose, pose_to_doppler: whole replacements; the arguments above that configure them are then unused.

    Example:
        >>> sim = ts.VideoToDoppler(detector, pose, radar=ts.RadarConfig.free_space())
        >>> out = sim(video, fps)  # video (B, T, 3, H, W) -> Simulation
    """

    def __init__(
        self,
        detector: nn.Module | None = None,
        pose: nn.Module | None = None,
        radar: RadarConfig | None = None,
        wall: WallConfig | None = None,
        multipath: bool = False,
        leakage: bool = False,
        wall_echo: bool = False,
        snr_db: float | None = 50.0,
        person_height_m: tuple[float, ...] = (1.80, 1.70),
        initial_distance_m: tuple[float, ...] | None = None,
        camera: CameraConfig | None = None,
        detection_interval: int = 2,
        denoiser: nn.Module | None = None,
        video_to_pose: VideoToPose | None = None,
        pose_to_doppler: PoseToDoppler | None = None,
    ) -> None:
        super().__init__()
        if video_to_pose is None:
            if detector is None or pose is None:
                raise TensorsimError(
                    "VideoToDoppler: got no detector or no pose network, expected both, or video_to_pose; "
                    "VideoToDoppler.from_pretrained() takes the shipped ones"
                )
            video_to_pose = VideoToPose(
                detector,
                pose,
                person_height_m=person_height_m,
                initial_distance_m=initial_distance_m,
                camera=camera,
                detection_interval=detection_interval,
            )
        self.video_to_pose = video_to_pose
        self.pose_to_doppler = (
            pose_to_doppler
            if pose_to_doppler is not None
            else PoseToDoppler(
                RadarSimulator(
                    radar if radar is not None else RadarConfig.free_space(),
                    wall=wall,
                    multipath=multipath,
                    leakage=leakage,
                    wall_echo=wall_echo,
                    snr_db=snr_db,
                ),
                denoiser=denoiser,
            )
        )

    @classmethod
    def from_pretrained(
        cls,
        detector: str | os.PathLike[str] | None = None,
        pose: str | os.PathLike[str] | None = None,
        flip_test: bool = True,
        **options: Any,
    ) -> "VideoToDoppler":
        """The whole with trained networks, in evaluation mode.

        Args:
            detector, pose: paths or names of ``tensorsim models list``; None: the shipped weights.
            flip_test: see :func:`pretrained_pose`.
            **options: further arguments of the constructor.

        Raises:
            TensorsimError: weights that are not there or of another network.
        """
        return cls(RTMDet.from_pretrained(detector), pretrained_pose(pose, flip_test), **options).eval()

    def forward(self, video: Tensor, fps: float, lengths: Tensor | None = None) -> Simulation:
        """Simulate what the radar sees of clips.

        Args:
            video: (B, T, 3, H, W) RGB, uint8 or float in [0, 1].
            fps: frames per second.
            lengths: (B,) frames of each clip when the shorter ones are padded.

        Raises:
            TensorsimError: see :class:`VideoToPose` and :class:`PoseToDoppler`.
        """
        pose = self.video_to_pose(video, fps, lengths)
        if not torch.jit.is_scripting():
            warn_of_empty_clips(pose.valid)
        maps = self.pose_to_doppler(pose.joints, pose.valid, fps)
        return Simulation(
            pose.boxes,
            pose.keypoints,
            pose.keypoint_scores,
            pose.joints,
            pose.valid,
            maps.range_time,
            maps.range_time_mti,
            maps.doppler_time,
            maps.ridges,
            maps.ridge_magnitudes,
            maps.snr_db,
        )


class VideoToActivity(nn.Module):
    """Video -> maps -> activity, as one graph: :class:`VideoToDoppler` and a recognizer of its maps.

    A clip shows one activity of about four seconds, as the recognizer was trained on; its people are one scene.

    Args:
        video_to_doppler: frames to maps.
        recognizer: :class:`RadarMaps` -> logits (B, classes); see :class:`tensorsim.recognition.ActivityRecognizer`.

    Example:
        >>> sim = ts.VideoToActivity.from_pretrained()
        >>> label = ts.ACTIVITIES[int(sim(video, fps).logits[0].argmax())]
    """

    def __init__(self, video_to_doppler: VideoToDoppler, recognizer: nn.Module) -> None:
        super().__init__()
        self.video_to_doppler = video_to_doppler
        self.recognizer = recognizer

    @classmethod
    def from_pretrained(
        cls,
        detector: str | os.PathLike[str] | None = None,
        pose: str | os.PathLike[str] | None = None,
        classifier: str | os.PathLike[str] | None = None,
        radar: RadarConfig | None = None,
        **options: Any,
    ) -> "VideoToActivity":
        """The whole with trained networks, in evaluation mode.

        Args:
            detector, pose, classifier: paths or names of ``tensorsim models list``; None: the shipped weights.
            radar, **options: further arguments of :class:`VideoToDoppler`.

        Raises:
            TensorsimError: weights that are not there or of another network.
        """
        radar = radar if radar is not None else RadarConfig.free_space()
        return cls(
            VideoToDoppler.from_pretrained(detector, pose, radar=radar, **options),
            ActivityRecognizer.from_pretrained(radar, classifier),
        ).eval()

    def forward(self, video: Tensor, fps: float, lengths: Tensor | None = None) -> Recognition:
        """Clips (B, T, 3, H, W) to people, maps and logits; arguments and errors of :class:`VideoToDoppler`."""
        found = self.video_to_doppler(video, fps, lengths)
        logits = self.recognizer(
            RadarMaps(
                found.range_time,
                found.range_time_mti,
                found.doppler_time,
                found.ridges,
                found.ridge_magnitudes,
                found.snr_db,
            )
        )
        return Recognition(
            found.boxes,
            found.keypoints,
            found.keypoint_scores,
            found.joints,
            found.valid,
            found.range_time,
            found.range_time_mti,
            found.doppler_time,
            found.ridges,
            found.ridge_magnitudes,
            found.snr_db,
            logits,
        )


def pretrained_pose(source: str | os.PathLike[str] | None = None, flip_test: bool = True) -> TopDownPose:
    """Pose estimation with the network of a file or name: ``.onnx`` in ONNX Runtime; others are CPM or HRNet.

    Args:
        source: a path, a name of ``tensorsim models list``, or None for the shipped weights.
        flip_test: average with the mirror image, as published accuracies are measured: better, at twice the cost.

    Raises:
        TensorsimError: no such file or name, or weights of another network.
    """
    if source is not None and Path(source).suffix == ".onnx":
        network: nn.Module = OnnxHeatmaps(source)
    elif source is not None and "cpm" in Path(source).name:
        network = CPM.from_pretrained(source)
    else:
        network = HRNet.from_pretrained(source)
    return TopDownPose(network, flip_test=flip_test)


def warn_of_empty_clips(valid: Tensor) -> None:
    """Say which clips have no person (``valid`` (B, P, T)); their maps show the empty scene."""
    empty = torch.nonzero(~valid.flatten(1).any(dim=1)).flatten().tolist()
    if empty:
        warnings.warn(
            f"no person found in clip {', '.join(map(str, empty))} of {valid.shape[0]}: its maps show the empty scene",
            TensorsimWarning,
            stacklevel=3,
        )
