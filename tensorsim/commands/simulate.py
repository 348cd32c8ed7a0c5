"""``tensorsim simulate``: a video to what a radar would have seen of it."""

import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from tensorsim.commands.networks import network_path
from tensorsim.errors import TensorsimError

#: Above this many pulses (16 s in free space) range-time maps are kept at a display rate instead of every pulse.
FULL_RATE_PULSES = 1 << 17
DISPLAY_RATE_HZ = 256.0


@dataclass(frozen=True)
class Simulate:
    """Turn a video into what a radar would have seen.

    Writes maps.npz, pose.npz, summary.json, a PNG per map, skeleton.png and overlay.mp4 into a folder.
    """

    video: tyro.conf.Positional[Path]
    """Any video that OpenCV decodes."""
    out: Path
    """Folder for the results; its files appear together, when all are complete."""
    detector: Path | None = None
    """Person detector: RTMDet as .pth, .safetensors or .onnx. Default: $TENSORSIM_DETECTOR."""
    pose: Path | None = None
    """COCO-17 heat maps: HRNet as .pth or .safetensors, or any such network as .onnx. Default: $TENSORSIM_POSE."""
    scene: Literal["free-space", "through-wall"] = "free-space"
    """77 GHz radar in the open, or 2 GHz radar behind a wall with multipath."""
    radar: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Another radar for the scene: a preset (tensorsim.radar.presets: ti-awr1642, ti-awr1843, ti-iwr6843,
    infineon-bgt60tr13c, infineon-bgt24mtr12, cw-24ghz, free-space, through-wall) or a YAML file with fields of
    RadarConfig; a wall that it comes with replaces the scene's."""
    person_height: tuple[float, ...] = (1.80, 1.70)
    """Body heights in metres in order of appearance; the last one serves the rest."""
    initial_distance: tuple[float, ...] | None = None
    """Distances of the people in metres when they first appear; calibrates the focal length."""
    camera_fov: float = 60.0
    """Horizontal field of view of the camera in degrees, when no initial distance is given."""
    position: Literal["camera", "paper"] = "camera"
    """Camera model, or the paper's pixel displacement (no motion along the optical axis)."""
    motion: Literal["smooth", "paper"] = "smooth"
    """Two-sided smoothing and a spline, or the paper's forward filter, straight lines and Savitzky-Golay."""
    integration: Literal["noncoherent", "paper"] = "noncoherent"
    """How the Doppler-time map sums range bins; "paper" loses the sign of Doppler."""
    wall_paths: Literal["series", "paper"] = "series"
    """Bounces inside the wall: complete to first order, or the paper's."""
    multipath: bool | None = None
    """Wall bounces; default on behind a wall."""
    leakage: bool = False
    """Direct signal from transmitter to receiver."""
    wall_echo: bool = False
    """Static mirror reflection of the wall."""
    snr: float = 50.0
    """Signal-to-noise ratio in dB of the people's echo, per IF sample."""
    denoiser: Path | None = None
    """DnCNN weights (.pth or .safetensors) to clean the shown maps."""
    fps: float | None = None
    """Frames per second, instead of what the file says."""
    start: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Where to start."""
    end: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Where to stop."""
    stride: int = 1
    """Keep every n-th frame."""
    seed: int = 0
    """Seed of the noise."""
    device: str = "auto"
    """cpu, cuda, cuda:1, ...; auto takes a GPU where there is one."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Do it."""
        _check_numbers(self)
        detector_path = network_path(self.detector, "detector", "TENSORSIM_DETECTOR")
        pose_path = network_path(self.pose, "pose", "TENSORSIM_POSE")
        if self.out.exists() and not self.out.is_dir():
            raise TensorsimError(f"--out: {self.out} is a file, expected a folder")

        scene = _scene(self)

        import torch

        from tensorsim import run
        from tensorsim.data.video import VideoReader
        from tensorsim.device import usable_device
        from tensorsim.pipeline import PoseToDoppler, VideoToPose, warn_of_empty_clips

        device = usable_device(self.device)
        with run.collected_warnings() as messages, torch.inference_mode():
            reader = VideoReader(
                self.video, fps=self.fps, start_s=self.start, end_s=self.end, stride=self.stride
            )
            people: VideoToPose = _video_to_pose(self, detector_path, pose_path).to(device).eval()
            length_s = 0.0 if reader.frame_count is None else reader.frame_count / reader.fps
            maps_stage: PoseToDoppler = _pose_to_doppler(self, scene, length_s).to(device).eval()
            with run.complete_or_nothing(self.out) as folder:
                pose = run.pose_of_film(people, reader, device, self.quiet)
                warn_of_empty_clips(pose.valid)
                torch.manual_seed(self.seed)
                maps = run.maps_of_pose(maps_stage, pose, reader.fps, device, self.quiet)
                run.write_maps(folder, maps, run.axes_of(maps_stage, maps))
                run.write_pose(folder, pose, reader.fps)
                run.write_overlay(folder, reader, pose, people.keypoint_threshold, self.quiet)
                config = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self).items()}
                config |= {"detector": str(detector_path), "pose": str(pose_path)}
                snr_db = float(maps.snr_db)
                run.write_summary(
                    folder,
                    {
                        "people": run.people_of(pose, reader.fps),
                        "frames": pose.valid.shape[2],
                        "fps": reader.fps,
                        "seed": self.seed,
                        "realised_snr_db": round(snr_db, 3) if math.isfinite(snr_db) else None,
                        "radar": asdict(maps_stage.simulator.radar),
                        "wall": None if scene.wall is None else asdict(scene.wall),
                        "config": config,
                        "warnings": messages,
                    },
                )
        for message in messages:
            print(f"tensorsim: warning: {message}", file=sys.stderr)
        print(f"{self.out}: {pose.valid.shape[1]} people in {pose.valid.shape[2]} frames")


