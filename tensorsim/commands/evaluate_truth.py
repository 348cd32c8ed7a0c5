"""``tensorsim evaluate truth``: how close the maps are to the true ones."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tensorsim.commands.arguments import Option, Several
from tensorsim.commands.networks import default_networks
from tensorsim.exceptions import TensorsimError, check_seed, collected_warnings, print_warnings
from tensorsim.files import check_folder, write_text


@dataclass(frozen=True)
class EvaluateTruth:
    """Compare the maps of the pipeline with the maps of exactly known motion.

    Prints a table and writes truth.md, truth.csv and a figure per scene. Running it again with the same arguments
    resumes it.
    """

    out: Path
    """Output folder; its cells/ keeps the results of every clip."""
    clips: int = 10
    """Clips per row of the table."""
    activities: Several[str] = ()
    """Activities, one row each. Default: all twelve, or none with --motion ("all" for all with --motion)."""
    motion: Several[Path] = ()
    """Motion capture files (.npz, .bvh), one row each."""
    motion_fps: Option[float] = None
    """Frames per second of the motion capture, overriding the values in the files; needed if they state none."""
    scenes: tuple[Literal["free-space", "through-wall"], ...] = ("free-space", "through-wall")
    """Scenes to evaluate in."""
    settings: tuple[Literal["a", "b", "c"], ...] = ("a", "b")
    """Start from true 3D joints at video rate (a), true 2D keypoints (b), or the rendered film and networks (c)."""
    stages: bool = True
    """Also replace each stage in turn with the truth."""
    detector: Option[str] = None
    """Person detector for setting c: path or name. Default: $TENSORSIM_DETECTOR if set, else the shipped one."""
    pose: Option[str] = None
    """Pose network for setting c: path or name. Default: $TENSORSIM_POSE if set, else the shipped one."""
    lifter: Option[Literal["temporal", "nearest"]] = None
    """How keypoints are lifted to 3D. Default: as in `tensorsim simulate`."""
    seed: int = 0
    """Seed of the first clip of each activity; further clips use consecutive seeds."""
    jobs: int = 1
    """Number of processes, each with one thread."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> None:
        """Run the command."""
        check_folder(self.out)
        check_seed(self.seed, "--seed")
        if self.motion_fps is not None and not self.motion:
            raise TensorsimError("--motion-fps needs --motion")
        detector = pose = None
        if "c" in self.settings:
            detector, pose = default_networks(self.detector, self.pose)
        elif self.detector is not None or self.pose is not None:
            raise TensorsimError("--detector and --pose apply to --settings c only")

        from tensorsim.evaluation.report import markdown, save_pictures, write_csv
        from tensorsim.evaluation.truth import TruthLoop, example_maps

        loop = TruthLoop(
            self.out, self.clips, self.activities, self.motion, self.motion_fps, self.scenes, self.settings,
            self.stages, detector, pose, self.seed, self.jobs, self.lifter,
        )  # fmt: skip
        with collected_warnings() as messages:
            cells = loop.run(self.quiet)
        print_warnings(messages)
        text = markdown(cells)
        write_text(self.out / "truth.md", text)
        write_csv(self.out / "truth.csv", cells)
        pipelines = loop.pipelines()
        for scene in self.scenes:
            pictures = example_maps(loop, pipelines, scene)
            if pictures:
                save_pictures(self.out / f"doppler_time_{scene}.png", pictures, pipelines.speed_m_s(scene))
        print(text)
