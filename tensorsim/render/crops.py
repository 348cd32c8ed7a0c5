"""Crops of rendered people, as input for pose networks when there are no videos."""

import torch
from torch import Tensor

from tensorsim.geometry.framing import camera_on
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.people import PeopleConfig
from tensorsim.render.renderer import PersonRenderer
from tensorsim.vision.pose2d.crops import BoxCrop

_HEIGHT, _WIDTH, _FPS = 360, 640, 1.0


def rendered_crops(size: tuple[int, int], people: int = 12, poses: int = 2, seed: int = 0) -> Tensor:
    """Crops (N, 3, H, W) RGB in [0, 1] of this size of people in rooms, N up to ``people * poses``.

    Args:
        size: (H, W).
        people: number of people, each with a different look, room and activity.
        poses: poses of each person, a second apart.
        seed: for everything that is random.
    """
    generator = ActivityGenerator(PeopleConfig(start_range_m=(2.5, 5.0), keep_range_m=(2.5, 5.0)))
    crops = []
    for person in range(people):
        motion = generator.generate(
            1 + person % 11, seed=seed + person, duration_s=poses / _FPS, rate_hz=_FPS
        )
        everywhere, place_m = torch.ones_like(motion.valid), (0.0, 0.0, 1.0)
        camera = camera_on(motion.joints, everywhere, _HEIGHT, _WIDTH, position_m=place_m)
        film = PersonRenderer(camera, _HEIGHT, _WIDTH)(motion.joints, seed + person, valid=motion.valid)
        seen = film.valid[0].nonzero()[:, 0]
        crops.append(BoxCrop(size)(film.frames, film.boxes[0, seen], seen))
    return torch.cat(crops)
