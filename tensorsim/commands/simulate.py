"""``tensorsim simulate``: from a video, or known motion, to what a radar would have seen."""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tensorsim.commands.arguments import Option, numbers
from tensorsim.commands.clip_options import ClipOptions, Run
from tensorsim.commands.each_person import write_each_person
from tensorsim.commands.networks import NetworkOptions, default_networks, load_networks
from tensorsim.commands.options import (
    at_display_rate,
    check_drawable,
    described_label,
    load_recognizer,
    number_of_people,
)
from tensorsim.exceptions import TensorsimError, collected_warnings, print_warnings
from tensorsim.files import check_name
from tensorsim.limits import check_range

if TYPE_CHECKING:
    import torch

    from tensorsim.config import SimulationConfig
    from tensorsim.plot.apart import Drawing
    from tensorsim.sources import Source

#: Options that apply only to some kinds of source.
_MEANT_FOR = {
    "detector": ("video",),
    "min_detection_size": ("video",),
    "detection_interval": ("video",),
    "max_tracks": ("video",),
    "confirmation_hits": ("video",),
    "confirmation_window": ("video",),
    "deletion_misses": ("video",),
    "deletion_window": ("video",),
    "assignment_threshold": ("video",),
    "process_noise": ("video",),
    "measurement_noise": ("video",),
    "keypoint_threshold": ("video", "keypoints"),
    "pose": ("video",),
    "flip_test": ("video",),
    "engine": ("video",),
    "person_height": ("video", "keypoints"),
    "calibrate": ("video", "keypoints"),
    "camera_fov": ("video", "keypoints"),
    "position": ("video", "keypoints"),
    "lifter": ("video", "keypoints"),
    "library": ("video", "keypoints"),
    "walking_legs": ("video", "keypoints"),
    "range_rate": ("video", "keypoints"),
    "image_size": ("keypoints",),
    "clip": ("motion",),
    "heading": ("motion",),
}


