"""``tensorsim evaluate lifter``: how well the lifters lift people whom none of them was trained on."""

from dataclasses import dataclass
from pathlib import Path

from tensorsim.commands.arguments import Option, Several
from tensorsim.exceptions import TensorsimError, check_seed


@dataclass(frozen=True)
class EvaluateLifter:
    """Print the errors of the three lifters, from keypoints to smoothed joints, with known camera and body height.

    The temporal lifter is tested without and with corrected speeds along the line of sight (``--range-rate`` of
    ``simulate``).

    Generated people use seeds that were not trained on; of motion capture, only the sequences held out in training are
    used, every second one.
    """

    motion: Several[Path] = ()
    """Motion capture files (.npz, .bvh)."""
    films: Option[Path] = None
    """Folder films/ of `tensorsim evaluate truth --settings c`: keypoints that the networks found in rendered films."""
    weights: Option[str] = None
    """Weights of the temporal lifter: path or name. Default: the shipped one."""
    motions: int = 1200
    """Held-out motions from which views are drawn."""
    seed: int = 1234
    """Random seed for motions, cameras and errors; use one that was not trained on."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> None:
        """Run the command."""
        check_seed(self.seed, "--seed")
        if self.motions < 100:
            raise TensorsimError(f"--motions: got {self.motions}, expected at least 100")
        if self.films is not None and not self.films.is_dir():
            raise TensorsimError(f"--films: got {self.films}, expected a folder")

        from tqdm import tqdm

        from tensorsim.training import lifter_scores as scores
        from tensorsim.training.lifter_motion import build_pool
        from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
        from tensorsim.vision.lifting.videopose3d import VideoPose3D

        temporal = scores.temporal(TemporalLifter.from_pretrained(self.weights))
        # How each lifts, and whether speeds along the line of sight are corrected.
        lifters = {
            "temporal": (temporal, False),
            "temporal, range rate": (temporal, True),
            "nearest": (scores.nearest, False),
            "videopose3d": (scores.video_pose(VideoPose3D.from_pretrained()), False),
        }
        pool = build_pool(None, self.motions, self.motion, self.seed, held_out=True, quiet=self.quiet)
        rows = {
            "generated, errors": (("activities", "exercises"), True),
            "falls, errors": (("falls",), True),
            "blows, kicks, other falls, errors": (("everyday", "blows and kicks"), True),
        }
        if self.motion:
            rows = {
                "captured, exact": (("captures",), False),
                "captured, errors": (("captures",), True),
            } | rows
        header = "| people | lifter | " + " | ".join(scores.LiftErrors._fields) + " |"
        print(header.replace("_", " ") + "\n| --- | --- |" + " ---: |" * len(scores.LiftErrors._fields))
        for name, (kinds, errors) in rows.items():
            for lifter, (make, corrected) in lifters.items():
                views = scores.views(pool, kinds, errors, self.seed)
                bar = tqdm(
                    views, lifter, total=len(scores.CAMERAS), unit="camera", leave=False, disable=self.quiet
                )
                self._print(name, lifter, scores.judge(make, bar, corrected))
        if self.films is not None:
            for lifter, (make, corrected) in lifters.items():
                bar = tqdm(scores.watched(self.films), lifter, unit="film", leave=False, disable=self.quiet)
                self._print("rendered films", lifter, scores.judge(make, bar, corrected))

    @staticmethod
    def _print(people: str, lifter: str, errors: tuple[float, ...]) -> None:
        """A row of the table."""
        print(f"| {people} | {lifter} | " + " | ".join(f"{x:.2f}" for x in errors) + " |", flush=True)
