"""``tensorsim evaluate films``: labels are read and checked, networks run once per film, tables say what was found."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim import cli
from tensorsim.commands import evaluate_films
from tensorsim.config import ACTIVITIES, RadarConfig
from tensorsim.data.video_writer import write_video
from tensorsim.errors import TensorsimError
from tensorsim.evaluation import film_sheet
from tensorsim.evaluation.labelled_films import (
    FilmReader,
    LabelledFilm,
    Scene,
    Verdict,
    followed,
    judged,
    markdown,
    read_labels,
)
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.results import Axes
from tensorsim.streaming import Found
from tensorsim.types import Detections, Pose, RadarMaps
from tensorsim.vision.onnx_engine import OnnxEngine
from tests.film import RectangleDetector, StandingPose, film, panned, walker

FPS = 10.0


class CountingDetector(RectangleDetector):
    """Counts the frames that it has seen."""

    frames = 0

    def forward(self, images: Tensor) -> Detections:
        type(self).frames += images.shape[0]
        return super().forward(images)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two seconds of a person who walks away, and two of an empty room."""
    folder = tmp_path / "films"
    folder.mkdir()
    away = film(*walker(20, FPS, 4.0, 1.2, 0.3))
    for name, frames in (("walk.avi", away), ("room.avi", torch.zeros_like(away))):
        size = (frames.shape[3], frames.shape[2])
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter_fourcc(*"FFV1"), FPS, size)
        for frame in frames.permute(0, 2, 3, 1).numpy():
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
        writer.release()
    rows = [
        {"file": "walk.avi", "start_s": 0.2, "end_s": 2, "accept": [ACTIVITIES[7]]},
        {"file": "room.avi", "start_s": 0, "end_s": 2, "accept": [ACTIVITIES[0]]},
    ]
    (folder / "labels.json").write_text(json.dumps(rows))
    return folder


