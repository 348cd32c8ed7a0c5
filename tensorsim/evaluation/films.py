"""Keypoints of a clip in a camera picture: the true ones, or those found by networks in the rendered film."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import body_to_coco
from tensorsim.config import CameraConfig
from tensorsim.evaluation.clips import Clip
from tensorsim.files import complete_file
from tensorsim.geometry.framing import keypoint_boxes
from tensorsim.pipeline import VideoToPose
from tensorsim.render.cast import View
from tensorsim.render.renderer import PersonRenderer
from tensorsim.types import Tracks

#: Frame rate of the films.
FPS = 30.0
HEIGHT, WIDTH = 360, 640
#: Behind the radar, so that a whole body is in view from a range of 1.5 m.
CAMERA = CameraConfig(position_m=(0.0, -2.0, 1.0))


class Observed(NamedTuple):
    """People of a film in its picture.

    Attributes:
        boxes: (P, T, 4) ``xyxy`` pixels.
        valid: (P, T) bool, whether the person is tracked in that frame.
        keypoints: (P, T, 17, 2) pixels.
        scores: (P, T, 17).
    """

    boxes: Tensor
    valid: Tensor
    keypoints: Tensor
    scores: Tensor

    def tracks(self) -> Tracks:
        """The tracks in the form of a tracker's output, a batch of one clip."""
        return Tracks(self.boxes[None], self.valid[None], self.valid[None])

    def lifted_by(self, stage: VideoToPose) -> tuple[Tensor, Tensor]:
        """Joints (P, T, 14, 3) m that a stage makes from these keypoints, and whether people are present (P, T)."""
        pose = stage.lift(self.tracks(), self.keypoints[None], self.scores[None], HEIGHT, WIDTH, FPS)
        return pose.joints[0], pose.valid[0]


def project(joints: Tensor) -> tuple[Tensor, Tensor, View]:
    """COCO keypoints of joints (T, 14, 3): pixels (T, 17, 2), whether inside the picture (T, 17), and the view."""
    view = View.of_camera(CAMERA, HEIGHT, WIDTH, joints)
    pixels, depth = view.project(body_to_coco(joints))
    limit = pixels.new_tensor([WIDTH - 0.5, HEIGHT - 0.5])
    inside = ((pixels >= -0.5) & (pixels < limit)).all(dim=-1) & (depth > 0)
    return pixels, inside, view


def true_keypoints(clip: Clip) -> Observed:
    """The true keypoints of a clip, with score 1 inside the picture and 0 outside.

    Hidden ones count, as in COCO's labels; boxes enclose the keypoints with a margin.
    """
    joints = clip.joints(FPS)
    if not clip.present:
        frames = len(joints)
        return Observed(
            torch.zeros(0, frames, 4), torch.zeros(0, frames, dtype=torch.bool),
            torch.zeros(0, frames, 17, 2), torch.zeros(0, frames, 17),
        )  # fmt: skip
    pixels, inside, _ = project(joints)
    boxes = keypoint_boxes(pixels, inside)
    return Observed(boxes.float()[None], inside.any(dim=-1)[None], pixels.float()[None], inside.float()[None])


class Filmed(NamedTuple):
    """Results of the networks on a rendered film.

    Attributes:
        found: people detected and tracked.
        boxed: results of the pose network on the true boxes.
    """

    found: Observed
    boxed: Observed


def render_and_watch(clip: Clip, detector: nn.Module, pose: nn.Module) -> Filmed:
    """Render a clip and run detector, tracker and pose network on it; the frames are discarded."""
    joints = clip.joints(FPS).float()
    there = torch.full((1, len(joints)), clip.present)
    film = PersonRenderer(CAMERA, HEIGHT, WIDTH)(joints, seed=clip.seed, valid=there)
    stage = VideoToPose(detector, pose, camera=CAMERA).eval()
    with torch.inference_mode():
        seen = stage(film.frames[None], FPS)
        found = Observed(seen.boxes[0], seen.valid[0], seen.keypoints[0], seen.keypoint_scores[0])
        valid = film.valid
        keypoints, scores = stage.estimate(
            film.frames, film.boxes.transpose(0, 1).float(), valid.transpose(0, 1)
        )
    boxed = Observed(film.boxes.float(), valid, keypoints.transpose(0, 1), scores.transpose(0, 1))
    if not clip.present:
        boxed = true_keypoints(clip)
    return Filmed(found, boxed)


def filmed(path: Path, clip: Clip, detector: nn.Module, pose: nn.Module) -> Filmed:
    """:func:`render_and_watch`, stored in ``path`` (npz) the first time and read from there afterwards."""
    if path.is_file():
        with np.load(path, allow_pickle=False) as arrays:
            parts = [
                Observed(*(torch.from_numpy(arrays[f"{part}_{name}"]) for name in Observed._fields))
                for part in Filmed._fields
            ]
        return Filmed(*parts)
    result = render_and_watch(clip, detector, pose)
    arrays = {
        f"{part}_{name}": tensor.numpy()
        for part, people in zip(Filmed._fields, result, strict=True)
        for name, tensor in zip(Observed._fields, people, strict=True)
    }
    with complete_file(path) as scratch, scratch.open("wb") as file:
        np.savez(file, **arrays)
    return result
