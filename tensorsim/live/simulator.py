"""The whole live chain: a frame in, people, new columns of the maps and a label out."""

import copy
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tensorsim.config import SimulationConfig
from tensorsim.errors import TensorsimError, check_positive
from tensorsim.live.dense_search import DenseSearch
from tensorsim.live.labels import LiveLabel, LiveLabels
from tensorsim.live.pose import CausalPose, PoseState
from tensorsim.live.radar import LiveRadar
from tensorsim.live.tracking import OnlineTracker
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.recognition import ActivityRecognizer
from tensorsim.types import Detections
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.metric_pose import MetricPose


class LivePerson(NamedTuple):
    """A person in a frame.

    Attributes:
        number: in order of appearance, from 1.
        box: (4,) ``xyxy`` pixels.
        keypoints: (17, 2) COCO keypoints in pixels.
        scores: (17,) of the keypoints, from 0.
        joints: (14, 3) world metres, filtered.
        present: whether the person is in the radar's scene.
    """

    number: int
    box: Tensor
    keypoints: Tensor
    scores: Tensor
    joints: Tensor
    present: bool


class LiveFrame(NamedTuple):
    """What a frame adds.

    Attributes:
        number: of the frame, from 0; missing frames count.
        time_s: of the frame in seconds, ``number / fps``.
        people: people in the frame.
        doppler_time: (F, k) new columns of the Doppler-time map, linear magnitude; k is 0 where none is complete.
        doppler_time_s: (k,) float64 centres of their windows in seconds.
        range_time: (R, c) new columns of the range-time map at the display rate, linear magnitude.
        range_time_mti: (R, c') the same after the moving target indicator.
        label: activity of the last four seconds, once a second; else None.
        delay_s: time from the end of the last Doppler window to this frame, in seconds of the film.
    """

    number: int
    time_s: float
    people: list[LivePerson]
    doppler_time: Tensor
    doppler_time_s: Tensor
    range_time: Tensor
    range_time_mti: Tensor
    label: LiveLabel | None
    delay_s: float


