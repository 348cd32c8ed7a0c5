import torch

from tensorsim.evaluation.films import project
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.training.film_maps import FilmLoss, as_if_found


def keypoints(activity: int, duration_s: float = 40.0) -> tuple[torch.Tensor, torch.Tensor]:
    motion = ActivityGenerator().generate(activity, seed=1, duration_s=duration_s, rate_hz=30.0)
    pixels, inside, _ = project(motion.joints[0])
    return pixels, inside


def test_errors_are_those_of_a_pose_network() -> None:
    """Medians and tails between those measured on rendered films, about the same a frame later, worse at the arms."""
    pixels, inside = keypoints(1)
    inside[:, 3] = False
    found, scores = [], []
    for seed in range(8):
        k, s = as_if_found(pixels, inside, torch.Generator().manual_seed(seed))
        found.append(k), scores.append(s)
    extent = (pixels[inside.any(1)].amax(1) - pixels[inside.any(1)].amin(1)).amax(-1).quantile(0.9)
    error = (torch.stack(found) - pixels) / extent
    size = error.norm(dim=-1)
    assert 0.01 < float(size.median()) < 0.03
    assert 0.03 < float(size.quantile(0.9)) < 0.12
    kept = (error[:, 1:] * error[:, :-1]).sum() / error.square().sum()
    assert 0.8 < float(kept) < 0.95
    assert float(size[:, :, 7:11].median()) > 1.2 * float(size[:, :, 11:].median())
    score = torch.stack(scores)
    assert bool((score[:, :, 3] == 0).all())
    assert 0 < float(score[:, inside].min()) < float(score.max()) < 1
    trusted, doubted = size[score > 0.8], size[(score < 0.5) & (score > 0)]
    assert float(doubted.median()) > 2 * float(trusted.median())


def test_the_same_seed_gives_the_same_errors() -> None:
    pixels, inside = keypoints(7, 2.0)
    one, other = (as_if_found(pixels, inside, torch.Generator().manual_seed(3)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_a_camera_loses_some_of_a_motion() -> None:
    motion = ActivityGenerator().generate(7, seed=1, duration_s=2.0, rate_hz=30.0)
    height_m = float(motion.people.height_m[0])
    joints, seen = FilmLoss()(motion.joints[0], height_m, 30.0, torch.Generator().manual_seed(0))
    assert joints.shape == (60, 14, 3)
    assert bool(seen.all())
    error = (joints - motion.joints[0]).norm(dim=-1)
    assert 0.02 < float(error.mean()) < 1.0


def test_nobody_in_the_picture_is_nobody_found() -> None:
    behind = torch.full((30, 14, 3), -50.0)
    joints, seen = FilmLoss()(behind, 1.7, 30.0, torch.Generator().manual_seed(0))
    assert not bool(seen.any())
    assert bool(joints.isfinite().all())
