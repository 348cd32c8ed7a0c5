"""The command line on a film: files, contents, repeatable noise, nothing half-written."""

import dataclasses
import inspect
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import tyro

import tensorsim as ts
from tensorsim import cli, streaming
from tensorsim.commands import simulate
from tensorsim.commands.arguments import describe_options, help_texts
from tensorsim.commands.options import RadarOptions, load_recognizer
from tensorsim.data.video import VideoReader
from tensorsim.data.video_writer import write_video
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.plot import draw_floor
from tensorsim.radar.presets import PRESETS
from tensorsim.weights import save_weights
from tests.film import RectangleDetector, StandingPose, film, panned, walker
from tests.stage import assert_same

FPS = 10.0
FILES = {
    "maps.npz",
    "pose.npz",
    "summary.json",
    "range_time.png",
    "range_time_mti.png",
    "doppler_time.png",
    "skeleton.png",
    "overlay.mp4",
    "report.html",
}


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A losslessly written film of a person who walks away."""
    path = tmp_path_factory.mktemp("film") / "walk.avi"
    frames = film(*walker(25, FPS, 4.0, 1.2, 0.3)).permute(0, 2, 3, 1).numpy()
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter_fourcc(*"FFV1"), FPS, (frames.shape[2], frames.shape[1])
    )
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    return path


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Use the stand-in networks of tests/film.py behind the command line."""
    weights = tmp_path / "w.onnx"
    weights.write_text("")

    monkeypatch.setattr(simulate, "load_networks", lambda *_: (RectangleDetector(), StandingPose()))
    return ["--detector", str(weights), "--pose", str(weights), "--scene", "through-wall", "--quiet"]


@pytest.mark.parametrize("threads", [1, 2])
def test_streaming_equals_the_graph(walk: Path, threads: int, request: pytest.FixtureRequest) -> None:
    request.addfinalizer(partial(torch.set_num_threads, torch.get_num_threads()))
    torch.set_num_threads(threads)
    reader = VideoReader(walk)
    stage = VideoToPose(RectangleDetector(), StandingPose(), frames_per_batch=3)
    whole = torch.cat(list(reader.chunks(100)))
    with torch.no_grad():
        streamed = streaming.people_of_film(stage, reader, torch.device("cpu"), quiet=True).pose
        assert_same(streamed, stage(whole.unsqueeze(0), reader.fps), atol=1e-5)
        smoother = ts.motion.SavitzkyGolay(33, 3)
        for options in (
            {},
            {"resampler": ts.motion.PoseResampler(128.0, "linear"), "pulse_smoother": smoother},
        ):
            radar = ts.radar.RadarSimulator(ts.RadarConfig.through_wall(), snr_db=None)
            maps_stage = PoseToDoppler(radar, **options)  # type: ignore[arg-type]
            maps = streaming.maps_of_pose(maps_stage, streamed, reader.fps, torch.device("cpu"), quiet=True)
            expected = maps_stage(streamed.joints, streamed.valid, reader.fps)
            assert_same(maps, [f[0] for f in expected], atol=1e-5)


class Growing(RectangleDetector):
    """Pads every call to one more."""

    calls = 0

    def forward(self, images: torch.Tensor) -> ts.types.Detections:
        found = super().forward(images)
        self.calls += 1
        more = [field.new_zeros(len(images), self.calls, *field.shape[2:]) for field in found]
        return ts.types.Detections(*(torch.cat(pair, dim=1) for pair in zip(found, more, strict=True)))


def test_a_detector_may_pad_every_part_of_a_film_to_another_count(walk: Path) -> None:
    reader = VideoReader(walk)
    found = [
        streaming.detections_of_film(
            VideoToPose(detector, StandingPose(), frames_per_batch=3), reader, torch.device("cpu"), quiet=True
        )[0]
        for detector in (RectangleDetector(), Growing())
    ]
    count = found[0].valid.shape[1]
    assert found[1].valid.shape[1] > count + 1
    assert_same([field[:, :count] for field in found[1]], found[0])


