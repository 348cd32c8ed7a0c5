"""A tiny film whose truth is known, and stand-in networks that read it without weights.

Each person is an upright rectangle of one colour channel (red, then green) standing in a pinhole camera at the
radar; the detector finds the rectangles, the pose network puts a standing body into each crop.
"""

import math

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from tensorsim.types import Detections

WIDTH, HEIGHT = 320, 240
FOCAL_PX = WIDTH / 2 / math.tan(math.pi / 6)  # the default field of view of 60 degrees
BODY_M = 1.75
#: u (to the image's right) and v (down from the crown), in body heights, of the COCO-17 keypoints of someone
#: who stands and faces the camera: their left is on the image's right. The joints themselves are at heights of 0.37
#: (elbows), 0.47 (hips), 0.715 (knees) and 0.96 (ankles).
STANDING = (
    (0.00, 0.07), (0.02, 0.06), (-0.02, 0.06), (0.04, 0.07), (-0.04, 0.07),
    (0.13, 0.18), (-0.13, 0.18), (0.15, 0.359), (-0.15, 0.359), (0.16, 0.52), (-0.16, 0.52),
    (0.053, 0.475), (-0.053, 0.475), (0.053, 0.724), (-0.053, 0.724), (0.053, 0.948), (-0.053, 0.948),
)  # fmt: skip


def film(range_m: Tensor, x_m: Tensor) -> Tensor:
    """Frames (T, 3, H, W) uint8 of up to two people at ``range_m`` and ``x_m``, both (P, T); NaN = not there."""
    people, frames = range_m.shape
    video = torch.zeros(frames, 3, HEIGHT, WIDTH, dtype=torch.uint8)
    for person in range(people):
        for t in range(frames):
            y, x = float(range_m[person, t]), float(x_m[person, t])
            if math.isnan(y):
                continue
            tall, wide = FOCAL_PX * BODY_M / y, FOCAL_PX * 0.45 / y
            u = (WIDTH - 1) / 2 + FOCAL_PX * x / y
            feet = (HEIGHT - 1) / 2 + FOCAL_PX * 1.5 / y
            top, bottom = max(0, round(feet - tall)), min(HEIGHT, round(feet))
            left, right = max(0, round(u - wide / 2)), min(WIDTH, round(u + wide / 2))
            video[t, person, top:bottom, left:right] = 255
    return video


def walker(frames: int, fps: float, start_m: float, speed_m_s: float, x_m: float) -> tuple[Tensor, Tensor]:
    """Range and x (1, T) of a person who walks away at ``speed_m_s``."""
    t = torch.arange(frames) / fps
    return (start_m + speed_m_s * t).unsqueeze(0), torch.full((1, frames), x_m)


def panned(frames: Tensor, px_per_frame: int) -> Tensor:
    """The film (T, 3, H, W) in front of a blue pattern that moves to the left, as for a camera that pans right."""
    count, _, height, width = frames.shape
    size = (width + count * px_per_frame, height)
    coarse = np.random.default_rng(0).integers(0, 110, (12, size[0] // 20), np.uint8)
    pattern = torch.from_numpy(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC))
    behind = [pattern[:, px_per_frame * k : px_per_frame * k + width] for k in range(count)]
    return torch.maximum(frames, torch.stack(behind)[:, None])


class RectangleDetector(nn.Module):
    """Finds the rectangle of each of two colour channels."""

    def forward(self, images: Tensor) -> Detections:
        images = images.float() / 255 if images.dtype == torch.uint8 else images
        n = images.shape[0]
        boxes = torch.zeros(n, 2, 4, device=images.device)
        valid = torch.zeros(n, 2, dtype=torch.bool, device=images.device)
        for i in range(n):
            for c in range(2):
                rows = torch.nonzero((images[i, c] > 0.5).any(dim=1)).flatten()
                columns = torch.nonzero((images[i, c] > 0.5).any(dim=0)).flatten()
                if rows.numel() > 0:
                    boxes[i, c, 0] = columns[0]
                    boxes[i, c, 1] = rows[0]
                    boxes[i, c, 2] = columns[-1] + 1
                    boxes[i, c, 3] = rows[-1] + 1
                    valid[i, c] = True
        return Detections(
            boxes, 0.9 * valid, torch.zeros(n, 2, dtype=torch.long, device=images.device), valid
        )


class StandingPose(nn.Module):
    """Puts a standing body into every crop: Gaussians of sigma 2 at the joints, as a trained network would."""

    points: Tensor

    def __init__(self) -> None:
        super().__init__()
        # A crop is 1.25 bodies tall, centred on the box, 64 heat-map pixels; the same scale holds in u.
        template = torch.tensor(STANDING)
        u = 24 - 0.5 + template[:, 0] / 1.25 * 64
        v = 32 - 0.5 + (template[:, 1] - 0.5) / 1.25 * 64
        self.register_buffer("points", torch.stack((u, v), dim=-1), persistent=False)

    def forward(self, crops: Tensor) -> Tensor:
        v = torch.arange(64, device=crops.device).reshape(1, 64, 1)
        u = torch.arange(48, device=crops.device).reshape(1, 1, 48)
        squared = (u - self.points[:, 0].reshape(17, 1, 1)) ** 2 + (
            v - self.points[:, 1].reshape(17, 1, 1)
        ) ** 2
        return torch.exp(-squared / 8).expand(crops.shape[0], 17, 64, 48)