@pytest.fixture
def arguments(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Of the command, which writes into ``out``, with networks for the films of :func:`data` that count."""
    weights = tmp_path / "w.onnx"
    weights.write_text("")
    monkeypatch.setattr(evaluate_films, "load_networks", lambda *_: (CountingDetector(), StandingPose()))
    CountingDetector.frames = 0
    paths = ["--data", str(data), "--out", str(tmp_path / "out")]
    networks = ["--detector", str(weights), "--pose", str(weights), "--lifter", "nearest"]
    return ["evaluate", "films", *paths, *networks, "--scenes", "through-wall", "--quiet"]


def test_the_command_labels_films_and_runs_the_networks_once(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    cli.main(arguments)
    walk, room = json.loads((out / "films.json").read_text())
    assert walk["seconds"] == pytest.approx(1.8)
    assert walk["people"][0]["followed_s"] == pytest.approx(1.8)
    # The figure glides without steps: a part of its motion is taken for an error of its size.
    assert walk["people"][0]["mean_approach_m_s"] == pytest.approx(-1.2, abs=0.25)
    assert 0.5 < walk["people"][0]["fastest_joint_m_s"] < 4.0
    assert room["people"] == []
    assert "no person found" in " ".join(room["warnings"])
    verdict = walk["scenes"]["through-wall"]
    assert verdict["label"] in ACTIVITIES
    assert verdict["right"] == (verdict["label"] == ACTIVITIES[7])
    for name in ("walk", "room"):
        picture = cv2.imread(str(out / f"{name}.png"))
        assert picture is not None
        assert picture.shape[1] > 1500
    with (out / "films.csv").open() as file:
        assert [line["file"] for line in csv.DictReader(file)] == ["walk.avi", "room.avi"]
    table = capsys.readouterr().out
    assert "| walk.avi | S8 |" in table
    assert table == (out / "films.md").read_text()

    seen = CountingDetector.frames
    assert seen == 10 + 11  # every second frame and the last
    cli.main([*arguments, "--only", "walk"])
    assert CountingDetector.frames == seen, "kept in cache/"
    assert json.loads((out / "films.json").read_text()) == [walk]

    cli.main([*arguments, "--only", "walk", "--whole"])
    (whole,) = json.loads((out / "films.json").read_text())
    assert whole["seconds"] == pytest.approx(2.0)
    seen = CountingDetector.frames

    cli.main([*arguments, "--only", "walk", "--body", "surface"])
    assert CountingDetector.frames == seen
    (other,) = json.loads((out / "films.json").read_text())
    assert other["people"] == walk["people"]
    assert other["scenes"] != walk["scenes"]


def test_parts_of_one_film_have_a_sheet_each(arguments: list[str], data: Path, tmp_path: Path) -> None:
    name = "w$a_$lk.avi"  # no mathematics, as matplotlib might take it for
    (data / "walk.avi").rename(data / name)
    parts = [
        {"file": name, "start_s": start_s, "end_s": start_s + 1, "accept": [ACTIVITIES[7]]}
        for start_s in (0, 0.5)
    ]
    parts.append(parts[0] | {"end_s": 1.25, "accept": [ACTIVITIES[0]]})
    (data / "labels.json").write_text(json.dumps(parts))
    cli.main(arguments)
    out = tmp_path / "out"
    assert sorted(path.name for path in out.glob("*.png")) == [
        f"{name}_{part}s.png" for part in ("0-1.25", "0-1", "0.5-1.5")
    ]
    with (out / "films.csv").open() as file:
        lines = [(line["start_s"], line["end_s"]) for line in csv.DictReader(file)]
    assert lines == [("0.0", "1.0"), ("0.5", "1.5"), ("0.0", "1.25")]
    assert f"| {name}, 0.5 to 1.5 s |" in (out / "films.md").read_text()

    cli.main([*arguments, "--whole"])
    (whole,) = json.loads((out / "films.json").read_text())
    assert whole["accept"] == [ACTIVITIES[7], ACTIVITIES[0]], "what is right in any part"


def test_variants_of_films_are_labelled_without_the_networks(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main([*arguments, "--only", "walk", "--variants"])
    assert CountingDetector.frames == 10
    (walk,) = json.loads((tmp_path / "out" / "films.json").read_text())
    assert len(walk["variants"]) == 6
    assert walk["variants"]["as it is"] == walk["scenes"]
    probabilities = {of["through-wall"]["right_probability"] for of in walk["variants"].values()}
    assert len(probabilities) > 3
    assert all(0 <= probability <= 1 for probability in probabilities)
    right = sum(of["through-wall"]["right"] for of in walk["variants"].values()) / 6
    assert f"| right, mean over variants |  | {right:.1f} of 1 |" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore:.* its frames are up to")
def test_times_of_frames_are_kept_with_what_the_networks_found(tmp_path: Path) -> None:
    """A person walks away for 2 s; the film pauses for 1 s after 1 s, and its last frames come late."""
    image = pytest.importorskip("PIL.Image")
    pictures = [
        image.fromarray(frame) for frame in film(*walker(20, FPS, 4.0, 1.2, 0.3)).permute(0, 2, 3, 1).numpy()
    ]
    path = tmp_path / "walk.gif"
    durations = [100] * 9 + [1100] + [100] * 10
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations)
    known = LabelledFilm(path.parent, path.name, 0.25, 2.65, (ACTIVITIES[7],))
    (tmp_path / "w.onnx").write_text("")
    stage = VideoToPose(CountingDetector(), StandingPose()).eval()
    reader = FilmReader(
        stage, (tmp_path / "w.onnx", tmp_path / "w.onnx"), tmp_path / "cache", calibrate=False
    )
    found = []
    with torch.inference_mode():
        for _ in range(2):
            video = reader.open(known)
            CountingDetector.frames = 0
            found.append(reader.people(known, video, torch.device("cpu"), quiet=True))
            # Frames from 0.3 to 0.9 s and from 2.0 to 2.6 s, shown at even times from the first one on.
            assert video.uneven_times_s is not None
            np.testing.assert_allclose(
                video.uneven_times_s, np.r_[np.arange(3, 10), np.arange(20, 27)] / 10, atol=1e-6
            )
            assert found[-1].pose.valid.shape[2] == int(2.3 * video.fps + 1e-3) + 1
            assert sum(len(chunk) for chunk in video.even_chunks(4)) == found[-1].pose.valid.shape[2]
    assert CountingDetector.frames == 0, "kept in the cache"
    for first, second in zip(found[0].pose, found[1].pose, strict=True):
        assert torch.equal(first, second)


def test_another_version_watches_films_anew(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = read_labels(data)[0]
    (tmp_path / "w.onnx").write_text("")
    stage, kept = VideoToPose(CountingDetector(), StandingPose()).eval(), []
    for version in ("1", "1", "2"):
        monkeypatch.setattr("tensorsim.config.documents.version", lambda _, version=version: version)
        reader = FilmReader(stage, (tmp_path / "w.onnx",) * 2, tmp_path / "cache")
        with torch.inference_mode():
            reader.observed(known, reader.open(known), torch.device("cpu"), quiet=True)
        kept.append(len(list((tmp_path / "cache").glob("[dk]e*"))))
    assert kept == [2, 2, 4]


@pytest.mark.parametrize("part", ["detector", "pose"])
def test_what_networks_found_is_kept_for_each_engine(data: Path, tmp_path: Path, part: str) -> None:
    """The same weights in integers find something else."""
    known = read_labels(data)[0]
    (tmp_path / "w.onnx").write_text("")
    kept = []
    for runtime in ("onnxruntime", "int8", "int8"):
        networks = {"detector": CountingDetector(), "pose": StandingPose()}
        engine = OnnxEngine(nn.Identity(), (8, 8), runtime)  # type: ignore[arg-type]
        networks[part].add_module("engine", engine)
        reader = FilmReader(VideoToPose(**networks).eval(), (tmp_path / "w.onnx",) * 2, tmp_path / "cache")
        with torch.inference_mode():
            reader.observed(known, reader.open(known), torch.device("cpu"), quiet=True)
        kept.append(
            len([path for path in (tmp_path / "cache").iterdir() if path.name.startswith(("det", "key"))])
        )
    assert kept == ([2, 4, 4] if part == "detector" else [2, 3, 3])


def test_how_the_camera_moves_is_kept_with_what_the_networks_found(tmp_path: Path) -> None:
    frames = panned(film(*walker(25, FPS, 4.0, 1.2, 0.3)), 6)
    write_video(tmp_path / "pan.avi", frames.permute(0, 2, 3, 1).numpy(), FPS)
    known = LabelledFilm(tmp_path, "pan.avi", 0.0, 2.4, (ACTIVITIES[7],))
    (tmp_path / "w.onnx").write_text("")
    stage = VideoToPose(CountingDetector(), StandingPose()).eval()
    networks = (tmp_path / "w.onnx", tmp_path / "w.onnx")
    found = {}
    with torch.inference_mode():
        for calibrate in (True, False):
            reader = FilmReader(stage, networks, tmp_path / "cache", calibrate=calibrate)
            found[calibrate] = reader.people(known, reader.open(known), torch.device("cpu"), quiet=True)
        kept = sorted(path.name.split("-")[0] for path in (tmp_path / "cache").iterdir())
        assert kept == ["camera", "detections", "keypoints"]
        (tmp_path / "pan.avi").rename(tmp_path / "moved.avi")
        again = FilmReader(stage, networks, tmp_path / "cache")
        film_there = LabelledFilm(tmp_path, "moved.avi", 0.0, 2.4, known.accept)
        seen = again.observed(film_there, again.open(film_there), torch.device("cpu"), quiet=True)
    assert found[False].from_film is None
    assert found[True].from_film is not None
    assert found[True].from_film.shape == (24, 3, 3)
    assert found[True].background_px_s == pytest.approx(60, rel=0.1)
    assert seen.camera_steps is not None
    assert seen.camera_steps[1:, 0].numpy() == pytest.approx(-6.0, abs=0.3)
    # The walker's place in the picture is that of the film.
    torch.testing.assert_close(found[True].pose.keypoints, found[False].pose.keypoints, rtol=0.0, atol=0.01)


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        ([{"file": "walk.avi", "start_s": 0}], r"KeyError \('end_s'\), expected a list"),
        ([{"file": "walk.avi", "start_s": 0, "end_s": 1, "accept": ["Walk"]}], "got 'Walk', expected one of"),
        ([{"file": "walk.avi", "start_s": 0, "end_s": 1, "accept": [ACTIVITIES[7]]}] * 2, "0 to 1 twice"),
        ([{"file": "run.avi", "start_s": 0, "end_s": 1, "accept": [ACTIVITIES[7]]}], "run.avi: no such file"),
        ([], "got no films"),
        (
            [{"file": "walk.avi", "start_s": 0, "end_s": 1, "accept": []}],
            "walk.avi: got no activity to accept",
        ),
        (
            [{"file": "walk.avi", "start_s": math.nan, "end_s": 1, "accept": [ACTIVITIES[7]]}],
            "seconds nan to 1",
        ),
        ([{"file": "walk.avi", "start_s": 2, "end_s": 1, "accept": [ACTIVITIES[7]]}], "seconds 2 to 1"),
    ],
)
def test_bad_labels_are_refused(data: Path, rows: list[dict[str, Any]], why: str) -> None:
    (data / "labels.json").write_text(json.dumps(rows))
    with pytest.raises(TensorsimError, match=why):
        read_labels(data)
    with pytest.raises(TensorsimError, match=r"no labels\.json"):
        read_labels(data.parent)


class Always(nn.Module):
    """Recognises every map as the same activity."""

    def __init__(self, index: int) -> None:
        super().__init__()
        self.index = index
        self.class_names = ACTIVITIES

    class_names = ACTIVITIES

    def probabilities(self, maps: RadarMaps) -> Tensor:
        return self.forward(maps).softmax(-1)

    def forward(self, maps: RadarMaps) -> Tensor:
        return torch.nn.functional.one_hot(torch.tensor(self.index), len(ACTIVITIES)).double().mul(4)


def somebody(speed_m_s: float, frames: int = 20) -> Pose:
    """A body that moves away as a whole."""
    joints = torch.rand(14, 3, generator=torch.Generator().manual_seed(0)).expand(1, 1, frames, 14, 3).clone()
    joints[..., 1] += 3.0 + speed_m_s * torch.arange(frames)[:, None] / FPS
    there = torch.ones(1, 1, frames, dtype=torch.bool)
    there[..., 0] = False
    return Pose(
        torch.zeros(1, 1, frames, 4),
        torch.zeros(1, 1, frames, 17, 2),
        torch.zeros(1, 1, frames, 17),
        joints,
        there,
    )


def test_a_verdict_is_right_where_the_label_is_accepted() -> None:
    stage = PoseToDoppler(RadarSimulator(RadarConfig.through_wall(), snr_db=50.0))
    known = LabelledFilm(Path(), "walk.avi", 0.0, 2.0, (ACTIVITIES[7],))
    cpu = torch.device("cpu")
    for index, right in ((7, True), (1, False)):
        how = Scene(stage, Always(index))  # type: ignore[arg-type]
        verdict, maps = judged(known, Found(somebody(1.0)), FPS, "through-wall", how, 0, cpu, quiet=True)
        assert maps is not None
        assert (verdict.label, verdict.right) == (ACTIVITIES[index], right)
        assert verdict.probability == pytest.approx(np.exp(4) / (np.exp(4) + 11), abs=1e-3)
        assert verdict.right_probability == pytest.approx(np.exp(4 * right) / (np.exp(4) + 11), abs=1e-3)
    verdict, maps = judged(known, Found(somebody(10.0)), FPS, "through-wall", how, 0, cpu, quiet=True)
    assert maps is None
    assert not verdict.right
    assert "radial speed" in (verdict.error or "")


def test_the_sheet_of_a_cut_has_the_times_of_the_film() -> None:
    from matplotlib.figure import Figure

    axes = Figure().subplots(1, 2)
    film_sheet._draw_places(axes[0], somebody(1.0), FPS, 12.5)
    assert [line.get_xdata()[0] for line in axes[0].get_lines()] == [12.5] * 3
    maps = RadarMaps(*(torch.rand(8, 5) for _ in RadarMaps._fields))
    doppler, time_s = np.linspace(-4, 4, 8), np.linspace(0.1, 1.9, 5)
    verdict = Verdict("through-wall", ACTIVITIES[7], 0.5, True)
    film_sheet._draw_map(axes[1], verdict, maps, Axes(np.arange(3), doppler, time_s, 30.0, 1.0), 12.5)
    assert axes[1].get_images()[0].get_extent()[:2] == pytest.approx([12.6, 14.4])


def test_who_was_followed_for_how_long() -> None:
    row = followed(somebody(2.0), FPS, RadarConfig())[0]
    assert row["followed_s"] == pytest.approx(1.9)
    assert row["fastest_joint_m_s"] == pytest.approx(2.0, abs=0.1)


def test_the_table_counts_what_is_right() -> None:
    verdicts = [
        {"label": ACTIVITIES[7], "probability": 0.9, "right": True},
        {"label": None, "probability": None, "right": False},
    ]
    rows = [
        {
            "file": f"{i}.avi",
            "accept": [ACTIVITIES[7]],
            "people": [],
            "seconds": 4.0,
            "scenes": {"s": verdict},
        }
        for i, verdict in enumerate(verdicts)
    ]
    lines = markdown(rows).splitlines()
    assert lines[2] == "| 0.avi | S8 | S8 0.90 right | nobody of 4.0 s |"
    assert lines[3].split("|")[3].strip() == "no map"
    assert "**1 of 2**" in lines[4]
