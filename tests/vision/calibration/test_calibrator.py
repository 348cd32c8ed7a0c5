"""The camera is estimated from people who walk, stays as assumed without evidence, and states its uncertainty."""

import math
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn

from tensorsim.evaluation.camera import (
    FPS,
    HEIGHT,
    WIDTH,
    errors_of,
    estimate,
    known_camera,
    walk_before,
)
from tensorsim.vision.calibration import calibrator
from tensorsim.vision.calibration.calibrator import (
    CameraCalibrator,
    CameraEstimate,
    horizontal_fov,
    with_reserve,
)
from tensorsim.vision.calibration.camera_fit import (
    Bodies,
    camera_axes,
    fit_camera,
    jacobian,
    misfit,
    place_upright,
    residuals,
    robust,
)
from tensorsim.vision.calibration.upright import (
    WALK_RATIO,
    cadence,
    ends_of_body,
    is_upright,
    steadily,
    still_beside_others,
    walking_share,
)
from tests.film import STANDING
from tests.stage import StageTester


def standing(feet_v: float, size_px: float) -> Tensor:
    """COCO keypoints (17, 2) of a body that stands in the middle of the picture, seen from the front."""
    points = torch.tensor(STANDING, dtype=torch.float64)
    u = (WIDTH - 1) / 2 + size_px * points[:, 0]
    return torch.stack([u, feet_v + size_px * (points[:, 1] - 0.96)], dim=-1)


class TestCameraCalibrator(StageTester):
    gradient_arguments: ClassVar[tuple[int, ...]] = ()  # an estimate, not a stage to train through
    batched_arguments: ClassVar[tuple[int, ...]] = (0, 1, 2)
    exports: ClassVar[bool] = False  # picks the best of several fits by value

    def make(self) -> nn.Module:
        return CameraCalibrator(most_frames=10)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        time = torch.arange(20)
        body = torch.stack([standing(380.0 + 2 * float(t), 200.0 + 2 * float(t)) for t in time]).to(dtype)
        noise = torch.randn(*batch, 1, 20, 17, 2, generator=torch.Generator().manual_seed(0), dtype=dtype)
        keypoints = body + noise
        valid = torch.ones(*batch, 1, 20, dtype=torch.bool)
        return keypoints, torch.ones(*batch, 1, 20, 17, dtype=dtype), valid, HEIGHT, WIDTH, FPS

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        keypoints, scores, valid, *rest = self.inputs((1,), torch.float32)
        return [
            ((keypoints[..., 0], scores, valid, *rest), "keypoints"),
            ((keypoints, scores[..., :3], valid, *rest), "scores: got shape"),
            ((keypoints, scores, valid[..., :3], *rest), "valid: got"),
            ((keypoints * math.nan, scores, valid, *rest), "keypoints"),
            ((keypoints, scores, valid, 0, *rest[1:]), "image: got 0 x"),
            ((keypoints, scores, valid, *rest[:2], 0.0), "fps"),
        ]


@pytest.mark.parametrize(
    ("tilt", "height", "fov"), [(0.0, 0.8, 60.0), (12.0, 1.5, 60.0), (24.0, 3.0, 40.0), (35.0, 3.0, 90.0)]
)
def test_somebody_who_walks_tells_the_camera(tilt: float, height: float, fov: float) -> None:
    camera = known_camera(tilt, height, fov)
    walk = walk_before(camera, seed=1)
    assert walk.seen > 0.5
    found = estimate(walk, noise_px=2.0, known_height=True)
    errors = errors_of(found, camera, walk)
    assert abs(errors.pitch_deg) < 2.0
    assert abs(errors.range) < 0.12
    assert abs(errors.fov_deg) < 8.0
    assert abs(errors.pitch_deg) < 4 * math.degrees(float(found.pitch_sd_rad)) + 0.3
    assert abs(float(found.roll_rad)) < math.radians(2.0)
    assert int(found.frames) > 100


