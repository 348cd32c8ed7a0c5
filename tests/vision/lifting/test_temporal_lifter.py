"""The temporal lifter: geometry against projection in NumPy, blocks against the whole, what it learns to see."""

import math
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts
from tensorsim.body.skeleton import (
    BONES,
    MIRRORED,
    MIRRORED_JOINTS,
    body_to_coco,
    coco_to_body,
    mid_hips,
    mirror,
)
from tensorsim.config import CameraConfig, PoseConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.camera import camera_to_world, project
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.vision.lifting.sight import level_sight, turned_back, windowed_mean
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter, along_axes
from tensorsim.vision.lifting.temporal_net import TemporalNet
from tests.stage import StageTester

CAMERA = CameraConfig(position_m=(0.3, -1.0, 1.9), pitch_rad=-0.3, yaw_rad=0.2, horizontal_fov_rad=1.2)
HEIGHT, WIDTH = 480, 640


def network(seed: int = 0, channels: int = 16) -> TemporalNet:
    """A small network whose answers depend on everything it sees."""
    torch.manual_seed(seed)
    net = TemporalNet(channels)
    nn.init.normal_(net.leave.weight, std=0.05)
    return net.eval()


def filmed(frames: int = 24, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """A generated walk before CAMERA: joints, keypoints, scores, boxes, valid, each for one person."""
    joints = ActivityGenerator().generate("walking", 1, seed, frames / 30).joints[0]
    focal = WIDTH / 2 / math.tan(CAMERA.horizontal_fov_rad / 2)
    center = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    pixels, _ = project(body_to_coco(joints), focal, center, camera_to_world(CAMERA))
    boxes = torch.cat([pixels.amin(dim=-2) - 5, pixels.amax(dim=-2) + 5], dim=-1)
    scores = torch.full((frames, 17), 0.9, dtype=joints.dtype)
    return joints, pixels[None], scores[None], boxes[None], torch.ones(1, frames, dtype=torch.bool)


class TestTemporalLifter(StageTester):
    batched_arguments: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)
    gradient_arguments: ClassVar[tuple[int, ...]] = (0,)
    gradient_atol: ClassVar[float] = 1e-4

    def make(self) -> nn.Module:
        return TemporalLifter(network(), CAMERA, (1.7, 1.6), frames_per_block=5)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        _, keypoints, scores, boxes, valid = filmed(12)
        generator = torch.Generator().manual_seed(1)
        shape = (*batch, 2)
        noise = 3 * torch.randn(*shape, 12, 17, 2, generator=generator, dtype=torch.float64)
        scores = scores.expand(*shape, 12, 17).clone()
        scores[..., 3, 7] = 0.1  # hidden
        valid = valid.expand(*shape, 12).clone()
        valid[..., 1, 5:7] = False  # nobody
        return (
            (keypoints + noise).to(dtype), scores.to(dtype), boxes.expand(*shape, 12, 4).to(dtype), valid,
            HEIGHT, WIDTH, 30.0,
        )  # fmt: skip

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        k, s, b, v, *rest = self.inputs((1,), torch.float32)
        broken = k.clone()
        broken[0, 0, 0, 0, 0] = float("nan")
        return [
            ((k[..., :16, :], s, b, v, *rest), "17"),
            ((k, s[..., :3], b, v, *rest), "scores"),
            ((k, s, b[..., :3], v, *rest), "boxes"),
            ((k, s, b, v[..., :3], *rest), "valid"),
            ((k, s, b, v.float(), *rest), "bool"),
            ((broken, s, b, v, *rest), "keypoints"),
            ((k, s, b, v, 0, WIDTH, 30.0), "image"),
            ((k, s, b, v, HEIGHT, WIDTH, 0.0), "fps"),
            ((k[:, :, :0], s[:, :, :0], b[:, :, :0], v[:, :, :0], *rest), "frame"),
        ]


class TestBeforeAnEstimatedCamera(TestTemporalLifter):
    def make(self) -> nn.Module:
        return TemporalLifter(network(), CAMERA, (1.7, 1.6), frames_per_block=5, camera_known=False)


