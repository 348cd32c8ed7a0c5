import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.skeleton import body_height
from tensorsim.config import CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.camera import camera_to_world
from tensorsim.render.body import build_body
from tensorsim.render.cast import View, Volumes, cast
from tensorsim.render.look import Look, Surface, paint
from tensorsim.render.renderer import (
    FLESH_M,
    HIDDEN,
    OUTSIDE,
    VISIBLE,
    PersonRenderer,
    RenderedVideo,
    Shadows,
)
from tensorsim.render.scene import Light

CAMERA = CameraConfig(position_m=(0.2, -0.1, 1.2), pitch_rad=-0.08, yaw_rad=0.1)
SMALL = {"height": 96, "width": 160}


def person(
    x: float = 0.4,
    y: float = 3.5,
    heading: float = math.pi,
    frames: int = 1,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """A body that lifts its right arm sideways, standing on the floor: (frames, 14, 3)."""
    lift = torch.linspace(0.4, 0.8, frames, dtype=torch.float64)
    pose = BodyPose.standing((frames,))
    shoulder = pose.shoulder.clone()
    shoulder[:, 0, 1] = lift
    pose = pose._replace(heading=torch.full((frames,), heading, dtype=torch.float64), shoulder=shoulder)
    joints = forward_kinematics(pose, 1.75)
    joints = joints - joints[..., 2].amin() * joints.new_tensor([0, 0, 1]) + joints.new_tensor([x, y, 0.07])
    return joints.to(dtype)


def film(joints: Tensor, seed: int = 0, **settings: object) -> RenderedVideo:
    settings = {"camera": CAMERA, **SMALL, **settings}
    return PersonRenderer(**settings)(joints, seed=seed)  # type: ignore[arg-type]


def volumes(count: int, seed: int = 0, flat: bool = True) -> Volumes:
    """Random tapered capsules 3 m in front of the camera."""
    g = torch.Generator().manual_seed(seed)
    start = torch.rand(count, 3, generator=g, dtype=torch.float64) * 1.4 + torch.tensor([-0.5, 2.4, 0.5])
    end = start + 0.5 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    axes = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64))[0]
    radii = 0.05 + 0.1 * torch.rand(2, count, generator=g, dtype=torch.float64)
    depth = 0.5 + torch.rand(count, generator=g, dtype=torch.float64) if flat else torch.ones(count).double()
    return Volumes(start, end, radii[0], radii[1], axes, start, depth, torch.ones(count).double())


def marched(v: Volumes, index: int, origin: np.ndarray, direction: np.ndarray) -> float:
    """First hit found by walking a ray in small steps through the union of spheres, and refining."""
    front, stretch = v.axes[index, 1].numpy(), 1 / float(v.depth[index]) - 1

    def squash(p: np.ndarray) -> np.ndarray:
        return p + stretch * (p @ front)[..., None] * front

    s = np.linspace(0, 1, 400)
    a, b = v.start[index].numpy(), v.end[index].numpy()
    centres, radii = squash(a + s[:, None] * (b - a)), v.start_radius[index].item() * (1 - s)
    radii = radii + s * v.end_radius[index].item()

    def inside(t: np.ndarray) -> np.ndarray:
        points = squash(origin + t[:, None] * direction)
        return (np.linalg.norm(points[:, None] - centres, axis=-1) < radii).any(axis=1)

    t = np.linspace(1, 6, 2000)
    hit = inside(t)
    if not hit.any():
        return math.inf
    low, high = t[max(hit.argmax() - 1, 0)], t[hit.argmax()]
    fine = np.linspace(low, high, 60)
    return float(fine[inside(fine).argmax()])


# ---- rays ----------------------------------------------------------------------------------------------


def test_casting_agrees_with_marching_through_spheres() -> None:
    v = volumes(6)
    view = View.of_camera(CAMERA, 24, 40, torch.zeros((), dtype=torch.float64))
    checked = 0
    for index in range(6):
        one = Volumes(*(x[index : index + 1] for x in v))
        hits = cast(one, torch.zeros(1, dtype=torch.int64), view)
        met = torch.isfinite(hits.depth)
        assert met.any()
        for pixel in met.nonzero()[::3, 0].tolist():
            expected = marched(v, index, view.origins[0].numpy(), view.directions[pixel].numpy())
            if math.isfinite(expected):  # grazing rays slip between the steps
                assert float(hits.depth[pixel]) == pytest.approx(expected, abs=2e-3)
                checked += 1
    assert checked > 25


