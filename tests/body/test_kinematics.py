"""Forward kinematics and the pose sampler, against hand-worked poses and conserved lengths."""

import math

import pytest
import torch
from torch import Tensor

from tensorsim.body import proportions, skeleton
from tensorsim.body.kinematics import BodyPose, forward_kinematics, rest_on_floor, rotation
from tensorsim.body.skeleton import mirror
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.motion.pose_sampler import sample_poses

RIGHT_ANGLE = math.pi / 2


def at(joints: Tensor, name: str) -> Tensor:
    return joints[..., JOINTS.index(name), :]


def standing(**angles: Tensor) -> Tensor:
    return forward_kinematics(BodyPose.standing()._replace(**angles))


def assert_direction(joints: Tensor, start: str, end: str, direction: tuple[float, float, float]) -> None:
    bone = at(joints, end) - at(joints, start)
    torch.testing.assert_close(
        bone / bone.norm(), torch.tensor(direction, dtype=bone.dtype), atol=1e-9, rtol=0
    )


def test_standing_body_has_the_published_heights() -> None:
    joints = rest_on_floor(standing())
    for name, height in (("ankle", 0.039), ("knee", 0.285), ("hip", 0.530), ("shoulder", 0.818)):
        for side in ("left", "right"):
            assert float(at(joints, f"{side}_{name}")[2]) == pytest.approx(height, abs=1e-9)


def test_right_is_plus_x_and_the_body_faces_plus_y() -> None:
    joints = standing()
    for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
        assert at(joints, f"right_{name}")[0] > 0 > at(joints, f"left_{name}")[0]
    assert at(joints, "head")[1] > 0


def test_heading_turns_counter_clockwise_seen_from_above() -> None:
    joints = standing(heading=torch.tensor(RIGHT_ANGLE, dtype=torch.float64))
    assert at(joints, "head")[0] < 0  # from facing +y to facing -x
    assert at(joints, "right_hip")[1] > 0


def test_flexion_goes_forward_knees_bend_backward_and_abduction_goes_sideways() -> None:
    pose = BodyPose.standing()
    hip, shoulder, knee, elbow = (t.clone() for t in (pose.hip, pose.shoulder, pose.knee, pose.elbow))
    hip[0, 0] = shoulder[1, 0] = RIGHT_ANGLE  # right thigh and left arm forward
    shoulder[0, 1] = hip[1, 1] = RIGHT_ANGLE  # right arm and left leg sideways
    knee[0] = elbow[1] = RIGHT_ANGLE
    joints = standing(hip=hip, shoulder=shoulder, knee=knee, elbow=elbow)
    assert_direction(joints, "right_hip", "right_knee", (0, 1, 0))
    assert_direction(joints, "right_knee", "right_ankle", (0, 0, -1))
    assert_direction(joints, "left_shoulder", "left_elbow", (0, 1, 0))
    assert_direction(joints, "left_elbow", "left_wrist", (0, 0, 1))
    assert_direction(joints, "right_shoulder", "right_elbow", (1, 0, 0))
    assert_direction(joints, "left_hip", "left_knee", (-1, 0, 0))


def test_inward_rotation_turns_the_forearms_towards_each_other() -> None:
    pose = BodyPose.standing()
    shoulder, elbow = pose.shoulder.clone(), pose.elbow + RIGHT_ANGLE
    shoulder[:, 2] = RIGHT_ANGLE
    joints = standing(shoulder=shoulder, elbow=elbow)
    assert_direction(joints, "right_elbow", "right_wrist", (-1, 0, 0))
    assert_direction(joints, "left_elbow", "left_wrist", (1, 0, 0))


