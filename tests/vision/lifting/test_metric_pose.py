"""Metric pose: bodies with known motion, projected in NumPy, must come back to where they were."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.proportions import ANKLE_HEIGHT
from tensorsim.body.skeleton import lowest_ankle, mid_hips
from tensorsim.config import JOINTS, CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.camera import camera_to_world
from tensorsim.types import Lifted
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.metric_pose import (
    MetricPose,
    accumulated_displacement,
    camera_range,
    metres_per_pixel,
)
from tests.stage import StageTester

WIDTH, HEIGHT, FPS, TALL = 1280, 720, 30.0, 1.75
FOCAL = WIDTH / 2 / math.tan(math.pi / 6)  # of the default field of view


class Placed(nn.Module):
    """MetricPose with the fields of Lifted as separate tensors."""

    def __init__(self, mode: str) -> None:
        super().__init__()
        self.place = MetricPose(mode=mode, range_smoothing_s=0.1, floor_window_s=0.2)

    def forward(
        self, keypoints: Tensor, scores: Tensor, depth: Tensor, scale: Tensor, fit: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor]:
        index = torch.zeros(scale.shape, dtype=torch.int64, device=scale.device)
        lifted = Lifted(depth, scale, fit, index, torch.zeros_like(scale), torch.zeros_like(depth))
        return self.place(keypoints, scores, lifted, valid, 480, 640, 30.0)


class MetricPoseTester(StageTester):
    batched_arguments = (0, 1, 2, 3, 4, 5)
    gradient_arguments = (0, 2, 3, 4)
    mode = "camera"

    def make(self) -> nn.Module:
        return Placed(self.mode)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(*batch, 2, 8, *shape, generator=generator, dtype=dtype)

        valid = uniform(0, 1) > 0.2
        valid[..., 1, 6:] = False
        fit = uniform(100, 300, 14, 2)
        return (
            fit + uniform(-3, 3, 14, 2),
            uniform(0, 1, 14),
            uniform(-0.2, 0.2, 14),
            uniform(180, 220),
            fit,
            valid,
        )

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        good = self.inputs((), torch.float32)

        def but(position: int, value: Tensor) -> tuple[Any, ...]:
            return (*good[:position], value, *good[position + 1 :])

        return [
            (but(0, good[0][..., :13, :]), r"expected \(\.\.\., P, T, 14, 2\)"),
            (but(0, good[0][0, 0]), r"expected \(\.\.\., P, T, 14, 2\)"),
            (but(0, good[0] * float("nan")), "keypoints: got NaN"),
            (but(1, good[1][:, :3]), r"scores: got shape \[2, 3, 14\], expected \[2, 8, 14\]"),
            (but(1, good[1] * float("nan")), "scores: got NaN"),
            (but(2, good[2][..., :3]), r"lifted.depth: got shape \[2, 8, 3\]"),
            (but(3, good[3][..., :3]), r"lifted.scale: got shape \[2, 3\]"),
            (but(4, good[4][..., :1]), r"lifted.keypoints: got shape"),
            (but(2, good[2] * float("nan")), "lifted.depth: got NaN"),
            (but(3, good[3] * float("nan")), "lifted.scale: got NaN"),
            (but(4, good[4] * float("nan")), "lifted.keypoints: got NaN"),
            (but(5, good[5][:1]), r"valid: got torch.bool of shape \[1, 8\]"),
            (but(5, good[5].float()), "valid: got torch.float32 .* expected bool"),
            (tuple(x[:, :0] for x in good), "at least 1 frame"),
        ]


class TestCameraMode(MetricPoseTester):
    def test_refuses_what_does_not_fit_the_people(self) -> None:
        keypoints, scores, depth, scale, fit, valid = self.inputs((), torch.float32)
        index = torch.zeros(scale.shape, dtype=torch.int64)
        lifted = Lifted(depth, scale, fit, index, torch.zeros_like(scale), torch.zeros_like(depth))
        place, rest = MetricPose(), (valid, 480, 640, 30.0)
        with pytest.raises(TensorsimError, match=r"lifted.distance: got shape \[1, 8\]"):
            place(keypoints, scores, lifted._replace(distance=lifted.distance[:1]), *rest)
        for cut_off in (valid[:1], valid.float()):
            with pytest.raises(TensorsimError, match="cut_off: got"):
                place(keypoints, scores, lifted, *rest, None, cut_off)
        poses = torch.eye(3, 4).expand(8, 3, 4) * float("nan")
        with pytest.raises(TensorsimError, match="camera_pose: got NaN"):
            place(keypoints, scores, lifted, *rest, poses)


class TestPaperMode(MetricPoseTester):
    mode = "paper"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "gps"}, "mode: got 'gps'"),
        ({"person_height_m": ()}, "person_height_m: got no values"),
        ({"person_height_m": (1.8, -1.0)}, r"person_height_m\[1\]: got -1\.0"),
        ({"initial_distance_m": (0.0,)}, r"initial_distance_m\[0\]: got 0\.0"),
        ({"initial_distance_m": ()}, "initial_distance_m: got no values"),
        ({"keypoint_threshold": 0.0}, "keypoint_threshold"),
        ({"range_smoothing_s": -1.0}, "range_smoothing_s"),
        ({"floor_window_s": float("nan")}, "floor_window_s"),
    ],
)
def test_refuses_bad_settings(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        MetricPose(**options)


# ---- scenes with a known answer ------------------------------------------------------------------------


#: Metres of two steps with hips that swing by 0.4 rad, such that the ankle of the straight leg rests.
STRIDE_M = 1.30


def walker(start: tuple[float, float], velocity: tuple[float, float], frames: int = 90) -> Tensor:
    """World joints (T, 14, 3) of a walking body, the lower ankle on the floor in every frame."""
    t = torch.arange(frames, dtype=torch.float64) / FPS
    phase = 2 * math.pi * math.hypot(*velocity) / STRIDE_M * t
    ahead = torch.sin(phase).asin() * (2 / math.pi)  # from -1 to 1 and back at a constant pace
    swing = (math.sin(0.4) * ahead).asin() / 0.4
    lift = torch.cos(phase) if velocity != (0.0, 0.0) else torch.zeros_like(t)
    zero = torch.zeros_like(t)
    flexion = torch.stack([swing, -swing], dim=-1)
    heading = math.atan2(velocity[1], velocity[0]) - math.pi / 2 if velocity != (0.0, 0.0) else 0.0
    pose = BodyPose.standing((frames,))._replace(
        heading=zero + heading,
        hip=torch.stack([0.4 * flexion, 0 * flexion], dim=-1),
        knee=0.1 + 0.6 * torch.stack([lift, -lift], dim=-1).clamp(min=0.0),
        shoulder=torch.stack([-0.4 * flexion, 0 * flexion + 0.1, 0 * flexion], dim=-1),
        elbow=0 * flexion + 0.4,
    )
    joints = forward_kinematics(pose, TALL)
    way = torch.stack([start[0] + velocity[0] * t, start[1] + velocity[1] * t, -lowest_ankle(joints)], dim=-1)
    return joints + way[:, None]


def project(world: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """Pinhole in NumPy, from the angles themselves: turn by -yaw, then by -pitch, then divide by depth."""
    x, y, z = np.moveaxis(world - np.array(camera.position_m), -1, 0)
    c, s = math.cos(camera.yaw_rad), math.sin(camera.yaw_rad)
    right, ahead = c * x - s * y, s * x + c * y
    c, s = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    forward, up = c * ahead + s * z, -s * ahead + c * z
    focal = FOCAL if camera.focal_px is None else camera.focal_px
    u0, v0 = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2) if camera.center_px is None else camera.center_px
    return np.stack([u0 + focal * right / forward, v0 - focal * up / forward], axis=-1)


def film(
    world: Tensor,
    camera: CameraConfig = CameraConfig(),  # noqa: B008
    tall: float = TALL,
) -> tuple[Tensor, Lifted]:
    """Keypoints (T, 14, 2) of world joints and the lifting that an all-knowing lifter would return."""
    image = torch.tensor(project(world.numpy(), camera))
    pose = camera_to_world(camera)
    ahead = (world - pose[:, 3]) @ pose[:, 2]
    root = mid_hips(ahead[..., None])
    depth = (ahead - root) / tall
    focal = FOCAL if camera.focal_px is None else camera.focal_px
    scale = focal / (root[:, 0] / tall + depth.mean(dim=-1))
    nothing = torch.zeros(len(world), dtype=torch.float64)
    return image, Lifted(depth, scale, image, nothing.long(), nothing, torch.zeros_like(depth))


def place(module: MetricPose, image: Tensor, lifted: Lifted, **options: Any) -> Tensor:
    ones = torch.ones(1, *image.shape[:-1], dtype=image.dtype)
    lifted = Lifted(*(field[None] for field in lifted))
    return module(image[None], ones, lifted, ones[..., 0] > 0, HEIGHT, WIDTH, FPS, **options)[0][0]


@pytest.mark.parametrize("velocity", [(0.0, 1.3), (0.0, -1.3), (1.3, 0.0), (-0.8, 0.9)])
def test_a_walker_comes_back_to_where_it_was(velocity: tuple[float, float]) -> None:
    world = walker((-0.5, 6.0) if velocity[1] <= 0 else (0.3, 3.0), velocity)
    joints = place(MetricPose(person_height_m=(TALL,)), *film(world))
    error = (joints - world).norm(dim=-1)
    assert float(error.max()) < 0.03
    speed = (mid_hips(joints)[-1] - mid_hips(joints)[0])[:2] * FPS / (len(world) - 1)
    torch.testing.assert_close(speed, torch.tensor(velocity, dtype=torch.float64), atol=0.01, rtol=0)


def test_the_camera_may_look_sideways_down_and_stand_elsewhere() -> None:
    camera = CameraConfig(
        focal_px=900.0, center_px=(600.0, 300.0), position_m=(1.0, -0.5, 2.5), pitch_rad=-0.2, yaw_rad=0.3
    )
    world = walker((2.0, 4.0), (0.3, 0.8))
    joints = place(MetricPose(camera, person_height_m=(TALL,)), *film(world, camera))
    assert float((joints - world).norm(dim=-1).max()) < 0.03


def test_a_moving_camera_is_followed() -> None:
    """The camera is carried forward and turned while a person walks away from it."""
    world = walker((0.0, 4.0), (0.0, 1.0))
    views = [CameraConfig(position_m=(0.01 * t, 0.02 * t, 1.5), yaw_rad=0.002 * t) for t in range(len(world))]
    films = [film(frame[None], view) for frame, view in zip(world, views, strict=True)]
    image = torch.cat([f[0] for f in films])
    lifted = Lifted(*(torch.cat(fields) for fields in zip(*(f[1] for f in films), strict=True)))
    poses = torch.stack([camera_to_world(view) for view in views])
    module = MetricPose(person_height_m=(TALL,))
    joints = place(module, image, lifted, camera_pose=poses)
    assert float((joints - world).norm(dim=-1).max()) < 0.03
    assert float((place(module, image, lifted) - world).norm(dim=-1).max()) > 0.5
    with pytest.raises(TensorsimError, match=r"camera_pose: got shape \[89, 3, 4\], expected \[90, 3, 4\]"):
        place(module, image, lifted, camera_pose=poses[1:])


def test_default_camera_looks_along_range_and_pixels_go_right_and_down() -> None:
    pose = camera_to_world(CameraConfig())
    expected = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5]], dtype=torch.float64)
    torch.testing.assert_close(pose, expected)
    turned = camera_to_world(CameraConfig(yaw_rad=0.1, pitch_rad=0.2))
    assert turned[0, 2] > 0  # towards +x
    assert turned[2, 2] > 0  # upwards
    torch.testing.assert_close(turned[:, :3] @ turned[:, :3].T, torch.eye(3, dtype=torch.float64))


def test_initial_distance_replaces_the_focal_length() -> None:
    telephoto = CameraConfig(focal_px=2500.0)
    world = walker((0.0, 4.0), (0.0, 1.3))
    image, lifted = film(world, telephoto)
    early = float(mid_hips(world)[:16, 1].median())
    joints = place(MetricPose(person_height_m=(TALL,), initial_distance_m=(early,)), image, lifted)
    assert float((joints - world).norm(dim=-1).max()) < 0.05
    wrong = place(MetricPose(person_height_m=(TALL,)), image, lifted)
    assert float((wrong - world).norm(dim=-1).max()) > 1.0


def test_sitting_down_does_not_change_the_range_but_makes_the_papers_person_grow() -> None:
    frames = 90
    e = torch.linspace(0, 1, frames, dtype=torch.float64)
    pose = BodyPose.standing((frames,))._replace(
        heading=torch.full((frames,), 0.3, dtype=torch.float64),
        hip=torch.stack([e[:, None].expand(-1, 2) * 1.5, torch.zeros(frames, 2).double()], dim=-1),
        knee=e[:, None].expand(-1, 2) * 1.5,
    )
    joints = forward_kinematics(pose, TALL)
    world = joints + torch.stack([0 * e, 0 * e + 3.5, -lowest_ankle(joints)], dim=-1)[:, None]
    image, lifted = film(world)
    placed = place(MetricPose(person_height_m=(TALL,)), image, lifted)
    assert float((placed - world).norm(dim=-1).max()) < 0.03

    def thigh(x: Tensor) -> Tensor:
        return (x[:, JOINTS.index("left_hip")] - x[:, JOINTS.index("left_knee")])[:, [0, 2]].norm(dim=-1)

    paper = place(MetricPose(person_height_m=(TALL,), mode="paper"), image, lifted)
    sizes = (paper[:, :2] - paper[:, [1, 8]]).norm(dim=-1).amax(dim=-1)  # neck to hip
    assert float(sizes[-1]) > 1.2 * float(sizes[0])


def test_a_jump_leaves_the_floor_and_a_wrong_ankle_does_not_move_it() -> None:
    world = walker((0.0, 4.0), (0.0, 0.0))
    t = torch.arange(90, dtype=torch.float64) / FPS
    flight = (1.2 * 9.81 * 0.25 * (t - 1.25) - 0.5 * 9.81 * (t - 1.25) ** 2).clamp(min=0.0)
    assert 0.3 < float(flight.max()) < 0.5
    jumping = world.clone()
    jumping[..., 2] += flight[:, None]
    image, lifted = film(jumping)
    image[20, JOINTS.index("left_ankle"), 1] += 200.0  # one bad frame, far below the floor
    joints = place(MetricPose(person_height_m=(TALL,)), image, lifted)
    others = [j for j in range(14) if j != JOINTS.index("left_ankle")]
    assert float((joints - jumping)[:, others].norm(dim=-1).max()) < 0.05
    papers = place(MetricPose(person_height_m=(TALL,), mode="paper"), image, lifted)
    assert float(lowest_ankle(papers).abs().max()) < 1e-9


def test_papers_position_adds_pixels_times_alpha_at_constant_range() -> None:
    world = walker((-0.5, 4.0), (0.6, 0.0))
    image, lifted = film(world)
    paper = place(MetricPose(person_height_m=(TALL,), mode="paper", initial_distance_m=(2.5,)), image, lifted)
    extent = image[..., 1].amax(dim=-1) - image[..., 1].amin(dim=-1)
    alpha = TALL / extent
    root = mid_hips(image)
    x = np.zeros(90)
    for t in range(1, 90):
        x[t] = x[t - 1] + float(alpha[t]) * float(root[t, 0] - root[t - 1, 0])
    np.testing.assert_allclose(mid_hips(paper)[:, 0].numpy(), x, rtol=0, atol=1e-9)
    torch.testing.assert_close(mid_hips(paper)[:, 1], torch.full((90,), 2.5, dtype=torch.float64))
    depth = 0.2 * alpha[:, None] * lifted.scale[:, None] * lifted.depth
    torch.testing.assert_close(paper[..., 1] - 2.5, depth)
    with pytest.raises(TensorsimError, match="the paper has no camera"):
        place(MetricPose(mode="paper"), image, lifted, camera_pose=torch.zeros(90, 3, 4))


def test_papers_position_stays_where_the_hips_stay_while_the_scale_changes() -> None:
    """Across the picture, then down into a squat with the hips in place."""
    u = torch.cat([torch.linspace(100, 500, 20), torch.full((20,), 500.0)]).double()
    size = torch.cat([torch.full((20,), 450.0), torch.linspace(450, 260, 20)]).double()
    alpha, valid = metres_per_pixel(torch.tensor(1.75), size), torch.ones(40, dtype=torch.bool)
    x = accumulated_displacement(u, alpha, valid)
    assert x[0] == 0
    assert x[19:].tolist() == pytest.approx([400 * 1.75 / 450] * 21)
    valid[5:9] = valid[:2] = False  # frames without a pose change nothing of where it ends
    x = accumulated_displacement(torch.where(valid, u, 1e6), alpha, valid)
    assert x[:3].tolist() == [0, 0, 0]
    assert float(x[-1]) == pytest.approx(float(u[-1] - u[2]) * 1.75 / 450)


def test_range_of_a_pinhole_camera() -> None:
    focal, height = torch.tensor(1000.0), torch.tensor(1.8)
    assert float(camera_range(focal, height, torch.tensor(450.0))) == pytest.approx(4.0)


def test_the_last_height_serves_all_further_people() -> None:
    world = walker((0.0, 4.0), (0.0, 0.0), frames=10)
    image, lifted = film(world)
    people = 3
    ones = torch.ones(people, 10, 14, dtype=torch.float64)
    lifted = Lifted(*(field.expand(people, *field.shape) for field in lifted))
    joints, _ = MetricPose(person_height_m=(1.8, 0.9))(
        image.expand(people, -1, -1, -1), ones, lifted, ones[..., 0] > 0, HEIGHT, WIDTH, FPS
    )
    ranges = mid_hips(joints)[:, 0, 1]
    assert float(ranges[0] / ranges[1]) == pytest.approx(2.0, rel=1e-6)
    assert float(ranges[2]) == float(ranges[1])


def test_hidden_joints_and_absent_people_are_filled_and_marked() -> None:
    world = walker((0.0, 4.0), (0.0, 0.5))
    image, lifted = film(world)
    wrist = JOINTS.index("right_wrist")
    hidden = image.clone()
    hidden[30:40, wrist] = 0.0
    scores = torch.ones(2, 90, 14, dtype=torch.float64)
    scores[0, 30:40, wrist] = 0.1
    valid = torch.ones(2, 90, dtype=torch.bool)
    valid[0, 60:] = False
    valid[1] = False
    both = Lifted(*(torch.stack([field, field]) for field in lifted))
    joints, seen = MetricPose(person_height_m=(TALL,))(
        torch.stack([hidden, hidden]), scores, both, valid, HEIGHT, WIDTH, FPS
    )
    assert float((joints[0, :60] - world[:60]).norm(dim=-1).max()) < 0.03
    torch.testing.assert_close(joints[0, 60:], joints[0, 59:60].expand(30, -1, -1))
    assert float(joints[1].abs().max()) == 0.0
    expected = valid[..., None].expand(-1, -1, 14).clone()
    expected[0, 30:40, wrist] = False
    assert torch.equal(seen, expected)


@pytest.mark.parametrize(("tall", "is_person"), [(0.5, False), (0.9, True)])
def test_a_post_beside_a_walker_is_nobody_but_a_child_is(tall: float, is_person: bool) -> None:
    """By its size a post of half a metre, 5 m away, is a person 17.5 m away whose feet are 3.75 m below the floor."""
    world = walker((0.5, 4.0), (0.0, 0.0))
    small = world * (tall / TALL) + torch.tensor([-1.0, 5.0 - 4.0 * tall / TALL, 0.0])
    images, lifts = zip(film(small, tall=tall), film(world), strict=True)
    lifted = Lifted(*(torch.stack(fields) for fields in zip(*lifts, strict=True)))
    ones = torch.ones(2, 90, 14, dtype=torch.float64)
    arguments = (torch.stack(images), ones, lifted, ones[..., 0] > 0, HEIGHT, WIDTH, FPS)
    joints, seen = MetricPose(person_height_m=(TALL,))(*arguments)
    assert bool(seen[1].all())
    assert bool(seen[0].all()) == bool(seen[0].any()) == is_person
    assert bool(joints[0].any()) == is_person
    assert float((joints[1] - world).norm(dim=-1).max()) < 0.03
    assert bool(MetricPose(person_height_m=(tall, TALL))(*arguments)[1].all()), "of known height"
    assert bool(MetricPose(person_height_m=(TALL,), calibrated=True)(*arguments)[1].all()), (
        "no floor is estimated"
    )


def place_seen(
    module: MetricPose, image: Tensor, scores: Tensor, lifted: Lifted, cut_off: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    lifted = Lifted(*(field[None] for field in lifted))
    valid = torch.ones(1, len(image), dtype=torch.bool)
    told = None if cut_off is None else cut_off[None]
    joints, seen = module(image[None], scores[None], lifted, valid, HEIGHT, WIDTH, FPS, None, told)
    return joints[0], seen[0]


def misread(image: Tensor, lifted: Lifted, frames: slice, shown: list[int], factor: float) -> Lifted:
    """As if the size found in some frames, from the joints that show, were wrong by a factor."""
    keypoints, scale = lifted.keypoints.clone(), lifted.scale.clone()
    middle = image[frames, shown].mean(dim=1, keepdim=True)
    keypoints[frames] = middle + factor * (keypoints[frames] - middle)
    scale[frames] *= factor
    return lifted._replace(keypoints=keypoints, scale=scale)


@pytest.mark.parametrize("factor", [0.8, 1.3])
def test_hidden_legs_are_as_long_as_before(factor: float) -> None:
    world = walker((0.0, 4.0), (0.3, 0.0))
    image, lifted = film(world)
    shown = [j for j, name in enumerate(JOINTS) if "knee" not in name and "ankle" not in name][:7]
    scores = torch.zeros(90, 14, dtype=torch.float64)
    scores[:60], scores[60:, shown] = 1.0, 1.0
    found = misread(image, lifted, slice(60, 90), shown, factor)
    joints, seen = place_seen(MetricPose(person_height_m=(TALL,)), image, scores, found)
    assert seen[60:].sum(dim=-1).unique().tolist() == [7]
    assert float((joints - world).norm(dim=-1).max()) < 0.1
    thigh = (joints[:, 8] - joints[:, 9]).norm(dim=-1)
    assert float(thigh.std() / thigh.mean()) < 0.03


def test_a_part_taken_for_a_small_body_says_nothing() -> None:
    world = walker((0.0, 4.0), (0.5, 0.0))
    image, lifted = film(world)
    shown = [j for j, name in enumerate(JOINTS) if "knee" in name or "ankle" in name]
    scores = torch.ones(90, 14, dtype=torch.float64)
    scores[85:] = 0.0
    scores[85:, shown] = 1.0
    found = misread(image, lifted, slice(85, 90), shown, 0.4)
    joints, seen = place_seen(MetricPose(person_height_m=(TALL,)), image, scores, found)
    assert seen[:85].all()
    assert not seen[85:].any()
    torch.testing.assert_close(joints[85:], joints[84:85].expand(5, -1, -1))
    # A person who looks small while the whole body is visible is far away.
    far = misread(image, lifted, slice(85, 90), list(range(14)), 0.4)
    joints, seen = place_seen(MetricPose(person_height_m=(TALL,)), image, torch.ones_like(scores), far)
    assert seen.all()


def test_size_does_not_count_where_the_left_or_right_edge_cuts_somebody_off() -> None:
    world = walker((1.2, 4.0), (0.6, 0.0))  # walks out of the picture to the right
    image, lifted = film(world)
    assert bool((image[:, :, 0] <= 0.98 * WIDTH).all(dim=-1)[:20].all())
    cut = image.clone()
    cut[..., 0] = cut[..., 0].clamp(max=WIDTH - 1.0)
    frames = int((image[..., 0] < 0.99 * (WIDTH - 1)).all(dim=-1).sum())
    assert 20 < frames < 85, "the picture ends within the film"
    found = misread(image, lifted, slice(frames, 90), list(range(14)), 0.6)
    joints, _ = place_seen(MetricPose(person_height_m=(TALL,)), cut, torch.ones(90, 14).double(), found)
    off = (joints[:, [8, 11], 1].mean(-1) - world[:, [8, 11], 1].mean(-1)).abs()
    assert float(off.max()) < 0.15


def test_size_does_not_count_where_somebody_is_said_to_be_cut_off() -> None:
    """Entering: the box touches the edge, the network places all joints inside, too close together."""
    world = walker((0.0, 5.0), (0.0, -0.8))
    image, lifted = film(world)
    found = misread(image, lifted, slice(0, 8), list(range(14)), 0.6)
    entering = torch.arange(90) < 8
    scores = torch.ones(90, 14, dtype=torch.float64)
    module = MetricPose(person_height_m=(TALL,))

    def furthest_off(cut_off: Tensor | None) -> float:
        joints, _ = place_seen(module, image, scores, found, cut_off)
        return float((joints[:, [8, 11], 1].mean(-1) - world[:, [8, 11], 1].mean(-1)).abs().max())

    assert furthest_off(entering) < 0.1
    assert furthest_off(None) >= 0.1


def test_a_lifted_walker_recedes_at_its_speed() -> None:
    """The whole way: a pool that has other poses, noise of 2 px, and no knowledge of the scale."""
    world = walker((0.2, 3.0), (0.0, 1.3))
    image, _ = film(world)
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    image = image + 2.0 * noise
    lifted = NearestPoseLifter()(image.float(), torch.ones(90, 14))
    joints = place(MetricPose(person_height_m=(TALL,)), image.float(), lifted).double()
    root, true = mid_hips(joints), mid_hips(world)
    speed = (root[1:, 1] - root[:-1, 1]) * FPS
    assert float(speed.mean()) == pytest.approx(1.3, abs=0.13)
    assert float((speed - 1.3).square().mean().sqrt()) < 0.35
    assert float((root - true)[:, 1].abs().mean()) < 0.25
    raw = TALL * FOCAL / lifted.scale.double()
    assert float((raw[1:] - raw[:-1] - 1.3 / FPS).std()) * FPS > 3 * float(
        (speed - 1.3).std()
    )  # what smoothing is for


def test_ankles_stand_at_zero_which_is_the_sole_less_the_ankle_height() -> None:
    """The floor is where the lower ankle is: heights are short of the truth by the ankle's own height."""
    standing = forward_kinematics(BodyPose.standing((40,)), TALL) + torch.tensor([0.0, 4.0, 0.0])
    image, lifted = film(standing)
    joints = place(MetricPose(person_height_m=(TALL,)), image, lifted)
    assert float(lowest_ankle(joints).abs().max()) < 1e-6
    neck = (0.818 - ANKLE_HEIGHT) * TALL
    assert float(joints[0, 1, 2]) == pytest.approx(neck, abs=0.02)


