"""Classifiers on maps that went through the whole pipeline: poses from films in place of true motion."""

import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.pipeline import PoseToDoppler
from tensorsim.radar.echo import EchoSynthesizer
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.recognition.recognizer import ActivityRecognizer


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
    """Every ``pose.npz`` below a folder; the name of the folder that it lies in begins with S1 to S12.

    Raises:
        TensorsimError: none there, or a name without a class.
    """
    found = []
    for path in sorted(folder.rglob("pose.npz")):
        name = re.match(r"S(\d+)(?!\d)", path.parent.name)
        if name is None or not 1 <= int(name[1]) <= len(ACTIVITIES):
            raise TensorsimError(f"{path}: its folder's name does not begin with S1 to S{len(ACTIVITIES)}")
        with np.load(path) as file:
            joints, valid = torch.from_numpy(file["joints_m"]), torch.from_numpy(file["valid"])
            found.append(LabelledPose(joints.double(), valid, float(file["fps"]), int(name[1]) - 1))
    if not found:
        raise TensorsimError(f"{folder}: got no pose.npz, expected some")
    return found


@torch.no_grad()
def classify_poses(
    weights: Path, poses: list[LabelledPose], scene: str, snr_db: float, quiet: bool = False
) -> list[bool]:
    """Which of the films a network (SPNet or SPGNet, .safetensors) recognises in a scene."""
    radar, wall = PRESETS[scene].radar, PRESETS[scene].wall
    echo = EchoSynthesizer(radar, wall, multipath=wall is not None)
    stage = PoseToDoppler(RadarSimulator(radar, echo=echo, snr_db=snr_db))
    recognise = ActivityRecognizer.from_pretrained(radar, weights)
    right = []
    for number, pose in enumerate(tqdm(poses, desc=scene, unit="film", disable=quiet)):
        torch.manual_seed(number)
        with warnings.catch_warnings():
            # Motion too fast for the preset aliases, as it did in training.
            warnings.simplefilter("ignore", TensorsimWarning)
            maps = stage(pose.joints.unsqueeze(0), pose.valid.unsqueeze(0), pose.fps)
        right.append(int(recognise(maps).argmax()) == pose.activity)
    return right