def test_trunk_and_whole_body_lean_forward_and_to_the_right() -> None:
    quarter = torch.tensor(RIGHT_ANGLE, dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    assert_direction(standing(lean=quarter), "right_knee", "right_hip", (0, 1, 0))
    assert_direction(standing(roll=quarter), "right_knee", "right_hip", (1, 0, 0))
    pitched = standing(trunk=torch.stack([quarter, zero, zero]))
    assert at(pitched, "neck")[1] > 0.28
    assert at(standing(trunk=torch.stack([zero, quarter, zero])), "neck")[0] > 0.28
    assert at(standing(trunk=torch.stack([zero, zero, quarter])), "right_shoulder")[1] > 0.1


def test_rotations_are_scipys() -> None:
    from scipy.spatial.transform import Rotation

    for axis, letter in enumerate("xyz"):
        expected = torch.tensor(Rotation.from_euler(letter, 0.7).as_matrix())
        torch.testing.assert_close(rotation(axis, torch.tensor(0.7, dtype=torch.float64)), expected)


def test_bone_lengths_do_not_depend_on_the_pose() -> None:
    joints = sample_poses(400, seed=3)
    for a, b, length in (
        ("right_hip", "right_knee", proportions.THIGH),
        ("left_knee", "left_ankle", proportions.SHANK),
        ("left_shoulder", "left_elbow", proportions.UPPER_ARM),
        ("right_elbow", "right_wrist", proportions.FOREARM),
        ("right_shoulder", "left_shoulder", 2 * proportions.HALF_SHOULDERS),
        ("right_hip", "left_hip", 2 * proportions.HALF_HIPS),
        ("neck", "head", math.hypot(proportions.NOSE_FORWARD, proportions.NOSE_UP)),
    ):
        measured = (at(joints, a) - at(joints, b)).norm(dim=-1)
        torch.testing.assert_close(measured, torch.full_like(measured, length), atol=1e-9, rtol=0)


def test_height_scales_and_batches_equal_loops() -> None:
    pose = BodyPose.standing((2, 3))
    pose = pose._replace(**{k: torch.randn_like(v) for k, v in pose._asdict().items()})
    height = torch.tensor([1.6, 1.8], dtype=torch.float64)[:, None].expand(2, 3)
    whole = forward_kinematics(pose, height)
    one = forward_kinematics(BodyPose(*(field[1, 2] for field in pose)), 1.8)
    torch.testing.assert_close(whole[1, 2], one)


def test_gradients_against_finite_differences() -> None:
    pose = BodyPose.standing()
    angles = [torch.randn_like(field).requires_grad_(True) for field in pose]
    assert torch.autograd.gradcheck(lambda *a: forward_kinematics(BodyPose(*a)), angles, fast_mode=True)


def test_a_lying_body_rests_on_its_flesh() -> None:
    lying = standing(lean=torch.tensor(RIGHT_ANGLE, dtype=torch.float64))
    joints = rest_on_floor(lying, 1.8)
    assert float(joints[..., 2].min()) == pytest.approx(1.8 * proportions.FLESH)


def test_mirror_swaps_sides_and_undoes_itself() -> None:
    poses = sample_poses(50)
    flipped = mirror(poses)
    torch.testing.assert_close(at(flipped, "left_wrist")[:, 1:], at(poses, "right_wrist")[:, 1:])
    torch.testing.assert_close(at(flipped, "left_wrist")[:, 0], -at(poses, "right_wrist")[:, 0])
    torch.testing.assert_close(mirror(flipped), poses)


def test_sampler_repeats_by_seed_and_covers_what_people_do() -> None:
    poses = sample_poses(600, seed=1)
    assert torch.equal(poses, sample_poses(600, seed=1))
    assert not torch.equal(poses, sample_poses(600, seed=2))
    assert bool(poses.isfinite().all())
    hands_up = (at(poses, "right_wrist")[:, 2] > at(poses, "head")[:, 2]).double().mean()
    lying = (at(poses, "neck")[:, 2].abs() < 0.1).double().mean()
    high_kick = (at(poses, "right_ankle")[:, 2] > -0.1).double().mean()
    steps = ((at(poses, "right_ankle") - at(poses, "left_ankle"))[:, 1].abs() > 0.2).double().mean()
    for share in (hands_up, lying, high_kick):
        assert 0.005 < float(share) < 0.5
    assert float(steps) > 0.2
    # Neither side is preferred.
    sides = (at(poses, "right_ankle") - at(poses, "left_ankle"))[:, 1:]
    assert float(sides.mean(dim=0).abs().max()) < 0.05


@pytest.mark.parametrize(
    "joints", [torch.zeros(13, 3), torch.zeros(14, 2), torch.zeros(14), torch.zeros(14, 3, dtype=torch.int64)]
)
def test_coco_keypoints_refuse_other_shapes(joints: Tensor) -> None:
    with pytest.raises(TensorsimError, match="joints: got"):
        skeleton.body_to_coco(joints)


def test_sampler_refuses_too_few() -> None:
    with pytest.raises(TensorsimError, match="count 3, expected at least 13"):
        sample_poses(3)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotation_equals_kornia(axis: int) -> None:
    import kornia.geometry

    angle = torch.linspace(-7, 7, 30, dtype=torch.float64)
    vector = torch.eye(3, dtype=torch.float64)[axis] * angle[:, None]
    expected = kornia.geometry.axis_angle_to_rotation_matrix(vector)
    torch.testing.assert_close(rotation(axis, angle), expected, rtol=0, atol=1e-12)