def test_a_long_film_tells_no_less_than_the_walk_in_it() -> None:
    """Frames without people do not count; of a person who walks for minutes, only windows are used."""
    camera = known_camera(24.0, 3.0, 60.0)
    walk = walk_before(camera, 5)
    stage = CameraCalibrator((walk.height_m,), 0.02)
    keypoints, scores = walk.keypoints[None], walk.scores[None]
    frames = keypoints.shape[1]

    def told(keypoints: Tensor, scores: Tensor) -> CameraEstimate:
        return stage(keypoints, scores, scores.any(-1), HEIGHT, WIDTH, FPS)

    alone = errors_of(told(keypoints, scores), camera, walk)
    ahead, later = 20 * frames, 55 * frames  # ten minutes
    nothing = torch.zeros(1, ahead, 17, 2).double(), torch.zeros(1, later, 17, 2).double()
    long = told(
        torch.cat([nothing[0], keypoints, nothing[1]], dim=1),
        torch.cat([nothing[0][..., 0], scores, nothing[1][..., 0]], dim=1),
    )
    found = errors_of(long, camera, walk)
    assert abs(found.pitch_deg - alone.pitch_deg) < 0.3
    assert abs(found.range - alone.range) < 0.02
    gap = torch.zeros(1, 2 * round(FPS), 17, 2).double()
    again = torch.cat([keypoints, gap], dim=1).repeat(1, 30, 1, 1)
    found = errors_of(told(again, torch.cat([scores, gap[..., 0]], dim=1).repeat(1, 30, 1)), camera, walk)
    assert abs(found.pitch_deg) < 1.0
    assert abs(found.range) < 0.07


def test_nobody_tells_nothing() -> None:
    module = CameraCalibrator(most_frames=10)
    args = TestCameraCalibrator().inputs((), torch.float64)
    lying = args[0].flip(-1)
    for keypoints, valid in ((args[0], torch.zeros_like(args[2])), (lying, args[2])):
        found = module(keypoints, args[1], valid, *args[3:])
        assert int(found.frames) == 0
        assert float(found.pitch_rad) == pytest.approx(0.0, abs=1e-6)
        assert float(found.horizontal_fov_rad) == pytest.approx(math.pi / 3, abs=1e-6)
        assert float(found.height_m) == pytest.approx(1.5, abs=1e-6)
        assert float(found.pitch_sd_rad) == pytest.approx(math.radians(20.0), rel=1e-3)
    found = module(args[0][:0], args[1][:0], args[2][:0], *args[3:])
    assert float(found.pitch_sd_rad) == pytest.approx(math.radians(20.0))


@pytest.mark.parametrize(("seed", "far_share", "lift"), [(1, 0.7, 0.15), (2, 0.5, 0.12)])
def test_keypoints_of_low_scores_do_not_tell_the_camera(seed: int, far_share: float, lift: float) -> None:
    """Feet that are found too high where they are near, with half the usual score, make people small there."""
    camera = known_camera(24.0, 3.0, 60.0)
    walk = walk_before(camera, seed=seed)
    keypoints, scores = walk.keypoints.clone(), walk.scores.clone()
    size = (keypoints[:, 15:17].mean(dim=1) - keypoints[:, 5:7].mean(dim=1)).norm(dim=-1)
    near = (size > size.quantile(far_share))[:, None]
    keypoints[:, 15:17, 1] -= lift * size[:, None] * near
    scores[:, 15:17] = torch.where(near, 0.45, scores[:, 15:17])
    tilts = []
    for threshold in (0.6, 0.3):
        module = CameraCalibrator((walk.height_m,), 0.02, keypoint_threshold=threshold)
        found = module(keypoints[None], scores[None], walk.scores.any(dim=-1)[None], HEIGHT, WIDTH, FPS)
        errors = errors_of(found, camera, walk)
        tilts.append(abs(errors.pitch_deg))
        # Frames that do not count make it less certain, not wrong: a person who walks up to a gap has not stopped.
        assert abs(errors.range) < 0.12
    assert tilts[0] < 0.5
    assert tilts[1] > 0.55


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_whoever_walks_straight_away_walks_all_the_time(seed: int) -> None:
    """Ankles that hardly move against each other, gaps and the ends of a film do not make a walker stand."""
    walk = walk_before(known_camera(0.0, 1.5, 60.0), seed=seed)
    upright = is_upright(walk.keypoints, walk.scores, 0.5)
    share = walking_share(walk.keypoints[None], upright[None], FPS)[0]
    assert float(share[upright].min()) == 1.0
    gap = torch.arange(len(upright)).remainder(70) < 10
    share = walking_share(walk.keypoints[None], (upright & ~gap)[None], FPS)[0]
    assert float(share[upright & ~gap].min()) > 0.5
    assert float(share[gap].max()) == 0.0


