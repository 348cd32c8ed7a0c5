"""Legs of walkers step as those of the gait model do; what swings by itself, or does not walk, stays as it is."""

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.gait import boulic_gait
from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import MIRRORED_JOINTS, mid_hips
from tensorsim.errors import TensorsimError
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.vision.lifting.walking_legs import WalkingLegs
from tests.stage import StageTester

FPS = 30.0
LEGS = [9, 10, 12, 13]
MIRRORED_LEGS = [MIRRORED_JOINTS[joint] if joint in LEGS else joint for joint in range(14)]


def generated(activity: str, heading_deg: float = 0.0, seed: int = 3) -> Tensor:
    """Joints (T, 14, 3) of a generated person."""
    joints = ActivityGenerator().generate(activity, seed=seed, duration_s=4.0, rate_hz=FPS).joints[0].double()
    return joints @ rotation(2, torch.tensor(math.radians(heading_deg), dtype=torch.float64)).mT


def hanging(joints: Tensor) -> Tensor:
    """The same people with straight legs below their hips, as a lifter gives those that it knows nothing of."""
    legs = joints.clone()
    for hip in (8, 11):
        for number, below in ((1, 0.42), (2, 0.82)):
            legs[..., hip + number, :] = joints[..., hip, :] - below * joints.new_tensor([0.0, 0.0, 1.0])
    return legs


def masks(joints: Tensor, hidden: bool = True) -> tuple[Tensor, Tensor]:
    """Which joints are seen, all but knees and ankles, and that people are there throughout."""
    seen = torch.ones(joints.shape[:-1], dtype=torch.bool)
    seen[..., LEGS] = not hidden
    return seen, torch.ones(joints.shape[:-2], dtype=torch.bool)


def swinging(joints: Tensor, share: float) -> Tensor:
    """The same people with legs that swing ``share`` times as far from straight ones."""
    straight = hanging(joints)
    legs = straight + share * (joints - straight)
    return torch.where(torch.isin(torch.arange(14), torch.tensor(LEGS))[:, None], legs, joints)


def exchanged(joints: Tensor, frames: Tensor) -> Tensor:
    """The same people with knees and ankles of the other side in some frames (T,)."""
    return torch.where(frames[:, None, None], joints[:, MIRRORED_LEGS], joints)


def nearest_way(found: Tensor, true: Tensor) -> float:
    """Mean distance in m of knees and ankles from true ones, about their hips, whichever leg is called right."""
    found, true = (joints[:, LEGS] - joints[:, [8, 8, 11, 11]] for joints in (found, true))
    return min(float((found - one).norm(dim=-1).mean()) for one in (true, true[:, [2, 3, 0, 1]]))


def speeds(joints: Tensor) -> Tensor:
    """Speeds (T - 1, 2) of the ankles in m/s."""
    return (joints[1:, [10, 13]] - joints[:-1, [10, 13]]).norm(dim=-1) * FPS


class TestWalkingLegs(StageTester):
    batched_arguments = (0, 1, 2)
    gradient_arguments = (0,)

    def make(self) -> nn.Module:
        return WalkingLegs()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)
        walk = hanging(generated("walking"))[:40].to(dtype)
        noise = torch.randn(*batch, *walk.shape, generator=generator, dtype=dtype)
        joints = walk + 0.01 * noise
        return joints, *masks(joints), FPS

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        joints, seen, valid, fps = self.inputs((), torch.float32)
        return [
            ((joints[..., :13, :], seen, valid, fps), "14"),
            ((joints * float("nan"), seen, valid, fps), "joints: got NaN"),
            ((joints, seen[..., :13], valid, fps), "seen"),
            ((joints, seen, valid.float(), fps), "valid"),
            ((joints, seen, valid, 0.0), "fps"),
        ]