def test_joints_lie_on_the_lines_of_sight_of_their_keypoints() -> None:
    """An untrained network moves no keypoint: projected back, its joints are at the pixels that it was given."""
    torch.manual_seed(0)
    net = TemporalNet(16)
    with torch.no_grad():  # depths and sizes at random, no shifts
        net.leave.weight[28:43].normal_(std=0.1)
    joints, keypoints, scores, boxes, valid = filmed()
    lifter = TemporalLifter(net, CAMERA, (1.7,)).double().eval()
    with torch.no_grad():
        found = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0)
        body, _ = coco_to_body(keypoints, scores)
        lifted = lifter.in_picture(
            found, body + 1.0, scores[..., :14] * 0, HEIGHT, WIDTH, 30.0
        )  # none is seen
    points = (found.joints + found.root[..., None, :])[0].numpy() - np.array(CAMERA.position_m)
    pose = camera_to_world(CAMERA).numpy()[:, :3]
    local = points @ pose
    focal = WIDTH / 2 / math.tan(CAMERA.horizontal_fov_rad / 2)
    pixels = focal * local[..., :2] / local[..., 2:] + np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    np.testing.assert_allclose(pixels, body[0].numpy(), atol=1e-6)
    torch.testing.assert_close(lifted.keypoints, body, atol=1e-6, rtol=0)
    assert float(mid_hips(found.joints).abs().max()) < 1e-9
    assert (
        float((found.joints[0] - (joints - mid_hips(joints)[:, None])).abs().max()) > 0.1
    )  # depths at random


def test_metric_pose_places_what_the_lifter_found() -> None:
    """Through ``in_picture`` and MetricPose, an upright body comes out where the lifter has it."""
    _, keypoints, scores, boxes, valid = filmed()
    keypoints, scores, boxes = (x[:, :1].expand_as(x).contiguous() for x in (keypoints, scores, boxes))
    torch.manual_seed(0)
    net = TemporalNet(16)
    nn.init.normal_(net.leave.bias[28:42], std=0.04)  # depths
    lifter = TemporalLifter(net, CAMERA, (1.7,)).double().eval()
    with torch.no_grad():
        found = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0)
        body, _ = coco_to_body(keypoints, scores)
        lifted = lifter.in_picture(found, body, scores[..., :14], HEIGHT, WIDTH, 30.0)
        place = ts.vision.MetricPose(CAMERA, (1.7,), calibrated=True)
        joints, _ = place(lifted.keypoints, scores[..., :14], lifted, valid, HEIGHT, WIDTH, 30.0)
    torch.testing.assert_close(joints, found.joints + found.root[..., None, :], atol=1e-5, rtol=0)


def test_keypoints_that_are_nearly_right_stay_and_others_move() -> None:
    _, keypoints, scores, boxes, valid = filmed()
    torch.manual_seed(0)
    lifter = TemporalLifter(TemporalNet(16), CAMERA, (1.7,)).double().eval()  # moves no keypoint
    body, _ = coco_to_body(keypoints, scores)
    jittery, wrong = body.clone(), body.clone()
    with torch.no_grad():
        found = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0)
        unit = lifter.in_picture(found, body, scores[..., :14], HEIGHT, WIDTH, 30.0).scale[0, :, None]
        jittery[..., 4, :] += 0.05 * unit * torch.tensor([1.0, 0.0])
        wrong[..., 4, :] += 0.2 * unit * torch.tensor([1.0, 0.0])
        near = lifter.in_picture(found, jittery, scores[..., :14], HEIGHT, WIDTH, 30.0).keypoints
        far = lifter.in_picture(found, wrong, scores[..., :14], HEIGHT, WIDTH, 30.0).keypoints
    torch.testing.assert_close(near, jittery, atol=1e-6, rtol=0)
    torch.testing.assert_close(far, body, atol=1e-6, rtol=0)


