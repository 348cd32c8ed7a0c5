"""How well poses are lifted: motion capture, generated activities and everyday movements, filmed from 8 sides.

python -m tests.benchmarks.eval_lifting [--tune] [LIBRARY.safetensors]

Clips with an even number (in the order of the files) are those that settings were tuned on; without --tune the
others are judged. Bodies of 1.75 m stay 4 m in front of a pinhole camera, keypoints have 2 px of noise at a height
of 300 px; 30 frames a second, at most 45 frames, without the first, which is a calibration jump in the CMU clips.
Joints lie on their lines of sight at the lifted depth, and are compared with the true ones relative to the hips.
"""

import math
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tensorsim.body.skeleton import body_height, mid_hips
from tensorsim.motion.activities import ActivityGenerator, perform
from tensorsim.motion.exercises import EXERCISES
from tensorsim.motion.people import PeopleConfig, draw_people
from tensorsim.training.pose_pool import facing_away, with_mirror_images, without_near_duplicates
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.pose_library import load_pose_library, standardise_poses, turn
from tests.conftest import SHARED_DATA

FRAMES, SIDES = 45, 8
HEIGHT_M, RANGE_M, FOCAL_PX, NOISE_PX = 1.75, 4.0, 685.7, 2.0
EVERYDAY = ("picking up", "bending", "squats", "lying down", "getting up", "crawling")
LIFTINGS: dict[str, dict[str, float]] = {
    "nearest": {"neighbours": 1},
    "k nearest": {"temporal": 0.0},
    "k nearest and time (default)": {},
}


def mocap_clips() -> dict[str, Tensor]:
    """All clips (T, 14, 3) at about 30 frames a second, by name."""
    clips = {}
    with np.load(SHARED_DATA / "mocap" / "cmu_14joints_120hz.npz") as file:
        for name in file.files:
            clips[name] = torch.tensor(file[name][4::4])
    with np.load(SHARED_DATA / "mocap" / "deepmimic_14joints.npz") as file:
        for name in file.files:
            if not name.endswith("_fps"):
                step = round(float(file[f"{name}_fps"]) / 30)
                clips[f"deepmimic_{name}"] = torch.tensor(file[name][step::step])
    return clips


def generated_clips(seed: int) -> dict[str, Tensor]:
    """A clip of each activity with a person; none of these people is in the shipped library."""
    actors = ActivityGenerator()
    names = range(1, 12)
    return {f"activity {i + 1}": actors.generate(i, 1, seed + i).joints[0].float() for i in names}


def everyday_clips(seed: int) -> dict[str, Tensor]:
    """A clip (T, 14, 3) of each movement near the floor or far from upright, by people of their own."""
    time = (torch.arange(FRAMES, dtype=torch.float64) / 30 + 0.2)[None]
    clips = {}
    for i, name in enumerate(EVERYDAY):
        who = draw_people(1, PeopleConfig(heading_rad=0.0), torch.Generator().manual_seed(seed + i))
        clips[name] = perform(EXERCISES[name], time, who)[0].float()
    return clips


def film(joints: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Keypoints (T, 14, 2) in pixels and true joints (T, 14, 3) in metres relative to the hips."""
    body = HEIGHT_M * (joints - mid_hips(joints)[:, None]) / body_height(joints).mean()
    body = turn(body, torch.full((len(body),), 2 * math.pi * side / SIDES))
    across = torch.stack([body[..., 0], -body[..., 2]], dim=-1)
    image = FOCAL_PX * across / (RANGE_M + body[..., 1])[..., None]
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(side))
    return image + NOISE_PX * noise, body


def judge(lifter: NearestPoseLifter, joints: Tensor) -> np.ndarray:
    """Mean over 8 sides, cm: error of joints, of their depths, and of the change of depth between frames."""
    films = [film(joints[:FRAMES], side) for side in range(SIDES)]
    image, true = (torch.stack(x) for x in zip(*films, strict=True))
    depth = HEIGHT_M * lifter(image, torch.ones(image.shape[:-1])).depth
    depth = depth - mid_hips(depth[..., None])
    rays = torch.cat([image / FOCAL_PX, torch.ones_like(image[..., :1])], dim=-1)
    u, v, y = (rays * (RANGE_M + depth)[..., None]).unbind(-1)
    found = torch.stack([u, y - RANGE_M, -v], dim=-1)
    found = found - mid_hips(found)[..., None, :]
    wrong = depth - true[..., 1]
    return 100 * np.array(
        [
            float((found - true).norm(dim=-1).mean()),
            float(wrong.abs().mean()),
            float((wrong[:, 1:] - wrong[:, :-1]).abs().mean()),
        ]
    )


def other_clips(clips: dict[str, Tensor], name: str) -> Tensor:
    """The pool that all clips but one make."""
    poses = torch.cat([standardise_poses(clip) for other, clip in clips.items() if other != name])
    return without_near_duplicates(with_mirror_images(facing_away(poses)), 0.015)


def main() -> None:
    torch.set_num_threads(1)
    every = mocap_clips()
    tune = "--tune" in sys.argv
    files = [Path(a) for a in sys.argv[1:] if a != "--tune"]
    library = load_pose_library(files[0] if files else None)
    judged = {name: clip for i, (name, clip) in enumerate(every.items()) if (i % 2 == 0) == tune}
    acted = generated_clips(700 if tune else 800)
    near_floor = everyday_clips(700 if tune else 900)
    print(f"library of {len(library)} poses; joints, depth, change of depth, in cm")
    by_clip: dict[str, np.ndarray] = {}

    def show(name: str, pool: str, kind: str, rows: list[np.ndarray]) -> None:
        print(f"{name:30s} {pool:12s} {kind:10s}", *(f"{x:6.2f}" for x in np.mean(rows, axis=0)), flush=True)

    for name, options in LIFTINGS.items():
        lifter = NearestPoseLifter(library, **options)  # type: ignore[arg-type]
        for kind, clips in (("mocap", judged), ("generated", acted), ("everyday", near_floor)):
            by_clip = {**by_clip, **{clip: judge(lifter, joints) for clip, joints in clips.items()}}
            show(name, "library", kind, [by_clip[clip] for clip in clips])
        pools = {clip: other_clips(every, clip) for clip in judged}
        rows = [judge(NearestPoseLifter(pools[c], **options), judged[c]) for c in judged]  # type: ignore[arg-type]
        show(name, "other clips", "mocap", rows)
    print("by clip, library and default:")
    for clip, row in by_clip.items():
        print(f"  {clip:24s}", *(f"{x:6.2f}" for x in row))


if __name__ == "__main__":
    main()
