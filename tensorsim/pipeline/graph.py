"""The whole graph: video -> maps, and video -> label."""

import os
import warnings
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from tensorsim.config import CameraConfig, RadarConfig, SceneConfig, SimulationConfig, WallConfig
from tensorsim.errors import TensorsimError, TensorsimWarning, check_replaced
from tensorsim.pipeline.maps import PoseToDoppler
from tensorsim.pipeline.networks import pretrained_detector, pretrained_pose
from tensorsim.pipeline.pose import VideoToPose
from tensorsim.protocols import check_instance, check_part
from tensorsim.radar.presets import radar_scene
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.types import RadarMaps, Recognition, Simulation


class VideoToDoppler(nn.Module):
    """Video -> people, joints, echo and maps, as one graph.

    Args:
        detector, pose: the two networks, see :class:`VideoToPose`.
        radar: a radar, or the name of a preset (``tensorsim.radar.PRESETS``), which brings its own wall and floor;
            default the panel's free-space radar.
        wall: a wall between the radar and the people, or behind them; see :class:`tensorsim.radar.EchoSynthesizer`.
        multipath, leakage, wall_echo: paths beyond the direct one; all off by default, even for the preset
            ``"through-wall"`` (:meth:`from_config` and the command turn multipath on where there is a wall).
        snr_db: signal-to-noise ratio in dB per IF sample of the people's echo; None means no noise. The noise is
            drawn from torch's global generator (``torch.manual_seed``).
        person_height_m, initial_distance_m, camera, detection_interval: see :class:`VideoToPose`.
        denoiser: see :class:`PoseToDoppler`.
        video_to_pose, pose_to_doppler: prebuilt stages, instead of building them from the arguments above.

    Raises:
        TensorsimError: a prebuilt stage together with arguments that it would be built from; no detector or pose
            network and no prebuilt stage; parts that are not suitable stages.

    Example:
        >>> sim = ts.VideoToDoppler(detector, pose, radar=ts.RadarConfig.free_space())
        >>> out = sim(video, fps)  # video (B, T, 3, H, W) -> Simulation
    """

    def __init__(
        self,
        detector: nn.Module | None = None,
        pose: nn.Module | None = None,
        radar: RadarConfig | str | None = None,
        wall: WallConfig | None = None,
        multipath: bool = False,
        leakage: bool = False,
        wall_echo: bool = False,
        snr_db: float | None = 50.0,
        person_height_m: tuple[float, ...] | None = None,
        initial_distance_m: tuple[float, ...] | None = None,
        camera: CameraConfig | None = None,
        detection_interval: int | None = None,
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
                detection_interval=2 if detection_interval is None else detection_interval,
            )
        else:
            of_pose = {
                "detector": detector,
                "pose": pose,
                "person_height_m": person_height_m,
                "initial_distance_m": initial_distance_m,
                "camera": camera,
                "detection_interval": detection_interval,
            }
            check_instance(video_to_pose, VideoToPose, "video_to_pose")
            check_replaced("video_to_pose", {name: value is not None for name, value in of_pose.items()})
        self.video_to_pose = video_to_pose
        if pose_to_doppler is None:
            scene = as_scene(radar, wall)
            scene = replace(scene, multipath=multipath, leakage=leakage, wall_echo=wall_echo, snr_db=snr_db)
            pose_to_doppler = PoseToDoppler(RadarSimulator(scene), denoiser=denoiser)
        else:
            check_instance(pose_to_doppler, PoseToDoppler, "pose_to_doppler")
            of_radar = {"radar": radar is not None, "wall": wall is not None, "multipath": multipath}
            of_radar |= {"leakage": leakage, "wall_echo": wall_echo, "snr_db": snr_db != SceneConfig().snr_db}
            check_replaced("pose_to_doppler", of_radar | {"denoiser": denoiser is not None})
        self.pose_to_doppler = pose_to_doppler

    @classmethod
    def from_config(
        cls, config: SimulationConfig, detector: nn.Module | None = None, pose: nn.Module | None = None
    ) -> "VideoToDoppler":
        """The graph described by a configuration, in evaluation mode, its networks frozen.

        Args:
            config: the configuration.
            detector, pose: networks to use instead of those that it names.

        Raises:
            TensorsimError: weights that do not exist or belong to another network.

        Warns:
            TensorsimWarning: ``pose.calibrate`` is set: it needs a whole video, so the graph uses ``pose.camera``.
                :func:`tensorsim.streaming.people_of_film` estimates the camera, as ``tensorsim simulate`` does.

        Example:
            >>> sim = ts.VideoToDoppler.from_config(ts.SimulationConfig.through_wall())
        """
        if config.pose.calibrate:
            warnings.warn(
                "pose.calibrate is ignored here and pose.camera is used; use "
                "tensorsim.streaming.people_of_film(..., calibrate=True) to estimate the camera",
                TensorsimWarning,
                stacklevel=2,
            )
        return cls(
            video_to_pose=VideoToPose.from_config(config, detector, pose),
            pose_to_doppler=PoseToDoppler.from_config(config),
        ).eval()

    @classmethod
    def from_pretrained(
        cls,
        detector: str | os.PathLike[str] | None = None,
        pose: str | os.PathLike[str] | None = None,
        flip_test: bool = True,
        **options: Any,
    ) -> "VideoToDoppler":
        """The complete pipeline with trained networks, in evaluation mode, its networks frozen.

        Args:
            detector, pose: paths or names of ``tensorsim models list``; None: the shipped weights.
            flip_test: see :func:`pretrained_pose`.
            **options: further arguments of the constructor.

        Raises:
            TensorsimError: weights that do not exist or belong to another network.
        """
        whole = cls(pretrained_detector(detector), pretrained_pose(pose, flip_test), **options).eval()
        whole.video_to_pose.requires_grad_(False)
        return whole

    def forward(
        self, video: Tensor, fps: float, lengths: Tensor | None = None, times_s: Tensor | None = None
    ) -> Simulation:
        """Simulate what the radar sees in clips.

        Args:
            video: (B, T, 3, H, W) RGB, uint8 or float in [0, 1].
            fps: frames per second.
            lengths: (B,) frames of each clip when shorter ones are padded. The noise level follows the mean power of
                the echo over all T frames: for a clip that is half padding it is 3 dB lower.
            times_s: (B, T) times in seconds of frames that are not evenly spaced.

        Raises:
            TensorsimError: see :class:`VideoToPose` and :class:`PoseToDoppler`.
        """
        pose = self.video_to_pose(video, fps, lengths, times_s)
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

    A clip should show one activity of about four seconds, as in the recognizer's training; its people form one scene.

    Args:
        video_to_doppler: frames to maps.
        recognizer: :class:`RadarMaps` -> logits (B, classes); see :class:`tensorsim.recognition.ActivityRecognizer`.

    Raises:
        TensorsimError: a recognizer made for another radar, or parts that are not suitable stages.

    Example:
        >>> sim = ts.VideoToActivity.from_pretrained()
        >>> label = ts.ACTIVITIES[int(sim(video, fps).logits[0].argmax())]
    """

    def __init__(self, video_to_doppler: VideoToDoppler, recognizer: nn.Module) -> None:
        super().__init__()
        check_instance(video_to_doppler, VideoToDoppler, "video_to_doppler")
        self.video_to_doppler = video_to_doppler
        self.recognizer = check_part(recognizer, "recognizer")
        radar = video_to_doppler.pose_to_doppler.simulator.radar
        if isinstance(recognizer, ActivityRecognizer) and recognizer.radar != radar:
            raise TensorsimError(
                f"recognizer: got one for the maps of {recognizer.radar}, expected {radar}, the radar of the simulation"
            )

    @classmethod
    def from_pretrained(
        cls,
        detector: str | os.PathLike[str] | None = None,
        pose: str | os.PathLike[str] | None = None,
        classifier: str | os.PathLike[str] | None = None,
        radar: RadarConfig | str | None = None,
        **options: Any,
    ) -> "VideoToActivity":
        """The complete pipeline with trained networks, in evaluation mode, its networks frozen.

        Args:
            detector, pose, classifier: paths or names of ``tensorsim models list``; None: the shipped weights.
            radar, **options: further arguments of :class:`VideoToDoppler`.

        Raises:
            TensorsimError: weights that do not exist or belong to another network.
        """
        whole = VideoToDoppler.from_pretrained(detector, pose, radar=radar, **options)
        radar = whole.pose_to_doppler.simulator.radar
        recognizer = ActivityRecognizer.from_pretrained(radar, classifier).requires_grad_(False)
        return cls(whole, recognizer).eval()

    @classmethod
    def from_config(cls, config: SimulationConfig) -> "VideoToActivity":
        """The graph described by a configuration, in evaluation mode, its networks frozen.

        Raises:
            TensorsimError: weights that do not exist or belong to another network, or ``classifier="none"``.
        """
        if config.classifier == "none":
            raise TensorsimError("VideoToActivity: got the classifier 'none', expected weights")
        recognizer = ActivityRecognizer.from_pretrained(config.scene.radar, config.classifier)
        return cls(VideoToDoppler.from_config(config), recognizer.requires_grad_(False)).eval()

    def forward(
        self, video: Tensor, fps: float, lengths: Tensor | None = None, times_s: Tensor | None = None
    ) -> Recognition:
        """Clips (B, T, 3, H, W) to people, maps and logits; arguments and errors as in :class:`VideoToDoppler`."""
        found = self.video_to_doppler(video, fps, lengths, times_s)
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


def as_scene(radar: RadarConfig | str | None, wall: WallConfig | None) -> SceneConfig:
    """The scene of a radar, or of a preset by name, and a wall.

    Raises:
        TensorsimError: an unknown name, or something that is not a radar or a wall.
    """
    if isinstance(radar, str):
        scene = radar_scene(radar)
        return scene if wall is None else replace(scene, wall=wall)
    return SceneConfig(RadarConfig.free_space() if radar is None else radar, wall)


def warn_of_empty_clips(valid: Tensor) -> None:
    """Warn if any clip has no person (``valid`` (B, P, T)); ``valid`` of the output shows which."""
    if not bool(valid.flatten(1).any(dim=1).all()):
        warnings.warn(
            "no person found in a clip: its maps show the empty scene",
            TensorsimWarning,
            stacklevel=3,
        )
