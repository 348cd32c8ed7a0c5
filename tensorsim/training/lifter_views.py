"""Training data of a lifter: motion seen by random cameras, with keypoint errors like those of networks.

Everything is computed for a whole batch at once: B windows of T frames.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import MIRRORED, body_to_coco, coco_to_body, mid_hips, mirror, trunk_lean
from tensorsim.config import CameraConfig
from tensorsim.geometry.camera import camera_to_world, focal_length
from tensorsim.training.lifter_motion import RATE_HZ, MotionPool
from tensorsim.vision.lifting.sight import Sight, level_sight

#: Score below which a keypoint counts as hidden.
THRESHOLD = 0.3
#: Share of the windows whose keypoints are exact, and of those whose camera is known.
_LABELLED, _KNOWN = 0.1, 0.4
#: Relative size of the errors of each COCO keypoint: face, shoulders, elbows, wrists, hips, knees, ankles.
_ERROR = (0.7,) * 5 + (0.9,) * 2 + (1.2,) * 2 + (1.5,) * 2 + (1.2,) * 2 + (1.0,) * 2 + (1.2,) * 2
#: Scores of well-found keypoints, measured on films: head, then shoulders to ankles.
USUAL_SCORES = (0.92,) * 5 + (0.80,) * 12
#: Distances in body heights from the outermost keypoints to the left, top, right and bottom of the detector's boxes,
#: measured on rendered films: for upright people, and for people lying down.
_MARGINS = ((0.04, 0.06, 0.04, 0.078), (0.05, 0.06, 0.05, 0.045))
#: Keypoints that are mistaken for one another: (right, left) of arms, of legs, and all.
_SWAPS = ((5, 7, 9), (11, 13, 15), (1, 3, 5, 7, 9, 11, 13, 15))
#: Jumps per second of each keypoint: a limb is taken for something else, or for that of the other side, for some
#: frames; their mean duration in seconds, their distance in body heights, and the share of those to the other side.
JUMPS_HZ = (0.015,) * 5 + (0.02,) * 2 + (0.10,) * 2 + (0.16,) * 2 + (0.02,) * 2 + (0.11,) * 2 + (0.16,) * 2
JUMP_S, JUMP, JUMP_ACROSS = 0.12, 0.2, 0.44
#: Share of these jumps of elbows and wrists that the lifter learns from: with all of them, it smooths quick hands.
_ARMS = torch.tensor((1.0,) * 7 + (0.5,) * 2 + (0.44,) * 2 + (1.0,) * 6)
#: (2, 17) keypoints that people who lie down are reduced to where the detector finds them in part: hips and legs, or
#: those above the knees.
PARTS = torch.stack([torch.arange(17) >= 11, torch.arange(17) < 13])


class Windows(NamedTuple):
    """A batch of windows.

    Attributes:
        joints: (B, T, 14, 3) true joints relative to the camera, in the world axes of the assumed one, body heights.
        keypoints: (B, T, 17, 2) pixels with errors.
        scores: (B, T, 17).
        boxes: (B, T, 4).
        valid: (B, T) bool.
        focal: (B,) assumed focal length in pixels.
        center: (B, 2).
        rotation: (B, 3, 3) assumed, world from camera.
        extent: (B, 2) width and height of the picture.
        fps: (B,).
        camera_height: (B,) assumed height of the camera above the floor, body heights.
    """

    joints: Tensor
    keypoints: Tensor
    scores: Tensor
    boxes: Tensor
    valid: Tensor
    focal: Tensor
    center: Tensor
    rotation: Tensor
    extent: Tensor
    fps: Tensor
    camera_height: Tensor

    def sight(self) -> Sight:
        """The input of the network."""
        joints, joint_scores = coco_to_body(self.keypoints, self.scores, THRESHOLD)
        return level_sight(
            self.keypoints, self.scores, joints, joint_scores, self.boxes, self.valid, self.focal, self.center,
            self.rotation, self.extent, self.fps, self.camera_height, THRESHOLD,
        )  # fmt: skip


class Draw:
    """Random numbers of a batch."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count, self.generator = count, generator

    def number(self, low: float, high: float, *tail: int) -> Tensor:
        """Uniform numbers (B, *tail)."""
        return low + (high - low) * torch.rand(self.count, *tail, generator=self.generator)

    def normal(self, *tail: int) -> Tensor:
        """Normal numbers (B, *tail)."""
        return torch.randn(self.count, *tail, generator=self.generator)

    def chance(self, probability: float, *tail: int) -> Tensor:
        """(B, *tail) bool, true with this probability."""
        return torch.rand(self.count, *tail, generator=self.generator) < probability

    def spells(self, frames: int, rate: float, shortest: float, longest: float, *tail: int) -> Tensor:
        """(B, *tail, T) bool: with probability ``rate``, one period of a random share of the frames, anywhere."""
        length = self.number(shortest, longest, *tail) * frames
        start = self.number(-0.3, 1.1, *tail) * frames
        time = torch.arange(frames)
        inside = (time >= start[..., None]) & (time < (start + length)[..., None])
        return inside & self.chance(rate, *tail)[..., None]

    def correlated(self, frames: int, last: Tensor, *tail: int) -> Tensor:
        """(B, T, *tail) noise of unit variance from a first-order process, correlated over ``last`` (B,) frames."""
        white = self.normal(frames, *tail)
        keep = torch.exp(-1 / last.clamp(min=0.1)).reshape(-1, *(1 for _ in tail))
        drive = (1 - keep.square()).sqrt()
        x = white[:, 0]
        rows = [x]
        for t in range(1, frames):
            x = keep * x + drive * white[:, t]
            rows.append(x)
        return torch.stack(rows, dim=1)


