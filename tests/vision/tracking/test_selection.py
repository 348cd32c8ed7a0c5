"""People who count: all, the moving, the nearest, or one by number."""

import pytest
import torch

from tensorsim.errors import TensorsimError
from tensorsim.types import Pose
from tensorsim.vision.tracking.selection import moves, select_people

FPS = 30.0


@pytest.fixture
def scene() -> Pose:
    """A person who sits at 2 m, one who walks at 4 m, one who punches at 3 m, and a glimpse of one at 1 m."""
    body = torch.rand(14, 3, generator=torch.Generator().manual_seed(0))
    joints = body.expand(1, 4, 60, 14, 3).clone()
    time = torch.arange(60) / FPS
    joints[0, 0, ..., 1] += 2.0
    joints[0, 1, ..., 1] += 4.0 + time[:, None]
    joints[0, 2, ..., 1] += 3.0
    joints[0, 2, :, 4, 1] += 0.5 * (6 * time).sin()
    joints[0, 3, ..., 1] += 1.0
    joints += 0.01 * torch.randn(joints.shape, generator=torch.Generator().manual_seed(1))
    valid = torch.ones(1, 4, 60, dtype=torch.bool)
    valid[0, 3, 3:] = False
    rest = torch.zeros(1, 4, 60, 17, 3)
    return Pose(torch.zeros(1, 4, 60, 4), rest[..., :2], rest[..., 2], joints, valid)


@pytest.mark.parametrize(
    ("mode", "people"), [("all", {1, 2, 3, 4}), ("moving", {2, 3}), ("nearest", {1}), ("2", {2}), ("4", {4})]
)
def test_who_counts(scene: Pose, mode: str, people: set[int]) -> None:
    chosen = select_people(scene, mode, FPS)
    assert {int(k) + 1 for k in torch.nonzero(chosen.valid[0].any(dim=-1)).flatten()} == people
    assert chosen.joints is scene.joints
    assert not bool((chosen.valid & ~scene.valid).any())


def test_what_is_refused(scene: Pose) -> None:
    for mode in ("5", "0", "nobody", "-1"):
        with pytest.raises(TensorsimError, match=r"'moving', 'nearest' or the number of one of the 4 found"):
            select_people(scene, mode, FPS)
    with pytest.raises(TensorsimError, match="got 2, expected 'all'"):
        select_people(scene, 2, FPS)  # type: ignore[arg-type]
    twice = Pose(*(torch.cat([part, part]) for part in scene))
    with pytest.raises(TensorsimError, match="got 2 clips"):
        select_people(twice, "all", FPS)


def test_an_empty_scene(scene: Pose) -> None:
    nobody = Pose(*(part[:, :0] for part in scene))
    assert select_people(nobody, "nearest", FPS) is nobody
    assert not bool(moves(torch.zeros(0, 14, 3)))
