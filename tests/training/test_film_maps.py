from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tensorsim.evaluation.clips import ActivityClip
from tensorsim.evaluation.films import FPS, Filmed, filmed, true_keypoints
from tensorsim.evaluation.settings import Pipelines, Setting
from tensorsim.training.film_errors import FilmErrors, Watched
from tensorsim.training.film_maps import FilmLoss, film_poses

CLIP = ActivityClip("S8 Walking", "0", 7, 2.0)


def errors(clip: ActivityClip = CLIP, found: bool = True) -> FilmErrors:
    """Errors of networks that see a film as it is, or nothing in it."""
    seen = true_keypoints(clip)
    film = Watched.of(clip, seen._replace(valid=seen.valid & found))
    return FilmErrors({"film": film})


def test_a_camera_loses_some_of_a_motion() -> None:
    loss = FilmLoss(errors())
    joints = CLIP.joints(FPS)
    found, seen = loss(joints, CLIP.height_m, torch.Generator().manual_seed(0))
    assert found.shape == (60, 14, 3)
    assert seen.shape == (60,)
    assert bool(seen.all())
    error = (found - joints).norm(dim=-1)
    assert 0.02 < float(error.mean()) < 0.5


def test_the_height_is_known() -> None:
    """As to the truth loop; a person said to be taller is placed farther away."""
    loss = FilmLoss(errors())
    near, far = (
        loss(CLIP.joints(FPS), height, torch.Generator().manual_seed(0))[0][:, 8, 1].mean()
        for height in (CLIP.height_m, 1.1 * CLIP.height_m)
    )
    assert float(far) > float(near) + 0.2


def test_nobody_found_is_nobody_there() -> None:
    other = replace(CLIP, seed=19)
    joints, seen = FilmLoss(errors(found=False))(other.joints(FPS), 1.7, torch.Generator().manual_seed(0))
    assert not bool(seen.any())
    assert bool(joints.isfinite().all())


def test_joints_are_those_of_the_truth_loop() -> None:
    """Keypoints with errors are lifted as those of a film are."""
    mine = errors()
    seen = mine(CLIP.joints(FPS), CLIP.height_m, torch.Generator().manual_seed(1))
    joints, valid = FilmLoss(mine)(CLIP.joints(FPS), CLIP.height_m, torch.Generator().manual_seed(1))
    expected, there = Pipelines({}).joints(Setting("c"), CLIP, Filmed(seen, seen))
    torch.testing.assert_close(joints, expected[0].double())
    assert torch.equal(valid, there[0])


def test_films_are_lifted_and_labelled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A person at the place of the true keypoints, and nobody in an empty scene."""
    for row, folder in (("S1 Empty", "S1_Empty"), ("S8 Walking", "S8_Walking")):
        clip = ActivityClip(row, "1", 12 if row == "S1 Empty" else 19)
        seen = true_keypoints(clip)
        monkeypatch.setattr(
            "tensorsim.evaluation.films.render_and_watch", lambda *_, seen=seen: Filmed(seen, seen)
        )
        filmed(tmp_path / folder / "1-0123abcd.npz", clip, torch.nn.Identity(), torch.nn.Identity())
    empty, walk = film_poses(tmp_path)
    assert (empty.activity, walk.activity) == (0, 7)
    assert empty.joints.shape == walk.joints.shape == (1, 120, 14, 3)
    assert not bool(empty.valid.any())
    assert bool(walk.valid.any())
    away = (walk.joints[0] - ActivityClip("S8 Walking", "1", 19).joints(FPS)).norm(dim=-1)
    assert float(away[walk.valid[0]].median()) < 0.5