class TestSeenLegs(TestWalkingLegs):
    """Legs that are seen to swing too little, but for half a second, so that the phase matters."""

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)
        walk = swinging(generated("walking"), 0.4)[40:80].to(dtype)
        noise = torch.randn(*batch, *walk.shape, generator=generator, dtype=dtype)
        joints = walk + 0.005 * noise
        seen, valid = masks(joints, hidden=False)
        seen[..., 12:27, 9:11] = seen[..., 12:27, 12:14] = False
        assert float((self.make()(joints, seen, valid, FPS) - joints).abs().amax()) > 0.1
        return joints, seen, valid, FPS


@pytest.mark.parametrize("heading", [0.0, 70.0, 200.0])
def test_hidden_legs_step_as_true_ones(heading: float) -> None:
    """Feet swing as fast, and one of them stands meanwhile, as the cadence belongs to the speed."""
    walk = generated("walking", heading)
    hung = hanging(walk)
    legs = WalkingLegs()(hung, *masks(walk), FPS)
    inner = slice(20, -20)  # blended at the ends
    assert torch.equal(legs[:, [0, 1, 2, 3, 4, 5, 6, 7, 8, 11]], walk[:, [0, 1, 2, 3, 4, 5, 6, 7, 8, 11]])
    true, found, glide = (speeds(joints[inner]) for joints in (walk, legs, hung))
    assert found.amax() == pytest.approx(float(true.amax()), rel=0.1)
    assert float(glide.amax()) < 0.5 * float(true.amax())
    assert float(found.amin(dim=-1).median()) < 0.3 < 0.7 < float(glide.amin(dim=-1).median())
    for first, second in ((8, 9), (9, 10), (11, 12), (12, 13)):
        bone = (legs[inner, first] - legs[inner, second]).norm(dim=-1)
        torch.testing.assert_close(bone, (hung[inner, first] - hung[inner, second]).norm(dim=-1))


@pytest.mark.parametrize("seed", [3, 4, 5])
@pytest.mark.parametrize("heading", [0.0, 90.0, 200.0])
def test_legs_that_swing_too_little_step_in_phase(heading: float, seed: int) -> None:
    walk = generated("walking", heading, seed)
    seen, valid = masks(walk, hidden=False)
    shrunk = swinging(walk, 0.4)
    legs = WalkingLegs()(shrunk, seen, valid, FPS)
    inner = slice(20, -20)
    assert nearest_way(legs[inner], walk[inner]) < 0.6 * nearest_way(shrunk[inner], walk[inner])
    true, found = speeds(walk[inner]), speeds(legs[inner])
    assert found.amax() == pytest.approx(float(true.amax()), rel=0.15)
    assert (found - true).square().mean().sqrt() < 0.4 * true.square().mean().sqrt()


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_phase_does_not_depend_on_which_leg_is_called_right(share: float) -> None:
    """The leading leg is called left at every step, or any leg is called any: the same two legs step."""
    walk = generated("walking", 70.0)
    masked = masks(walk, hidden=False)
    legs = WalkingLegs()(swinging(walk, share), *masked, FPS)
    ahead = walk[-1, 8] - walk[0, 8]
    leading = ((walk[:, 10] - walk[:, 13]) @ ahead) > 0
    random = torch.rand(len(walk), generator=torch.Generator().manual_seed(1)) < 0.5
    for frames in (leading, random):
        confused = WalkingLegs()(exchanged(swinging(walk, share), frames), *masked, FPS)
        assert nearest_way(confused[20:-20], legs[20:-20]) < 0.05
        assert nearest_way(confused[20:-20], walk[20:-20]) < 0.1


def test_hidden_legs_step_in_phase_with_seen_ones() -> None:
    """For a second they are beyond the picture; the phase carries on from before and after."""
    walk = generated("walking", 30.0)
    hides = (torch.arange(len(walk)) >= 50) & (torch.arange(len(walk)) < 80)
    joints = torch.where(hides[:, None, None], hanging(walk), swinging(walk, 0.5))
    seen, valid = masks(walk, hidden=False)
    seen[..., LEGS] &= ~hides[:, None]
    legs = WalkingLegs()(joints, seen, valid, FPS)
    assert nearest_way(legs[50:80], walk[50:80]) < 0.12
    assert nearest_way(legs[20:-20], walk[20:-20]) < 0.1