def test_a_joint_does_not_jump_to_a_wrong_keypoint_and_back() -> None:
    _, keypoints, scores, boxes, valid = filmed(40)
    torch.manual_seed(0)
    lifter = TemporalLifter(TemporalNet(16), CAMERA, (1.7,)).double().eval()  # moves no keypoint
    body, _ = coco_to_body(keypoints, scores)
    spoilt = body.clone()
    with torch.no_grad():
        found = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0)
        unit = lifter.in_picture(found, body, scores[..., :14], HEIGHT, WIDTH, 30.0).scale[0, :, None]
        spoilt[0, :, 4, 0] += 0.05 * unit[:, 0]  # near enough
        spoilt[0, 20, 4, 0] += 0.2 * unit[20, 0]
        lifted = lifter.in_picture(found, spoilt, scores[..., :14], HEIGHT, WIDTH, 30.0)
    share = (lifted.keypoints - body)[0, :, 4, 0] / (0.05 * unit[:, 0])
    # Three frames to each side make a tenth of a second.
    expected = torch.ones(40, dtype=share.dtype)
    expected[14:27] = torch.tensor([1, 2, 3, 4, 5, 6, 7, 6, 5, 4, 3, 2, 1]) / -7 + 1
    torch.testing.assert_close(share, expected, atol=1e-6, rtol=0)


def test_a_mirrored_film_gives_the_mirrored_motion() -> None:
    camera = CameraConfig(position_m=(0.0, 0.0, 1.9), pitch_rad=-0.3, horizontal_fov_rad=1.2)
    lifter = TemporalLifter(network(), camera, (1.7,)).double().eval()
    _, keypoints, scores, boxes, valid = filmed()
    scores[0, 5:9, 9] = 0.1  # a wrist that is not seen for a while
    other = list(MIRRORED)
    turned = keypoints[..., other, :] * torch.tensor([-1.0, 1.0]) + torch.tensor([WIDTH - 1.0, 0.0])
    edges = torch.stack(
        [WIDTH - 1 - boxes[..., 2], boxes[..., 1], WIDTH - 1 - boxes[..., 0], boxes[..., 3]], -1
    )
    with torch.no_grad():
        plain = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0)
        back = lifter(turned, scores[..., other], edges, valid, HEIGHT, WIDTH, 30.0)
    torch.testing.assert_close(mirror(back.joints), plain.joints, atol=1e-9, rtol=0)
    torch.testing.assert_close(back.root * torch.tensor([-1.0, 1.0, 1.0]), plain.root, atol=1e-9, rtol=0)
    spread = back.deviation[..., list(MIRRORED_JOINTS), :]
    torch.testing.assert_close(spread, plain.deviation, atol=1e-9, rtol=0)
    torch.testing.assert_close(back.root_deviation, plain.root_deviation, atol=1e-9, rtol=0)


def test_tilt_turn_and_focal_length_are_taken_out() -> None:
    """The same people seen by another camera at the same place look the same to the network."""
    joints, *_ = filmed()
    sights = []
    for pitch, yaw, fov in ((0.0, 0.0, 1.0), (-0.4, 0.1, 1.3)):
        camera = CameraConfig(
            position_m=CAMERA.position_m, pitch_rad=pitch, yaw_rad=yaw, horizontal_fov_rad=fov
        )
        focal = WIDTH / 2 / math.tan(fov / 2)
        center = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
        pose = camera_to_world(camera)
        pixels, _ = project(body_to_coco(joints), focal, center, pose)
        body, _ = coco_to_body(pixels, torch.ones(pixels.shape[:-1], dtype=pixels.dtype))
        one = torch.ones(1, dtype=torch.float64)
        frames = len(joints)
        sights.append(
            level_sight(
                pixels[None], one.expand(1, frames, 17), body[None], one.expand(1, frames, 14),
                torch.zeros(1, frames, 4, dtype=torch.float64), torch.ones(1, frames, dtype=torch.bool), focal * one,
                torch.tensor([center], dtype=torch.float64), pose[None, :, :3],
                torch.tensor([[WIDTH, HEIGHT]], dtype=torch.float64), 30 * one, one,
            )
        )  # fmt: skip
    torch.testing.assert_close(sights[0].joints, sights[1].joints, atol=5e-3, rtol=0)
    torch.testing.assert_close(sights[0].size, sights[1].size, rtol=5e-3, atol=0)
    torch.testing.assert_close(sights[0].azimuth, sights[1].azimuth, atol=5e-3, rtol=0)


