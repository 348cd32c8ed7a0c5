"""From frames to smooth motion: tracking, pose, position in the world, smoothing."""

from dataclasses import dataclass, field
from typing import Literal

from tensorsim.config.camera import CameraConfig
from tensorsim.config.checks import require_choices, require_counts, require_positive, require_ranges
from tensorsim.exceptions import TensorsimError, check_per_person, check_score

Position = Literal["camera", "paper"]
Lifting = Literal["temporal", "nearest"]
Resampling = Literal["spline", "linear"]
SmoothingMode = Literal["rts", "forward"]

#: Body weights of the panel in kg, for which its cross sections are valid.
PANEL_WEIGHTS_KG = (84.24, 75.00)
#: Initial distances of the panel in metres; the paper's position method needs them.
PANEL_DISTANCES_M = (4.00, 0.50)
#: Body surface area grows with this power of the weight (Du Bois and Du Bois, Arch. Intern. Med. 17, 1916).
WEIGHT_EXPONENT = 0.425


@dataclass(frozen=True)
class TrackerConfig:
    """Detection and tracking; see :class:`tensorsim.vision.GNNTracker`.

    Attributes:
        detector: name or file of the detector's weights; None is the shipped network.
        detection_interval: the detector runs on every n-th frame (panel: detection interval, 2), less often from
            45 frames per second, see :class:`~tensorsim.pipeline.VideoToPose`.
        min_box_px: smallest width and height of a detection in pixels (panel: minimum detection size, 5 x 5).
        max_tracks: largest number of people tracked at once (panel: maximum number of tracks, 5).
        confirm_hits: detections needed to confirm a track (panel: confirmation threshold, 2 of 5) ...
        confirm_window: ... within this many frames in which the detector ran.
        delete_misses: misses after which a track ends (panel: deletion threshold, 23 of 23) ...
        delete_window: ... within this many frames in which the detector ran.
        assignment_threshold: largest squared Mahalanobis distance of an assignment (panel: 150).
        process_noise: density of the acceleration noise of a box in size^2 / frame^3, where size is the longer side of
            the box (panel: process noise, 0.001).
        measurement_noise: variance of a detected coordinate in size^2, default 0.0004 (panel: Kalman measurement
            noise, 0.01).

    Raises:
        TensorsimError: numbers out of range.
    """

    detector: str | None = None
    detection_interval: int = 2
    min_box_px: float = 5.0
    max_tracks: int = 5
    confirm_hits: int = 2
    confirm_window: int = 5
    delete_misses: int = 23
    delete_window: int = 23
    assignment_threshold: float = 150.0
    process_noise: float = 1e-3
    measurement_noise: float = 4e-4

    def __post_init__(self) -> None:
        require_counts(self, "max_tracks", most=256)
        frames = ("confirm_hits", "confirm_window", "delete_misses", "delete_window")
        require_counts(self, "detection_interval", *frames, most=10_000)
        require_positive(
            "TrackerConfig",
            assignment_threshold=self.assignment_threshold,
            process_noise=self.process_noise,
            measurement_noise=self.measurement_noise,
        )