# ---- thresholds, from both sides ----------------------------------------------------------------------------


def range_of_late_frames(image: Tensor, lifted: Lifted, scores: Tensor) -> float:
    joints, _ = place_seen(MetricPose(person_height_m=(TALL,)), image, scores, lifted)
    return float(mid_hips(joints)[75:, 1].mean())


@pytest.mark.parametrize(("seen", "trusted"), [(7, False), (8, True)])
def test_eight_joints_make_a_reliable_size(seen: int, trusted: bool) -> None:
    image, lifted = film(walker((0.0, 4.0), (0.3, 0.0)))
    scores = torch.ones(90, 14, dtype=torch.float64)
    scores[60:, seen:] = 0.0
    lifted = lifted._replace(scale=torch.cat([lifted.scale[:60], lifted.scale[60:] / 1.05]))
    assert range_of_late_frames(image, lifted, scores) == pytest.approx(4.2 if trusted else 4.0, abs=0.06)


@pytest.mark.parametrize(("error", "trusted"), [(0.249, True), (0.251, False)])
def test_a_pose_that_fits_badly_has_no_reliable_size(error: float, trusted: bool) -> None:
    image, lifted = film(walker((0.0, 4.0), (0.3, 0.0)))
    distance = lifted.distance.clone()
    distance[60:] = error
    scale = torch.cat([lifted.scale[:60], lifted.scale[60:] / 1.05])
    found = lifted._replace(scale=scale, distance=distance)
    late = range_of_late_frames(image, found, torch.ones(90, 14, dtype=torch.float64))
    assert late == pytest.approx(4.2 if trusted else 4.0, abs=0.06)