def _check_numbers(options: Simulate) -> None:
    for name, values in (
        ("person-height", options.person_height),
        ("initial-distance", options.initial_distance),
    ):
        if values is not None and (len(values) == 0 or not all(math.isfinite(v) and v > 0 for v in values)):
            raise TensorsimError(f"--{name}: got {values}, expected positive numbers of metres")
    if not 0 < options.camera_fov < 180:
        raise TensorsimError(f"--camera-fov: got {options.camera_fov}, expected degrees between 0 and 180")
    if not math.isfinite(options.snr):
        raise TensorsimError(f"--snr: got {options.snr}, expected a finite number of dB")
    if options.position == "paper" and options.initial_distance is None:
        raise TensorsimError("--position paper: got no --initial-distance, which it starts from")


def _video_to_pose(options: Simulate, detector_path: Path, pose_path: Path):  # type: ignore[no-untyped-def]
    from tensorsim.config import CameraConfig
    from tensorsim.pipeline import VideoToPose
    from tensorsim.vision.hrnet import HRNet
    from tensorsim.vision.kalman import KalmanSmoother
    from tensorsim.vision.metric_pose import MetricPose
    from tensorsim.vision.onnx_heatmaps import OnnxHeatmaps
    from tensorsim.vision.rtmdet import RTMDet

    detector = RTMDet.from_pretrained(detector_path)
    network = OnnxHeatmaps(pose_path) if pose_path.suffix == ".onnx" else HRNet.from_pretrained(pose_path)
    return VideoToPose(
        detector,
        network,
        metric_pose=MetricPose(
            CameraConfig(horizontal_fov_rad=math.radians(options.camera_fov)),
            person_height_m=options.person_height,
            initial_distance_m=options.initial_distance,
            mode=options.position,
        ),
        smoother=KalmanSmoother(mode="forward" if options.motion == "paper" else "rts"),
    )


def _scene(options: Simulate):  # type: ignore[no-untyped-def]
    from tensorsim.radar.presets import PRESETS, RadarScene, radar_scene

    scene = PRESETS[options.scene]
    if options.radar is None:
        return scene
    try:
        chosen = radar_scene(options.radar)
    except TensorsimError as error:
        raise TensorsimError(f"--radar: {error}") from None
    if chosen.radar.has_array:
        raise TensorsimError(
            f"--radar: {options.radar} has several antennas, expected one transmitter and one receiver: the maps "
            "of this command have no antenna dimension"
        )
    return RadarScene(chosen.radar, chosen.wall if chosen.wall is not None else scene.wall)


def _pose_to_doppler(options: Simulate, scene, length_s: float):  # type: ignore[no-untyped-def]
    from tensorsim.enhance.dncnn import DnCNN, MapDenoiser
    from tensorsim.motion.resample import PoseResampler
    from tensorsim.motion.savgol import SavitzkyGolay
    from tensorsim.pipeline import PoseToDoppler
    from tensorsim.radar.simulator import RadarSimulator

    radar, wall = scene
    behind_wall = wall is not None
    simulator = RadarSimulator(
        radar,
        wall=wall,
        multipath=behind_wall if options.multipath is None else options.multipath,
        leakage=options.leakage,
        wall_echo=options.wall_echo,
        wall_paths=options.wall_paths,
        snr_db=options.snr,
        integration=options.integration,
        display_rate_hz=DISPLAY_RATE_HZ if length_s * radar.prf_hz > FULL_RATE_PULSES else None,
    )
    denoiser = None if options.denoiser is None else MapDenoiser(DnCNN.from_pretrained(options.denoiser))
    if options.motion == "paper":
        # The panel's smoothing ratio of 0.25, read as a quarter of a second of pulses.
        window = round(0.25 * radar.prf_hz) // 2 * 2 + 1
        return PoseToDoppler(
            simulator,
            resampler=PoseResampler(radar.prf_hz, method="linear"),
            pulse_smoother=SavitzkyGolay(window, 3),
            denoiser=denoiser,
        )
    return PoseToDoppler(simulator, denoiser=denoiser)