def test_legs_that_do_not_swing_at_all_are_left() -> None:
    """Somebody on a skateboard, or carried."""
    walk = generated("walking")
    glides = hanging(walk)
    torch.testing.assert_close(WalkingLegs()(glides, *masks(walk, hidden=False), FPS), glides)


@pytest.mark.parametrize("turned_deg", [-90.0, 90.0, 180.0])
def test_legs_seen_of_who_goes_sideways_or_backwards_are_left(turned_deg: float) -> None:
    walk = swinging(generated("walking"), 0.5)
    middle = walk[:, [8, 11]].mean(dim=1, keepdim=True)
    turn = rotation(2, torch.tensor(math.radians(turned_deg), dtype=torch.float64))
    turned = (walk - middle) @ turn.mT + middle
    seen, valid = masks(walk, hidden=False)
    assert not torch.equal(WalkingLegs()(walk, seen, valid, FPS), walk)
    torch.testing.assert_close(WalkingLegs()(turned, seen, valid, FPS), turned)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_legs_at_another_cadence_are_left(seed: int) -> None:
    """Steps at a third of the cadence that belongs to the speed, as of a run in slow motion."""
    walk = generated("walking", seed=seed)
    hips = mid_hips(walk)[:, None]
    rows = (walk - hips)[: len(walk) // 3 + 1].flatten(1).T[None]
    slow = F.interpolate(rows, len(walk), mode="linear", align_corners=True)[0].T.unflatten(1, (14, 3)) + hips
    seen, valid = masks(slow, hidden=False)
    found = WalkingLegs()(slow, seen, valid, FPS)
    torch.testing.assert_close(found[20:-20], slow[20:-20])  # at both ends a second is too short to tell
    assert (found - slow).norm(dim=-1).mean() < 0.01


def test_runners_are_left() -> None:
    walk = generated("walking")
    seen, valid = masks(walk, hidden=False)
    shrunk = swinging(walk, 0.5)
    assert not torch.equal(WalkingLegs()(shrunk, seen, valid, FPS), shrunk)
    hips = shrunk[:, [8, 11]].mean(dim=1, keepdim=True) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    run = shrunk + 2.0 * (hips - hips[:1])
    torch.testing.assert_close(WalkingLegs()(run, seen, valid, FPS), run)


def test_legs_of_unlike_lengths_keep_in_step() -> None:
    """A lifter makes one leg longer than the other; after half a minute one is still ahead when the other is behind."""
    ahead = 1.2 * torch.arange(900, dtype=torch.float64)[:, None, None] / FPS
    walk = hanging(generated("walking"))[:1] + ahead * torch.tensor([0.0, 1.0, 0.0])
    walk[:, 12:14, 2] += 0.08
    legs = WalkingLegs()(walk, *masks(walk), FPS)[-80:-20]
    swing = (legs[:, [10, 13]] - legs[:, [8, 11]])[..., 1]
    swing = swing - swing.mean(dim=0)
    assert float((swing[:, 0] * swing[:, 1]).sum()) < -0.5 * float(swing[:, 0].square().sum())


def test_backwards_knees_bend_forwards_still() -> None:
    walk = hanging(generated("walking")).flip(0)
    legs = WalkingLegs()(walk, *masks(walk), FPS)[20:-20]
    right = (legs[:, 8] - legs[:, 11])[:, :2]
    facing = torch.nn.functional.normalize(torch.stack([-right[:, 1], right[:, 0]], dim=-1), dim=-1)
    for hip in (8, 11):
        middle = (legs[:, hip, :2] + legs[:, hip + 2, :2]) / 2
        assert float(((legs[:, hip + 1, :2] - middle) * facing).sum(dim=-1).amin()) > -0.02


@pytest.mark.parametrize("activity", ["punching", "sitting down", "grabbing", "rotating"])
def test_who_stays_does_not_step(activity: str) -> None:
    still = hanging(generated(activity))
    torch.testing.assert_close(WalkingLegs()(still, *masks(still), FPS), still)


@pytest.mark.parametrize("turned_deg", [-120.0, -50.0, 50.0, 90.0])
def test_who_seems_to_face_another_way_steps_along_the_path(turned_deg: float) -> None:
    """The facing of a body cut off at the hips is off by tens of degrees in films."""
    walk = generated("walking")
    middle = walk[:, [8, 11]].mean(dim=1, keepdim=True)
    turn = rotation(2, torch.tensor(math.radians(turned_deg), dtype=torch.float64))
    glides = (hanging(walk) - middle) @ turn.mT + middle
    legs = WalkingLegs()(glides, *masks(glides), FPS)[20:-20]
    swing = (legs[:, [10, 13]] - legs[:, [8, 11]]).var(dim=0)
    assert float(swing[:, 1].amin()) > 0.01 > 4 * float(swing[:, 0].amax())  # m^2; the path is along y
    assert float(speeds(legs).amax()) == pytest.approx(float(speeds(walk[20:-20]).amax()), rel=0.1)


def test_legs_of_who_turns_round_on_the_way_do_not_jump() -> None:
    walk = hanging(generated("walking"))
    middle = walk[:, [8, 11]].mean(dim=1, keepdim=True)
    turns = rotation(2, torch.linspace(0, math.pi, len(walk), dtype=torch.float64))
    turning = (walk - middle) @ turns.mT + middle
    legs = WalkingLegs()(turning, *masks(turning), FPS)
    assert not torch.equal(legs[20:40], turning[20:40])
    assert not torch.equal(legs[-40:-20], turning[-40:-20])
    assert float(speeds(legs).amax()) < 1.3 * float(speeds(generated("walking")).amax())


def test_only_hidden_legs_of_upright_people_change() -> None:
    walk = generated("walking")
    legs, (seen, valid) = WalkingLegs(), masks(walk)
    assert torch.equal(legs(walk, *masks(walk, hidden=False), FPS), walk)
    assert torch.equal(legs(walk, seen, torch.zeros_like(valid), FPS), walk)
    lying = walk @ rotation(0, torch.tensor(math.pi / 2, dtype=torch.float64)).mT
    assert torch.equal(legs(lying, seen, valid, FPS), lying)
    # Legs that are hidden for a moment are left to the lifter; seen ones are, up to the frame beside hidden ones.
    briefly = torch.ones_like(seen)
    briefly[40:54, LEGS] = False
    assert torch.equal(legs(walk, briefly, valid, FPS), walk)
    half = torch.ones_like(seen)
    half[60:, LEGS] = False
    found = legs(walk, half, valid, FPS)
    assert torch.equal(found[:60], walk[:60])
    assert not torch.equal(found[80:], walk[80:])
    assert float(speeds(found).amax()) < 1.3 * float(speeds(walk).amax())


def test_angles_are_those_of_the_gait_model() -> None:
    phase = torch.linspace(0, 2, 101, dtype=torch.float64)
    for relative_speed in (0.4, 1.25, 2.0):
        gait = boulic_gait(torch.tensor(relative_speed, dtype=torch.float64), phase)
        hip, knee = WalkingLegs()._angles(torch.full_like(phase, relative_speed), phase).unbind(-1)
        assert float((hip - gait.hip[..., 0]).abs().amax()) < math.radians(1.0)
        assert float((knee - gait.knee[..., 0]).abs().amax()) < math.radians(2.5)


def test_refuses_speeds_out_of_order() -> None:
    with pytest.raises(TensorsimError, match="walking_m_s"):
        WalkingLegs(slow_m_s=0.6, walking_m_s=0.5)
    with pytest.raises(TensorsimError, match="running_m_s"):
        WalkingLegs(running_m_s=0.5)
    for name in ("slow_m_s", "blend_s", "mean_s"):
        with pytest.raises(TensorsimError, match=name):
            WalkingLegs(**{name: 0.0})
