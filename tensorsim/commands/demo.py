"""``tensorsim demo``: a person with known motion is filmed, and the film's maps are compared with the true ones."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tensorsim.array_files import array_formats, save_arrays
from tensorsim.commands.clip_options import ClipOptions, Run
from tensorsim.commands.networks import NetworkOptions, default_networks, load_networks
from tensorsim.commands.options import (
    at_display_rate,
    check_drawable,
    described_label,
    load_recognizer,
    number_of_people,
)
from tensorsim.exceptions import TensorsimError, collected_warnings, print_warnings

if TYPE_CHECKING:
    from torch import Tensor

    from tensorsim.config import CameraConfig, SimulationConfig
    from tensorsim.motion.activities import GeneratedMotion
    from tensorsim.plot.apart import Drawing
    from tensorsim.render.renderer import RenderedVideo
    from tensorsim.types import Pose, RadarMaps

FILM_FPS = 30.0
#: Longest film in seconds.
LONGEST_S = 60.0
#: The true motion is evaluated this many times per frame of the film.
MOMENTS_PER_FRAME = 8
HEIGHT, WIDTH = 360, 640
#: Distances at which a whole body fits into the picture of an ordinary lens.
NEAR_M, FAR_M = 3.0, 6.0
#: At about half the height of a body, where the camera sees all of it without much tilt, as in a handheld film.
CAMERA_M = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Demo(NetworkOptions, ClipOptions):
    """Render a film of a person with known motion and simulate the radar from it. Needs no input file.

    Writes what `simulate` writes, film.mp4, and the ground truth: maps_truth.npz and pose_truth.npz. Each map figure
    shows the map from the film beside the map of the true motion; summary.json lists the errors.
    """

    activity: str = "walking"
    """What the person does: walking, punching, kicking, grabbing, sitting down, standing up, rotating, sitting to
    walking, walking to sitting, falling to walking, walking to falling, or empty."""
    out: Path = Path("demo")
    """Output folder, written only if the whole run succeeds."""
    duration: float = 4.0
    """Length of the film in seconds."""

    def run(self) -> None:
        """Run the command."""
        with self.ready(self.out) as drawing:
            self._demonstrate(drawing)

    def _demonstrate(self, drawing: "Drawing") -> None:
        # Long because it lists all the steps; each is a call.
        from tensorsim.motion.activities import activity_index

        activity = activity_index(self.activity)
        if not 0.5 <= self.duration <= LONGEST_S:
            raise TensorsimError(
                f"--duration: got {self.duration}, expected seconds from 0.5 to {LONGEST_S:g}"
            )
        detector, pose_network = default_networks(self.detector, self.pose)
        config = self._film_configuration(detector, pose_network)

        import torch

        from tensorsim import results
        from tensorsim.body.skeleton import mid_hips
        from tensorsim.config import ACTIVITIES, SmoothingConfig
        from tensorsim.data.video import KEPT_MB, VideoReader
        from tensorsim.data.video_writer import write_video
        from tensorsim.device import usable_device
        from tensorsim.files import complete_or_nothing
        from tensorsim.pipeline import PoseToDoppler, VideoToPose
        from tensorsim.sources import drawn_by, film_source
        from tensorsim.streaming import maps_of_pose
        from tensorsim.summary import summary_of, write_summary
        from tensorsim.vision.engines import chosen_engine

        device = usable_device(self.device)
        with collected_warnings() as messages, torch.inference_mode():
            recognizer = load_recognizer(config)
            networks = load_networks(detector, pose_network, config.pose.flip_test, self.engine)
            maps_stage = PoseToDoppler.from_config(config).to(device)
            check_drawable(maps_stage)
            # The true motion is exact and densely sampled: it needs no smoothing.
            true_stage = PoseToDoppler.from_config(config.replace(smoothing=SmoothingConfig())).to(device)
            frames = round(self.duration * FILM_FPS)
            if not self.quiet:
                print(f"rendering {frames} frames of {ACTIVITIES[activity]} ...", file=sys.stderr)
            truth, film, camera, height_m = film_person(activity, frames, config.seed)
            start_m = float(mid_hips(truth.joints)[0, 0, 1])
            # The camera is fully known, whatever a given configuration states for another film.
            config = config.replace(
                pose__person_height_m=(height_m,),
                pose__camera=camera,
                pose__calibrate=False,
                pose__initial_distance_m=(start_m,) if config.pose.position == "paper" else None,
            )
            people = VideoToPose.from_config(config, *networks).to(device)
            with complete_or_nothing(self.out) as folder, drawing.complete():
                write_video(folder / "film.mp4", film.frames.permute(0, 2, 3, 1).numpy(), FILM_FPS)
                source = film_source(VideoReader(folder / "film.mp4", kept_mb=KEPT_MB), people, device)
                name = f"demo: {ACTIVITIES[activity]}"
                pictures = self.pictures(maps_stage, None, name)
                simulated = results.simulated(
                    source, maps_stage, folder, config, device, drawing, pictures, self.quiet
                )
                with simulated as (seen, maps, strip):
                    pose = seen.pose
                    torch.manual_seed(config.seed)
                    rate_hz = FILM_FPS * MOMENTS_PER_FRAME
                    joints = true_pose(truth.joints, truth.valid)
                    true_maps = maps_of_pose(true_stage, joints, rate_hz, device, self.quiet)
                    somebody = bool(truth.valid.any() | pose.valid.any())
                    done = Run(
                        config, maps_stage, recognizer, pose, maps, FILM_FPS, name, somebody, device, drawing
                    )
                    label = self.write_results(folder, done, true_maps)
                write_pose_truth(folder, film, truth.valid, array_formats(self.save))
                likeness, empty_likeness = likeness_to_truth(maps, true_maps)
                about = {
                    "activity": ACTIVITIES[activity],
                    "person_height_m": round(height_m, 4),
                    **drawn_by(camera, (HEIGHT, WIDTH)),
                    "film_against_truth": likeness | joint_errors(pose, film),
                    "empty_map_against_truth": empty_likeness,
                    "engine": chosen_engine(self.engine, device),
                    "options": self.described(),
                    "warnings": messages,
                }
                summary = label | summary_of(source, config, seen, maps) | about
                self.write_report(folder, done, strip.result(), summary, true_maps)
                write_summary(folder, summary)
        print_warnings(messages)
        count = int(pose.valid[0].any(1).sum())
        found = f"{number_of_people(count)} found, {described_label(label)}"
        print(
            f"{self.out}: film of {ACTIVITIES[activity]}: {found}; {described_likeness(likeness, empty_likeness)}"
        )

    def _film_configuration(self, detector: Path, pose_network: Path) -> "SimulationConfig":
        """The configuration for a film of the demonstration, with its networks."""
        from tensorsim.registry import name_of

        config = at_display_rate(self.configuration(), self.full_rate)
        return config.replace(tracking__detector=name_of(detector), pose__network=name_of(pose_network))


class Filmed(NamedTuple):
    """A rendered person whose motion is known.

    Attributes:
        truth: the motion, :data:`MOMENTS_PER_FRAME` times per frame.
        film: the frames and what is true in each.
        camera: that filmed it.
        height_m: of the person.
    """

    truth: "GeneratedMotion"
    film: "RenderedVideo"
    camera: "CameraConfig"
    height_m: float


def film_person(activity: int, frames: int, seed: int) -> Filmed:
    """Render a person who does an activity, in this many frames."""
    import torch

    from tensorsim.geometry.framing import camera_on
    from tensorsim.motion.activities import ActivityGenerator
    from tensorsim.motion.people import PeopleConfig
    from tensorsim.render.renderer import PersonRenderer

    people = PeopleConfig(start_range_m=(NEAR_M, FAR_M), keep_range_m=(NEAR_M, FAR_M))
    rate_hz = FILM_FPS * MOMENTS_PER_FRAME
    truth = ActivityGenerator(people).generate(
        activity, seed=seed, duration_s=frames / FILM_FPS, rate_hz=rate_hz
    )
    camera = camera_on(truth.joints, torch.ones_like(truth.valid), HEIGHT, WIDTH, position_m=CAMERA_M)
    joints, valid = truth.joints[:, ::MOMENTS_PER_FRAME], truth.valid[:, ::MOMENTS_PER_FRAME]
    film = PersonRenderer(camera, HEIGHT, WIDTH)(joints, seed, valid=valid)
    return Filmed(truth, film, camera, float(truth.people.height_m[0]))


def write_pose_truth(folder: Path, film: "RenderedVideo", valid: "Tensor", formats: Sequence[str]) -> None:
    """Write ``pose_truth``, the truth for each frame, in these formats; ``valid`` (P, T) at the rate of the motion."""
    arrays: dict[str, Any] = {
        "joints_m": film.joints.numpy(),
        "keypoints_px": film.keypoints.numpy(),
        "visibility": film.visibility.numpy(),
        "boxes_px": film.boxes.numpy(),
        "valid": valid[:, ::MOMENTS_PER_FRAME].numpy(),
        "fps": FILM_FPS,
    }
    save_arrays(folder / "pose_truth", arrays, formats)


def true_pose(joints: "Tensor", valid: "Tensor") -> "Pose":
    """Known joints (P, T, 14, 3) and presence (P, T) as a Pose of one clip, with blank image data."""
    from tensorsim.types import Pose

    people, frames = valid.shape
    blank = joints.new_zeros(1, people, frames, 17, 2).float()
    return Pose(blank[..., :2, :].flatten(-2), blank, blank[..., 0], joints[None].float(), valid[None])


def likeness_to_truth(maps: "RadarMaps", truth: "RadarMaps") -> tuple[dict[str, Any], dict[str, Any]]:
    """Similarity of maps, and of empty maps, to the true ones.

    See :func:`tensorsim.evaluation.scores.similarity`.
    """
    import torch

    from tensorsim.evaluation.scores import similarity

    likeness = similarity(maps, truth)
    empty = maps._replace(**{name: torch.zeros_like(getattr(maps, name)) for name in likeness})
    return likeness, similarity(empty, truth)


def described_likeness(likeness: dict[str, Any], empty: dict[str, Any]) -> str:
    """The scores of the Doppler-time map in one line."""
    figures = likeness["doppler_time"]
    if figures["psnr_linear_db"] is None:
        return "the Doppler-time map from the film is that of the true motion"
    return (
        "Doppler-time map from the film against that of the true motion: "
        f"PSNR {figures['psnr_linear_db']:.1f} dB, SSIM {figures['ssim_linear']:.2f} "
        f"(an empty map: PSNR {empty['doppler_time']['psnr_linear_db']:.1f} dB)"
    )


def joint_errors(pose: "Pose", film: "RenderedVideo") -> dict[str, Any]:
    """Errors of the estimated joints for the person found longest; None if nobody was found."""
    import torch

    from tensorsim.body.skeleton import mid_hips

    found = pose.valid[0]
    if not bool(found.any()) or not bool(film.valid.any()):
        return {"joint_error_m": None, "range_error_m": None}
    best = int(found.sum(dim=1).argmax())
    both = found[best] & film.valid[0]
    estimate, truth = pose.joints[0, best, both], film.joints[0, both]
    root, true_root = mid_hips(estimate), mid_hips(truth)
    posture = (estimate - root[:, None]) - (truth - true_root[:, None])
    away = (root - true_root)[:, 1]
    return {
        "joint_error_m": round(float(torch.linalg.vector_norm(posture, dim=-1).mean()), 4),
        "range_error_m": round(float(away.abs().mean()), 4),
    }