def test_no_hit_is_missed_outside_the_windows() -> None:
    v = volumes(8, seed=3)
    view = View.of_camera(CAMERA, 48, 80, torch.zeros((), dtype=torch.float64))

    class Everywhere(View):
        def windows(self, volumes: Volumes) -> Tensor:
            return torch.tensor([[0, 0, 80, 48]]).expand(len(volumes.start), 4)

    owner = torch.zeros(8, dtype=torch.int64)
    torch.testing.assert_close(cast(v, owner, view).depth, cast(v, owner, Everywhere(*view)).depth)


def test_sphere_has_the_depth_and_normal_of_the_closed_form() -> None:
    centre = torch.tensor([[0.2, 4.0, 1.2]], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    v = Volumes(centre, centre, 0.5 * one, 0.5 * one, torch.eye(3).double()[None], centre, one, one)
    camera = CameraConfig(position_m=(0.2, 0.0, 1.2), center_px=(20.0, 12.0))
    view = View.of_camera(camera, 25, 41, torch.zeros((), dtype=torch.float64))
    hits = cast(v, torch.zeros(1, dtype=torch.int64), view)
    middle = 12 * 41 + 20
    assert float(hits.depth[middle]) == pytest.approx(3.5, abs=1e-9)
    torch.testing.assert_close(hits.normal[middle], torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))