def test_who_fights_in_place_does_not_walk() -> None:
    """Feet that move in place say nothing of the focal length."""
    time = torch.arange(60, dtype=torch.float64) / FPS
    body = standing(400.0, 200.0).expand(60, 17, 2).clone()
    body[:, 15, 0] += 25 * (2 * math.pi * time).sin()
    body[:, 16, 0] -= 25 * (2 * math.pi * time).sin()
    there = torch.ones(1, 60, dtype=torch.bool)
    assert not bool(walking_share(body[None], there, FPS).any())
    gone = body + torch.stack([100 * time, 0 * time], dim=-1)[:, None]
    assert float(walking_share(gone[None], there, FPS)[0, 30]) == 1.0
    found = CameraCalibrator(most_frames=15)(
        body[None], torch.ones(1, 60, 17, dtype=torch.float64), there, HEIGHT, WIDTH, FPS
    )
    assert math.degrees(float(found.horizontal_fov_rad)) == pytest.approx(60.0, abs=6.0)


@pytest.mark.parametrize("hertz", [0.7, 0.93, 1.2])
def test_cadence_is_that_of_the_ankles(hertz: float) -> None:
    """Of a person who turns in the middle, so that left and right change sides; people who do not walk have none."""
    time = torch.arange(180, dtype=torch.float64) / FPS
    swing = 25 * (2 * math.pi * hertz * time).sin() * torch.where(time < 3.0, 1.0, -1.0)
    body = standing(400.0, 200.0).expand(180, 17, 2).clone()
    body[:, 15, 0] += swing
    body[:, 16, 0] -= swing
    noise = torch.randn(180, 17, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    walks = torch.ones(180, dtype=torch.float64)
    found, share = cadence(torch.stack([body, body]) + 2 * noise, torch.stack([walks, 0 * walks]), FPS)
    assert float(found[0]) == pytest.approx(hertz, rel=0.03)
    assert float(share[0]) > 0.6
    assert float(share[1]) == 0.0
    # Feet that change places at random have no cadence.
    assert float(cadence((standing(400.0, 200.0) + 10 * noise)[None], walks[None], FPS)[1]) < 0.3


def test_cadence_does_not_depend_on_how_long_the_film_is() -> None:
    walk = walk_before(known_camera(12.0, 1.5, 60.0), 3)
    frames = walk.keypoints.shape[0]
    walking = torch.ones(frames, dtype=torch.float64)
    empty = torch.zeros(7 * frames, 17, 2, dtype=torch.float64)
    alone = cadence(walk.keypoints, walking, FPS)
    longer = cadence(
        torch.cat([walk.keypoints, empty]), torch.cat([walking, torch.zeros(7 * frames).double()]), FPS
    )
    assert torch.equal(alone[0], longer[0])
    assert torch.allclose(alone[1], longer[1], atol=0.02)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cadence_of_generated_walks_tells_their_speed(seed: int) -> None:
    walk = walk_before(known_camera(0.0, 1.5, 60.0), seed=seed)
    upright = is_upright(walk.keypoints, walk.scores, 0.5)[None]
    hertz, share = cadence(walk.keypoints[None], walking_share(walk.keypoints[None], upright, FPS), FPS)
    way = walk.joints[30:, 1, :2] - walk.joints[:-30, 1, :2]
    assert float(share) > 0.4
    assert WALK_RATIO * walk.height_m * float(hertz) ** 2 == pytest.approx(
        float(way.norm(dim=-1).median()), rel=0.15
    )


def test_a_roll_is_found() -> None:
    """Everybody leans to the left of a camera that is turned clockwise."""
    camera = known_camera(12.0, 1.5, 60.0)
    walk = walk_before(camera, seed=1)
    roll = math.radians(4.0)
    c, s = math.cos(roll), math.sin(roll)
    middle = torch.tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2], dtype=torch.float64)
    turned = (walk.keypoints - middle) @ torch.tensor([[c, -s], [s, c]], dtype=torch.float64) + middle
    head, feet = turned[:, 0].mean(dim=0), turned[:, 15:].mean(dim=(0, 1))
    assert head[0] < feet[0]
    found = estimate(walk._replace(keypoints=turned), noise_px=0.0, known_height=True)
    assert float(found.roll_rad) == pytest.approx(roll, abs=math.radians(1.5))