@dataclass(frozen=True)
class Simulate(NetworkOptions, ClipOptions):
    """Simulate the radar maps of the people in a video, in motion capture, or in keypoints from a video.

    Writes report.html, maps.npz, pose.npz, summary.json, a figure per map, skeleton.png and overlay.mp4 to a folder.
    """

    source: tyro.conf.Positional[Path]
    """A video that OpenCV can decode; motion capture as .bvh or .npz (named joints, AMASS, data_3d_h36m.npz); or
    keypoints from a video, COCO or BlazePose, as .json, or a folder with one such file per frame."""
    out: Path
    """Output folder, written only if the whole run succeeds."""
    person_height: Annotated[Option[tuple[float, ...]], tyro.conf.arg(metavar="METRES ...")] = None
    """Body heights in metres in order of appearance; the last one applies to all further people. Default: 1.80 1.70."""
    initial_distance: Annotated[Option[tuple[float, ...]], tyro.conf.arg(metavar="METRES ...")] = None
    """Distances of the people in metres when they first appear. For videos and keypoints they determine the focal
    length. Motion capture is shifted so that the first person starts there; by default it stays where the file puts it,
    unless somebody would come too near the radar."""
    camera_fov: Option[float] = None
    """Horizontal field of view of the camera in degrees, used if no initial distance is given. Default: estimated. With
    --no-calibrate: 60 degrees horizontally. If the film gives no information: 60 degrees along the longer side."""
    calibrate: Option[bool] = None
    """Estimate tilt, roll, height and field of view of the camera from the people in the film. Default: on, except with
    --camera-fov, --initial-distance or --position paper; with --config, as it says."""
    position: Option[Literal["camera", "paper"]] = None
    """How people are placed: with a camera model, or with the paper's pixel displacement (no motion along the optical
    axis). Default: camera."""
    lifter: Option[Literal["temporal", "nearest"]] = None
    """How keypoints are lifted to 3D: by a network that sees a window of frames, or from the nearest poses of a
    library. Default: temporal."""
    library: Option[Path] = None
    """Pose library for the nearest lifter, as written by `tensorsim library build`. Default: the shipped one."""
    walking_legs: Option[bool] = None
    """Give the legs of people who walk the steps of a gait model where the film shows too little of them (temporal
    lifter only). Default: on."""
    range_rate: Option[bool] = None
    """Correct how fast people come closer or move away by how they move (temporal lifter only). Default: off, because
    fewer real films are then labelled rightly."""
    per_person: bool = False
    """With several people in the scene, also simulate and label each one alone: maps_person_N.npz and
    doppler_time_person_N.png, with N as in the overlay."""
    fps: Option[float] = None
    """Frames per second, overriding the file's value."""
    start: Annotated[Option[float], tyro.conf.arg(metavar="SECONDS")] = None
    """Start time in the film, in seconds."""
    end: Annotated[Option[float], tyro.conf.arg(metavar="SECONDS")] = None
    """End time in the film, in seconds."""
    stride: int = 1
    """Keep every n-th frame."""
    image_size: Annotated[Option[tuple[int, int]], numbers("WIDTH HEIGHT", int)] = None
    """Width and height in pixels of the images in which the keypoints were found, if their file does not state them."""
    clip: Option[str] = None
    """Which motion to use from a file with several: the name of an array, or subject and action as in "S1/Walking"."""
    heading: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 0.0
    """Rotation of motion capture about the vertical axis, in degrees (counter-clockwise seen from above)."""

    def run(self) -> None:
        """Run the command."""
        with self.ready(self.out) as drawing:
            self._simulate(drawing)

    def _simulate(self, drawing: "Drawing") -> None:
        import torch

        from tensorsim import results
        from tensorsim.device import usable_device
        from tensorsim.files import complete_or_nothing
        from tensorsim.pipeline import PoseToDoppler
        from tensorsim.sources import KINDS, kind_of
        from tensorsim.summary import summary_of, write_summary
        from tensorsim.vision.engines import chosen_engine

        kind = kind_of(self.source)
        for field in fields(self):
            unlike = getattr(self, field.name) != field.default
            if unlike and kind not in _MEANT_FOR.get(field.name, KINDS):
                meant = " or ".join(KINDS[k] for k in _MEANT_FOR[field.name])
                name = field.name.replace("_", "-")
                raise TensorsimError(f"--{name} applies to {meant} only, not to {KINDS[kind]}")
        config = self.configuration()
        device = usable_device(self.device)
        with collected_warnings() as messages, torch.inference_mode():
            recognizer = load_recognizer(config)
            source, config = self._source(kind, config, device)
            config = at_display_rate(config, self.full_rate)
            stage = PoseToDoppler.from_config(config).to(device)
            check_drawable(stage)
            if source.frame_count is not None:  # files may state a frame or two too few
                results.check_length(source.frame_count, source.fps, stage, uncertain=2)
            with complete_or_nothing(self.out, self.source) as folder, drawing.complete():
                name, fps = self.source.name, source.fps
                pictures = self.pictures(stage, None, name)
                simulated = results.simulated(
                    source, stage, folder, config, device, drawing, pictures, self.quiet
                )
                with simulated as (found, maps, strip):
                    pose = found.pose
                    somebody = bool(pose.valid.any())
                    done = Run(config, stage, recognizer, pose, maps, fps, name, somebody, device, drawing)
                    label = self.write_results(folder, done)
                    alone = write_each_person(folder, done, self) if self.per_person else []
                summary = label | summary_of(source, config, found, maps)
                summary |= {"options": self.described(), "warnings": messages}
                if kind == "video":
                    summary["engine"] = chosen_engine(self.engine, device)
                for row, person in zip(summary["people"], alone, strict=len(alone) > 0):
                    row |= person.label
                self.write_report(
                    folder, done, strip.result(), summary, further=[person.map for person in alone]
                )
                write_summary(folder, summary)
        print_warnings(messages)
        people = number_of_people(int(pose.valid[0].any(1).sum()))
        print(f"{self.out}: {people} in {pose.valid.shape[2]} frames, {described_label(label)}")

    def configuration(self) -> "SimulationConfig":
        """The configuration with the options on how people are found."""
        from tensorsim.config.people import PANEL_DISTANCES_M

        config = super().configuration()
        camera_fov = None if self.camera_fov is None else math.radians(self.camera_fov)
        if (self.position or config.pose.position) == "camera":
            # The panel's distances, from which the paper's positions start, were not measured in this film.
            starts = config.pose.position == "paper" and config.pose.initial_distance_m == PANEL_DISTANCES_M
            if camera_fov is not None or starts:  # initial distances would calibrate the focal length
                config = config.replace(pose__initial_distance_m=None)
        if camera_fov is not None:
            config = config.replace(pose__camera__focal_px=None, pose__camera__horizontal_fov_rad=camera_fov)
        for field, value in (
            ("pose__person_height_m", self.person_height),
            ("pose__initial_distance_m", self.initial_distance),
            ("pose__position", self.position),
            ("pose__lifter", self.lifter if self.library is None or self.lifter is not None else "nearest"),
            ("pose__library", None if self.library is None else str(self.library)),
            ("pose__walking_legs", self.walking_legs),
            ("pose__range_rate", self.range_rate),
        ):
            if value is not None:
                config = config.replace(**{field: value})
        paper, calibrate = config.pose.position == "paper", self.calibrate
        if calibrate and paper:
            raise TensorsimError("--calibrate cannot be combined with --position paper (or --paper)")
        if calibrate:
            config = config.replace(pose__initial_distance_m=None)
        if calibrate is None:
            told = camera_fov is not None or self.initial_distance is not None
            calibrate = not (told or paper) and (self.config is None or config.pose.calibrate)
        return config.replace(pose__calibrate=calibrate)

    def check(self, out: Path) -> None:
        """Refuse options that cannot work, before anything heavy is imported."""
        super().check(out)
        for name, quantity in (
            ("person_height", "body height"),
            ("initial_distance", "distance"),
            ("image_size", "image side"),
            ("camera_fov", "field of view"),
            ("heading", "angle"),
            ("fps", "frame rate"),
            ("start", "time"),
            ("end", "time"),
            ("stride", "stride"),
        ):
            given, option = getattr(self, name), f"--{name.replace('_', '-')}"
            if given == ():
                raise TensorsimError(f"{option}: got no numbers, expected at least one")
            for value in given if isinstance(given, tuple) else [given] * (given is not None):
                check_range(value, quantity, option)
        for option in ("camera_fov", "initial_distance"):
            if self.calibrate and getattr(self, option) is not None:
                raise TensorsimError(
                    f"--calibrate cannot be combined with --{option.replace('_', '-')}: both determine the camera"
                )
        if self.position == "paper" and self.initial_distance is None and self.config is None:
            raise TensorsimError("--position paper needs --initial-distance")
        check_name(self.source, "source")
        if not self.source.exists():
            raise TensorsimError(
                f"{self.source}: no such file, expected a video, motion capture or keypoints"
            )

    def _source(
        self, kind: str, config: "SimulationConfig", device: "torch.device"
    ) -> "tuple[Source, SimulationConfig]":
        """The people of this kind of source; the configuration with the files of the networks that find them."""
        from torch import nn

        from tensorsim import sources
        from tensorsim.data.video import KEPT_MB, VideoReader
        from tensorsim.pipeline import VideoToPose
        from tensorsim.registry import name_of

        cut = sources.Cut(self.start, self.end, self.stride)
        if kind == "motion":
            if self.initial_distance is not None and len(self.initial_distance) > 1:
                raise TensorsimError(
                    f"--initial-distance: got {self.initial_distance} for motion capture, expected only that of the "
                    "first person: the others keep their places relative to it"
                )
            start_m = None if self.initial_distance is None else self.initial_distance[0]
            turn = math.radians(self.heading)
            return sources.motion_source(self.source, self.clip, self.fps, turn, start_m, cut), config
        if kind == "keypoints":
            size = None if self.image_size is None else (self.image_size[1], self.image_size[0])
            stage = VideoToPose.from_config(config, nn.Identity(), nn.Identity())
            calibrate = config.pose.calibrate
            return sources.keypoint_source(self.source, stage, self.fps, size, cut, calibrate), config
        detector, pose = default_networks(
            self.detector or config.tracking.detector, self.pose or config.pose.network
        )
        config = config.replace(tracking__detector=name_of(detector), pose__network=name_of(pose))
        reader = VideoReader(
            self.source,
            fps=self.fps,
            start_s=self.start,
            end_s=self.end,
            stride=self.stride,
            kept_mb=KEPT_MB,
        )
        networks = load_networks(detector, pose, config.pose.flip_test, self.engine)
        stage = VideoToPose.from_config(config, *networks).to(device)
        return sources.film_source(reader, stage, device, config.pose.calibrate), config