@pytest.mark.parametrize("known", [True, False])
def test_blocks_equal_the_whole(known: bool) -> None:
    """A long film in blocks with overlap gives what it gives in one piece."""
    _, keypoints, scores, boxes, valid = filmed(150)
    valid[0, 60:75] = False
    arguments = (keypoints.float(), scores.float(), boxes.float(), valid, HEIGHT, WIDTH, 30.0)
    with torch.no_grad():
        whole = TemporalLifter(network(), CAMERA, camera_known=known)(*arguments)
        parts = TemporalLifter(network(), CAMERA, frames_per_block=40, camera_known=known)(*arguments)
    for one, other in zip(whole, parts, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("fps", "films"), [(44.0, 1), (50.0, 2), (120.0, 4)])
def test_a_fast_film_is_seen_as_several_of_about_30_frames_per_second(fps: float, films: int) -> None:
    """The window of the network is a number of frames, so that of a fast film would be short."""
    _, keypoints, scores, boxes, valid = filmed(40)
    inputs = [x.expand(2, *x.shape[1:]) for x in (keypoints, scores, boxes, valid)]
    lifter = TemporalLifter(network().double(), CAMERA, (1.7, 1.6), frames_per_block=7)
    with torch.no_grad():
        found = lifter(*inputs, HEIGHT, WIDTH, fps)
        for first in range(films):
            alone = lifter(*(x[:, first::films] for x in inputs), HEIGHT, WIDTH, fps / films)
            for one, other in zip(found, alone, strict=True):
                torch.testing.assert_close(one[:, first::films], other, atol=1e-9, rtol=0)
        shorter = lifter(*(x[:, :39] for x in inputs), HEIGHT, WIDTH, fps)
    assert shorter.joints.shape == (2, 39, 14, 3)
    assert bool(torch.isfinite(shorter.joints).all())


def test_tracks_cost_time_only_around_the_frames_in_which_they_are() -> None:
    keypoints, scores, boxes, valid = (x.expand(2, *x.shape[1:]) for x in filmed(600)[1:])
    valid = valid.clone()
    valid[0, 60:], valid[1, :540] = False, False
    looked: list[int] = []
    lifter = TemporalLifter(network().double(), CAMERA)
    lifter.network.register_forward_pre_hook(
        lambda _, sight: looked.append(sight[0].joints[..., 0, 0].numel())
    )
    with torch.no_grad():
        found = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0)
        frames = sum(looked) / 2  # people and their mirror images
        lifter.frames_per_block = 600
        whole = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0)
    assert frames < 0.75 * valid.numel()
    for one, other in zip(found, whole, strict=True):
        torch.testing.assert_close(one[valid], other[valid], atol=1e-9, rtol=0)
        assert bool(torch.isfinite(one).all())


def test_for_another_camera_the_settings_are_the_same() -> None:
    lifter = TemporalLifter(network(), CAMERA, (1.7,), keypoint_threshold=0.4, frames_per_block=99)
    lifter.near, lifter.gives_way_s = 0.1, 0.3
    other = lifter.seen_by(CameraConfig(focal_px=900.0))
    assert (other.near, other.gives_way_s, other.keypoint_threshold) == (0.1, 0.3, 0.4)
    assert (other.frames_per_block, other.heights.tolist(), other.camera_known) == (99, [1.7], True)
    assert other.pinhole.focal_length(100) == 900.0


def test_before_an_estimated_camera_bones_have_their_lengths() -> None:
    """A person who keeps still: the same picture, from where all bones together are 2.39 standing heights long."""
    _, keypoints, scores, boxes, valid = filmed(60)
    keypoints, boxes = (x[:, :1].expand_as(x) for x in (keypoints, boxes))
    lifter = TemporalLifter(network(), CAMERA, (1.7,)).double()
    estimated = lifter.seen_by(CAMERA, known=False)
    with torch.no_grad():
        known, found = (
            part(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0) for part in (lifter, estimated)
        )
    points = torch.cat([found.joints, mid_hips(found.joints)[..., None, :]], dim=-2)
    lengths = [(points[..., a, :] - points[..., b, :]).norm(dim=-1) for a, b in BONES]
    total = torch.stack(lengths).sum(dim=0)[0, 30]
    assert float(total) == pytest.approx(
        2.39 * 1.7, rel=1e-4
    )  # the ends of the film are seen a little otherwise
    camera_m = torch.tensor(CAMERA.position_m, dtype=torch.float64)
    seen = [p.joints[0, 30] + p.root[0, 30] - camera_m for p in (known, found)]
    ratio = seen[1].norm(dim=-1) / seen[0].norm(dim=-1)
    assert abs(float(ratio[0]) - 1) > 0.01
    torch.testing.assert_close(seen[1], ratio[0] * seen[0])


