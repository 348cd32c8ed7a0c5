"""Simulated keypoints as networks find them in films from any camera, and the motion that the pipeline makes of them.

Networks do not err at random: a hidden arm stays in the wrong place for as long as it is hidden, left and right are
mixed up for a while, the leg that is ahead is called left at every step, a wrist or ankle jumps to something else for a
moment, people who lie down are lost. Sizes of errors are fractions of the body's height in the picture.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import MIRRORED, body_to_coco
from tensorsim.config import CameraConfig
from tensorsim.evaluation.measured.motions import Draw, smooth_noise
from tensorsim.geometry.camera import NEAR_M, camera_to_world, focal_length, principal_point, project
from tensorsim.geometry.framing import keypoint_boxes
from tensorsim.pipeline import VideoToPose
from tensorsim.training.lifter_views import JUMPS_HZ, PARTS, USUAL_SCORES, found_in_part, jumps_from, landed
from tensorsim.types import Tracks
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter

#: Errors of each COCO keypoint relative to the mean: head, shoulders, elbows, wrists, hips, knees, ankles.
RELATIVE = (0.6,) * 5 + (0.8,) * 2 + (1.2,) * 2 + (1.6,) * 2 + (1.0,) * 2 + (1.0,) * 2 + (1.2,) * 2
#: Keypoints that are mixed up with those of the other side: arms, legs, all.
MIXED_UP = ((5, 6, 7, 8, 9, 10), (11, 12, 13, 14, 15, 16), tuple(range(5, 17)))
#: Pictures: height, width.
SIZES = ((360, 640), (480, 640), (640, 360))


class Seen(NamedTuple):
    """A person in a film.

    Attributes:
        keypoints: (T, 17, 2) pixels.
        scores: (T, 17).
        valid: (T,) bool, whether tracked.
    """

    keypoints: Tensor
    scores: Tensor
    valid: Tensor


class Filming(NamedTuple):
    """A camera, its calibration as known to the pipeline, and the size of its pictures."""

    camera: CameraConfig
    believed: CameraConfig
    height: int
    width: int


def draw_camera(hips: Tensor, draw: Draw) -> Filming:
    """A camera above the radar that has people with hips (T, 3) in view, and its calibration with errors."""
    height, width = SIZES[int(torch.multinomial(torch.tensor([0.5, 0.4, 0.1]), 1, generator=draw.generator))]
    fov = math.radians(float(draw(42.0, 75.0)))
    above = float(draw(0.6, 2.6))
    middle = hips.mean(0) - hips.new_tensor([0.0, 0.0, above])
    towards = math.atan2(float(middle[2]), float(middle[:2].norm()))
    half = math.atan(math.tan(fov / 2) * height / width)
    thought = towards + float(draw(-0.45, 0.45)) * half
    pitch = thought + math.radians(4.0) * float(draw.normal(1))
    # In films where nobody walks far, the focal length is poorly known.
    unsure = 0.12 if float(draw(0.0, 1.0)) < 0.75 else 0.3
    stretch = math.exp(unsure * float(draw.normal(1)))
    lifted = max(0.3, above * stretch + 0.1 * float(draw.normal(1)))
    camera = CameraConfig(horizontal_fov_rad=fov, position_m=(0.0, 0.0, above), pitch_rad=pitch)
    believed = CameraConfig(
        horizontal_fov_rad=min(1.6, 2 * math.atan(math.tan(fov / 2) / stretch)),
        position_m=(0.0, 0.0, lifted),
        pitch_rad=thought,
    )
    return Filming(camera, believed, height, width)


def _spell(frames: int, rate: float, shortest: float, longest: float, draw: Draw) -> Tensor:
    """(N, T) bool: with probability ``rate``, one period at a random time, of a random share of the frames."""
    length = draw(shortest, longest) * frames
    start = draw(-0.2, 1.0) * frames
    time = torch.arange(frames)
    return (draw(0.0, 1.0) < rate) & (time >= start) & (time < start + length)


def project_keypoints(joints: Tensor, filming: Filming) -> tuple[Tensor, Tensor]:
    """Keypoints of joints (T, 14, 3) m in the pictures, (T, 17, 2) pixels, and their depths (T, 17) m."""
    focal = focal_length(filming.camera, filming.width)
    center = principal_point(filming.camera, filming.height, filming.width)
    return project(body_to_coco(joints), focal, center, camera_to_world(filming.camera))


def find_keypoints(joints: Tensor, height_m: float, fps: float, filming: Filming, draw: Draw) -> Seen:
    """What networks find of a person with joints (T, 14, 3) m and this height; ``draw`` is for one."""
    frames = len(joints)
    true, depth = project_keypoints(joints, filming)
    focal = focal_length(filming.camera, filming.width)
    unit = (focal * height_m / depth[:, 11:13].mean(1).clamp(min=0.5))[:, None, None]

    level = torch.exp(0.5 * draw.normal(1))[..., 0] * torch.tensor(RELATIVE, dtype=torch.float64)[:, None]
    quick, slow = (
        smooth_noise(draw, frames, fps, torch.full((1, 1), band, dtype=torch.float64), 34)[0].unflatten(
            -1, (17, 2)
        )
        for band in (4.0, 0.6)
    )
    error = level * (0.0025 * quick + 0.009 * slow)
    # People whose trunk is not upright are found badly, half of those who lie not at all: points anywhere on them.
    trunk = (joints[:, 1] - (joints[:, 8] + joints[:, 11]) / 2)[:, 2] / (0.3 * height_m)
    tilted = (1.0 - trunk).clamp(0.0, 1.0)
    worse = 2.0 + 10.0 * tilted * (draw(0.0, 1.0) < 0.5)[0]
    error = error * (1 + worse * tilted)[:, None, None]
    each = Draw(17, draw.generator)
    # A lost point is taken for something else nearby, and its score is low for a part of that time.
    wild = _spell(frames, 0.06, 0.03, 0.3, each).T
    away = smooth_noise(draw, frames, fps, torch.full((1, 1), 1.0, dtype=torch.float64), 34)[0]
    error = error + 0.1 * wild[..., None] * away.unflatten(-1, (17, 2))
    found = true + unit * error

    other = found[:, list(MIRRORED)]
    # The far arm or leg of a person seen from the side is taken for the near one.
    near = (true - true[:, list(MIRRORED)]).norm(dim=-1, keepdim=True) < 0.1 * unit
    far = (depth > depth[:, list(MIRRORED)] + 0.06)[..., None] & (torch.arange(17) > 6)[:, None]
    merged = near & far & _spell(frames, 0.4, 0.2, 1.0, each).T[..., None]
    found = torch.where(merged, other, found)
    # Where legs seen from the side pass each other, the one ahead in the picture is called left, or right, throughout.
    side_on = (true[:, 11, 0] - true[:, 12, 0]).abs() < 0.06 * unit[:, 0, 0]
    left_ahead = true[:, 15, 0] > true[:, 16, 0]
    left_leads = (draw(0.0, 1.0) < 0.5)[0]
    exchanged = side_on & (left_ahead != left_leads) & _spell(frames, 0.4, 0.3, 1.2, draw)[0]
    legs = torch.arange(17) > 12
    found = torch.where((exchanged[:, None] & legs)[..., None], found[:, list(MIRRORED)], found)
    for group in MIXED_UP:
        mixed = torch.zeros(17, dtype=torch.bool)
        mixed[list(group)] = True
        spell = _spell(frames, 0.12, 0.02, 0.25, draw)[0]
        found = torch.where((spell[:, None] & mixed)[..., None], found[:, list(MIRRORED)], found)

    often = torch.exp(draw.normal(1)) * (1 + 2 * tilted.mean())
    began, lasting = each(0.0, 1.0, frames).T, each(1e-6, 1.0, frames).T
    rate_hz = often * torch.tensor(JUMPS_HZ, dtype=torch.float64)
    jumps, since = jumps_from(rate_hz, fps, began, lasting)
    step, across = each.normal(frames, 2).transpose(0, 1), each(0.0, 1.0, frames).T
    found = torch.where(jumps[..., None], landed(found, unit, since, step, across), found)

    usual = torch.tensor(USUAL_SCORES, dtype=torch.float64)
    # Networks are almost as confident of wrong points.
    scores = usual - 1.2 * error.norm(dim=-1) + 0.06 * each.normal(frames).T
    scores = (scores - jumps * each(0.15, 0.25, frames).T).clamp(0.35, 0.98)
    scores = torch.where(merged[..., 0], scores - 0.2, scores)
    hidden = _spell(frames, 0.06, 0.1, 1.0, each).T
    scores = torch.where(hidden, 0.2, scores)
    # Of some people who lie down, the detector finds only a part.
    part = PARTS[int(draw(0.0, 1.0) < 0.3)]
    cut = (tilted > 0.6) & _spell(frames, 0.3, 0.3, 1.5, draw)[0]
    found, scores = found_in_part(
        found, scores, part | ~cut[:, None], 0.06 * unit * away.unflatten(-1, (17, 2))
    )
    inside = (found >= -0.5).all(-1) & (found[..., 0] < filming.width) & (found[..., 1] < filming.height)
    scores = scores * (inside & (depth > NEAR_M))
    return Seen(found, scores, _followed(found, scores, tilted, fps, draw))


def _followed(found: Tensor, scores: Tensor, tilted: Tensor, fps: float, draw: Draw) -> Tensor:
    """Frames (T,) in which a person is tracked: many who lie down are lost, some arrive late or leave early."""
    frames = len(found)
    time = torch.arange(frames)
    seen = (scores >= 0.3).sum(-1) >= 4
    followed = seen & ~_spell(frames, 0.12, 0.03, 0.2, draw)[0]
    if float(draw(0.0, 1.0)) < 0.12:
        followed &= time >= float(draw(0.0, 0.4)) * frames
    if float(draw(0.0, 1.0)) < 0.12:
        followed &= time < float(draw(0.6, 1.0)) * frames
    lying = tilted > 0.7
    if bool(lying.any()):
        chance = float(draw(0.0, 1.0))
        if chance < 0.35:  # lost on the way down or some time after
            lost = int(torch.nonzero(lying)[0]) + float(draw(-0.25, 1.2)) * fps
            if bool(lying[-1]):
                followed &= time < lost
            else:  # found again after getting up
                followed &= (time < lost) | (time > int(torch.nonzero(lying)[-1]))
        elif chance < 0.45:
            followed &= ~lying
    return followed


class FilmedMotion:
    """Motion as the pipeline finds it in films: keypoints with errors, lifted, placed and smoothed."""

    def __init__(self) -> None:
        nothing = nn.Identity()
        self.stage = VideoToPose(nothing, nothing, lifter=TemporalLifter.from_pretrained().double()).eval()

    @torch.no_grad()
    def __call__(
        self, people: list[tuple[Tensor, float]], fps: float, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """People, each joints (T, 14, 3) m and height in m, to joints (P, T, 14, 3) and presence (P, T)."""
        draw = Draw(1, generator)
        hips = torch.stack([(joints[:, 8] + joints[:, 11]) / 2 for joints, _ in people])
        filming = draw_camera(hips.mean(0), draw)
        seen = [find_keypoints(joints, height, fps, filming, draw) for joints, height in people]
        return self.lifted(seen, filming, fps)

    @torch.no_grad()
    def lifted(self, seen: list[Seen], filming: Filming, fps: float) -> tuple[Tensor, Tensor]:
        """What the pipeline makes of keypoints from a camera: joints (P, T, 14, 3) and presence (P, T)."""
        keypoints, scores, valid = (torch.stack(parts) for parts in zip(*seen, strict=True))
        boxes = keypoint_boxes(keypoints, scores)
        if not bool(valid.any()):
            return torch.ones((*valid.shape, 14, 3)), valid
        stage = self.stage.seen_by(filming.believed, known=False)
        tracks = Tracks(boxes.float()[None], valid[None], valid[None])
        pose = stage.lift(
            tracks, keypoints.float()[None], scores.float()[None], filming.height, filming.width, fps
        )
        return pose.joints[0].double(), pose.valid[0]
