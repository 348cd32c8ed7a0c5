from pathlib import Path

import numpy as np
import pytest
import torch

from tensorsim.body.skeleton import MIRRORED
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.clips import ActivityClip, activity_clips
from tensorsim.evaluation.films import FPS, Observed, project
from tensorsim.training.film_errors import FilmErrors, Look, Watched, watched_films

KICK, WALK = ActivityClip("S3 Kicking", "0", 2), ActivityClip("S8 Walking", "0", 7)


def seen(clip: ActivityClip, error_px: float = 0.0, joint: int = 9, lost: int = 0) -> Observed:
    """The true keypoints, one of them misplaced; lost in the first frames; and a track without a person."""
    pixels, inside, _ = project(clip.joints(FPS))
    keypoints = pixels.clone()
    keypoints[:, joint, 0] += error_px
    valid = torch.arange(len(pixels)) >= lost
    return Observed(
        torch.zeros(2, len(pixels), 4),
        torch.stack([torch.ones_like(valid), valid]),
        torch.stack([keypoints + 300.0, keypoints]).float(),
        torch.stack([torch.full_like(inside.float(), 0.3), 0.9 * inside]).float(),
    )


def watched(clip: ActivityClip, *arguments: float) -> Watched:
    return Watched.of(clip, seen(clip, *arguments))  # type: ignore[arg-type]


def test_a_unit_is_the_standing_height_in_the_picture() -> None:
    """At any distance: a walker's keypoints, from eyes to ankles, span a little less than one."""
    look = Look.of(WALK.joints(FPS), WALK.height_m)
    assert float(look.unit_px.max() / look.unit_px.min()) > 1.05
    span = look.shape[..., 1].amax(1) - look.shape[..., 1].amin(1)
    assert 0.8 < float(span.min()) < float(span.max()) < 1.0


def test_errors_are_found_less_true_and_of_the_nearest_track() -> None:
    one = watched(WALK, 7.0, 9, 5)
    look = Look.of(WALK.joints(FPS), WALK.height_m)
    assert one.found.tolist() == [False] * 5 + [True] * 115
    torch.testing.assert_close(one.error[5:, 9, 0], 7.0 / look.unit_px[5:], rtol=1e-4, atol=1e-6)
    assert float(one.error[:, :9].abs().max()) < 1e-5
    assert float(one.error[:5].abs().max()) == 0
    assert float(one.scores[5:][one.inside[5:]].min()) == pytest.approx(0.9)


def test_a_mirror_swaps_sides() -> None:
    one = watched(KICK, 7.0)
    turned = one.mirrored()
    assert MIRRORED[9] == 10
    torch.testing.assert_close(turned.error[:, 10, 0], -one.error[:, 9, 0])
    torch.testing.assert_close(turned.shape[:, 15, 1], one.shape[:, 16, 1])
    torch.testing.assert_close(turned.mirrored().shape, one.shape)


def test_the_same_motion_gets_its_own_errors() -> None:
    """The film of a motion is the one most alike, wherever it is in the picture, with all that was found and lost."""
    errors = FilmErrors({"walk": watched(WALK, -9.0, 9, 24), "kick": watched(KICK, 5.0, 13)})
    errors.films = [errors.films[0], errors.films[2]] * 2  # as if mirrored ones did not exist
    errors._starts = [errors._starts[0], errors._starts[2]] * 2
    errors._features = [errors._features[0], errors._features[2]] * 2
    right = {}
    for seed in range(8):
        found = errors(KICK.joints(FPS), KICK.height_m, torch.Generator().manual_seed(seed))
        error = found.keypoints[0] - project(KICK.joints(FPS))[0]
        right[seed] = bool((error[:, 13, 0] - 5.0).abs().max() < 1e-2)
        if right[seed]:
            assert float(error[:, :13].abs().max()) < 1e-2
            assert bool(found.valid.all())
    assert any(right.values())


def test_similar_pieces_are_preferred_to_others() -> None:
    """Another walker gets the errors of the walk: a wrist, not the ankle of the kick."""
    other = ActivityClip("S8 Walking", "1", 19)
    kicks = {f"kick{k}": watched(KICK, 40.0, 15) for k in range(3)}
    walks = {f"walk{k}": watched(WALK, 40.0, 9) for k in range(3)}
    errors = FilmErrors(kicks | walks)
    wrist, ankle = 0.0, 0.0
    for seed in range(6):
        found = errors(other.joints(FPS), other.height_m, torch.Generator().manual_seed(seed))
        error = (found.keypoints[0] - project(other.joints(FPS))[0]).norm(dim=-1)
        wrist += float(error[:, 9:11].max(-1).values.mean())
        ankle += float(error[:, 15:17].max(-1).values.mean())
    assert wrist > 2 * ankle


