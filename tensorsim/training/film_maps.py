"""Poses estimated from films instead of true motion: real ones to test classifiers, simulated ones to train them."""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.evaluation.films import CAMERA, FPS
from tensorsim.evaluation.settings import Pipelines, Setting
from tensorsim.motion.activities import activity_index
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.training.film_errors import FilmErrors, activity_of_folder, films_of
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter


class FilmLoss:
    """Motion as the pipeline estimates it from a film: keypoints with errors, lifted, placed and smoothed.

    The camera is that of ``tensorsim.evaluation.films``; nothing is rendered.

    Args:
        errors: errors of the keypoints.
    """

    def __init__(self, errors: FilmErrors) -> None:
        self.errors = errors
        self.lifter = TemporalLifter.from_pretrained().double()

    @torch.no_grad()
    def __call__(self, joints: Tensor, height_m: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Joints (T, 14, 3) of one person to those that the pipeline estimates, and the frames (T,) where it does.

        The frame rate is ``tensorsim.evaluation.films.FPS``.
        """
        seen = self.errors(joints, height_m, generator)
        if not bool(seen.valid.any()):
            return torch.ones_like(joints), seen.valid[0]
        nothing = nn.Identity()
        stage = VideoToPose(
            nothing, nothing, (height_m,), camera=CAMERA, lifter=self.lifter.seen_by(CAMERA, (height_m,))
        ).eval()
        found, valid = seen.lifted_by(stage)
        return found[0].double(), valid[0]


class LabelledPose(NamedTuple):
    """The people of a film.

    Attributes:
        joints: (P, T, 14, 3) m.
        valid: (P, T) bool.
        fps: frames per second.
        activity: index into ``tensorsim.ACTIVITIES``.
    """

    joints: Tensor
    valid: Tensor
    fps: float
    activity: int


def labelled_poses(folder: Path) -> list[LabelledPose]:
    """Every ``pose.npz`` below a folder; the name of the folder that contains it begins with S1 to S12.

    Raises:
        TensorsimError: there is none, or a name without a class.
    """
    found = []
    for path in sorted(folder.rglob("pose.npz")):
        activity = activity_of_folder(path)
        if activity is None:
            raise TensorsimError(f"{path}: its folder's name does not begin with S1 to S{len(ACTIVITIES)}")
        with np.load(path) as file:
            joints, valid = torch.from_numpy(file["joints_m"]), torch.from_numpy(file["valid"])
            found.append(LabelledPose(joints.double(), valid, float(file["fps"]), activity))
    if not found:
        raise TensorsimError(f"{folder}: got no pose.npz, expected some")
    return found


def film_poses(folder: Path) -> list[LabelledPose]:
    """The people of every film that ``tensorsim evaluate truth`` stores for its setting c, lifted in the same way.

    Raises:
        TensorsimError: see :func:`~tensorsim.training.film_errors.films_of`.
    """
    pipelines = Pipelines({})
    found = []
    for _, clip, seen in films_of(folder):
        joints, valid = pipelines.lifted(Setting("c"), clip, seen)
        if len(joints) == 0:  # nobody found: one body without an echo
            joints, valid = torch.ones(1, valid.shape[-1], 14, 3), valid.new_zeros(1, valid.shape[-1])
        found.append(LabelledPose(joints.double(), valid, FPS, activity_index(clip.row)))
    return found


@torch.no_grad()
def classify_poses(
    weights: Path, poses: list[LabelledPose], scene: str, snr_db: float, quiet: bool = False
) -> list[int]:
    """Activities (indices) that a network (SPNet or SPGNet, .safetensors) predicts for the films in a scene."""
    radar, wall = PRESETS[scene].radar, PRESETS[scene].wall
    echo = EchoSynthesizer(radar, wall, multipath=wall is not None)
    stage = PoseToDoppler(RadarSimulator(radar, echo=echo, snr_db=snr_db))
    recognise = ActivityRecognizer.from_pretrained(radar, weights)
    recognised = []
    for number, pose in enumerate(tqdm(poses, desc=scene, unit="film", disable=quiet)):
        torch.manual_seed(number)
        with warnings.catch_warnings():
            # Motion too fast for the preset aliases, as in training.
            warnings.simplefilter("ignore", TensorsimWarning)
            maps = stage(pose.joints.unsqueeze(0), pose.valid.unsqueeze(0), pose.fps)
        recognised.append(int(recognise(maps).argmax()))
    return recognised
