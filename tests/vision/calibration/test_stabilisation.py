"""People in front of a camera that pans and zooms are found at the same places as with a static camera."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from tensorsim import plot, streaming
from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import body_to_coco, mid_hips
from tensorsim.config import CameraConfig
from tensorsim.evaluation.camera import FPS, HEIGHT, WIDTH, walk_before
from tensorsim.evaluation.film_variants import Observed, mirrored, variants
from tensorsim.geometry.camera import camera_to_world, focal_length, principal_point, project
from tensorsim.geometry.framing import keypoint_boxes
from tensorsim.pipeline import VideoToPose
from tensorsim.streaming import lifted_film
from tensorsim.types import Tracks
from tensorsim.vision import TemporalLifter
from tensorsim.vision.calibration import stabilisation
from tensorsim.vision.calibration.camera_motion import BackgroundMotion
from tensorsim.vision.calibration.stabilisation import (
    at_even_times,
    camera_path,
    homographies,
    mapped,
    still_picture,
)
from tests.vision.calibration.test_camera_motion import boxes_of, film

FRAMES, FOCAL = 90, 500.0
SIZE = (480, 640)


def swaying(frames: int, pan_deg: float = 12.0) -> tuple[Tensor, Tensor]:
    """Rotations (T, 3, 3) from the first frame's camera axes to each frame's, and zooms (T,): a camera held by hand."""
    share = torch.linspace(0.0, 1.0, frames, dtype=torch.float64)
    degrees = torch.stack([3 * torch.sin(9 * share), pan_deg * share, 2 * torch.sin(5 * share)], dim=-1)
    x, y, z = torch.deg2rad(degrees).unbind(-1)
    return rotation(2, z) @ rotation(0, x) @ rotation(1, -y), torch.exp(0.1 * torch.sin(4 * share))


def pixels(
    points: Tensor, turns: Tensor, zooms: Tensor, focal: float = FOCAL, size: tuple[int, int] = SIZE
) -> Tensor:
    """Points (T, N, 3) in the first frame's camera axes as each frame sees them, (T, N, 2)."""
    local = points @ turns.mT
    middle = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2], dtype=torch.float64)
    return focal * zooms[:, None, None] * local[..., :2] / local[..., 2:] + middle


def steps_of(turns: Tensor, zooms: Tensor, focal: float = FOCAL, size: tuple[int, int] = SIZE) -> Tensor:
    """How the background near the middle of the picture moves from frame to frame, by where four points of it go."""
    middle = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2], dtype=torch.float64)
    offsets = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]], dtype=torch.float64)
    rows = [torch.zeros(4, dtype=torch.float64)]
    for k in range(1, len(turns)):
        local = torch.cat([offsets / focal / zooms[k - 1], torch.ones(4, 1, dtype=torch.float64)], dim=-1)
        after = pixels((local @ turns[k - 1])[None], turns[k : k + 1], zooms[k : k + 1], focal, size)[0]
        along = after[1] - after[0]
        shift = after.mean(dim=0) - middle
        rows.append(
            torch.cat([shift, torch.atan2(along[1:], along[:1]), (along.norm() / 2).log().reshape(1)])
        )
    return torch.stack(rows)


def test_the_path_of_the_camera_is_that_of_its_turns() -> None:
    turns, zooms = swaying(FRAMES)
    found, focals = camera_path(steps_of(turns, zooms), FOCAL)
    assert float((found - turns).abs().max()) < math.radians(0.1)
    torch.testing.assert_close(focals, FOCAL * zooms, rtol=2e-3, atol=0.0)


