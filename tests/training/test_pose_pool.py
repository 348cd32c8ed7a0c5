"""Building pools of poses: headings, near-duplicates, sources, and the command."""

import glob
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tensorsim import cli
from tensorsim.body.skeleton import body_height, mirror
from tensorsim.commands.library import BuildLibrary
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.training.pose_pool import (
    everyday_poses,
    facing_away,
    generated_poses,
    recorded_poses,
    with_mirror_images,
    without_near_duplicates,
)
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.pose_library import load_pose_library, standardise_poses, turn


def test_every_heading_of_a_pose_becomes_the_same() -> None:
    poses = standardise_poses(sample_poses(50, seed=2))
    angle = torch.linspace(0, 6, 50, dtype=torch.float64)
    torch.testing.assert_close(facing_away(turn(poses, angle)), facing_away(poses))
    right = (
        facing_away(poses)[:, JOINTS.index("right_hip")]
        + facing_away(poses)[:, JOINTS.index("right_shoulder")]
    )
    left = (
        facing_away(poses)[:, JOINTS.index("left_hip")] + facing_away(poses)[:, JOINTS.index("left_shoulder")]
    )
    assert float((right - left)[:, 0].min()) > 0
    torch.testing.assert_close((right - left)[:, 1], torch.zeros(50, dtype=torch.float64), atol=1e-12, rtol=0)


def test_no_two_poses_are_near_and_none_is_lost() -> None:
    generator = torch.Generator().manual_seed(0)
    groups = standardise_poses(sample_poses(60))
    noise = 0.001 * torch.randn(40, 60, 14, 3, generator=generator, dtype=torch.float64)
    poses = (groups + noise).flatten(0, 1)  # 2400: more than a block
    kept = without_near_duplicates(poses, 0.02)
    distance = torch.cdist(kept.flatten(1), kept.flatten(1)) / math.sqrt(14)
    assert float(distance.fill_diagonal_(1.0).min()) >= 0.02
    to_kept = torch.cdist(poses.flatten(1), kept.flatten(1)) / math.sqrt(14)
    assert float(to_kept.amin(dim=1).max()) < 0.02
    assert 40 < len(kept) <= 60
    assert torch.equal(kept[0], poses[0])


def test_generated_poses_are_bodies_of_many_proportions_on_both_sides() -> None:
    poses = generated_poses(660, seed=3)
    assert poses.shape == (660, 14, 3)
    assert torch.equal(poses, generated_poses(660, seed=3))
    assert not torch.equal(poses, generated_poses(660, seed=4))
    torch.testing.assert_close(body_height(poses), torch.ones(660, dtype=torch.float64))
    shank = (poses[:, 9] - poses[:, 10]).norm(dim=-1)
    assert 0.03 < float(shank.std() / shank.mean()) < 0.08
    sides = poses[:, JOINTS.index("right_wrist"), 1].mean() - poses[:, JOINTS.index("left_wrist"), 1].mean()
    assert abs(float(sides)) < 0.03  # neither hand is in front more often
    with pytest.raises(TensorsimError, match="got a count of 10, expected at least 396"):
        generated_poses(10, seed=0)


def test_the_shipped_pool_has_a_pose_near_those_of_other_people_who_move_near_the_floor() -> None:
    # Root mean square over the joints, in body heights. Of a pool whose falls ended on the arms: 0.030 and 0.141.
    poses = everyday_poses(400, seed=77)
    torch.testing.assert_close(body_height(poses), torch.ones(400, dtype=torch.float64))
    assert torch.equal(poses, everyday_poses(400, seed=77))
    pool = load_pose_library().double()
    away = torch.cdist(poses.flatten(1), pool.flatten(1)).amin(dim=1) / math.sqrt(14)
    assert float(away.mean()) < 0.028
    assert float(away.quantile(0.95)) < 0.1


def test_reads_all_clips_of_a_file_and_leaves_out_who_is_not_there(tmp_path: Path) -> None:
    clip = 1.8 * sample_poses(40).numpy()
    np.savez(tmp_path / "two.npz", walk=clip[:30], run=clip[30:], walk_fps=60.0)
    found = recorded_poses(tmp_path / "two.npz")
    torch.testing.assert_close(found, facing_away(standardise_poses(torch.tensor(clip))), atol=1e-5, rtol=0)
    valid = np.zeros((1, 40), dtype=bool)
    np.savez(tmp_path / "some.npz", joints_m=clip[None], valid=valid | (np.arange(40) < 7), fps=30.0)
    assert len(recorded_poses(tmp_path / "some.npz")) == 7
    np.savez(tmp_path / "none.npz", joints_m=clip[None], valid=valid, fps=30.0)
    with pytest.raises(TensorsimError, match=r"none\.npz: contains no people"):
        recorded_poses(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(TensorsimError, match=r"text\.npz: got a file that cannot be read"):
        recorded_poses(tmp_path / "text.npz")


def test_command_builds_from_folders_patterns_and_the_generator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mocap" / "deep"
    folder.mkdir(parents=True)
    clip = standardise_poses(sample_poses(30))
    np.savez(folder / "a.npz", joints_m=clip[:20].numpy(), fps=30.0)
    np.savez(tmp_path / "mocap" / "b.npz", joints_m=clip[20:].numpy(), fps=30.0)
    out = tmp_path / "new" / "pool.safetensors"
    BuildLibrary(sources=(tmp_path / "mocap",), out=out, quiet=True, tolerance=1e-4).run()
    poses = load_pose_library(out)
    assert len(poses) == 60
    assert "kept 60 of 60 poses (60 differ)" in capsys.readouterr().out
    expected = with_mirror_images(facing_away(clip)).float()
    assert float(torch.cdist(expected.flatten(1), poses.flatten(1)).amin(dim=1).max()) < 5e-3  # float16
    assert float(torch.cdist(mirror(poses).flatten(1), poses.flatten(1)).amin(dim=1).max()) < 5e-3

    BuildLibrary(sources=(Path(tmp_path / "m*" / "*.npz"),), out=out, generate=400, most=50, quiet=True).run()
    assert load_file(out)["poses"].shape == (50, 14, 3)
    assert load_file(out)["poses"].dtype == torch.float16
    assert glob.glob(str(out.parent / ".*")) == []
    NearestPoseLifter(load_pose_library(out), yaws=4)


def test_the_command_goes_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip = standardise_poses(sample_poses(20))
    np.savez(tmp_path / "a.npz", joints_m=clip.numpy(), fps=30.0)
    out = tmp_path / "pool.safetensors"
    cli.main(["library", "build", str(tmp_path / "a.npz"), "--out", str(out), "--quiet"])
    assert "of 40" in capsys.readouterr().out
    assert out.is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "nothing to build from"),
        ({"generate": 400, "seed": -1}, "--seed: got -1"),
        ({"generate": -5}, "--generate: got -5"),
        ({"generate": 400, "most": 0}, "--most: got 0"),
        ({"generate": 400, "out": Path("pool.npz")}, r"--out: got pool\.npz"),
        ({"generate": 400, "tolerance": 0.0}, "tolerance"),
        ({"sources": (Path("missing/*.bvh"),)}, r"got missing/\*\.bvh, expected motion files"),
    ],
)
def test_command_refuses(
    options: dict[str, object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TensorsimError, match=message):
        BuildLibrary(**{"quiet": True, **options}).run()  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
