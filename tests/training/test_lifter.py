"""Training of the temporal lifter: motion, views, errors, loss, a run from the command line."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import body_height, body_to_coco, mid_hips
from tensorsim.cli import main
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.camera import known_camera
from tensorsim.training import lifter_motion
from tensorsim.training.lifter import (
    LifterRecipe,
    VideoPoseRecipe,
    laplace,
    lifter_loss,
    picture_joints,
    speed_weight,
    target,
)
from tensorsim.training.lifter_motion import FRAMES, KINDS, MotionPool, build_pool, captures, with_other_bones
from tensorsim.training.lifter_scores import judge, lifted, nearest, temporal, views
from tensorsim.training.lifter_views import (
    JUMP_S,
    JUMPS_HZ,
    Draw,
    before_camera,
    film,
    found_in_part,
    jumps_from,
    seen_in,
    windows_of,
)
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
from tensorsim.vision.lifting.temporal_net import Located, TemporalNet
from tensorsim.vision.lifting.videopose3d import VideoPose3D
from tests.networks import terms_of_training


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> MotionPool:
    """A few motions of every kind; the capture is a generated walk in a file."""
    folder = tmp_path_factory.mktemp("motion")
    walk = build_pool(None, 4, seed=3, quiet=True).joints[0, :200]
    np.savez(folder / "walks_60hz.npz", one=walk.numpy(), two=walk.numpy(), three=walk.numpy())
    made = build_pool(folder / "pool.pt", 24, (folder / "walks_60hz.npz",), quiet=True)
    again = build_pool(folder / "pool.pt", 24, (folder / "walks_60hz.npz",), quiet=True)
    assert torch.equal(made.joints, again.joints)
    with pytest.raises(TensorsimError, match="expected"):
        build_pool(folder / "pool.pt", 25, (folder / "walks_60hz.npz",), quiet=True)
    kept = captures((folder / "walks_60hz.npz",), held_out=True)
    assert [name.split()[1] for name in kept] == ["two"]
    return made


def test_motions_are_bodies_on_the_floor(pool: MotionPool) -> None:
    assert set(pool.kind.tolist()) == set(range(len(KINDS)))
    assert pool.joints.shape[1:] == (FRAMES, 14, 3)
    tall = body_height(pool.joints)
    assert float((tall / tall.mean(dim=1, keepdim=True) - 1).abs().max()) < 0.02  # bones keep their length
    assert float((tall.mean(dim=1) / pool.height_m - 1).abs().max()) < 0.1
    assert float(pool.joints[..., 2].amin()) > -0.02
    assert float(pool.joints[..., 2].amin(dim=-1).median()) < 0.15


def test_falls_go_in_all_directions() -> None:
    generator = torch.Generator().manual_seed(0)
    people = lifter_motion.draw_people(
        64, lifter_motion.PeopleConfig(heading_rad=0.0, facing_radar_share=0.0), generator
    )
    time = torch.linspace(0.0, 3.0, 2, dtype=torch.float64).expand(64, -1)
    joints = lifter_motion.perform(lifter_motion.fall_any_way, time, people)
    along = (joints[:, -1, 1] - mid_hips(joints[:, -1]))[:, :2]
    quadrant = (along > 0).long() @ torch.tensor([1, 2])
    assert len(quadrant.unique()) == 4
    assert float(joints[:, -1, :, 2].amax(dim=-1).median()) < 0.7  # they lie


def test_other_bones_have_the_lengths_asked_for(pool: MotionPool) -> None:
    joints = pool.joints[0].double()
    factors = torch.tensor([1.1, 1.0, 0.9, 1.2, 1.05, 0.95, 1.0], dtype=torch.float64)
    moved = with_other_bones(joints, factors)
    for one, other, factor in ((2, 3, 0.9), (3, 4, 1.2), (8, 9, 1.05), (9, 10, 0.95), (2, 5, 1.1)):
        ratio = (moved[:, one] - moved[:, other]).norm(dim=-1) / (joints[:, one] - joints[:, other]).norm(
            dim=-1
        )
        torch.testing.assert_close(ratio, torch.full_like(ratio, factor))


def test_exact_keypoints_are_the_projection(pool: MotionPool) -> None:
    """Against NumPy: a camera that looks down by 20 degrees."""
    draw = Draw(3, torch.Generator().manual_seed(1))
    joints, height, fps = windows_of(pool, 20, draw, 30.0)
    camera = known_camera(20.0, 2.0, 60.0)
    view = before_camera(joints, camera, (640, 480), draw)
    window = seen_in(view, height, fps, draw, errors=False)
    points = body_to_coco(view.joints).numpy().astype(np.float64)
    tilt = np.radians(20.0)
    ahead = points[..., 1] * np.cos(tilt) - points[..., 2] * np.sin(tilt)
    down = -points[..., 2] * np.cos(tilt) - points[..., 1] * np.sin(tilt)
    focal = 320 / np.tan(np.radians(30.0))
    pixels = np.stack([319.5 + focal * points[..., 0] / ahead, 239.5 + focal * down / ahead], axis=-1)
    inside = window.scores.numpy() > 0.5
    assert inside.mean() > 0.5
    np.testing.assert_allclose(window.keypoints.numpy()[inside], pixels[inside], atol=0.01)
    assert torch.equal(fps, torch.full((3,), 30.0))


def test_windows_with_the_same_seed_are_the_same_and_errors_are_bounded(pool: MotionPool) -> None:
    one, other = (film(pool, 16, 32, torch.Generator().manual_seed(5)) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(one.keypoints, film(pool, 16, 32, torch.Generator().manual_seed(6)).keypoints)
    shown = one.scores > 0.3
    assert 0.5 < float(shown.float().mean()) < 1.0
    assert bool(one.keypoints.isfinite().all())
    assert float((one.boxes[..., 2] - one.boxes[..., 0]).amin()) >= 0.0


def test_limbs_jump_as_often_and_for_as_long_as_stated() -> None:
    draw = Draw(40, torch.Generator().manual_seed(0))
    fps, frames = 30.0, 2000
    often = torch.ones(40, 1, 1)
    often[20:] = 3.0  # people who lie down
    began, lasting = draw.number(0.0, 1.0, frames, 17), draw.number(1e-6, 1.0, frames, 17)
    jumps, since = jumps_from(often * torch.tensor(JUMPS_HZ), fps, began, lasting)
    # An exponential duration in whole frames, and a frame at either end.
    duration_s = (2 + 1 / math.expm1(1 / (JUMP_S * fps))) / fps
    for people, factor in ((slice(20), 1.0), (slice(20, None), 3.0)):
        limbs = [7, 8, 9, 10, 13, 14, 15, 16]
        share = jumps[people, 60:].double().mean((0, 1))[limbs]
        expected = factor * torch.tensor(JUMPS_HZ)[limbs].double() * duration_s
        assert float((share / expected - 1).abs().max()) < 0.25
        assert abs(float(share.sum() / expected.sum()) - 1) < 0.1  # jumps that overlap count once
    assert bool((since <= torch.arange(frames)[:, None]).all())


def test_keypoints_of_a_person_found_in_part_are_placed_on_that_part() -> None:
    generator = torch.Generator().manual_seed(0)
    points, noise = (100 * torch.randn(5, 17, 2, generator=generator) for _ in range(2))
    part = torch.zeros(17, dtype=torch.bool)
    part[11:] = True
    found, scores = found_in_part(points, torch.full((5, 17), 0.8), part.expand(5, 17), noise)
    assert torch.equal(found[:, 11:], points[:, 11:])
    assert bool((found.amin(1) >= points[:, 11:].amin(1)).all())
    assert bool((found.amax(1) <= points[:, 11:].amax(1)).all())
    torch.testing.assert_close(scores, torch.where(part, 0.8, 0.36).expand(5, 17))
    whole, _ = found_in_part(points, scores, torch.ones(5, 17, dtype=torch.bool), noise)
    assert torch.equal(whole, points)


def test_target_is_turned_to_the_person(pool: MotionPool) -> None:
    window = film(pool, 4, 32, torch.Generator().manual_seed(2))
    sight = window.sight()
    turned = target(window, sight)
    angle = torch.atan2(sight.azimuth[..., 1], sight.azimuth[..., 0])
    expected = window.joints @ rotation(2, angle).mT  # counter-clockwise by the azimuth, which is clockwise
    torch.testing.assert_close(turned, expected, atol=1e-5, rtol=1e-5)


def test_loss_is_least_for_the_truth_and_for_the_right_spread(pool: MotionPool) -> None:
    window = film(pool, 4, 32, torch.Generator().manual_seed(2))
    true = target(window, window.sight())
    spread, weight = torch.full((4, 32, 14, 2), -4.0), torch.ones(4, 32)
    right = lifter_loss(Located(true, spread, spread[..., 0, 0]), true, weight, window.fps)
    shifted = true + torch.tensor([0.0, 0.3, 0.0]) * torch.arange(14)[:, None] / 14
    wrong = lifter_loss(Located(shifted, spread, spread[..., 0, 0]), true, weight, window.fps)
    assert float(right["place"]) < 1e-6
    assert float(right["bones"]) < 1e-4
    assert float(wrong["loss"]) > float(right["loss"])
    assert float(wrong["depth"]) > 0.05
    error = torch.tensor(0.2)
    levels = torch.linspace(-4.0, 1.0, 101)
    best = levels[laplace(error, levels).argmin()]
    assert float(best.exp()) == pytest.approx(0.2, rel=0.05)


def test_errors_of_fast_joints_weigh_more() -> None:
    """A wrist that moves at 2 body heights/s between frames 12 and 15 has the weight 3 there and two frames around."""
    about = torch.zeros(1, 30, 14, 3)
    about[0, :, 4, 1] = 2.0 / 25 * (torch.arange(30.0) - 12).clamp(0, 3)
    weight = speed_weight(about, torch.tensor([25.0]))
    expected = torch.ones(1, 30, 14)
    expected[0, 10:18, 4] = 3.0
    torch.testing.assert_close(weight, expected)
    assert float(speed_weight(20 * about, torch.tensor([25.0])).max()) == 6.0


def test_learns(pool: MotionPool) -> None:
    """Sixty steps on a few motions halve the error of depths."""
    torch.manual_seed(0)
    net = TemporalNet(32)
    recipe = LifterRecipe(net, pool, pool, frames=24, learning_rate=4e-3)
    losses = terms_of_training(recipe, recipe.collate([{"index": k} for k in range(24)]), 60, "depth")
    assert losses[-1] < 0.5 * losses[0]


def test_videopose3d_sees_and_learns_the_same_body(pool: MotionPool) -> None:
    """Exact keypoints are the projection of the target; forty steps halve the error."""
    draw = Draw(8, torch.Generator().manual_seed(1))
    joints, height, fps = windows_of(pool, 24, draw, 30.0)
    view = before_camera(joints, known_camera(20.0, 2.0, 60.0), (640, 480), draw)
    window = seen_in(view, height, fps, draw, errors=False)
    torch.manual_seed(0)
    net = VideoPose3D((3, 3), 64, dropout=0.0)
    recipe = VideoPoseRecipe(net, pool, pool, frames=24, learning_rate=4e-3)
    batch = recipe.batch_of(window)
    hips = (mid_hips(view.joints)[:, :, None] @ view.rotation[:, None])[..., 0, :]
    true = batch["target"] / 1.75 * height[:, None, None, None] + hips[:, :, None]  # metres from the camera
    seen = true[..., :2] / true[..., 2:] * view.focal[:, None, None, None] / 320
    whole = (window.scores > 0.5).all(dim=-1)
    assert int(whole.sum()) > 20
    limbs = [2, 5, 12, 13, 15, 16]  # right and left knees, elbows, wrists: COCO marks most others elsewhere
    torch.testing.assert_close(
        picture_joints(window)[whole][:, limbs], seen[whole][:, limbs], atol=0.01, rtol=0
    )
    losses = terms_of_training(recipe, recipe.collate([{"index": k} for k in range(24)]), 40)
    assert losses[-1] < 0.5 * losses[0]
    assert set(recipe.validate(net.eval())) == {"score", "joints_cm", "depth_cm"}


def test_scores_of_the_truth_are_perfect(pool: MotionPool, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = next(views(pool, ("joined poses",), errors=False))
    monkeypatch.setattr(
        "tensorsim.training.lifter_scores.lifted",
        lambda make, people, range_rate: (people.joints, people.valid),
    )
    errors = judge(nearest, iter([seen]))
    assert errors.depth_cm == pytest.approx(0.0, abs=1e-6)
    assert errors.range_percent == pytest.approx(0.0, abs=1e-6)
    assert errors.peak == pytest.approx(1.0)
    assert errors.within == 1.0
    assert errors.radial == pytest.approx(1.0)
    # Wrists and ankles that move half as fast towards the camera, and as fast across its picture.
    place = seen.joints.new_tensor(seen.camera.position_m)
    way = torch.nn.functional.normalize(
        (mid_hips(seen.joints) - place).mean(1) * place.new_tensor([1.0, 1, 0]), dim=-1
    )
    along = (seen.joints * way[:, None, None]).sum(-1, keepdim=True) * way[:, None, None]
    slow = seen.joints - 0.5 * (along - along.mean(1, keepdim=True))
    monkeypatch.setattr("tensorsim.training.lifter_scores.lifted", lambda *_: (slow, seen.valid))
    assert judge(nearest, iter([seen])).radial == pytest.approx(0.5, abs=0.05)


def test_the_pipeline_takes_a_temporal_lifter(pool: MotionPool) -> None:
    torch.manual_seed(0)
    seen = next(views(pool, ("activities",), errors=True))
    joints, valid = lifted(temporal(TemporalLifter(TemporalNet(16)).eval()), seen)
    assert joints.shape == seen.joints.shape
    assert bool(joints.isfinite().all())
    assert bool(valid.any())


def test_train_lifter_from_the_command_line(tmp_path: Path) -> None:
    """Two steps, then on to three; the weights load."""
    arguments = [
        "train",
        "lifter",
        "--out",
        str(tmp_path),
        "--motions",
        "100",
        "--batch",
        "2",
        "--frames",
        "16",
    ]
    arguments += ["--channels", "8", "--workers", "0", "--quiet"]
    main([*arguments, "--steps", "2"])
    main([*arguments, "--steps", "3"])
    lifter = TemporalLifter.from_pretrained(tmp_path / "best.safetensors")
    assert lifter.network.enter.out_features == 8
    arguments[3] = str(tmp_path / "tcn")
    main([*arguments, "--network", "videopose3d", "--steps", "1"])
    assert VideoPose3D.from_pretrained(tmp_path / "tcn" / "best.safetensors").receptive_field == 27
    with pytest.raises(SystemExit):
        main([*arguments[:2], "--out", str(tmp_path / "x"), "--frames", "3"])