def test_frames_out_of_reach_have_no_say() -> None:
    _, keypoints, scores, boxes, valid = filmed(120)
    lifter = TemporalLifter(network(), CAMERA).double()
    other = keypoints.clone()
    other[0, 0] += 40.0
    with torch.no_grad():
        before = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0).joints[0]
        after = lifter(other, scores, boxes, valid, HEIGHT, WIDTH, 30.0).joints[0]
    change = (after - before).abs().amax(dim=(1, 2))
    assert float(change[: lifter.reach // 2].max()) > 1e-4
    assert float(change[lifter.reach + 1 :].max()) < 1e-9


def test_deviations_follow_the_line_of_sight() -> None:
    across, along = torch.tensor([0.1]), torch.tensor([0.3])
    for degrees, expected in ((0.0, [0.1, 0.3, 0.1]), (90.0, [0.3, 0.1, 0.1])):
        angle = math.radians(degrees)
        azimuth = torch.tensor([[math.cos(angle), math.sin(angle)]])
        torch.testing.assert_close(along_axes(across, along, azimuth)[0], torch.tensor(expected))
    ahead = torch.tensor([[[[0.0, 2.0, 0.0]]]])
    torch.testing.assert_close(
        turned_back(ahead, torch.tensor([[[0.0, 1.0]]])), torch.tensor([[[[2.0, 0.0, 0.0]]]])
    )


def test_deviations_are_those_of_laplaces_distribution() -> None:
    """sqrt(2) of the mean absolute error, which is in body heights for joints and a share of the distance for hips."""
    torch.manual_seed(0)
    net = TemporalNet(16)
    with torch.no_grad():  # the network subtracts 3
        net.leave.bias[43:71:2], net.leave.bias[44:71:2] = math.log(0.02) + 3, math.log(0.05) + 3
        net.leave.bias[71] = math.log(0.04) + 3
    _, *seen = filmed()
    with torch.no_grad():
        found = TemporalLifter(net, CAMERA, (1.7,)).double()(*seen, HEIGHT, WIDTH, 30.0)
    square = found.deviation.numpy() ** 2
    np.testing.assert_allclose(square[..., 2], 2 * (0.02 * 1.7) ** 2, rtol=1e-6)
    np.testing.assert_allclose(square[..., :2].sum(-1), 2 * (0.02**2 + 0.05**2) * 1.7**2, rtol=1e-6)
    distance = np.linalg.norm((found.root.numpy() - np.array(CAMERA.position_m))[..., :2], axis=-1)
    square = found.root_deviation.numpy() ** 2
    np.testing.assert_allclose(square[..., 2], 2 * (0.3 * 0.04 * distance) ** 2, rtol=1e-6)
    np.testing.assert_allclose(square[..., :2].sum(-1), 2 * (1 + 0.3**2) * (0.04 * distance) ** 2, rtol=1e-6)


def test_windowed_mean_is_that_of_numpy() -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(1, 40, 1, generator=generator, dtype=torch.float64)
    weight = (torch.rand(1, 40, generator=generator) < 0.7).double()
    mean = windowed_mean(x, weight)[0, :, 0]
    for t in (0, 7, 20, 39):
        inside = slice(max(t - 10, 0), t + 11)
        expected = np.average(x[0, inside, 0].numpy(), weights=weight[0, inside].numpy())
        assert float(mean[t]) == pytest.approx(expected)


def test_refuses_settings_that_cannot_be() -> None:
    with pytest.raises(TensorsimError, match="person_height_m"):
        TemporalLifter(network(), person_height_m=())
    with pytest.raises(TensorsimError, match="frames_per_block"):
        TemporalLifter(network(), frames_per_block=0)
    with pytest.raises(TensorsimError, match="library"):
        PoseConfig(lifter="temporal", library="pool.safetensors")
    with pytest.raises(TensorsimError, match="lifter"):
        PoseConfig(lifter="best")  # type: ignore[arg-type]


def sight_in_numpy(
    keypoints: np.ndarray, scores: np.ndarray, joints: np.ndarray, joint_scores: np.ndarray, boxes: np.ndarray,
    valid: np.ndarray, focal: float, center: np.ndarray, rotation: np.ndarray, extent: np.ndarray, fps: float,
    camera_height: float,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """One track, frame by frame, with angles: features (T, 67), joints (T, 14, 2), elevation, size, azimuth (T,)."""
    frames = len(keypoints)

    def ray(pixel: np.ndarray) -> np.ndarray:
        return rotation @ np.array([*((pixel - center) / focal), 1.0])

    seen = (scores >= 0.3) & valid[:, None]
    towards = np.zeros((frames, 3))
    for t in np.flatnonzero(seen.sum(axis=1) >= 3):
        units = [ray(k) / np.linalg.norm(ray(k)) for k in keypoints[t, seen[t]]]
        towards[t] = np.mean(units, axis=0)
    near = [slice(max(t - 10, 0), t + 11) for t in range(frames)]
    counts = seen.sum(axis=1)
    direction = np.array([towards[s][counts[s] >= 3].mean(axis=0) for s in near])
    azimuth = np.arctan2(direction[:, 0], direction[:, 1])
    elevation = direction[:, 2] / np.hypot(direction[:, 0], direction[:, 1])

    def on_plane(t: int, pixel: np.ndarray) -> np.ndarray:
        x, y, z = ray(pixel)
        c, s = math.cos(azimuth[t]), math.sin(azimuth[t])
        return np.array([x * c - y * s, z]) / (x * s + y * c)

    log_size = np.zeros(frames)
    for t in np.flatnonzero(counts >= 5):
        points = np.array([on_plane(t, k) for k in keypoints[t, seen[t]]])
        log_size[t] = np.log(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))) / 2
    size = np.exp([log_size[s][counts[s] >= 5].mean() for s in near])
    features, found = [], []
    for t in range(frames):
        offset = np.array([0.0, elevation[t]])
        spot = [(on_plane(t, k) - offset) / size[t] * s for k, s in zip(keypoints[t], seen[t], strict=True)]
        shown = (joint_scores[t] >= 0.3) & valid[t]
        found.append([(on_plane(t, j) - offset) / size[t] * s for j, s in zip(joints[t], shown, strict=True)])
        left, top, right, bottom = boxes[t]
        middle = [(left + right) / 2, (top + bottom) / 2]
        edges = [
            on_plane(t, np.array([left, middle[1]]))[0] / size[t],
            on_plane(t, np.array([right, middle[1]]))[0] / size[t],
            (on_plane(t, np.array([middle[0], top]))[1] - elevation[t]) / size[t],
            (on_plane(t, np.array([middle[0], bottom]))[1] - elevation[t]) / size[t],
        ]
        wide, tall = right - left, bottom - top
        room = np.clip(
            [left / wide, (extent[0] - right) / wide, top / tall, (extent[1] - bottom) / tall], 0, 1
        )
        more = [elevation[t], 1 + 0.5 * np.log(size[t]), valid[t], 30 / fps, counts[t] >= 5]
        there = float(valid[t])
        # 1 / (distance of the floor where a point of the picture shows it), over the size, with both in heights.
        lowest = min(
            [on_plane(t, k)[1] for k, s in zip(keypoints[t], seen[t], strict=True) if s], default=np.inf
        )
        bottom_edge = elevation[t] + size[t] * np.clip(edges[3], -8, 8) * there
        floor = [np.clip(-e / camera_height / size[t], -4, 8) / 4 for e in (lowest, bottom_edge)]
        floor = np.array(floor) if counts[t] >= 5 else np.zeros(2)
        more += [*floor, np.log(camera_height)]
        parts = [np.ravel(spot), scores[t] * seen[t], np.array(edges) * there, room * there, more]
        features.append(np.concatenate(parts))
    return np.array(features), np.array(found), elevation, size, azimuth


def test_features_are_those_of_angles_in_numpy() -> None:
    _, keypoints, scores, boxes, valid = filmed(30)
    keypoints = keypoints + 3 * torch.randn(keypoints.shape, generator=torch.Generator().manual_seed(4))
    boxes = boxes.clone()
    boxes[0, :, 1] -= 30.0  # nearer to the upper edge of the picture than it is high
    scores, valid = scores.clone(), valid.clone()
    scores[0, 4, 7], scores[0, 9, 4:], scores[0, 11, 2:], scores[0, 13, 5] = 0.29, 0.1, 0.1, 0.3
    valid[0, 20:23] = False
    joints, joint_scores = coco_to_body(keypoints, scores)
    rotation = camera_to_world(CAMERA)[:, :3].double()
    focal, center = WIDTH / 2 / math.tan(CAMERA.horizontal_fov_rad / 2), ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    arguments = (keypoints, scores, joints, joint_scores, boxes, valid)
    sight = level_sight(
        *arguments,
        torch.tensor([focal]).double(),
        torch.tensor([center]).double(),
        rotation[None],
        torch.tensor([[WIDTH, HEIGHT]]).double(),
        torch.tensor([24.0]).double(),
        torch.tensor([1.2]).double(),
    )
    expected = sight_in_numpy(
        *(x[0].numpy() for x in arguments), focal, np.array(center), rotation.numpy(),
        np.array([WIDTH, HEIGHT]), 24.0, 1.2,
    )  # fmt: skip
    angle = torch.atan2(sight.azimuth[0, :, 1], sight.azimuth[0, :, 0])
    for mine, theirs in zip((*sight[:4], angle[None]), expected, strict=True):
        np.testing.assert_allclose(mine[0].numpy(), theirs, atol=2e-5)


def test_where_nobody_is_seen_for_long_the_camera_looks() -> None:
    """Direction ahead of the camera, and a size of 0.08."""
    _, keypoints, scores, boxes, valid = filmed(4)
    joints, joint_scores = coco_to_body(keypoints, scores * 0)
    one = torch.ones(1, dtype=torch.float64)
    rotation = camera_to_world(CAMERA)[None, :, :3].double()
    sight = level_sight(
        keypoints, scores * 0, joints, joint_scores, boxes, valid, 500 * one, torch.tensor([[319.5, 239.5]]).double(),
        rotation, torch.tensor([[WIDTH, HEIGHT]]).double(), 30 * one, one,
    )  # fmt: skip
    assert sight.size.unique().tolist() == pytest.approx([0.08])
    np.testing.assert_allclose(sight.elevation.numpy(), math.tan(CAMERA.pitch_rad), rtol=1e-6)
    assert float(torch.atan2(sight.azimuth[0, 0, 1], sight.azimuth[0, 0, 0])) == pytest.approx(CAMERA.yaw_rad)
    assert not sight.joints.any()


@pytest.mark.parametrize(("shift", "moved"), [(0.5, 0.0), (1.5, 0.5), (2.1, 1.0), (5.0, 1.0)])
def test_keypoints_far_from_the_found_body_give_way_to_it(shift: float, moved: float) -> None:
    """Up to ``near`` standing heights they stay, from twice that on the body's joints take their places."""
    torch.manual_seed(0)
    _, keypoints, scores, boxes, valid = filmed()
    lifter = TemporalLifter(TemporalNet(16), CAMERA, (1.7,)).double().eval()
    with torch.no_grad():
        found = lifter(keypoints, scores, boxes, valid, HEIGHT, WIDTH, 30.0)
        body, seen = coco_to_body(keypoints, scores)
        exact = lifter.in_picture(
            found, body, 0 * seen, HEIGHT, WIDTH, 30.0
        )  # the found body, where nothing is seen
        away = exact.keypoints + torch.tensor([1.0, 0.0]) * shift * lifter.near * exact.scale[..., None, None]
        lifted = lifter.in_picture(found, away, torch.ones_like(seen), HEIGHT, WIDTH, 30.0)
    share = ((away - lifted.keypoints)[..., 0] / (away - exact.keypoints)[..., 0]).mean()
    assert float(share) == pytest.approx(moved, abs=0.005)  # the scale is that of the joints that count
    if shift < 1.0:
        assert torch.equal(lifted.keypoints, away)
