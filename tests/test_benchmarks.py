"""The command's benchmark times every stage that it names."""

from pathlib import Path

import pytest

from tensorsim.commands.demo import film_person
from tensorsim.data.video_writer import write_video
from tests.benchmarks import bench_video


@pytest.mark.slow
def test_every_stage_of_the_benchmark_is_timed(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    frames = film_person(7, 45, 0).film.frames
    write_video(film, iter(frames.permute(0, 2, 3, 1).numpy()), 30.0)
    stages, wall, finding = bench_video.simulate(film, [])
    assert set(stages) == {stage for *_, stage in bench_video.STAGES} | {"decoding", "the rest"}
    assert min(stages.values()) > 0
    assert 0 < finding < wall
