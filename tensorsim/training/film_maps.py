"""Poses from films in place of true motion: to test classifiers on, and imitated cheaply to train them with."""

import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.evaluation.films import CAMERA, HEIGHT, WIDTH, project
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.radar.echo import EchoSynthesizer
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.recognition.recognizer import ActivityRecognizer
from tensorsim.types import Tracks
from tensorsim.vision.lifter import NearestPoseLifter
from tensorsim.vision.metric_pose import MetricPose

#: Errors of a pose network on rendered films, measured against their true key points: deviation per axis as a share of
#: the person's extent in the picture, at the median; spread of its logarithm; what is left of an error in the next
#: frame, and of its size. Elbows and wrists have the factor.
_ERROR, _LOG_SPREAD, _ERROR_KEPT, _SIZE_KEPT = 0.014, 0.9, 0.9, 0.95
_ARMS, _ARMS_FACTOR = slice(7, 11), 1.5


def _autoregressive(shape: tuple[int, ...], kept: float, generator: torch.Generator) -> Tensor:
    """Normal noise of variance 1 along the first dimension, each value ``kept`` of the last and something new."""
    series = torch.randn(shape, generator=generator, dtype=torch.float64)
    for now in range(1, shape[0]):
        series[now] = kept * series[now - 1] + (1 - kept**2) ** 0.5 * series[now]
    return series


def as_if_found(pixels: Tensor, inside: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Key points with errors and scores like those of a pose network on a film.

    Errors stay for about a third of a second, their size changes slowly by joint and clip, and scores fall with them.

    Args:
        pixels: (T, 17, 2) true COCO key points.
        inside: (T, 17) whether they are in the picture.
        generator: of the errors.

    Returns:
        Pixels (T, 17, 2) and scores (T, 17), 0 outside of the picture.
    """
    frames = pixels.shape[0]
    seen = torch.where(inside[..., None], pixels, torch.nan)
    extent = (seen.nan_to_num(nan=-torch.inf).amax(1) - seen.nan_to_num(nan=torch.inf).amin(1)).amax(-1)
    extent = extent.clamp(min=0.0).quantile(0.9)
    size = _ERROR * torch.exp(_LOG_SPREAD * _autoregressive((frames, 17), _SIZE_KEPT, generator))
    size = size * torch.exp(0.4 * torch.randn((), generator=generator, dtype=torch.float64))
    size[:, _ARMS] *= _ARMS_FACTOR
    error = size[..., None] * _autoregressive((frames, 17, 2), _ERROR_KEPT, generator)
    doubt = 0.08 * torch.randn(frames, 17, generator=generator, dtype=torch.float64)
    scores = (0.92 - 9 * torch.linalg.vector_norm(error, dim=-1) + doubt).clamp(0.05, 0.97)
    return pixels + extent * error, torch.where(inside, scores, 0.0)


class FilmLoss:
    """What is left of a motion that a camera saw: key points with errors, lifted, placed and smoothed.

    The camera is that of ``tensorsim.evaluation.films``; nothing is rendered.
    """

    def __init__(self) -> None:
        self.lifter = NearestPoseLifter().eval()

    @torch.no_grad()
    def __call__(
        self, joints: Tensor, height_m: float, rate_hz: float, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Joints (T, 14, 3) of one person at ``rate_hz`` to those that the pipeline finds, and whether (T,) it does."""
        pixels, inside, _ = project(joints.double())
        found, scores = as_if_found(pixels, inside, generator)
        valid = inside.sum(-1) >= 5
        frames = len(joints)
        boxes = torch.cat([found.amin(1), found.amax(1)], -1).float()[None, None]
        tracks = Tracks(boxes, valid[None, None], valid[None, None])
        nothing = nn.Identity()
        stage = VideoToPose(
            nothing, nothing, lifter=self.lifter, metric_pose=MetricPose(CAMERA, (height_m,))
        ).eval()
        if not bool(valid.any()):
            return torch.ones(frames, 14, 3, dtype=torch.float64), valid
        pose = stage.lift(
            tracks, found.float()[None, None], scores.float()[None, None], HEIGHT, WIDTH, rate_hz
        )
        return pose.joints[0, 0].double(), pose.valid[0, 0]


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