@pytest.mark.parametrize(("factor", "kept"), [(0.64, False), (0.66, True)])
def test_a_part_of_less_than_two_thirds_of_the_size_is_discarded(factor: float, kept: bool) -> None:
    image, lifted = film(walker((0.0, 4.0), (0.0, 0.0)))
    shown = [j for j, name in enumerate(JOINTS) if "knee" in name or "ankle" in name]
    scores = torch.zeros(90, 14, dtype=torch.float64)
    scores[:85], scores[85:, shown] = 1.0, 1.0
    found = misread(image, lifted, slice(85, 90), shown, factor)
    _, seen = place_seen(MetricPose(person_height_m=(TALL,)), image, scores, found)
    assert bool(seen[85:].any()) is kept


@pytest.mark.parametrize("fps", [30.0, 1.0])
def test_the_focal_length_comes_from_the_first_half_second(fps: float) -> None:
    """Median of 15 valid frames at 30 per second, of one frame where half a second has none."""
    scale = torch.linspace(300.0, 600.0, 40, dtype=torch.float64)[None]
    valid = torch.ones(1, 40, dtype=torch.bool)
    valid[0, :3] = False
    metres = [torch.full((1, 1), x, dtype=torch.float64) for x in (4.0, 1.6)]
    focal = MetricPose()._focal_from(metres[0], metres[1], scale, torch.full_like(scale, 0.1), valid, fps)
    middle = float(scale[0, 3 + 7]) if fps == 30.0 else float(scale[0, 3])
    torch.testing.assert_close(focal, torch.full_like(scale, middle * (4.0 / 1.6 + 0.1)))


def test_usual_settings() -> None:
    module = MetricPose()
    assert module.heights.tolist() == [1.80, 1.70]
    assert module.distances.tolist() == [4.00, 0.50]
    assert (module.keypoint_threshold, module.mode, module.calibrated) == (0.3, "camera", False)
    assert (module.range_smoothing_s, module.floor_window_s) == (0.3, 1.5)
    other = MetricPose(None, (1.6,), (3.0,), 0.4, "paper", 0.2, 1.0, True)
    seen_by = other.seen_by(CameraConfig(focal_px=900.0))
    assert (seen_by.camera.focal_px, seen_by.heights.tolist(), seen_by.distances.tolist()) == (
        900.0,
        [1.6],
        [3.0],
    )
    assert (seen_by.keypoint_threshold, seen_by.mode, seen_by.calibrated) == (0.4, "paper", True)
    assert (seen_by.range_smoothing_s, seen_by.floor_window_s) == (0.2, 1.0)
    assert MetricPose().seen_by(CameraConfig()).distance_gives_focal is False