def test_bodies_are_placed_where_they_stand() -> None:
    """Against the projection of points written out."""
    pitch, height, focal = torch.tensor(-0.3, dtype=torch.float64), 2.0, 1.7
    x, y, z = 0.6, 4.0, (0.1, 1.4)
    image = []
    for above in z:
        forward = y * math.cos(-0.3) + (above - height) * math.sin(-0.3)
        down = y * math.sin(-0.3) - (above - height) * math.cos(-0.3)
        image.append([focal * x / forward, focal * down / forward])
    points = torch.tensor(image, dtype=torch.float64)[None, None]
    spot, seen = place_upright(
        camera_axes(pitch, torch.zeros_like(pitch)),
        torch.tensor(height, dtype=torch.float64),
        torch.tensor(focal, dtype=torch.float64),
        points,
        torch.tensor([[z]], dtype=torch.float64),
        torch.zeros_like(points),
    )
    torch.testing.assert_close(spot[0, 0], torch.tensor([x, y], dtype=torch.float64))
    torch.testing.assert_close(seen, points)


def test_upright_is_upright() -> None:
    body = standing(400.0, 200.0)
    seen = torch.ones(17)
    assert bool(is_upright(body, seen, 0.3))
    assert not bool(is_upright(body.flip(-1), seen, 0.3)), "lying"
    assert not bool(is_upright(body * torch.tensor([1.0, -1.0]), seen, 0.3)), "head down"
    sitting = body.clone()
    sitting[13:17, 1] -= 0.2 * 200
    sitting[13:15, 0] += 60
    assert not bool(is_upright(sitting, seen, 0.3))
    hidden = seen.clone()
    hidden[15] = 0.1
    assert not bool(is_upright(body, hidden, 0.3))


def test_who_sits_and_looks_upright_now_and_then_does_not_count() -> None:
    upright = torch.zeros(3, 90, dtype=torch.bool)
    upright[0, 30:60], upright[1, ::2], upright[2] = True, True, True
    valid = torch.ones_like(upright)
    valid[2, 45:] = False
    found = steadily(upright, valid, FPS)
    radius = int(0.4 * FPS)
    # At the ends of the half that is upright, up to a fifth of the frames around are not.
    begins = next(t for t in range(30, 60) if 30 - t + radius <= 0.2 * (2 * radius + 1))
    assert found[0].nonzero()[:, 0].tolist() == list(range(begins, 89 - begins + 1))
    assert not bool(found[1].any())
    assert torch.equal(found[2], valid[2])