class LiveSimulator:
    """Processes camera frames one at a time and returns people and new map columns. Causal, with bounded memory.

    Detection in every n-th frame, tracking (:class:`~tensorsim.live.tracking.OnlineTracker`), keypoints, lifting and
    the forward Kalman filter (:class:`~tensorsim.live.pose.CausalPose`), a spline and the radar
    (:class:`~tensorsim.live.radar.LiveRadar`). Map columns are returned one frame after their last pulse.

    Args:
        config: configuration of the run; None is the free-space scene. The camera is ``pose.camera``; it is not
            estimated. Poses are lifted by nearest matching, frame by frame, because the temporal lifter needs future
            frames.
        fps: frames per second of the camera.
        detector, pose: networks that replace those of the configuration.
        recognizer: labels the activity of the last four seconds once a second; None gives no labels.
        least_probability: labels with a lower probability become "not sure". The default, 0.0, always gives the most
            probable class; the default of ``tensorsim live`` is 0.2.

    Attributes:
        missed: number of frames registered as missing so far.
        config: the configuration with nearest matching, and range-time maps at a display rate.

    Example:
        >>> live = ts.LiveSimulator(fps=fps)
        >>> for frame in video[0]:  # (3, H, W) uint8 RGB
        ...     new = live.push(frame)
        >>> new.number, len(new.people), new.doppler_time.shape[0]
        (5, 0, 1024)

    Raises:
        TensorsimError: settings that need the whole film: a known initial distance, calibration, the paper's position,
            people other than ``"all"``, the MTI methods ``"mean"`` and ``"high-pass"``, smoothing along the pulses,
            sway, vital signs, a denoiser, effects of the receiver, an interfering radar; several antennas; a frame rate
            that is not positive; weights that are missing or of another network.
    """

    def __init__(
        self,
        config: SimulationConfig | None = None,
        fps: float = 30.0,
        detector: nn.Module | None = None,
        pose: nn.Module | None = None,
        recognizer: ActivityRecognizer | None = None,
        least_probability: float = 0.0,
    ) -> None:
        check_positive(fps, "fps")
        config = SimulationConfig() if config is None else config
        config = config.replace(pose__lifter_weights=None, pose__lifter="nearest")
        for name, given in (
            ("an initial distance", config.pose.initial_distance_m is not None),
            ("calibration", config.pose.calibrate),
            ("position 'paper'", config.pose.position == "paper"),
            (f"people {config.pose.people!r}", config.pose.people != "all"),
        ):
            if given:
                raise TensorsimError(f"live: got {name}, expected none: it needs the whole film")
        if config.processing.display_rate_hz is None and config.scene.radar.prf_hz > 256:
            config = config.replace(processing__display_rate_hz=256.0)
        self.config, self.fps = config, float(fps)
        # First, because it checks the settings before networks are loaded.
        self.radar = LiveRadar(PoseToDoppler.from_config(config), fps)
        self.vision = VideoToPose.from_config(config, detector, pose)
        self.lifter = _each_frame_alone(self.vision.lifter)
        self.poses = [self._causal_pose(height_m) for height_m in config.pose.person_height_m]
        self.tracker = OnlineTracker(**_tracking(config))
        self.tracks = self.tracker.begin()
        self.labels = None
        if recognizer is not None:
            self.labels = LiveLabels(recognizer, self.radar.simulator, least_probability)
        self.order: dict[int, int] = {}
        self.states: dict[int, PoseState] = {}
        self.appeared, self.index, self.missed = 0, -1, 0
        self.detected: int | None = None
        self.columns_done = 0

    @property
    def doppler_hz(self) -> np.ndarray:
        """Doppler axis (F,) of the maps, positive = approaching."""
        return self.radar.simulator.doppler.doppler_hz.numpy()

    @torch.inference_mode()
    def push(self, frame: Tensor) -> LiveFrame:
        """Process the next frame.

        Args:
            frame: (3, H, W) uint8 RGB.

        Returns:
            What the frame adds: people with keypoints in pixels and joints in metres, and new columns (F, k), (R, c)
            and (R, c') of the maps, of any number including 0; see :class:`LiveFrame`.

        Raises:
            TensorsimError: another shape or type.
        """
        if frame.dim() != 3 or frame.shape[0] != 3 or frame.dtype != torch.uint8:
            raise TensorsimError(
                f"frame: got {frame.dtype} of shape {list(frame.shape)}, expected uint8 (3, H, W) RGB"
            )
        self.index += 1
        detections = None
        # Not by frame number: a busy machine may drop too many of the very frames due for detection.
        if self.detected is None or self.index - self.detected >= self.vision.interval_at(self.fps):
            self.detected = self.index
            detections = Detections(*(field[0] for field in self.vision.detect(frame[None])))
        self.tracks = self.tracker.step(self.tracks, detections)
        return self._after(frame)

    @torch.inference_mode()
    def miss(self) -> LiveFrame:
        """Register a missing frame; people continue at their last velocity.

        Returns:
            As :meth:`push`; the people have keypoints and scores of 0.
        """
        self.index += 1
        self.missed += 1
        self.tracks = self.tracker.step(self.tracks, None)
        return self._after(None)

    def _after(self, frame: Tensor | None) -> LiveFrame:
        """What a frame adds once its detections are tracked."""
        people = self._people(frame)
        joints = {p.number - 1: (p.joints.double(), p.present) for p in people}
        new = self.radar.push(joints)
        doppler = self.radar.simulator.doppler
        count = new.doppler_time.shape[-1]
        column = torch.arange(self.columns_done, self.columns_done + count).double()
        late_s = self.radar.simulator.mti.delay_pulses / self.radar.prf_hz
        centre_s = (column * doppler.hop + doppler.length / 2) / self.radar.prf_hz + late_s
        self.columns_done += count
        time_s = self.index / self.fps
        # Before the first column, the radar is still filling its first window.
        end_s = ((self.columns_done - 1) * doppler.hop + doppler.length) / self.radar.prf_hz
        delay_s = time_s - end_s if self.columns_done else time_s
        label = None
        if self.labels is not None:
            label = self.labels.push(new.doppler_time, new.range_time_mti, new.end_s)
        return LiveFrame(
            self.index,
            time_s,
            people,
            new.doppler_time,
            centre_s,
            new.range_time,
            new.range_time_mti,
            label,
            delay_s,
        )

    def _people(self, frame: Tensor | None) -> list[LivePerson]:
        """People of this frame with their filtered joints."""
        numbers, boxes = self.tracker.people(self.tracks)
        living = set(self.tracks.living.rows.tolist())
        for gone in set(self.order) - living:
            del self.order[gone], self.states[gone]
        for number in numbers:
            if number not in self.order:
                self.order[number] = self.appeared
                self.appeared += 1
                self.states[number] = self._pose_of(number).begin(1)
        keypoints, scores = torch.zeros(len(numbers), 17, 2), torch.zeros(len(numbers), 17)
        height, width = (2, 2) if frame is None else (int(frame.shape[1]), int(frame.shape[2]))
        if frame is not None and numbers:
            found = self.vision.estimate(
                frame[None], boxes[None].float(), torch.ones(1, len(numbers), dtype=torch.bool)
            )
            keypoints, scores = found[0][0], found[1][0]
        there = torch.tensor([frame is not None])
        people = []
        for row, number in enumerate(numbers):
            stage = self._pose_of(number)
            one = slice(row, row + 1)
            state = stage(self.states[number], keypoints[one], scores[one], boxes[one], there, height, width)
            self.states[number] = state
            if int(state.frames) == 0:
                continue
            people.append(
                LivePerson(
                    self.order[number] + 1,
                    boxes[row],
                    keypoints[row],
                    scores[row],
                    state.shown[0],
                    bool(stage.present(state)[0]),
                )
            )
        return people

    def _pose_of(self, number: int) -> CausalPose:
        return self.poses[min(self.order[number], len(self.poses) - 1)]

    def _causal_pose(self, height_m: float) -> CausalPose:
        """The pose stage for a person of this height."""
        vision, people = self.vision, self.config.pose
        metric = MetricPose(people.camera, (height_m,), None, people.keypoint_threshold, calibrated=True)
        return CausalPose(
            self.lifter,
            metric,
            self.fps,
            people.keypoint_threshold,
            people.fewest_joints,
            vision.least_score,
            self.config.smoothing.brief_gap_s,
            vision.top_speed_m_s,
        ).eval()


def _each_frame_alone(lifter: nn.Module | None) -> nn.Module:
    """The same lifter without looking at other frames, fast for single frames.

    Raises:
        TensorsimError: a lifter of another class.
    """
    if not isinstance(lifter, NearestPoseLifter):
        raise TensorsimError(
            f"live: got a lifter of class {type(lifter).__name__}, expected NearestPoseLifter"
        )
    alone = copy.copy(lifter)
    alone._modules = {"search": DenseSearch(lifter.search)}
    alone.temporal = 0.0
    return alone


def _tracking(config: SimulationConfig) -> dict[str, Any]:
    """Arguments of the tracker."""
    tracking = config.tracking
    names = (
        "max_tracks confirm_hits confirm_window delete_misses delete_window assignment_threshold min_box_px "
        "process_noise measurement_noise"
    )
    return {name: getattr(tracking, name) for name in names.split()}
