"""Seconds for 4 s of film at 640x360 and 30 fps, by number of people.

python -m tests.benchmarks.bench_render
"""

import time

import torch

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.render.renderer import PersonRenderer

FRAMES = 120


def main() -> None:
    """Print one line per number of people."""
    swing = torch.sin(torch.linspace(0, 12, FRAMES, dtype=torch.float64))
    pose = BodyPose.standing((FRAMES,))
    pose = pose._replace(shoulder=pose.shoulder + swing[:, None, None] * 0.5, heading=3.0 + 0 * swing)
    joints = forward_kinematics(pose, 1.75) + torch.tensor([0.0, 3.0, 0.93])
    for people in (1, 2, 3):
        crowd = torch.stack([joints + torch.tensor([0.9 * p - 0.9, 0.5 * p, 0.0]) for p in range(people)])
        start = time.perf_counter()
        PersonRenderer()(crowd)
        print(f"{people} people: {time.perf_counter() - start:.1f} s for {FRAMES} frames of 640x360")


if __name__ == "__main__":
    main()