def test_simulate_writes_everything(
    walk: Path, tmp_path: Path, stand_ins: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "out"
    cli.main(
        ["simulate", str(walk), "--out", str(out), "--person-height", "1.75", "--no-calibrate", "--lifter", "nearest",
         *stand_ins]
    )  # fmt: skip
    assert {p.name for p in out.iterdir()} == FILES
    assert re.search(r"1 person in 25 frames, S\d+ [\w ]+ \(0\.\d\d\)\n", capsys.readouterr().out)
    maps, pose = np.load(out / "maps.npz"), np.load(out / "pose.npz")
    assert maps["range_time"].shape == (200, 320)
    assert maps["range_time_mti"].shape == (200, 319)
    assert maps["doppler_time"].shape == (len(maps["doppler_hz"]), len(maps["time_s"]))
    assert maps["ridges_hz"].shape == (3, len(maps["time_s"]))
    assert np.all(np.diff(maps["doppler_hz"]) > 0)
    assert maps["range_m"][1] == pytest.approx(ts.RadarConfig.through_wall().range_resolution_m)
    line_m = maps["range_m"][maps["range_time"].argmax(axis=0)]
    assert line_m[-1] - line_m[0] > 2.0, "walks away"
    assert pose["joints_m"].shape == (1, 25, 14, 3)
    assert pose["keypoints_px"].shape == (1, 25, 17, 2)
    assert pose["keypoint_scores"].shape == (1, 25, 17)
    assert pose["boxes_px"].shape == (1, 25, 4)
    assert pose["valid"].shape == (1, 25)
    assert float(pose["fps"]) == FPS
    summary = json.loads((out / "summary.json").read_text())
    assert summary["people"][0]["mean_approach_m_s"] == pytest.approx(-1.2, abs=0.15)
    assert summary["realised_snr_db"] == pytest.approx(50, abs=0.5)
    assert summary["seed"] == 0
    overlay = VideoReader(out / "overlay.mp4")
    assert (overlay.width, overlay.height) == (320, 240)
    assert sum(chunk.shape[0] for chunk in overlay.chunks(8)) == 25


def test_the_camera_is_estimated_unless_it_is_known(walk: Path, tmp_path: Path, stand_ins: list[str]) -> None:
    out = tmp_path / "out"
    cli.main(["simulate", str(walk), "--out", str(out), *stand_ins])
    summary = json.loads((out / "summary.json").read_text())
    assert summary["config"]["pose"]["calibrate"] is True
    assert summary["people"][0]["mean_approach_m_s"] < -0.6, "walks away"
    for known in (["--camera-fov", "50"], ["--initial-distance", "3"], ["--no-calibrate"]):
        arguments = [str(walk), "--out", str(out), *known]
        config = tyro.cli(simulate.Simulate, args=arguments).configuration()
        assert config.pose.calibrate is False


def _pose_of(*options: str) -> ts.config.PoseConfig:
    """How people are found with these options of ``simulate``."""
    return cli.parse(["simulate", "clip.mp4", "--out", "out", *options]).configuration().pose


def test_options_that_tell_the_camera_count_beside_a_configuration(tmp_path: Path) -> None:
    film, told, focal = (str(tmp_path / name) for name in ("film.yaml", "told.yaml", "focal.yaml"))
    ts.SimulationConfig().replace(pose__calibrate=True).to_yaml(Path(film))
    ts.SimulationConfig().replace(pose__initial_distance_m=(3.0,)).to_yaml(Path(told))
    ts.SimulationConfig().replace(pose__camera__focal_px=500.0).to_yaml(Path(focal))
    assert _pose_of("--config", film).calibrate
    for options in (["--camera-fov", "40"], ["--initial-distance", "6"], ["--position", "paper"]):
        assert not _pose_of("--config", film, *options).calibrate
    for file in (told, focal):
        pose = _pose_of("--config", file, "--camera-fov", "40")
        assert (pose.initial_distance_m, pose.camera.focal_px) == (None, None), "these would overrule it"
        assert pose.camera.horizontal_fov_rad == pytest.approx(math.radians(40))


def test_switches_count_beside_a_configuration(tmp_path: Path) -> None:
    names = ("leakage", "wall_echo", "sway", "vital_signs")
    on = ts.SimulationConfig.through_wall().replace(**{f"scene__{name}": True for name in names})
    on = on.replace(pose__initial_distance_m=(3.0,), pose__calibrate=False, pose__flip_test=False)
    on.to_yaml(tmp_path / "on.yaml")
    kept = ["simulate", "clip.mp4", "--out", "out", "--config", str(tmp_path / "on.yaml")]
    assert cli.parse(kept).configuration() == on
    off = [f"--no-{name.replace('_', '-')}" for name in names]
    config = cli.parse([*kept, *off, "--calibrate", "--flip-test"]).configuration()
    assert not any(getattr(config.scene, name) for name in names)
    assert config.pose.flip_test
    assert config.pose.calibrate
    assert config.pose.initial_distance_m is None, "it would overrule the camera that is estimated"


@pytest.mark.parametrize("told", [["--camera-fov", "40"], ["--initial-distance", "3"], ["--paper"]])
def test_a_camera_that_is_told_is_not_estimated(
    told: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film = tmp_path / "clip.mp4"
    film.touch()
    with pytest.raises(SystemExit):
        cli.main(["simulate", str(film), "--out", str(tmp_path / "out"), "--calibrate", *told])
    assert "--calibrate cannot be combined with " in capsys.readouterr().err


def test_the_distances_of_the_panel_calibrate_no_camera() -> None:
    assert _pose_of("--paper").initial_distance_m == (4.0, 0.5)
    pose = _pose_of("--paper", "--position", "camera")
    assert (pose.initial_distance_m, pose.calibrate) == (None, True)
    pose = _pose_of("--paper", "--position", "camera", "--initial-distance", "3")
    assert (pose.initial_distance_m, pose.calibrate) == ((3.0,), False)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film of one person who walks away and one who approaches."""
    path = tmp_path_factory.mktemp("film") / "two.avi"
    away, comes = walker(25, FPS, 3.0, 1.0, -0.7), walker(25, FPS, 6.0, -0.8, 0.9)
    frames = film(*(torch.cat(both) for both in zip(away, comes, strict=True))).permute(0, 2, 3, 1).numpy()
    write_video(path, frames, FPS)
    return path


def test_each_person_alone(two: Path, tmp_path: Path, stand_ins: list[str]) -> None:
    """The maps of a person are those of a run with this person only; one pass of the networks gives all."""
    shared = [str(two), "--no-calibrate", *stand_ins, "--out"]
    cli.main(["simulate", *shared, str(tmp_path / "all"), "--per-person"])
    summary = json.loads((tmp_path / "all" / "summary.json").read_text())
    further = {
        f"{name}_person_{n}{end}"
        for n in (1, 2)
        for name, end in (("maps", ".npz"), ("doppler_time", ".png"))
    }
    assert {p.name for p in (tmp_path / "all").iterdir()} == FILES | further
    assert set(summary["files"]) == FILES | further
    for number in (1, 2):
        out = tmp_path / str(number)
        cli.main(["simulate", *shared, str(out), "--people", str(number), "--per-person"])
        assert {p.name for p in out.iterdir()} == FILES, "nobody else is there"
        with (
            np.load(out / "maps.npz") as alone,
            np.load(tmp_path / "all" / f"maps_person_{number}.npz") as one,
        ):
            assert set(alone) == set(one)
            for name in alone:
                np.testing.assert_array_equal(alone[name], one[name])
        row = summary["people"][number - 1]
        expected = json.loads((out / "summary.json").read_text())
        assert {name: row[name] for name in ("label", "probabilities", "timeline")} == {
            name: expected[name] for name in ("label", "probabilities", "timeline")
        }
        assert f"Doppler-time map of person {number}" in (tmp_path / "all" / "report.html").read_text()
    assert summary["people"][0]["mean_approach_m_s"] < 0 < summary["people"][1]["mean_approach_m_s"]


def test_the_camera_is_in_summary_and_overlay(walk: Path, tmp_path: Path, stand_ins: list[str]) -> None:
    cli.main(["simulate", str(walk), "--out", str(tmp_path / "out"), *stand_ins])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    camera = summary["camera"]
    assert camera["frames"] > 10
    for name in ("pitch_deg", "roll_deg", "horizontal_fov_deg", "height_m"):
        value, deviation = camera[name]
        assert abs(value) < 90
        assert deviation > 0
    assert summary["background_px_s"] is None, "black all over"
    estimated = ts.CameraConfig(
        horizontal_fov_rad=math.radians(camera["horizontal_fov_deg"][0]),
        position_m=(0.0, 0.0, camera["height_m"][0]),
        pitch_rad=math.radians(camera["pitch_deg"][0]),
        roll_rad=math.radians(camera["roll_deg"][0]),
    )
    grid = draw_floor(np.zeros((240, 320, 3), np.uint8), estimated)[..., 2] > 150
    cli.main(["simulate", str(walk), "--out", str(tmp_path / "level"), "--no-calibrate", *stand_ins])
    assert json.loads((tmp_path / "level" / "summary.json").read_text())["camera"] is None
    drawn, bare = (
        next(VideoReader(tmp_path / name / "overlay.mp4").chunks(1))[0, 2].numpy()
        for name in ("out", "level")
    )
    assert drawn[grid].mean() > 100 + bare[grid].mean()


def test_a_camera_that_moves_is_said_and_its_turns_are_taken_out_where_it_is_estimated(
    tmp_path: Path, stand_ins: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """A walker in front of a blue pattern that moves at 60 pixels per second."""
    frames = panned(film(*walker(25, FPS, 4.0, 1.2, 0.3)), 6)
    write_video(tmp_path / "pan.avi", frames.permute(0, 2, 3, 1).numpy(), FPS)
    cli.main(["simulate", str(tmp_path / "pan.avi"), "--out", str(tmp_path / "out"), *stand_ins])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["background_px_s"] == pytest.approx(60, rel=0.1)
    (said,) = [m for m in summary["warnings"] if "the camera moves: the background shifts" in m]
    assert "its turns and zooms are taken out" in said
    assert "the camera moves" in capsys.readouterr().err
    x_m = np.load(tmp_path / "out" / "pose.npz")["joints_m"][0, :, 1, 0]
    known = ["--camera-fov", "60", "--out", str(tmp_path / "known")]
    cli.main(["simulate", str(tmp_path / "pan.avi"), *known, *stand_ins])
    summary = json.loads((tmp_path / "known" / "summary.json").read_text())
    assert sum("that is not taken out of the motion of people" in m for m in summary["warnings"]) == 1
    # The background goes to the left by 144 of 320 pixels: the camera turns to the right, and so does the walker.
    moved = (
        x_m[-1]
        - x_m[0]
        - float(np.diff(np.load(tmp_path / "known" / "pose.npz")["joints_m"][0, [0, -1], 1, 0])[0])
    )
    assert moved > 1.5


def test_radar_from_a_file(walk: Path, tmp_path: Path, stand_ins: list[str]) -> None:
    """The file's radar replaces the scene's, its wall too; the scene's wall stays where the file has none."""
    scene = RadarOptions(scene="through-wall", radar="cw-24ghz").configuration().scene
    assert scene == ts.SceneConfig(PRESETS["cw-24ghz"].radar, ts.WallConfig())
    assert RadarOptions(radar="cw-24ghz").configuration().scene.wall is None
    assert RadarOptions(radar="through-wall").configuration().scene == PRESETS["through-wall"]
    assert RadarOptions().configuration().scene == PRESETS["free-space"]

    file = tmp_path / "my.yaml"
    file.write_text(
        "carrier_hz: 3e9\nbandwidth_hz: 500e6\nprf_hz: 200\nwall: {loss_tangent: 0.01}\nfloor: {}\n"
    )
    cli.main(["simulate", str(walk), "--out", str(tmp_path / "out"), "--radar", str(file), *stand_ins])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["radar"]["carrier_hz"] == 3e9
    assert summary["wall"]["loss_tangent"] == 0.01
    assert summary["floor"]["relative_permittivity"] == 5.24
    assert summary["options"]["radar"] == str(file)
    maps = np.load(tmp_path / "out" / "maps.npz")
    assert maps["range_time"].shape == (200, 500)
    assert maps["range_m"][1] == pytest.approx(0.29979, abs=1e-5)


@pytest.mark.parametrize(
    ("radar", "message"),
    [
        ("ti-awr1834", "error: --radar: .*perhaps 'ti-awr1843'"),
        ("bad.yaml", "error: --radar: .*bad.yaml: prf_hz: got 'fast', expected a number"),
    ],
)
def test_a_bad_radar_is_refused_before_work_starts(
    walk: Path,
    tmp_path: Path,
    stand_ins: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    radar: str,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.yaml").write_text("prf_hz: fast\n")
    with pytest.raises(SystemExit) as exit_:
        cli.main(["simulate", str(walk), "--out", str(tmp_path / "out"), "--radar", radar, *stand_ins])
    assert exit_.value.code == 2
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_help_names_every_preset() -> None:
    help_text = inspect.getsource(RadarOptions)
    assert all(name in help_text for name, scene in PRESETS.items() if not scene.radar.has_array)


def test_the_seed_repeats_the_noise(walk: Path, tmp_path: Path, stand_ins: list[str]) -> None:
    maps = []
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        cli.main(
            ["simulate", str(walk), "--out", str(tmp_path / name), "--snr", "5", "--seed", seed, *stand_ins]
        )
        maps.append(np.load(tmp_path / name / "maps.npz")["doppler_time"])
    assert np.array_equal(maps[0], maps[1])
    assert not np.array_equal(maps[0], maps[2])


@pytest.mark.parametrize(
    "moment",
    ["tensorsim.sources.people_of_film", "tensorsim.results.maps_of_pose", "tensorsim.results.write_overlay"],
)
def test_an_interrupt_leaves_nothing_half_written(
    walk: Path,
    tmp_path: Path,
    stand_ins: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    moment: str,
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(moment, interrupt)
    out = tmp_path / "results" / "out"
    with pytest.raises(SystemExit) as exit_:
        cli.main(["simulate", str(walk), "--out", str(out), *stand_ins])
    assert exit_.value.code == 130
    assert "interrupted" in capsys.readouterr().err
    assert not any(p.is_file() for p in (tmp_path / "results").rglob("*"))
    assert not out.exists()


def test_nobody_in_the_film_is_said(
    tmp_path: Path, stand_ins: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "dark.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), FPS, (64, 48))
    for _ in range(10):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    cli.main(["simulate", str(path), "--out", str(tmp_path / "out"), *stand_ins])
    assert "no person found" in capsys.readouterr().err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["people"] == []
    assert any("no person found" in w for w in summary["warnings"])
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES


@pytest.mark.parametrize("command", ["simulate", "demo", "experiment", "train pose"])
def test_help_says_none_of_no_default(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Optional options are described with their default values."""
    with pytest.raises(SystemExit):
        cli.main([*command.split(), "--help"])
    assert "None" not in capsys.readouterr().out


def _commands(table: Mapping[str, Any]) -> Iterator[type]:
    for command in table.values():
        if isinstance(command, tuple):
            yield from _commands(command[1])
        else:
            yield command


@pytest.mark.parametrize("command", [*_commands(cli.COMMANDS)])
def test_options_are_described_in_sentences_on_one_line(command: type) -> None:
    describe_options(command)
    for option in dataclasses.fields(command):
        text = option.metadata["help"]
        assert text[0].isupper(), option.name
        assert text.endswith((".", '."')), option.name
        assert "\n" not in text, option.name


def test_help_does_not_keep_the_lines_of_the_source(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["simulate", "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", "").split())
    assert " ".join(str(inspect.getdoc(simulate.Simulate)).split()) in shown
    assert help_texts(simulate.Simulate)["initial_distance"] in shown


def test_switches_may_be_on_off_or_as_configured() -> None:
    arguments = ["simulate", "clip.mp4", "--out", "out"]
    assert cli.parse(arguments).multipath is None
    assert cli.parse([*arguments, "--multipath", "False"]).multipath is False
    assert cli.parse([*arguments, "--person-height", "1.8", "1.6"]).person_height == (1.8, 1.6)


def test_help_shows_examples() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tensorsim", "--help"], capture_output=True, text=True, check=True
    )
    assert "tensorsim simulate clip.mp4 --out out/ --scene through-wall" in done.stdout


def test_says_its_version(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["--version"])
    assert capsys.readouterr().out == f"tensorsim {ts.__version__}\n"


def test_check_passes_here(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["check"])
    out = capsys.readouterr().out
    assert "WRONG" not in out
    assert "shows at 2.0" in out


def test_importing_tensorsim_is_light() -> None:
    code = (
        "import sys, tensorsim; heavy = {'torchaudio', 'matplotlib', 'onnxruntime', 'onnx', 'cv2', 'scipy'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_reader_who_has_seen_enough_ends_the_program_quietly() -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "tensorsim", "models", "list"]
    with os.fdopen(write, "w") as nobody:
        done = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, text=True, check=False)
    assert done.stderr == ""
    assert done.returncode == 141


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "a_file/out"], r"a_file\S*: could not be written \((File exists|Not a directory)\)$"),
        (["--out", "out", "--radar", "broken.yaml"], r"--radar: broken\.yaml: .* line 2"),
        (["--out", "out", "--seed", "-1"], r"--seed: got -1, expected an integer from 0"),
        (["--out", "out", "--seed", str(2**80)], r"--seed: got \d+, expected an integer from 0"),
    ],
)
def test_one_line_says_what_is_wrong(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a_file").touch()
    Path("broken.yaml").write_text("carrier_hz: [1\n")
    np.savez("walk.npz", joints=np.random.default_rng(0).random((30, 14, 3)), fps=30.0)
    with pytest.raises(SystemExit) as exit_:
        cli.main(["simulate", "walk.npz", "--scene", "through-wall", "--quiet", *arguments])
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("tensorsim: error: ")
    assert re.search(message, line), line
    assert {p.name for p in tmp_path.iterdir()} == {"a_file", "broken.yaml", "walk.npz"}


def test_a_classifier_of_other_classes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "five.safetensors"
    save_weights(ts.recognition.SPGNet(5), path, {"network": "SPGNet", "size": "32"})
    config = RadarOptions(classifier=str(path)).configuration()
    with pytest.raises(ts.TensorsimError, match=r"--classifier: .* 5 classes, expected 12"):
        load_recognizer(config)
