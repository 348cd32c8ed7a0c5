"""Pools of poses for nearest-match lifting, from recorded or generated motion, without near-duplicates."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import torch
from torch import Tensor

from tensorsim.body.skeleton import mirror
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError, check_positive
from tensorsim.motion import everyday, exercises, martial_arts
from tensorsim.motion.activities import ActivityGenerator, perform
from tensorsim.motion.people import PeopleConfig, draw_people
from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.vision.lifting.pose_library import standardise_poses, turn

#: Relative standard deviation of segment lengths in generated pools: skeletons labelled by people and networks differ
#: more than bodies do.
LIMB_DEVIATION = 0.05
#: Frames taken from a generated clip of 4 s.
_MOMENTS = 20
#: Movements near the floor or far from upright, and others that are rare in clips of the activities.
_EVERYDAY = (
    exercises.pick_up,
    exercises.bend,
    exercises.squat,
    exercises.lie_down,
    exercises.get_up,
    exercises.crawl,
    everyday.fall_any_way,
    everyday.fall_on_knees,
    martial_arts.swing_fist,
    everyday.kick_ball,
)


def facing_away(poses: Tensor) -> Tensor:
    """Poses (L, 14, 3) turned about the vertical so that the right side of hips and shoulders points along +x.

    A pose lying on its side, whose left-to-right line has no horizontal direction, is kept as it is.
    """

    def across(joint: str) -> Tensor:
        return poses[:, JOINTS.index(f"right_{joint}")] - poses[:, JOINTS.index(f"left_{joint}")]

    line = across("hip") + across("shoulder")
    return turn(poses, -torch.atan2(line[:, 1], line[:, 0]))


def everyday_poses(count: int, seed: int) -> Tensor:
    """Moments of people who pick up, bend, squat, lie down, get up, crawl, fall, swing fists and kick balls.

    Args:
        count: number of poses.
        seed: the same seed gives the same poses.

    Returns:
        (count, 14, 3) float64, standardised, facing +y, of bodies of many proportions.
    """
    people = PeopleConfig(limb_deviation=LIMB_DEVIATION, variation=0.2, heading_rad=0.0)
    generator = torch.Generator().manual_seed(seed)
    clips = math.ceil(count / len(_EVERYDAY) / _MOMENTS)
    acted = []
    for script in _EVERYDAY:
        who = draw_people(clips, people, generator)
        time = 4 * torch.rand(clips, _MOMENTS, generator=generator, dtype=torch.float64).sort(dim=1).values
        acted.append(perform(script, time, who).flatten(0, 1))
    chosen = torch.cat(acted)
    chosen = chosen[torch.randperm(len(chosen), generator=generator)[:count]]
    return facing_away(standardise_poses(chosen))


def generated_poses(count: int, seed: int) -> Tensor:
    """Generated poses: a sixth from :func:`everyday_poses`, a third of the rest from the activities.

    The others are drawn by :func:`~tensorsim.motion.pose_sampler.sample_poses`.

    Args:
        count: number of poses, at least 396.
        seed: the same seed gives the same poses.

    Returns:
        (count, 14, 3) float64, standardised, facing +y, of bodies of many proportions, both sides alike.
    """
    if count < 396:
        raise TensorsimError(f"generated poses: got a count of {count}, expected at least 396")
    others = count - count // 6
    people = PeopleConfig(limb_deviation=LIMB_DEVIATION, variation=0.2, heading_rad=0.0)
    actors = ActivityGenerator(people)
    generator = torch.Generator().manual_seed(seed)
    clips = math.ceil(others / 3 / 11 / _MOMENTS)
    acted = []
    for activity in range(1, 12):
        motion = actors.generate(activity, clips, generator, rate_hz=_MOMENTS / 4)
        acted.append(motion.joints.flatten(0, 1))
    chosen = torch.cat(acted)
    chosen = chosen[torch.randperm(len(chosen), generator=generator)[: others // 3]]
    sampled = sample_poses(others - len(chosen), seed, LIMB_DEVIATION)
    poses = facing_away(standardise_poses(torch.cat([chosen, sampled])))
    return torch.cat([poses, everyday_poses(count - others, seed)])


def recorded_poses(file: Path) -> Tensor:
    """All poses of a motion capture file that :func:`tensorsim.data.motion_files.load_motion` can read.

    From an npz with several arrays of joints, all are used.

    Returns:
        (L, 14, 3) float64, standardised, facing +y.

    Raises:
        TensorsimError: a file that cannot be read, or without people.
    """
    from tensorsim.data.motion_files import load_motion, motion_keys

    poses = []
    for key in motion_keys(file):
        motion = load_motion(file, key=key, fps=30.0)  # the frame rate does not matter for poses
        poses.append(motion.joints[motion.valid].double())
    if sum(len(p) for p in poses) == 0:
        raise TensorsimError(f"{file}: contains no people, expected poses")
    return facing_away(standardise_poses(torch.cat(poses)))


def with_mirror_images(poses: Tensor) -> Tensor:
    """Poses (L, 14, 3) and their mirror images, (2 L, 14, 3)."""
    return torch.cat([poses, mirror(poses)])


def without_near_duplicates(
    poses: Tensor, tolerance: float, progress: Callable[[Iterable[Tensor]], Iterable[Tensor]] = iter
) -> Tensor:
    """Poses without near-duplicates: no two are closer than a tolerance; the first of each group is kept.

    Args:
        poses: (L, 14, 3) body heights.
        tolerance: body heights, root mean square over the joints.
        progress: wraps the iteration over blocks of 1024 poses, to show progress.

    Returns:
        (K, 14, 3), in the order of the poses. Every pose left out is within the tolerance of a kept one.
    """
    check_positive(tolerance, "tolerance")
    radius = tolerance * math.sqrt(len(JOINTS))
    kept = poses[:1]
    for block in progress(poses.split(1024)):
        flat = block.flatten(1)
        new = torch.ones(len(block), dtype=torch.bool)
        for old in kept.flatten(1).split(8192):
            new &= torch.cdist(flat, old).amin(dim=1) >= radius
        block, flat = block[new], flat[new]
        near = torch.cdist(flat, flat) < radius
        left = torch.ones(len(block), dtype=torch.bool)
        for i in range(len(block)):
            if left[i]:
                left[i + 1 :] &= ~near[i, i + 1 :]
        kept = torch.cat([kept, block[left]])
    return kept