def test_a_thing_beside_somebody_who_walks_tells_nothing() -> None:
    """It looks like a small person low in the picture, which a camera high above the floor would see."""
    frames = 60
    walker = torch.stack([standing(320.0 + t, 180.0 + t) for t in range(frames)])
    noise = torch.randn(2, frames, 17, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    thing = standing(470.0, 60.0) + 0.2 * noise[1]
    both = torch.stack([walker + noise[0], thing])
    there = torch.ones(2, frames, dtype=torch.bool)
    assert still_beside_others(ends_of_body(both), there).tolist() == [False, True]
    assert still_beside_others(ends_of_body(both[1:]), there[1:]).tolist() == [False]
    seen = torch.ones(2, frames, 17, dtype=torch.float64)
    module = CameraCalibrator(most_frames=20)
    alone = module(both[:1], seen[:1], there[:1], HEIGHT, WIDTH, FPS)
    beside = module(both, seen, there, HEIGHT, WIDTH, FPS)
    assert int(beside.frames) == int(alone.frames) > 30
    for one, other in zip(beside[:8], alone[:8], strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=0)


def test_a_tilt_that_is_hardly_known_is_drawn_towards_level() -> None:
    value = torch.tensor([0.5, 0.5], dtype=torch.float64)
    deviation = torch.tensor([math.radians(5), math.radians(10)], dtype=torch.float64)
    frames = torch.ones(2, dtype=torch.int64)
    found = CameraEstimate(
        value, value, 3 * value / 0.5, 2 * value, deviation, deviation, value, value, frames
    )
    kept = with_reserve(found, HEIGHT, WIDTH)
    assert kept.pitch_rad.tolist() == pytest.approx([0.5, 0.125])
    assert kept.roll_rad.tolist() == pytest.approx([0.5, 0.125])
    assert kept.height_m.tolist() == pytest.approx([3.0, 1.5 * 2**0.25])
    assert kept.horizontal_fov_rad.tolist() == pytest.approx([1.0, math.pi / 3 + (1 - math.pi / 3) / 4])
    assert torch.equal(kept.pitch_sd_rad, deviation)


def test_pictures_taken_upright_are_as_wide_along_their_longer_side() -> None:
    nobody = torch.zeros(1, 30, dtype=torch.bool)
    keypoints, scores = torch.zeros(1, 30, 17, 2), torch.zeros(1, 30, 17)
    for height, width, fov in ((360, 640, 60.0), (640, 360, 35.98), (500, 500, 60.0)):
        found = CameraCalibrator()(keypoints, scores, nobody, height, width, FPS)
        assert math.degrees(float(found.horizontal_fov_rad)) == pytest.approx(fov, abs=0.01)
        unsure = found._replace(pitch_sd_rad=torch.tensor(1e6), horizontal_fov_rad=torch.tensor(1.5))
        kept = with_reserve(unsure, height, width)
        assert math.degrees(float(kept.horizontal_fov_rad)) == pytest.approx(fov, abs=0.01)
        # 15 degrees along the longer side are as many as the slope has them in the width.
        degrees = torch.deg2rad(torch.tensor([59.99, 60.01], dtype=torch.float64))
        slope = float(horizontal_fov(degrees, height, width).diff() / degrees.diff())
        assert math.degrees(float(found.horizontal_fov_sd_rad)) == pytest.approx(15 * slope, rel=1e-5)


# ---- the fit, in closed form -------------------------------------------------------------------------------


def seen(spots: list[tuple[float, float]], height_m: float, fov: float) -> Bodies:
    """A person with ankles at 0.1 m and shoulders at 1.4 m on these spots in front of a level camera."""
    x, y = torch.tensor(spots, dtype=torch.float64).T
    z = torch.tensor([0.1, 1.4], dtype=torch.float64).expand(len(spots), 2)
    image = torch.stack([(x / y)[:, None].expand(-1, 2), (height_m - z) / y[:, None]], dim=-1)
    ones = torch.ones(1, len(spots), dtype=torch.float64)
    return Bodies(image[None] / math.tan(fov / 2), ones > 0, z[None], ones, 0.01 * ones)


def parameters(height_m: float, fov: float, factor: float, pace: float, lean_m: float = 0.0) -> Tensor:
    return torch.tensor(
        [0.0, 0.0, math.log(height_m), fov, math.log(factor), math.log(pace), lean_m], dtype=torch.float64
    )


@pytest.mark.parametrize("frames", [2, 3, 12, 30])
def test_speeds_of_who_walks_straight(frames: int) -> None:
    """One step of 0.1 m in each of ten frames a second is 1 m/s, in clips of any length; a tenth is one deviation."""
    bodies = seen([(0.1 * t - 1.0, 4.0) for t in range(frames)], 1.5, 1.0)
    away, speed = misfit(parameters(1.5, 1.0, 1.0, 0.8), bodies, 10.0)
    torch.testing.assert_close(away, torch.zeros(1, frames, 4, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(speed, torch.full((1, frames), (1 / 0.8 - 1) / 0.1, dtype=torch.float64))


def test_speed_of_who_turns_is_that_along_the_way() -> None:
    """Right for a second, then away from the camera: the second about the corner is as long as every other."""
    corner = [(0.1 * min(t, 15) - 1.0, 4.0 + 0.1 * max(t - 15, 0)) for t in range(31)]
    _, speed = misfit(parameters(1.5, 1.0, 1.0, 1.0), seen(corner, 1.5, 1.0), 10.0)
    assert float(speed[0, 15]) == pytest.approx(0.0, abs=1e-9)
    assert float(speed.min()) > (math.sqrt(0.5) - 1.0) / 0.1 / 2


def test_who_stands_has_no_speed_and_who_is_not_seen_no_residual() -> None:
    bodies = seen([(0.1 * t - 1.0, 4.0) for t in range(30)], 1.5, 1.0)
    still = bodies._replace(walking=torch.zeros(1, 30, dtype=torch.float64))
    assert not misfit(parameters(1.5, 1.0, 1.0, 0.8), still, 10.0)[1].any()
    hidden = torch.ones(1, 30, dtype=torch.bool)
    hidden[0, 12] = False
    away, speed = misfit(parameters(1.4, 1.0, 1.0, 0.8), bodies._replace(upright=hidden), 10.0)
    assert not away[0, 12].any()
    assert bool(away[0, [11, 13]].any(dim=-1).all())
    # A second about frame 12, or with it at one end, has no known way.
    assert torch.nonzero(speed[0] == 0)[:, 0].tolist() == [7, 12, 17]


def test_shoulders_of_who_walks_lean_ahead() -> None:
    """A person who walks to the right: shoulders 0.1 m ahead of where they would be above the ankles."""
    bodies = seen([(0.1 * t - 1.0, 4.0) for t in range(12)], 1.5, 1.0)
    image = bodies.image.clone()
    image[..., 1, 0] += 0.1 / 4.0 / math.tan(0.5)
    away, _ = misfit(parameters(1.5, 1.0, 1.0, 1.0, lean_m=0.1), bodies._replace(image=image), 10.0)
    torch.testing.assert_close(away, torch.zeros_like(away), atol=1e-9, rtol=0)


def test_who_leans_nobody_knows_where_to_is_believed_less() -> None:
    """Frame 7 is at one end of a second that frame 12 takes away: its residual counts half."""
    bodies = seen([(0.1 * t - 1.0, 4.0) for t in range(30)], 1.5, 1.0)
    hidden = torch.ones(1, 30, dtype=torch.bool)
    hidden[0, 12] = False
    wrong = parameters(1.4, 1.0, 1.0, 1.0)
    whole, _ = misfit(wrong, bodies, 10.0)
    away, _ = misfit(wrong, bodies._replace(upright=hidden), 10.0)
    torch.testing.assert_close(away[0, [6, 7]], whole[0, [6, 7]] / torch.tensor([[1.0], [2.0]]).double())


def test_loss_and_weights_are_those_of_cauchy() -> None:
    """Of a body by its four residuals together, of a speed by its own."""
    residual = torch.tensor([[[1.0, 2.0, -2.0, 4.0, 3.0]]], dtype=torch.float64)
    loss, weight = robust(residual, 2.5)
    squared = torch.tensor([25 / 2.5**2, 9 / 2.5**2], dtype=torch.float64)
    torch.testing.assert_close(loss[0, 0], 2.5**2 / 2 * torch.log(1 + squared))
    torch.testing.assert_close(weight[0, 0], 1 / (1 + squared))


def test_slopes_are_those_of_automatic_differentiation() -> None:
    one = seen([(0.1 * t - 1.0, 4.0 + 0.05 * t) for t in range(12)], 1.5, 1.0)
    bodies = Bodies(*(torch.cat([field, field]) for field in one))
    at = torch.tensor([0.05, -0.02, math.log(1.4), 1.1, 0.02, -0.03, 0.1, -0.2, 0.05, 0.03]).double()
    expected = torch.autograd.functional.jacobian(lambda p: residuals(p, bodies, 10.0), at)
    torch.testing.assert_close(jacobian(at, bodies, 10.0), expected, atol=1e-5, rtol=1e-5)


def test_a_fit_finds_the_camera_and_its_covariance() -> None:
    """From a wrong start to the truth; the covariance is the inverse of the curvature of the loss."""
    bodies = seen([(0.1 * t - 1.5, 3.0 + 0.1 * t) for t in range(30)], 1.7, 1.2)
    truth = parameters(1.7, 1.2, 1.0, math.sqrt(2.0), 0.0)
    mean = truth.clone()
    deviation = torch.tensor([0.3, 0.1, 0.4, 0.3, 0.03, 0.2, 0.02], dtype=torch.float64)
    start = (truth + torch.tensor([0.1, 0.05, -0.2, -0.15, 0.02, 0.1, 0.03], dtype=torch.float64))[None]
    share = torch.full((1, 1, 1), 0.3, dtype=torch.float64)
    at, covariance, cost = fit_camera(start, mean, deviation, bodies, 10.0, share)
    torch.testing.assert_close(at[0], truth, atol=1e-6, rtol=0)
    assert float(cost[0]) < 1e-9
    slope = jacobian(truth, bodies, 10.0).flatten(0, 2)
    curvature = 0.3 * slope.T @ slope + torch.diag(deviation**-2)
    torch.testing.assert_close(covariance[0], torch.linalg.inv(curvature), rtol=1e-3, atol=1e-9)


def test_beliefs_about_cameras() -> None:
    """Before anybody is seen: level within 20 and 3 degrees, 1.5 m high within 1.6 times, 60 degrees within 15."""
    module, degree = CameraCalibrator(), math.pi / 180
    expected = [0.0, 0.0, math.log(1.5), 60 * degree]
    torch.testing.assert_close(module.mean, torch.tensor(expected, dtype=torch.float64))
    assert module.deviation.tolist() == pytest.approx([20 * degree, 3 * degree, 0.45, 15 * degree])
    assert math.exp(0.45) == pytest.approx(1.57, abs=0.01)
    assert len(module.starts.unique(dim=0)) == 12


def test_a_picture_of_one_pixel_is_a_picture() -> None:
    nobody = torch.zeros(1, 1, 3, 17, dtype=torch.bool)[..., 0]
    found = CameraCalibrator()(torch.zeros(1, 1, 3, 17, 2), torch.zeros(1, 1, 3, 17), nobody, 1, 1, 30.0)
    assert float(found[2][0]) == pytest.approx(1.5)


def test_bodies_that_are_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half the time in place, then going: heights of ankles and shoulders of a stand and of a walk, and their noise."""
    time = torch.arange(120, dtype=torch.float64) / FPS
    body = standing(400.0, 200.0).expand(120, 17, 2).clone()
    going = (time - 2.0).clamp(min=0.0)
    body[:, 15, 0] += 25 * (2 * math.pi * going).sin()
    body[:, 16, 0] -= 25 * (2 * math.pi * going).sin()
    body = body + torch.stack([60 * going, 0 * going], dim=-1)[:, None]
    taken: list[Any] = []

    def fit(start: Tensor, mean: Tensor, deviation: Tensor, bodies: Bodies, *_: Any) -> Any:
        taken.extend([mean, deviation, bodies])
        return start, torch.eye(start.shape[1]).double().expand(len(start), -1, -1), torch.zeros(len(start))

    monkeypatch.setattr(calibrator, "fit_camera", fit)
    there = torch.ones(1, 120, dtype=torch.bool)
    CameraCalibrator((1.6,))(body[None], torch.ones(1, 120, 17).double(), there, HEIGHT, WIDTH, FPS)
    mean, deviation, bodies = taken
    assert bodies.walking[0, :45].max() == 0
    assert bodies.walking[0, 80:100].min() == 1
    for when, shares in ((slice(0, 45), (0.039, 0.818)), (slice(80, 100), (0.075, 0.798))):
        expected = 1.6 * torch.tensor(shares, dtype=torch.float64)
        torch.testing.assert_close(
            bodies.above_floor[0, when], expected.expand_as(bodies.above_floor[0, when])
        )
    ankles, shoulders = body[10, 15:].mean(dim=0), body[10, 5:7].mean(dim=0)
    # COCO's ankle is above the joint by 0.048 of the shank, its knee below the joint by 0.038.
    shank = ankles - body[10, 13:15].mean(dim=0)
    ankles = ankles + 0.048 / (1 - 0.048 - 0.038) * shank
    middle = torch.tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2], dtype=torch.float64)
    torch.testing.assert_close(
        bodies.image[0, 10], (torch.stack([ankles, shoulders]) - middle) / (WIDTH / 2), atol=1e-3, rtol=0
    )
    size = float((ankles - shoulders).norm()) / (WIDTH / 2)
    assert float(bodies.noise[0, 10]) == pytest.approx(math.hypot(0.02 * size, 2 / (WIDTH / 2)), rel=1e-3)
    # One cycle per second, within a tenth after two seconds, determines the speed better than none.
    assert mean[[4, 6]].tolist() == pytest.approx([0.0, 0.035 * 1.6])
    assert float(mean[5]) == pytest.approx(math.log(0.9 * 1.6), abs=0.2)
    assert deviation[4:].tolist() == pytest.approx([0.08 / 1.6, 0.08, 0.02 * 1.6])


def test_of_many_people_those_who_tell_most_are_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    time = torch.arange(60, dtype=torch.float64)
    keypoints = standing(400.0, 200.0).expand(40, 60, 17, 2).clone()
    keypoints[..., 0] += 30 * torch.arange(40)[:, None, None]
    keypoints[30, :, :, 0] += 3 * time[:, None]  # the one who goes
    valid = torch.ones(40, 60, dtype=torch.bool)
    taken: list[Any] = []

    def fit(start: Tensor, mean: Tensor, deviation: Tensor, bodies: Bodies, *_: Any) -> Any:
        taken.extend([mean, deviation, bodies])
        return start, torch.eye(start.shape[1]).double().expand(len(start), -1, -1), torch.zeros(len(start))

    monkeypatch.setattr(calibrator, "fit_camera", fit)
    CameraCalibrator()(keypoints, torch.ones(40, 60, 17).double(), valid, HEIGHT, WIDTH, FPS)
    mean, deviation, bodies = taken
    assert len(bodies.image) == 12
    assert len(mean) == len(deviation) == 4 + 3 * 12
    moved = bodies.image[:, -1, 0, 0] - bodies.image[:, 0, 0, 0]
    assert float(moved.max()) > 0.4