def windows_of(
    pool: MotionPool, frames: int, draw: Draw, rate_hz: float | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Joints (B, T, 14, 3) in metres about a spot on the floor, heights (B) and frame rates (B)."""
    lengths = pool.joints.shape[1]
    which = torch.randint(len(pool.joints), (draw.count,), generator=draw.generator)
    slowest = RATE_HZ * (frames - 1) / (lengths - 2)
    usual = torch.tensor([30.0, 30.0, 25.0, 24.0])[torch.randint(4, (draw.count,), generator=draw.generator)]
    fps = torch.where(draw.chance(0.5), usual, draw.number(slowest, 60.0)).clamp(min=slowest)
    if rate_hz is not None:
        fps = torch.full_like(fps, rate_hz)
    step = RATE_HZ / fps
    start = draw.number(0.0, 1.0) * (lengths - 1.01 - step * (frames - 1))
    at = start[:, None] + step[:, None] * torch.arange(frames)
    before = at.floor().long()
    share = (at - before)[..., None, None]
    joints = torch.lerp(pool.joints[which[:, None], before], pool.joints[which[:, None], before + 1], share)
    joints = torch.where(draw.chance(0.5)[:, None, None, None], mirror(joints), joints)
    spot = mid_hips(joints).mean(dim=1, keepdim=True) * torch.tensor([1.0, 1.0, 0.0])
    turn = rotation(2, draw.number(0.0, 2 * math.pi))
    return (joints - spot[:, :, None]) @ turn[:, None].mT, pool.height_m[which], fps


class View(NamedTuple):
    """Cameras.

    Attributes:
        joints: (B, T, 14, 3) relative to the camera in world axes, metres.
        rotation: (B, 3, 3) world from camera.
        focal: (B,) pixels.
        extent: (B, 2) width and height of the picture.
        height_m: (B,) height of the camera above the floor.
    """

    joints: Tensor
    rotation: Tensor
    focal: Tensor
    extent: Tensor
    height_m: Tensor


#: Camera axes (right, down, forward) of a level camera, as columns in world axes.
_LEVEL = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def _any_camera(joints: Tensor, draw: Draw) -> View:
    """Random cameras in front of people."""
    size = torch.tensor([[640.0, 360.0], [640.0, 480.0], [480.0, 640.0], [360.0, 640.0]])
    share = torch.tensor([0.5, 0.3, 0.1, 0.1])
    extent = size[torch.multinomial(share, draw.count, True, generator=draw.generator)]
    half = torch.deg2rad(draw.number(20.0, 45.0))
    focal = extent.amax(dim=-1) / 2 / torch.tan(half)
    far = torch.exp(draw.number(math.log(1.6), math.log(9.0)))
    height = draw.number(0.6, 3.0)
    local = joints + torch.stack([torch.zeros_like(far), far, -height], dim=-1)[:, None, None]
    hips = local[:, :, 8].mean(dim=1)
    up = torch.atan2(hips[:, 2], hips[:, 1])
    tall, wide = torch.atan(extent / 2 / focal[:, None]).flip(-1).unbind(-1)
    pitch = (up - 0.5 * tall * draw.normal().clamp(-2, 2)).clamp(-0.75, 0.3)
    # Many cameras are level if the hips are then in the picture.
    pitch = torch.where(draw.chance(0.25), (up + 0.8 * tall).clamp(max=0.0), pitch)
    yaw = 0.8 * wide * draw.number(-1.0, 1.0)
    return View(local, rotation(2, yaw) @ rotation(0, pitch) @ _LEVEL, focal, extent, height)


def before_camera(joints: Tensor, camera: CameraConfig, extent: tuple[int, int], draw: Draw) -> View:
    """Joints (B, T, 14, 3) about a spot on the floor, put in front of one camera at a random place in its picture."""
    width, height = extent
    focal = torch.full((draw.count,), focal_length(camera, width))
    down, tall = -camera.pitch_rad, math.atan(height / 2 / float(focal[0]))
    rise = camera.position_m[2] - 0.9
    # The hips are at most this far from the middle of the picture, up or down.
    lowest, highest = down + 0.5 * tall, max(down - 0.5 * tall, 0.0)
    nearest = max(2.0, rise / math.tan(lowest)) if rise > 0 else 2.0
    farthest = min(7.0, rise / math.tan(highest)) if rise > 0 and highest > 0 else 7.0
    far = draw.number(nearest, max(farthest, nearest))
    aside = 0.6 * far * width / 2 / focal * draw.number(-1.0, 1.0)
    local = (
        joints + torch.stack([aside, far, torch.full_like(far, -camera.position_m[2])], dim=-1)[:, None, None]
    )
    turned = camera_to_world(camera)[:, :3].to(local.dtype).expand(draw.count, 3, 3)
    size = torch.tensor([float(width), float(height)]).expand(draw.count, 2)
    return View(local, turned, focal, size, torch.full_like(far, camera.position_m[2]))


def found_in_part(points: Tensor, scores: Tensor, part: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Keypoints of people of whom the detector finds a part: the others are placed somewhere on that part.

    Args:
        points: (..., 17, 2).
        scores: (..., 17).
        part: (..., 17) bool, keypoints in the part found.
        noise: (..., 17, 2) errors of the others before they are moved there, in the unit of the points.

    Returns:
        Keypoints, and scores, which are less than half for the others.
    """
    low = torch.where(part[..., None], points, torch.inf).amin(dim=-2, keepdim=True)
    high = torch.where(part[..., None], points, -torch.inf).amax(dim=-2, keepdim=True)
    moved = (points + noise).maximum(low).minimum(high)
    return torch.where(part[..., None], points, moved), torch.where(part, scores, 0.45 * scores)


def jumps_from(rate_hz: Tensor, fps: Tensor | float, began: Tensor, lasting: Tensor) -> tuple[Tensor, Tensor]:
    """Which keypoints jump (..., T, 17) bool, and the frame of the latest jump of each, 0 before the first.

    Args:
        rate_hz: (..., T or 1, 17) jumps per second.
        fps: frames per second, (..., 1, 1) or a number.
        began, lasting: (..., T, 17) uniform random numbers, the latter above 0.
    """
    time = torch.arange(began.shape[-2])[:, None]
    since = torch.where(began < rate_hz / fps, time, -1).cummax(dim=-2)[0]
    lasts = 1 - JUMP_S * fps * lasting.log()  # exponential
    jumps = (since >= 0) & (time - since < lasts.gather(-2, since.clamp(min=0)))
    return jumps, since.clamp(min=0)


def landed(found: Tensor, unit: Tensor, since: Tensor, step: Tensor, across: Tensor) -> Tensor:
    """Where keypoints (..., T, 17, 2) are if they jump: on the other side, or somewhere nearby.

    Args:
        found: keypoints before they jump.
        unit: (..., T, 1, 1) body heights in the unit of the keypoints.
        since: (..., T, 17) frame of the latest jump, see :func:`jumps_from`.
        step: (..., T, 17, 2) normal random numbers.
        across: (..., T, 17) uniform random numbers.
    """
    led = JUMP * step.gather(-3, since[..., None].expand_as(step))
    over = (across < JUMP_ACROSS).gather(-2, since)
    return torch.where(over[..., None], found[..., list(MIRRORED), :], found + unit * led)


def _missed(
    points: Tensor, unit: Tensor, depth: Tensor, tilted: Tensor, scores: Tensor, fps: Tensor, draw: Draw
) -> tuple[Tensor, Tensor]:
    """Keypoints (B, T, 17, 2) with errors like those of networks, and their scores.

    Args:
        points: true ones in pixels.
        unit: (B, T) pixels per body height.
        depth: (B, T, 17) distances from the camera in body heights.
        tilted: (B, T) 0 for an upright trunk to 1 for a horizontal one.
        scores: (B, T, 17) scores of the true ones.
        fps: (B,) frames per second.
        draw: random numbers.
    """
    frames = points.shape[1]
    relative = torch.tensor(_ERROR)[:, None]
    good = torch.exp(0.6 * draw.normal())[:, None, None, None] * relative
    error = 0.0015 * good * draw.normal(frames, 17, 2)
    error = error + 0.006 * good * draw.correlated(frames, 0.12 * fps, 17, 2)
    error = error + 0.006 * good * draw.correlated(frames, 0.8 * fps, 17, 2)
    error = error + 0.005 * good * draw.normal(1, 17, 2)
    wild = draw.spells(frames, 0.10, 0.03, 0.5, 17).transpose(1, 2)
    error = error + 0.12 * wild[..., None] * draw.correlated(frames, 0.5 * fps, 17, 2)
    # Networks find bodies slightly too small: faces low and ankles high, by 1 % on rendered films.
    size = -0.010 + 0.012 * draw.normal(1, 1, 1)
    error = error + size * (points - points.mean(dim=2, keepdim=True)) / unit[..., None, None]
    # People are found less accurately lying than standing, in half of the windows much less so.
    worse = 1 + draw.number(0.0, 1.0, 1) * torch.where(draw.chance(0.5), 1.0, 4.0)[:, None] * tilted
    error = error * worse[..., None, None]
    found = points + unit[..., None, None] * error

    other = points[:, :, list(MIRRORED)]
    near = (points - other).norm(dim=-1) < 0.12 * unit[..., None]
    behind = depth > depth[:, :, list(MIRRORED)] + 0.04
    # The far arm or leg of a person seen from the side is easily taken for the near one.
    limbs = torch.arange(17) > 6
    covered = near & behind & limbs & draw.spells(frames, 0.35, 0.1, 1.0, 17).transpose(1, 2)
    pull = draw.number(0.0, 1.0, 1, 17)[..., None]
    found = torch.where(covered[..., None], torch.lerp(found, found[:, :, list(MIRRORED)], pull), found)
    for group in _SWAPS:
        swapped = torch.zeros(17, dtype=torch.bool)
        swapped[list(group)] = True
        swapped = swapped | swapped[list(MIRRORED)]
        spell = draw.spells(frames, 0.07, 0.02, 0.35)
        found = torch.where((spell[..., None] & swapped)[..., None], found[:, :, list(MIRRORED)], found)

    often = torch.exp(draw.normal(1)) * (1 + draw.number(0.0, 6.0, 1) * tilted)
    began, lasting = draw.number(0.0, 1.0, frames, 17), draw.number(1e-6, 1.0, frames, 17)
    rate_hz = often[..., None] * (_ARMS * torch.tensor(JUMPS_HZ))
    jumps, since = jumps_from(rate_hz, fps[:, None, None], began, lasting)
    step, across = draw.normal(frames, 17, 2), draw.number(0.0, 1.0, frames, 17)
    there = landed(found, unit[..., None, None], since, step, across)
    found = torch.where(jumps[..., None], there, found)

    miss = (found - points).norm(dim=-1) / unit[..., None]
    usual = torch.tensor(USUAL_SCORES) * (1 + 0.05 * draw.normal(1, 17))
    level = torch.where(draw.chance(0.8)[:, None, None], usual, torch.ones(17)) * draw.number(
        0.85, 1.08, 1, 1
    )
    scores = scores * level - 2.0 * miss * draw.number(0.2, 1.0, 1, 17) - 0.15 * covered
    scores = scores + 0.05 * draw.correlated(frames, 0.3 * fps, 17)
    lost = draw.spells(frames, 0.10, 0.05, 1.2, 17).transpose(1, 2)
    scores = torch.where(lost, draw.number(0.0, 0.45, frames, 17), scores)
    # Of some people who lie down, the detector finds only a part.
    part = PARTS[draw.chance(0.3).long()][:, None]
    cut = (tilted > 0.6) & draw.spells(frames, 0.35, 0.3, 2.0)
    noise = 0.06 * unit[..., None, None] * draw.correlated(frames, 0.4 * fps, 17, 2)
    return found_in_part(found, scores, part | ~cut[..., None], noise)


def _followed(
    found: Tensor, scores: Tensor, unit: Tensor, tilted: Tensor, draw: Draw, gaps: bool
) -> tuple[Tensor, Tensor]:
    """Boxes (B, T, 4) of keypoints, like those of detectors and trackers, and the frames (B, T) that have one."""
    frames = found.shape[1]
    seen = scores >= THRESHOLD
    low = torch.where(seen[..., None], found, torch.inf).amin(dim=-2)
    high = torch.where(seen[..., None], found, -torch.inf).amax(dim=-2)
    valid = seen.sum(dim=-1) >= 4
    margin = torch.lerp(torch.tensor(_MARGINS[0]), torch.tensor(_MARGINS[1]), tilted[..., None])
    error = draw.normal(1, 4) + draw.correlated(frames, torch.full((draw.count,), 5.0), 4)
    margin = margin + torch.where(draw.chance(0.2), 0.03, 0.012)[:, None, None] * error
    margin = unit[..., None] * margin
    boxes = torch.cat([low - margin[..., :2], high + margin[..., 2:]], dim=-1)
    if gaps:
        valid = valid & ~draw.spells(frames, 0.15, 0.03, 0.4)
    return torch.where(valid[..., None], boxes, 0.0), valid


def film(pool: MotionPool, count: int, frames: int, generator: torch.Generator) -> Windows:
    """``count`` windows of motion from the pool, at random places in front of random cameras.

    Four in ten cameras are known to within a percent, the others only as well as one estimated from the film; one
    window in ten has exact keypoints.
    """
    draw = Draw(count, generator)
    joints, height, fps = windows_of(pool, frames, draw)
    view = _any_camera(joints, draw)
    seen = seen_in(view, height, fps, draw)
    labelled = draw.chance(_LABELLED)
    seen = Windows(
        *(torch.where(labelled.reshape(-1, *(1,) * (found.dim() - 1)), true, found)
          for true, found in zip(seen_in(view, height, fps, draw, errors=False), seen, strict=True))
    )  # fmt: skip
    known = draw.chance(_KNOWN)
    # Tilt and roll are wrong by a few degrees, the focal length by a few percent.
    wrong = torch.where(draw.chance(0.2), 0.10, 0.02)[:, None] * draw.normal(2)
    wrong = torch.where(known[:, None], 0.005 * draw.normal(2), wrong)
    tipped = rotation(0, wrong[:, 0]) @ rotation(1, 0.5 * wrong[:, 1])
    spread = torch.where(known, 0.005, torch.where(draw.chance(0.3), 0.15, 0.02))
    stretch = torch.exp(spread * draw.normal().clamp(-2, 2))
    forward = view.rotation[:, :, 2]
    shift = (stretch - 1)[:, None] * (mid_hips(view.joints) * forward[:, None]).sum(dim=-1)
    joints = (view.joints + (shift[..., None] * forward[:, None])[:, :, None]) @ tipped[:, None].mT
    # Usually the height of the camera is estimated with them, so that people stay on the floor.
    sunk = mid_hips(view.joints)[..., 2].mean(dim=-1) - mid_hips(joints)[..., 2].mean(dim=-1)
    above = view.height_m + torch.where(draw.chance(0.7), sunk, torch.zeros_like(sunk))
    spread = torch.where(known, 0.01, torch.where(draw.chance(0.3), 0.20, 0.04))
    above = above * torch.exp(spread * draw.normal())
    return seen._replace(
        joints=joints / height[:, None, None, None],
        camera_height=above / height,
        focal=view.focal * stretch,
        rotation=tipped @ view.rotation,
    )


def seen_in(view: View, height: Tensor, fps: Tensor, draw: Draw, errors: bool = True) -> Windows:
    """What networks see of people in front of cameras.

    Args:
        view: people and cameras.
        height: (B) standing heights, metres.
        fps: (B) frames per second.
        draw: random numbers.
        errors: False gives the exact keypoints, those outside the picture with a score of 0.
    """
    frames, extent = view.joints.shape[1], view.extent
    center = (extent - 1) / 2
    eyes = body_to_coco(view.joints)
    camera = eyes @ view.rotation[:, None]
    away = camera[..., 2].clamp(min=0.15)
    points = camera[..., :2] / away[..., None] * view.focal[:, None, None, None] + center[:, None, None]
    inside = ((points > -2) & (points < extent[:, None, None] + 2)).all(dim=-1) & (camera[..., 2] > 0.2)
    unit = (view.focal * height)[:, None] / away[..., 11:13].mean(dim=-1)
    tilted = trunk_lean(view.joints)
    if errors:
        scores = torch.ones_like(away)
        # From behind, eyes and nose are hidden; many networks still place them, with high scores.
        ahead = eyes[:, :, 0] - eyes[:, :, 3:5].mean(dim=2)
        toward = -(ahead * eyes[:, :, 0]).sum(dim=-1)
        toward = toward / (ahead.norm(dim=-1) * eyes[:, :, 0].norm(dim=-1)).clamp(min=1e-6)
        shown = (0.75 + 1.2 * toward[..., None]).clamp(0.0, 1.0)
        scores[..., :3] *= torch.where(draw.chance(0.35)[:, None, None], shown, 1.0)
        points, scores = _missed(points, unit, away / height[:, None, None], tilted, scores, fps, draw)
        scores = torch.where(inside, scores, draw.number(0.0, 0.35, frames, 17)).clamp(0.02, 1.0)
    else:
        scores = inside.float()
    points = torch.where(inside[..., None], points, points.clamp(min=0).minimum(extent[:, None, None]))
    boxes, valid = _followed(points, scores, unit, tilted, draw, errors)
    boxes = torch.minimum(boxes.clamp(min=0), torch.cat([extent, extent], dim=-1)[:, None])
    return Windows(
        view.joints / height[:, None, None, None], points, scores, boxes, valid, view.focal, center, view.rotation,
        extent, fps, view.height_m / height,
    )  # fmt: skip
