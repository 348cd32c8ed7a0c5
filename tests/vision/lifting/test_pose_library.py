"""Pools of poses: scaling, turning, loading, and the shipped one against its manifest and recipe."""

import hashlib
import json
from pathlib import Path

import pytest
import torch
import tyro
from safetensors.torch import load_file, save_file

from tensorsim.body import proportions
from tensorsim.body.skeleton import body_height, mid_hips
from tensorsim.commands.library import BuildLibrary
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.model_files import model_path, models_dir
from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.vision.lifting.pose_library import (
    SHIPPED_LIBRARY,
    all_headings,
    load_pose_library,
    standardise_poses,
    turn,
)


def test_body_height_is_that_of_the_model_body_in_every_pose() -> None:
    height = body_height(1.75 * sample_poses(200))
    # The pelvis may tilt against the legs, but bones keep their lengths.
    torch.testing.assert_close(height, torch.full_like(height, 1.75), rtol=1e-9, atol=0)


def test_standardised_poses_do_not_depend_on_place_and_unit() -> None:
    poses = sample_poses(60)
    moved = (1800 * poses + torch.tensor([3000.0, 200.0, -50.0])).reshape(3, 20, 14, 3)
    standard = standardise_poses(moved)
    torch.testing.assert_close(standard, poses, atol=1e-9, rtol=0)
    torch.testing.assert_close(mid_hips(standard), torch.zeros(60, 3, dtype=torch.float64))


def test_headings_turn_counter_clockwise_seen_from_above() -> None:
    poses = standardise_poses(sample_poses(20))
    quarter = all_headings(poses, 4).reshape(20, 4, 14, 3)
    torch.testing.assert_close(quarter[:, 0], poses)
    x, y, z = poses.unbind(-1)
    torch.testing.assert_close(quarter[:, 1], torch.stack([-y, x, z], dim=-1))
    torch.testing.assert_close(turn(poses, torch.full((20,), 3.0, dtype=torch.float64))[..., 2], z)


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (torch.zeros(0, 14, 3), "no poses"),
        (torch.randn(5, 17, 3), r"got shape \[5, 17, 3\]"),
        (torch.randn(5, 14, 2), r"got shape \[5, 14, 2\]"),
        (torch.zeros(5, 14, 3), "no length"),
        (torch.full((5, 14, 3), float("nan")), "NaN"),
        (torch.zeros(5, 14, 3, dtype=torch.int64), "dtype"),
    ],
)
def test_refuses_what_is_no_library(joints: torch.Tensor, message: str) -> None:
    with pytest.raises(TensorsimError, match=f"pose library.*{message}"):
        standardise_poses(joints)


def test_loads_a_file_of_ones_own(tmp_path: Path) -> None:
    poses = sample_poses(30).float()
    save_file({"poses": 1.8 * poses}, tmp_path / "own.safetensors")
    torch.testing.assert_close(load_pose_library(tmp_path / "own.safetensors"), poses, atol=1e-6, rtol=0)


def test_refuses_files_that_are_no_library(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="no file"):
        load_pose_library(tmp_path / "missing.safetensors")
    (tmp_path / "text.safetensors").write_text("not a tensor at all")
    with pytest.raises(TensorsimError, match="not a safetensors file"):
        load_pose_library(tmp_path / "text.safetensors")
    save_file({"weights": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(TensorsimError, match="no tensor 'poses', only \\['weights'\\]"):
        load_pose_library(tmp_path / "other.safetensors")


def test_shipped_library_is_what_the_manifest_says() -> None:
    entries = json.loads((models_dir() / "manifest.json").read_text(encoding="utf-8"))["models"]
    (entry,) = [e for e in entries if e["file"] == SHIPPED_LIBRARY]
    content = model_path(SHIPPED_LIBRARY).read_bytes()
    assert len(content) == entry["bytes"] < 1_500_000
    assert hashlib.sha256(content).hexdigest() == entry["sha256"]
    assert entry["licence"] == "Apache-2.0"


def test_recipe_of_the_manifest_makes_the_shipped_library_again(tmp_path: Path) -> None:
    entries = json.loads((models_dir() / "manifest.json").read_text(encoding="utf-8"))["models"]
    (entry,) = [e for e in entries if e["file"] == SHIPPED_LIBRARY]
    words = entry["recipe"].split()
    assert words[:3] == ["tensorsim", "library", "build"]
    target = tmp_path / "again.safetensors"
    words[words.index("--out") + 1] = str(target)
    tyro.cli(BuildLibrary, args=[*words[3:], "--quiet"]).run()
    again, shipped = load_file(target)["poses"], load_file(model_path(SHIPPED_LIBRARY))["poses"]
    # Another machine may round a last bit of float16 differently.
    assert abs(len(again) - len(shipped)) <= 2
    near = torch.cdist(shipped[::7].float().flatten(1), again.float().flatten(1)).amin(dim=1)
    assert float(near.quantile(0.99)) < 1e-2


def test_shipped_library_is_made_of_human_bodies() -> None:
    poses = load_pose_library()
    assert poses.dtype == torch.float32
    torch.testing.assert_close(body_height(poses), torch.ones(len(poses)), atol=1e-3, rtol=0)
    knee, ankle = poses[:, JOINTS.index("left_knee")], poses[:, JOINTS.index("left_ankle")]
    shank = (knee - ankle).norm(dim=-1)
    assert (
        0.9 * proportions.SHANK
        < float(shank.quantile(0.05))
        < float(shank.quantile(0.95))
        < 1.1 * proportions.SHANK
    )


def test_a_missing_model_is_named_with_what_there_is() -> None:
    with pytest.raises(TensorsimError, match=r"'nothing.safetensors', expected one of: .*pose_library_small"):
        model_path("nothing.safetensors")


@pytest.mark.parametrize("place", ["package/_models", "models"])
def test_models_are_found_in_a_wheel_and_in_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    monkeypatch.setattr("tensorsim.model_files._PACKAGE", tmp_path / "package")
    with pytest.raises(TensorsimError, match=r"no manifest\.json"):
        models_dir()
    (tmp_path / place).mkdir(parents=True)
    (tmp_path / place / "manifest.json").write_text("{}")
    assert model_path("manifest.json") == tmp_path / place / "manifest.json"