def test_what_stands_still_stays_at_one_pixel() -> None:
    turns, zooms = swaying(FRAMES)
    points = torch.tensor([[-0.6, -0.3, 3.0], [0.4, 0.8, 4.0], [1.0, 0.0, 9.0]], dtype=torch.float64)
    seen = pixels(points.expand(FRAMES, -1, -1), turns, zooms)
    assert float(seen.std(dim=0).max()) > 20
    mean = FOCAL * float(zooms.log().mean().exp())
    through = homographies(steps_of(turns, zooms), mean, SIZE)
    assert through is not None
    still = mapped(seen, through)
    assert float((still - still.mean(dim=0)).abs().max()) < 1.0
    # The still camera has the mean focal length: angles between the points are those that they have.
    middle = torch.tensor([(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2], dtype=torch.float64)
    rays = torch.cat([(still[0] - middle) / mean, torch.ones(3, 1, dtype=torch.float64)], dim=-1)
    unit = torch.nn.functional.normalize(rays, dim=-1)
    true = torch.nn.functional.normalize(points, dim=-1)
    torch.testing.assert_close(unit @ unit.T, true @ true.T, rtol=0.0, atol=1e-3)


def test_a_camera_that_turns_round_has_no_still_picture() -> None:
    turns, zooms = swaying(FRAMES, pan_deg=150.0)
    assert homographies(steps_of(turns, zooms), FOCAL, SIZE) is None


@pytest.mark.parametrize(("focal", "there"), [(700.0, True), (300.0, False)])
def test_no_corner_comes_near_the_horizon_of_the_still_picture(focal: float, there: bool) -> None:
    """A camera with a wide view turns to either side by 35 degrees."""
    turns, zooms = swaying(FRAMES, pan_deg=70.0)
    through = homographies(steps_of(turns, zooms, focal), focal, SIZE)
    assert (through is not None) == there


def test_people_on_another_device_stay_there(monkeypatch: pytest.MonkeyPatch) -> None:
    steady = homographies(torch.zeros(FRAMES, 4), FOCAL, SIZE)
    monkeypatch.setattr(stabilisation, "homographies", lambda *_: steady)  # of the steps, on the CPU
    monkeypatch.setattr(stabilisation, "_margin", lambda *_: (0, 0))
    with FakeTensorMode(allow_non_fake_inputs=True):
        keypoints = torch.empty(1, 2, FRAMES, 17, 2, device="cuda")
        valid = torch.empty(1, 2, FRAMES, dtype=torch.bool, device="cuda")
        tracks = Tracks(torch.empty(1, 2, FRAMES, 4, device="cuda"), valid, valid)
        still = still_picture(tracks, keypoints, keypoints[..., 0], SIZE, torch.zeros(FRAMES, 4), FOCAL)
        assert still is not None
        assert still.tracks.boxes.device.type == still.keypoints.device.type == "cuda"
        assert mapped(still.keypoints, still.from_film.inverse()).device.type == "cuda"


def test_a_still_camera_changes_nothing() -> None:
    through = homographies(torch.zeros(5, 4), FOCAL, SIZE)
    assert through is not None
    torch.testing.assert_close(through, torch.eye(3, dtype=torch.float64).expand(5, 3, 3))


def test_the_background_of_a_film_tells_the_steps() -> None:
    frames = film(60.0, 1.1, walker=False)
    background = BackgroundMotion(30.0, 0.0)
    background.add(frames, *boxes_of(len(frames)))
    steps = background.steps()
    assert steps is not None
    # The background goes to the left by 2 pixels in each frame, and grows about the upper left corner.
    grown = math.log(1.1) / 30
    torch.testing.assert_close(
        steps[1:, 3], torch.full((59,), grown, dtype=torch.float64), rtol=0.0, atol=2e-3
    )
    assert float(steps[1:, 2].abs().max()) < 2e-3
    zoom = math.exp(grown)
    for k in (1, 30, 59):
        expected = (zoom - 1) * np.array([(320 - 1) / 2, (240 - 1) / 2]) - [2.0 * 1.1 ** (k / 30), 0.0]
        assert steps[k, :2].numpy() == pytest.approx(expected, abs=0.15)


def test_a_film_without_a_clear_background_tells_none() -> None:
    wall = torch.full((30, 3, 240, 320), 90, dtype=torch.uint8)
    background = BackgroundMotion(30.0, 0.0)
    background.add(wall, *boxes_of(30))
    assert background.steps() is None


def test_steps_at_even_times_lead_along_the_same_path() -> None:
    times_s = torch.tensor([0.0, 0.1, 0.4, 0.5])
    steps = torch.tensor([[9.0, 9, 9, 9], [1, 2, 0.1, 0], [3, 0, 0, 0.3], [1, 0, 0, 0]])
    even = at_even_times(steps, times_s, 10.0)
    assert even.shape == (6, 4)
    path = even[1:].cumsum(dim=0)
    torch.testing.assert_close(path[[0, 3, 4]], steps[1:].cumsum(dim=0).double())
    torch.testing.assert_close(path[1], torch.tensor([2.0, 2.0, 0.1, 0.1], dtype=torch.float64))


def observed(keypoints: Tensor, size: tuple[int, int]) -> Tracks:
    valid = torch.ones(1, 1, keypoints.shape[2], dtype=torch.bool)
    boxes = keypoint_boxes(keypoints, torch.ones_like(keypoints[..., 0]))
    edge = torch.tensor([size[1] - 1.0, size[0] - 1.0]).repeat(2)
    return Tracks(boxes.clamp(min=0).minimum(edge), valid, valid)


def test_what_the_picture_cuts_off_stays_cut_off() -> None:
    turns, zooms = swaying(FRAMES)
    points = torch.full((1, 1, FRAMES, 17, 2), 300.0)
    points[..., 5, :] = torch.tensor([200.0, 100.0])
    points[0, 0, :40, 16, :] = torch.tensor([320.0, 479.0])
    points[0, 0, 40:, 16, :] = torch.tensor([320.0, 400.0])
    tracks = observed(points, SIZE)
    still = still_picture(
        tracks, points, torch.ones_like(points[..., 0]), SIZE, steps_of(turns, zooms), FOCAL
    )
    assert still is not None
    assert still.size[0] > SIZE[0]
    assert still.size[1] > SIZE[1]
    assert float(still.scores[0, 0, :40, 16].max()) == 0
    assert float(still.scores[0, 0, 40:].min()) == 1
    bottom = still.tracks.boxes[0, 0, :, 3]
    assert float(bottom[:40].min()) == still.size[0] - 1
    assert float(bottom[40:].max()) < still.size[0] - 2
    # All corners of the film are in the picture, one of them at its edge.
    corners = torch.tensor([(u, v) for u in (0.0, SIZE[1] - 1.0) for v in (0.0, SIZE[0] - 1.0)])
    at = mapped(corners, still.from_film) + still.margin
    assert float(at.min()) > -0.5
    assert float(at[..., 0].max()) < still.size[1] - 0.5
    assert float(at[..., 1].max()) < still.size[0] - 0.5


@pytest.mark.parametrize("pan_deg", [10.0, 25.0])
def test_somebody_who_walks_is_where_a_still_camera_sees_them(pan_deg: float) -> None:
    camera = CameraConfig(position_m=(0.0, 0.0, 1.6), pitch_rad=math.radians(-8.0))
    walk = walk_before(camera, 0)
    joints = walk.joints[:FRAMES].double()
    frames = len(joints)
    focal = focal_length(camera, WIDTH)
    assert principal_point(camera, HEIGHT, WIDTH) == ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    pose = camera_to_world(camera)
    level = (body_to_coco(joints) - pose[:, 3]) @ pose[:, :3]
    turns, zooms = swaying(frames, pan_deg)
    middle = math.radians(pan_deg / 2)
    turns = turns @ rotation(
        1, torch.tensor(middle, dtype=torch.float64)
    )  # before and behind the mean direction
    seen = pixels(level, turns, zooms, focal, (HEIGHT, WIDTH))
    stage = VideoToPose(
        torch.nn.Identity(), torch.nn.Identity(), lifter=TemporalLifter.from_pretrained().double()
    ).eval()

    def hips(keypoints: Tensor, steps: Tensor | None) -> tuple[Tensor, Tensor]:
        keypoints = keypoints[None, None]
        inside = (keypoints >= 0).all(-1) & (keypoints < torch.tensor([WIDTH, HEIGHT])).all(-1)
        tracks = observed(keypoints, (HEIGHT, WIDTH))
        with torch.inference_mode():
            found = lifted_film(stage, tracks, keypoints, 0.9 * inside, (HEIGHT, WIDTH), FPS, True, steps)
        if steps is not None:
            assert found.from_film is not None
            torch.testing.assert_close(found.pose.keypoints, keypoints, rtol=0.0, atol=1e-3)
            assert torch.equal(found.pose.boxes, tracks.boxes)
        return mid_hips(found.pose.joints[0, 0]), found.pose.valid[0, 0]

    still, _ = hips(
        project(body_to_coco(joints), focal, principal_point(camera, HEIGHT, WIDTH), pose)[0], None
    )
    steady, there = hips(seen, steps_of(turns, zooms, focal, (HEIGHT, WIDTH)))
    moving, _ = hips(seen, None)

    def course(path: Tensor) -> Tensor:
        """Where the hips are, but for the place and heading of all."""
        return (path - path[there].mean(dim=0))[there][:, :2]

    off = (course(steady) - course(still)).norm(dim=-1).mean()
    without = (course(moving) - course(still)).norm(dim=-1).mean()
    assert float(off) < 0.05
    assert float(without) > 0.2


@pytest.mark.parametrize("size", [(480, 640), (640, 360)])
def test_turns_are_first_taken_out_with_the_usual_field_of_view_along_the_longer_side(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Upright films with more across would seem to turn too far."""
    focal: list[float] = []
    monkeypatch.setattr(streaming, "still_picture", lambda *found: focal.append(found[-1]))
    stage = VideoToPose(torch.nn.Identity(), torch.nn.Identity()).eval()
    points = 100 + 40 * torch.rand(1, 1, 6, 17, 2, generator=torch.Generator().manual_seed(0))
    scores, steps = torch.ones_like(points[..., 0]), torch.zeros(6, 4, dtype=torch.float64)
    lifted_film(stage, observed(points, size), points, scores, size, 30.0, True, steps)
    assert focal == pytest.approx([max(size) / 2 / math.tan(math.radians(30.0))], rel=1e-6)


def test_variants_of_a_film_whose_camera_moves() -> None:
    turns, zooms = swaying(FRAMES)
    points = 300 + 40 * torch.randn(1, 1, FRAMES, 17, 2, generator=torch.Generator().manual_seed(0))
    scores = torch.ones_like(points[..., 0])
    steps = steps_of(turns, zooms)
    seen = Observed(observed(points, SIZE), points, scores, SIZE, 80.0, steps)
    for name, variant in variants(seen, 30.0).items():
        assert variant.camera_steps is not None, name
        assert len(variant.camera_steps) == variant.keypoints.shape[2], name
    turned = mirrored(seen)
    assert turned.camera_steps is not None
    one = still_picture(seen.tracks, seen.keypoints, scores, SIZE, steps, FOCAL)
    other = still_picture(turned.tracks, turned.keypoints, scores, SIZE, turned.camera_steps, FOCAL)
    assert one is not None
    assert other is not None
    again = mirrored(Observed(other.tracks, other.keypoints, scores, other.size))
    torch.testing.assert_close(again.keypoints, one.keypoints, rtol=0.0, atol=1e-2)


def test_lines_of_the_floor_go_through_the_homography() -> None:
    lines = plot.floor_lines(CameraConfig(pitch_rad=-0.2), *SIZE)
    through = homographies(torch.tensor([[0.0] * 4, [3.0, -2.0, 0.01, 0.02]]), FOCAL, SIZE)
    assert through is not None
    moved = plot.through(lines, through[1].numpy())
    expected = mapped(torch.from_numpy(lines).flatten(0, 1)[None], through[1:]).reshape(-1, 2, 2).numpy()
    assert moved == pytest.approx(expected)
    behind = np.diag([1.0, 1.0, -1.0])
    assert plot.through(lines, behind).shape == (0, 2, 2)