@dataclass(frozen=True)
class PoseConfig:
    """Keypoints, lifting to 3D and position in the world.

    Attributes:
        network: name or file of the pose network's weights; None is the shipped network.
        flip_test: average the network's output with that for the mirror image.
        keypoint_threshold: score from which a keypoint counts as seen (panel: key point threshold, 0.3).
        person_height_m: body heights in metres in order of appearance; the last one applies to all further people
            (panel: 1.80, 1.70 m).
        person_weight_kg: body weights in kg likewise (panel: 84.24, 75.00 kg). Cross sections scale with the body
            surface area, ``(weight / panel weight)^0.425``.
        initial_distance_m: distances of the people when they first appear, used to calibrate the focal length (panel:
            4.00, 0.50 m); None takes the camera's focal length.
        camera: pinhole camera.
        calibrate: estimate tilt, height and field of view of the camera from the people of a video instead of using
            ``camera``; see :class:`tensorsim.vision.CameraCalibrator`.
        position: ``"camera"`` (pinhole camera) or ``"paper"`` (increments of pixels times metres per pixel).
        lifter: ``"temporal"`` (a network that uses a window of frames) or ``"nearest"`` (nearest poses in a library).
        lifter_weights: name or file of the temporal lifter's weights; None is the shipped network.
        library: nearest lifter only: file of the pose library; None is the shipped one.
        neighbours: nearest lifter only: library poses averaged per frame; 1 is the paper's nearest match.
        temporal: nearest lifter only: weight of the change between frames when choosing poses; 0 matches each frame
            on its own.
        fewest_joints: how many of the 14 joints must be seen for a frame to be used.
        walking_legs: temporal lifter only: give the legs of people who walk the steps of a gait model where the film
            shows too little of them; see :class:`tensorsim.vision.WalkingLegs`.
        range_rate: temporal lifter only: correct how fast people come closer or move away by how they move; see
            :class:`tensorsim.vision.RangeRate`.
        people: who is simulated: ``"all"``, ``"moving"``, ``"nearest"`` or a person's number from 1.

    Raises:
        TensorsimError: numbers out of range or an unknown choice.
    """

    network: str | None = None
    flip_test: bool = True
    keypoint_threshold: float = 0.3
    person_height_m: tuple[float, ...] = (1.80, 1.70)
    person_weight_kg: tuple[float, ...] = PANEL_WEIGHTS_KG
    initial_distance_m: tuple[float, ...] | None = None
    camera: CameraConfig = field(default_factory=CameraConfig)
    calibrate: bool = False
    position: Position = "camera"
    lifter: Lifting = "temporal"
    lifter_weights: str | None = None
    library: str | None = None
    neighbours: int = 128
    temporal: float = 1.0
    fewest_joints: int = 5
    walking_legs: bool = True
    range_rate: bool = False
    people: str = "all"

    def __post_init__(self) -> None:
        require_choices(self, position=Position, lifter=Lifting)
        require_counts(self, "neighbours", "fewest_joints")
        if self.lifter == "temporal" and self.library is not None:
            raise TensorsimError(
                f"PoseConfig.library: got {self.library!r} with the temporal lifter, expected it with lifter='nearest'"
            )
        if self.lifter == "nearest" and self.lifter_weights is not None:
            raise TensorsimError(
                f"PoseConfig.lifter_weights: got {self.lifter_weights!r} with the nearest lifter, expected it with "
                "lifter='temporal'"
            )
        number = isinstance(self.people, str) and self.people.isdecimal() and int(self.people) >= 1
        if self.people not in ("all", "moving", "nearest") and not number:
            raise TensorsimError(
                f"PoseConfig.people: got {self.people!r}, expected 'all', 'moving', 'nearest' or a number from 1"
            )
        check_score(self.keypoint_threshold, "PoseConfig.keypoint_threshold")
        for name in ("person_height_m", "person_weight_kg", "initial_distance_m"):
            if getattr(self, name) is not None:
                check_per_person(getattr(self, name), f"PoseConfig.{name}")

    def rcs_scale(self, person: int) -> float:
        """Dimensionless factor on the cross sections of person number ``person`` (from 0), by weight."""
        weight = self.person_weight_kg[min(person, len(self.person_weight_kg) - 1)]
        panel = PANEL_WEIGHTS_KG[min(person, len(PANEL_WEIGHTS_KG) - 1)]
        return (weight / panel) ** WEIGHT_EXPONENT


@dataclass(frozen=True)
class SmoothingConfig:
    """Smoothing at video rate and interpolation to the pulse rate.

    Attributes:
        mode: ``"rts"`` smooths in both directions; ``"forward"`` is the paper's Kalman filter, which lags.
        brief_gap_s: a joint that is hidden for at most this many seconds is predicted by the smoother.
        resampling: ``"spline"`` (twice differentiable) or ``"linear"``, the paper's.
        smoothing_ratio: length of a Savitzky-Golay filter at pulse rate in seconds (panel: smoothing ratio, 0.25);
            None leaves it out.
        polynomial_order: order of the Savitzky-Golay filter.

    Raises:
        TensorsimError: numbers out of range or an unknown choice.
    """

    mode: SmoothingMode = "rts"
    brief_gap_s: float = 0.25
    resampling: Resampling = "spline"
    smoothing_ratio: float | None = None
    polynomial_order: int = 3

    def __post_init__(self) -> None:
        require_choices(self, mode=SmoothingMode, resampling=Resampling)
        require_counts(self, "polynomial_order")
        require_ranges(self, brief_gap_s="time")
        if self.smoothing_ratio is not None:
            require_ranges(self, smoothing_ratio="length of a window")
