"""People cut out of rendered pictures: outlines, points, repeatable."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tensorsim.errors import TensorsimError
from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.training import cutouts as module
from tensorsim.training.cutouts import Cutouts, render_cutout, render_cutouts
from tests.training.tars import write_tar


@pytest.mark.parametrize("index", [0, 20, 45, 60])
def test_points_lie_on_the_person(index: int) -> None:
    rgba, keypoints = render_cutout(sample_poses(65, 0)[index], seed=index, side=96)
    alpha = rgba[..., 3]
    assert 60 <= max(alpha.shape) <= 100
    # Cropped to the person, with one pixel around.
    solid = alpha > 127
    rows, columns = np.flatnonzero(solid.any(1)), np.flatnonzero(solid.any(0))
    assert max(rows[0], columns[0]) <= 1
    assert rows[-1] >= alpha.shape[0] - 2
    assert ((alpha > 0) & (alpha < 255)).sum() > 20  # soft edges
    seen = keypoints[keypoints[:, 2] == 2, :2].round().astype(int)
    assert len(seen) >= 5
    near = [solid[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].any() for x, y in seen]
    assert all(near)
    # Both ends of the body: the picture is not a part of it.
    assert (keypoints[:, 2] > 0).all()


def test_shards_are_repeatable_and_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PER_SHARD", 16)
    small = render_cutout
    monkeypatch.setattr(module, "render_cutout", lambda pose, seed: small(pose, seed, side=40))
    paths = render_cutouts(26, 3, tmp_path, quiet=True)
    assert [p.name for p in paths] == ["cutouts-000.tar", "cutouts-001.tar"]
    people = Cutouts(paths)
    assert len(people) == 26
    data = [p.read_bytes() for p in paths]
    paths[1].unlink()
    render_cutouts(26, 3, tmp_path, quiet=True)
    assert [p.read_bytes() for p in paths] == data
    assert sorted(tmp_path.iterdir()) == [*paths, tmp_path / "cutouts.json"]
    with pytest.raises(
        TensorsimError, match=r"it holds rendered people of .*'seed': 3.*, expected .*'seed': 4"
    ):
        render_cutouts(26, 4, tmp_path, quiet=True)
    with pytest.raises(TensorsimError, match=r"'people': 26.*, expected .*'people': 27"):
        render_cutouts(27, 3, tmp_path, quiet=True)
    # Shards without a description are used as they are.
    (tmp_path / "cutouts.json").unlink()
    assert render_cutouts(26, 4, tmp_path, quiet=True) == paths
    assert [p.read_bytes() for p in paths] == data
    (tmp_path / "cutouts.json").write_text("{")
    with pytest.raises(TensorsimError, match=r"cutouts\.json: damaged"):
        render_cutouts(26, 3, tmp_path, quiet=True)
    other = render_cutouts(26, 4, tmp_path / "other", quiet=True)
    assert other[0].read_bytes() != data[0]


def test_processes_begin_with_shards_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PER_SHARD", 8)
    small = render_cutout
    drawn: list[int] = []

    def draw(pose: torch.Tensor, seed: int) -> module.Cutout:
        drawn.append(seed % 1_000_003)
        return small(pose, seed, side=40)

    monkeypatch.setattr(module, "render_cutout", draw)
    alone = render_cutouts(26, 3, tmp_path / "alone", quiet=True)
    assert drawn == list(range(26))
    drawn.clear()
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    second = render_cutouts(26, 3, tmp_path / "second", quiet=True)
    assert drawn == [*range(8, 16), 24, 25, *range(8), *range(16, 24)]
    assert [path.read_bytes() for path in second] == [path.read_bytes() for path in alone]


def test_another_tar_is_refused(tmp_path: Path) -> None:
    path = write_tar(tmp_path / "cutouts-000.tar", {"0.png": b"", "0.json": b"[]"})
    with pytest.raises(TensorsimError, match=r"cutouts-000\.tar: not a shard of cut-outs"):
        Cutouts([path])