def test_an_error_grows_with_the_person() -> None:
    """The copy is in body heights: twice as near, twice as many pixels."""
    errors = FilmErrors({"walk": watched(WALK, 10.0)})
    joints = WALK.joints(FPS)
    units, sizes = [], []
    for nearer in (0.0, 1.0):
        moved = joints - joints.new_tensor([0.0, nearer, 0.0])
        found = errors(moved, WALK.height_m, torch.Generator().manual_seed(0))
        sizes.append((found.keypoints[0] - project(moved)[0]).norm(dim=-1)[:, 9:11].sum(-1).median())
        units.append(Look.of(moved, WALK.height_m).unit_px.median())
    assert float(units[1]) > 1.1 * float(units[0])
    assert float(sizes[1] / sizes[0]) == pytest.approx(float(units[1] / units[0]), rel=0.1)


def test_nothing_is_found_where_nothing_was() -> None:
    errors = FilmErrors({"walk": watched(WALK, 0.0, 9, 120)})
    found = errors(WALK.joints(FPS), WALK.height_m, torch.Generator().manual_seed(0))
    assert not bool(found.valid.any())
    assert bool(found.keypoints.isfinite().all())
    assert float(found.scores.abs().max()) == 0


def test_the_same_seed_gives_the_same_errors() -> None:
    films = {"walk": watched(WALK, 9.0), "kick": watched(KICK, 5.0), "lost": watched(WALK, -5.0, 3, 60)}
    joints = ActivityClip("S8 Walking", "2", 31).joints(FPS)[:50]

    def found(seed: int) -> torch.Tensor:
        return FilmErrors(films)(joints, 1.7, torch.Generator().manual_seed(seed)).keypoints

    assert found(3).shape == (1, 50, 17, 2)
    assert torch.equal(found(3), found(3))
    assert any(not torch.equal(found(3), found(seed)) for seed in range(4, 9))


def write_film(folder: Path, clip: ActivityClip, film: Observed) -> None:
    path = folder / "".join(c if c.isalnum() else "_" for c in clip.row) / f"{clip.name}-0123abcd.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    parts = {
        f"{part}_{name}": getattr(film, name) for part in ("found", "boxed") for name in Observed._fields
    }
    np.savez(path, **{name: tensor.numpy() for name, tensor in parts.items()})


def test_reads_the_films_of_the_truth_loop(tmp_path: Path) -> None:
    clip = activity_clips(("S3 Kicking",), 1, 4)["S3 Kicking"][0]
    assert isinstance(clip, ActivityClip)
    write_film(tmp_path, clip, seen(clip, 3.0))
    nobody = Observed(*(x[:0] for x in seen(WALK)))
    write_film(tmp_path, WALK, nobody)
    write_film(tmp_path, ActivityClip("S1 Empty", "0", 0), nobody)
    films = watched_films(tmp_path)
    assert list(films) == ["S3_Kicking/4-0123abcd.npz"]
    look = Look.of(clip.joints(FPS), clip.height_m)
    torch.testing.assert_close(
        films["S3_Kicking/4-0123abcd.npz"].error[:, 9, 0], 3.0 / look.unit_px, rtol=1e-3, atol=1e-6
    )


def test_other_films_have_another_digest() -> None:
    digests = {FilmErrors({"walk": watched(WALK, error)}).digest for error in (1.0, 2.0, 1.0)}
    assert len(digests) == 2


def test_refuses_what_is_too_short_or_not_there(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="got no films, expected those of"):
        watched_films(tmp_path)
    (tmp_path / "S13_Flying").mkdir()
    (tmp_path / "S13_Flying" / "0-0.npz").touch()
    with pytest.raises(TensorsimError, match="a name without a clip"):
        watched_films(tmp_path)
    with pytest.raises(TensorsimError, match="got a film of 0 frames, expected 12 or more"):
        FilmErrors({})
    errors = FilmErrors({"walk": watched(WALK)})
    with pytest.raises(TensorsimError, match="got 11 frames, expected at least 12"):
        errors(WALK.joints(FPS)[:11], 1.7, torch.Generator())
