"""A film in one line: what the streaming reader gives, in one tensor."""

from pathlib import Path

import numpy as np
import pytest
import torch

import tensorsim as ts


def test_read_video_gives_all_frames_and_the_rate(tmp_path: Path) -> None:
    levels = np.linspace(20, 220, 70).astype(np.uint8)
    frames = [np.full((32, 48, 3), level) for level in levels]
    ts.data.write_video(tmp_path / "film.mp4", frames, 25.0)
    video, fps = ts.data.read_video(tmp_path / "film.mp4")
    assert fps == 25.0
    assert video.dtype == torch.uint8
    assert video.shape == (1, 70, 3, 32, 48)
    assert np.allclose(video.double().mean((0, 2, 3, 4)), levels, atol=4)
    part = ts.data.read_video(tmp_path / "film.mp4", start_s=1.0, end_s=2.0, stride=5)
    assert part.fps == 5.0
    assert torch.equal(part.video, video[:, 25:50:5])
    with pytest.raises(ts.TensorsimError, match="no such file"):
        ts.data.read_video(tmp_path / "none.mp4")