def test_cone_seen_along_its_axis_shows_its_mantle() -> None:
    # From the thin end the rays are steeper than the mantle, which turns the sign of the quadratic.
    start = torch.tensor([[0.0, 5.0, 0.0]], dtype=torch.float64)
    end = torch.tensor([[0.0, 4.0, 0.0]], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    v = Volumes(start, end, 0.6 * one, 0.1 * one, torch.eye(3).double()[None], start, one, one)
    camera = CameraConfig(position_m=(0.0, 0.0, 0.0))
    view = View.of_camera(camera, 41, 41, torch.zeros((), dtype=torch.float64))
    hits = cast(v, torch.zeros(1, dtype=torch.int64), view)
    for pixel in (20 * 41 + 20, 20 * 41 + 22, 18 * 41 + 19, 20 * 41 + 23):
        expected = marched(v, 0, np.zeros(3), view.directions[pixel].numpy())
        assert float(hits.depth[pixel]) == pytest.approx(expected, abs=3e-3)


def test_projection_agrees_with_opencv() -> None:
    view = View.of_camera(CAMERA, 96, 160, torch.zeros((), dtype=torch.float64))
    points = torch.rand(20, 3, dtype=torch.float64) + torch.tensor([-0.5, 2.0, 0.5])
    axes = camera_to_world(CAMERA)[:, :3].T.numpy()
    focal = 80 / math.tan(math.pi / 6)
    matrix = np.array([[focal, 0, 79.5], [0, focal, 47.5], [0, 0, 1]])
    shift = -axes @ np.array(CAMERA.position_m)
    expected, _ = cv2.projectPoints(points.numpy(), cv2.Rodrigues(axes)[0], shift, matrix, None)
    np.testing.assert_allclose(view.project(points)[0].numpy(), expected.reshape(-1, 2), atol=1e-6)
    # rays are the inverse of the projection
    depth = torch.rand(96 * 160, dtype=torch.float64) + 1
    pixel, back = view.project(view.origins + depth[:, None] * view.directions)
    torch.testing.assert_close(back, depth)
    torch.testing.assert_close(pixel[5 * 160 + 7], torch.tensor([7.0, 5.0], dtype=torch.float64))


def test_shadow_falls_away_from_the_lamp() -> None:
    # A sphere 1 m up under a lamp at 45 degrees from the left shadows the floor 1 m to its right.
    centre = torch.tensor([[0.0, 3.0, 1.0]])
    one = torch.ones(1)
    v = Volumes(centre, centre, 0.2 * one, 0.2 * one, torch.eye(3)[None], centre, one, one)
    towards = torch.tensor([-1.0, 0.0, 1.0]) / math.sqrt(2)
    light = Light(towards, torch.ones(3), torch.ones(3))
    # The map holds the volumes; a far twin widens it over the floor.
    twin = Volumes(
        *(torch.cat([x, y]) for x, y in zip(v, v._replace(start=centre + 2, end=centre + 2), strict=True))
    )
    shadows = Shadows.of(twin, torch.zeros(2, dtype=torch.int64), light, 128)
    floor = torch.tensor([[1.0, 3.0, 0.0], [0.0, 3.0, 0.0], [-1.0, 3.0, 0.0], [-0.6, 3.0, 1.6]])
    assert shadows.reach(floor).tolist() == [0.0, 1.0, 1.0, 1.0]


# ---- bodies --------------------------------------------------------------------------------------------


def test_body_carries_the_keypoints_of_its_joints() -> None:
    joints = person(frames=3, dtype=torch.float64)
    body = build_body(joints)
    coco = body.keypoints
    assert body_height(joints).tolist() == pytest.approx([1.75] * len(joints), abs=1e-6)
    torch.testing.assert_close(coco[:, 0], joints[:, 0])
    for keypoint, joint in ((5, 5), (6, 2), (9, 7), (10, 4)):
        torch.testing.assert_close(coco[:, keypoint], joints[:, joint])
    # Knees are marked below the joint, ankles above it.
    for keypoint, joint, end, share in ((13, 12, 13, 0.038), (15, 13, 12, 0.048), (16, 10, 9, 0.048)):
        offset = share * (joints[:, end] - joints[:, joint])
        torch.testing.assert_close(coco[:, keypoint], joints[:, joint] + offset)
    # It faces the camera: its left eye and ear are to the right of its right ones, eyes before ears.
    assert (coco[:, 1, 0] > coco[:, 2, 0]).all()
    assert (coco[:, 3, 0] > coco[:, 4, 0]).all()
    assert (coco[:, 1:3, 1] < coco[:, 3:5, 1]).all()


def test_body_scales_with_its_skeleton() -> None:
    joints = person(dtype=torch.float64)
    small, large = build_body(joints), build_body(joints * 1.2)
    torch.testing.assert_close(small.volumes.start * 1.2, large.volumes.start)
    torch.testing.assert_close(small.volumes.start_radius * 1.2, large.volumes.start_radius)


def test_head_turns_with_the_nose() -> None:
    pose = BodyPose.standing((1,))
    turned = forward_kinematics(pose._replace(head=torch.tensor([[0.0, 0.6]], dtype=torch.float64)), 1.75)
    eyes = build_body(turned).keypoints[0, 1:3]
    across = eyes[1] - eyes[0]  # left to right eye
    assert math.atan2(float(across[1]), float(across[0])) == pytest.approx(0.6, abs=0.06)


def test_toes_do_not_sink_into_the_floor() -> None:
    joints = person(dtype=torch.float64)
    v = build_body(joints).volumes
    assert float((v.end[..., 2] - v.end_radius)[..., :].min()) > -0.02


def test_clothes_cover_what_they_should() -> None:
    look = Look.draw(torch.Generator().manual_seed(0))._replace(
        pattern=0, sleeve=0.5, leg=2.0, folds=torch.eye(4, 3) * 1e-6 + 1e-9
    )
    parts = torch.tensor([4, 4, 5, 7, 8, 9])  # upper arm twice, forearm, thigh, shank, shoe
    share = torch.tensor([0.2, 0.8, 0.2, 0.5, 0.5, 0.0])
    surface = Surface(torch.zeros(6, 3), torch.zeros(6, 3), parts, share, 1.0)
    albedo = paint(look, surface).albedo
    for row, colour in enumerate(
        (look.shirt, look.skin, look.skin, look.trousers, look.trousers, look.shoes)
    ):
        torch.testing.assert_close(albedo[row], colour, atol=1e-3, rtol=0)


# ---- films ---------------------------------------------------------------------------------------------


def test_film_has_the_promised_shapes() -> None:
    joints = torch.stack([person(-0.5, frames=2), person(0.8, frames=2)])
    video = film(joints)
    assert video.frames.shape == (2, 3, 96, 160)
    assert video.frames.dtype == torch.uint8
    assert video.masks.shape == (2, 2, 96, 160)
    assert video.boxes.shape == (2, 2, 4)
    assert video.keypoints.shape == (2, 2, 17, 2)
    assert video.visibility.shape == (2, 2, 17)
    assert video.keypoints_m.shape == (2, 2, 17, 3)
    torch.testing.assert_close(video.joints, joints)
    assert video.valid.all()
    assert video.camera.focal_px == pytest.approx(80 / math.tan(math.pi / 6))
    torch.testing.assert_close(film(person()).frames, film(person()[None]).frames)


def test_same_seed_same_film_other_seed_other_film() -> None:
    one, again, other = film(person(), 1), film(person(), 1), film(person(), 2)
    assert torch.equal(one.frames, again.frames)
    assert (one.frames.int() - other.frames.int()).abs().float().mean() > 5
    assert not torch.equal(one.keypoints, other.keypoints) or torch.equal(one.joints, other.joints)


def test_boxes_are_tight_about_masks() -> None:
    video = film(person(frames=2))
    for t in range(2):
        rows, columns = np.nonzero(video.masks[0, t].numpy())
        expected = [columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5]
        assert video.boxes[0, t].tolist() == expected


def test_joints_lie_under_the_pixels_of_their_person() -> None:
    video = film(person())
    body = video.keypoints[0, 0, 5:].round().long()
    inside = ((body >= 0) & (body < torch.tensor([160, 96]))).all(dim=-1)
    assert inside.sum() >= 10
    assert video.masks[0, 0][body[inside, 1], body[inside, 0]].all()


def test_face_is_seen_from_the_front_and_hidden_from_behind() -> None:
    front, back = film(person(heading=math.pi)), film(person(heading=0.0))
    assert (front.visibility[0, 0, :3] == VISIBLE).all()
    assert (back.visibility[0, 0, :3] == HIDDEN).all()
    assert (back.visibility[0, 0, 5:7] == VISIBLE).all()


def test_keypoints_out_of_the_picture_are_flagged() -> None:
    near = film(person(y=1.2), camera=CameraConfig(position_m=(0.4, 0.0, 1.5)))
    assert (near.visibility[0, 0, 15:] == OUTSIDE).all()
    assert (near.keypoints[0, 0, 15:, 1] > 96).all()


def test_nearer_person_hides_the_farther() -> None:
    alone, both = film(person(0.4, 5.0)), film(torch.stack([person(0.4, 5.0), person(0.3, 2.5)]))
    assert not (both.masks[0, 0] & both.masks[1, 0]).any()
    assert both.masks[0].sum() < 0.3 * alone.masks[0].sum()
    assert (both.visibility[0, 0, 11:13] == HIDDEN).all()
    assert (both.visibility[1, 0, 11:13] == VISIBLE).all()


def test_person_behind_the_camera_is_not_there() -> None:
    video = film(person(y=-3.0))
    assert not video.valid.any()
    assert not video.boxes.any()
    assert (video.visibility == OUTSIDE).all()


def test_who_is_not_there_leaves_no_trace() -> None:
    joints = torch.stack([person(-0.5, frames=2), person(0.8, frames=2)])
    valid = torch.tensor([[True, False], [False, False]])
    video = PersonRenderer(CAMERA, **SMALL)(joints, valid=valid)
    assert torch.equal(video.valid, valid)
    assert not video.visibility[1].any()
    assert not video.masks[:, 1].any()
    assert (video.frames[0].int() - video.frames[1].int()).abs().amax() > 60  # the one who left
    with pytest.raises(TensorsimError, match="valid"):
        PersonRenderer(CAMERA, **SMALL)(joints, valid=torch.ones(2, 3, dtype=torch.bool))


def test_given_background_is_kept_but_for_person_and_shadow() -> None:
    picture = torch.randint(0, 256, (3, 24, 40), dtype=torch.uint8)
    picture = torch.nn.functional.interpolate(picture[None].float(), (96, 160)).to(torch.uint8)[0]
    renderer = PersonRenderer(CAMERA, **SMALL, blur_px=0, noise=0, jpeg_quality=None)
    video = renderer(person(), background=picture)
    error = (video.frames[0].int() - picture.int()).abs().amax(dim=0)
    outside = ~video.masks[0, 0]
    assert error[outside][: 160 * 20].max() <= 1  # the upper part, where no floor is
    darker = (picture.int() - video.frames[0].int()).amin(dim=0) > 3
    assert (darker & outside).sum() > 20  # the shadow
    assert (darker & outside).float().mean() < 0.2


def test_noise_blur_and_compression_do_what_they_say() -> None:
    clean = film(person(), blur_px=0, noise=0, jpeg_quality=None).frames[0].float()
    noisy = film(person(), blur_px=0, noise=0.03, jpeg_quality=None).frames[0].float()
    grey = (clean > 100) & (clean < 150)
    assert float((noisy - clean)[grey].std()) / 255 == pytest.approx(0.03, rel=0.15)
    blurred = film(person(), blur_px=1.5, noise=0, jpeg_quality=None).frames[0].float()
    assert blurred.diff(dim=-1).abs().mean() < 0.8 * clean.diff(dim=-1).abs().mean()
    squeezed = film(person(), blur_px=0, noise=0, jpeg_quality=20).frames[0].float()
    assert 0.5 < (squeezed - clean).abs().mean() < 10


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_masks_on_cuda_equal_those_on_cpu() -> None:
    here, there = film(person()), film(person().cuda())
    assert (here.masks != there.masks.cpu()).float().mean() < 1e-3


def test_flesh_is_given_for_every_keypoint() -> None:
    assert len(FLESH_M) == 17


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (torch.zeros(2, 13, 3), "got shape .*13.*expected"),
        (torch.zeros(14, 3), "expected .*14, 3"),
        (torch.zeros(2, 14, 3, dtype=torch.int64), "floating"),
        (torch.zeros(0, 14, 3), "empty"),
        (torch.full((1, 14, 3), math.nan), "NaN"),
    ],
)
def test_refuses_bad_joints(joints: Tensor, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        film(joints)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"height": 4}, "16 x 16"),
        ({"blur_px": -1.0}, "blur_px"),
        ({"noise": math.nan}, "noise"),
        ({"jpeg_quality": 0}, "jpeg_quality"),
        ({"shadow_pixels": 2}, "shadow_pixels"),
    ],
)
def test_refuses_bad_settings(settings: dict[str, float], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        PersonRenderer(**settings)  # type: ignore[arg-type]


def test_refuses_bad_backgrounds() -> None:
    for picture in (torch.zeros(2, 8, 8), torch.zeros(3, 8), torch.zeros(3, 0, 8)):
        with pytest.raises(TensorsimError, match="background"):
            PersonRenderer(**SMALL)(person(), background=picture)


# ---- realism -------------------------------------------------------------------------------------------


def test_real_networks_take_it_for_a_person(shared_data: Path) -> None:
    from tensorsim.vision import OnnxHeatmaps, RTMDet, TopDownPose

    detector = RTMDet.from_pretrained(shared_data / "weights" / "rtmdet_nano_person.onnx").eval()
    network = TopDownPose(OnnxHeatmaps(shared_data / "weights" / "simplepose_coco17_256x192.onnx"))
    clips = np.load(shared_data / "mocap" / "cmu_14joints_120hz.npz")
    found, right = [], []
    for seed, (name, degrees, away) in enumerate(
        [
            ("walking_1", 180, 3.0),
            ("directing_traffic_1", 120, 4.0),
            ("walking_5", 65, 5.0),
            ("walking_2", 320, 6.0),
        ]
    ):
        joints = torch.from_numpy(clips[name])[1:][[30, 120]]
        angle = math.radians(degrees)
        turn = torch.tensor(
            [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
        )
        joints = (joints - joints[:1, [8, 11]].mean(1, keepdim=True) * torch.tensor([1.0, 1.0, 0.0])) @ turn.T
        joints[..., 1] += away
        video = PersonRenderer(CameraConfig(position_m=(0, 0, 1.2), pitch_rad=-0.08))(joints, seed=seed)
        images = video.frames.float() / 255
        with torch.no_grad():
            detections = detector(images)
            keypoints = network(images, video.boxes[0][:, None], video.valid[0][:, None])[0][:, 0]
        for t in range(len(joints)):
            box, boxes = video.boxes[0, t], detections.boxes[t]
            overlap = (torch.minimum(box[2:], boxes[:, 2:]) - torch.maximum(box[:2], boxes[:, :2])).clamp(
                min=0
            )
            common = overlap.prod(-1)
            areas = (boxes[:, 2:] - boxes[:, :2]).prod(-1) + (box[2:] - box[:2]).prod()
            iou = common / (areas - common).clamp(min=1)
            found.append(bool(((iou > 0.6) & (detections.scores[t] > 0.5)).any()))
            labelled = video.visibility[0, t] > OUTSIDE
            error = (keypoints[t] - video.keypoints[0, t]).norm(dim=-1) / (box[2:] - box[:2]).max()
            right.append(float((error < 0.1)[labelled].float().mean()))
    assert np.mean(found) >= 0.8
    assert np.mean(right) >= 0.6
