"""``tensorsim simulate`` on motion files and keypoints: the outputs of a video, and the maps of that very motion."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import loadmat

import tensorsim as ts
from tensorsim import cli
from tensorsim.commands.clip_options import ClipOptions
from tensorsim.geometry.framing import camera_on, seen_keypoints
from tests.bvh import write_bvh
from tests.test_cli import FILES
from tests.test_sources import coco_json

FPS = 30.0
QUICK = ["--scene", "through-wall", "--quiet"]


@pytest.fixture(scope="module")
def motion() -> ts.motion.GeneratedMotion:
    """Somebody who walks."""
    return ts.motion.ActivityGenerator().generate("walking", seed=3, rate_hz=FPS)


@pytest.fixture(scope="module")
def walk(motion: ts.motion.GeneratedMotion) -> np.ndarray:
    """(45, 14, 3) metres: its first 1.5 s."""
    return motion.joints[0, :45].numpy()


def test_bvh_gives_what_a_video_gives(walk: np.ndarray, tmp_path: Path) -> None:
    write_bvh(tmp_path / "walk.bvh", walk, FPS)
    out = tmp_path / "out"
    cli.main(["simulate", str(tmp_path / "walk.bvh"), "--out", str(out), "--snr", "80", *QUICK])
    assert {p.name for p in out.iterdir()} == FILES
    maps, pose = np.load(out / "maps.npz"), np.load(out / "pose.npz")
    assert np.abs(pose["joints_m"][0, ..., :2] - walk[..., :2]).max() < 1e-5
    assert float(pose["fps"]) == pytest.approx(FPS)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["source"]["kind"] == "motion"
    assert summary["frames"] == 45
    assert summary["config"]["tracking"]["detector"] is None
    (warning,) = summary["warnings"]
    assert warning.startswith("the label is unreliable: the scene lasts 1.5 s")

    simulator = ts.radar.RadarSimulator(
        ts.RadarConfig.through_wall(), ts.WallConfig(), multipath=True, snr_db=None
    )
    joints = torch.from_numpy(pose["joints_m"])[None]
    valid = torch.ones(1, 1, 45, dtype=torch.bool)
    expected = ts.PoseToDoppler(simulator)(joints, valid, FPS).doppler_time[0].numpy()
    assert maps["doppler_time"] == pytest.approx(expected, abs=2e-3 * float(expected.max()))


def test_that_nobody_moves_is_said(tmp_path: Path) -> None:
    """It does not claim that nobody was found; the empty scene may be of any length."""
    np.savez(
        tmp_path / "still.npz", joints=np.random.default_rng(0).random((1, 14, 3)).repeat(30, 0), fps=FPS
    )
    out = tmp_path / "out"
    cli.main(["simulate", str(tmp_path / "still.npz"), "--out", str(out), "--people", "moving", *QUICK])
    (warning,) = json.loads((out / "summary.json").read_text())["warnings"]
    assert warning == "--people moving selects none of the people found: the maps show an empty scene"


def test_maps_at_display_rate_or_of_every_pulse(walk: np.ndarray, tmp_path: Path) -> None:
    """Columns are root mean squares of the pulses of each; MATLAB's file has the same arrays."""
    np.savez(tmp_path / "walk.npz", walk=walk[:12], fps=FPS)
    for name, options in (("few", ["--save", "mat"]), ("all", ["--full-rate"])):
        arguments = ["simulate", str(tmp_path / "walk.npz"), "--out", str(tmp_path / name), "--quiet"]
        cli.main([*arguments, "--prf-hz", "2048", "--classifier", "none", *options])
    few, every = (np.load(tmp_path / name / "maps.npz") for name in ("few", "all"))
    assert every["range_time"].shape == (200, round(12 / FPS * 2048))
    assert float(few["range_time_rate_hz"]) == 256.0
    pulses = every["range_time"][:, : 8 * 100].reshape(200, 100, 8)
    assert few["range_time"][:, :100] == pytest.approx(np.sqrt((pulses**2).mean(2)), rel=1e-4)
    times = every["range_time_s"][: 8 * 100].reshape(100, 8)
    assert few["range_time_s"][:100] == pytest.approx(times.mean(1))
    assert np.array_equal(few["doppler_time"], every["doppler_time"])
    mat = loadmat(tmp_path / "few" / "maps.mat", squeeze_me=True)
    for key in few.files:
        assert np.array_equal(mat[key], few[key])
    assert loadmat(tmp_path / "few" / "pose.mat")["joints_m"].shape == (1, 12, 14, 3)


@pytest.mark.parametrize("window_s", ["0.06", "0.2"])
def test_labels_with_other_doppler_windows(walk: np.ndarray, tmp_path: Path, window_s: str) -> None:
    np.savez(tmp_path / "walk.npz", walk=walk[:12], fps=FPS)
    out = tmp_path / "out"
    cli.main(
        ["simulate", str(tmp_path / "walk.npz"), "--out", str(out), "--quiet", "--stft-window", window_s]
    )
    assert json.loads((out / "summary.json").read_text())["probabilities"]


def test_place_heading_and_part(walk: np.ndarray, tmp_path: Path) -> None:
    np.savez(tmp_path / "two.npz", first=walk, second=walk * 0.9, fps=FPS)
    arguments = ["simulate", str(tmp_path / "two.npz"), "--out", str(tmp_path / "out"), "--clip", "first"]
    arguments += ["--initial-distance", "3.5", "--heading", "90", "--start", "0.5", "--stride", "2", *QUICK]
    cli.main(arguments)
    pose = np.load(tmp_path / "out" / "pose.npz")
    assert pose["joints_m"].shape == (1, 15, 14, 3)
    assert float(pose["fps"]) == 15.0
    hips = pose["joints_m"][0][:, (8, 11), :2].mean(axis=1)
    assert hips[0] == pytest.approx([0.0, 3.5], abs=1e-5)
    way = walk[43, (8, 11), :2].mean(axis=0) - walk[15, (8, 11), :2].mean(axis=0)
    assert hips[-1] - hips[0] == pytest.approx([-way[1], way[0]], abs=1e-4), "a quarter turn to the left"


@pytest.mark.slow
def test_keypoints_give_what_a_video_gives(
    motion: ts.motion.GeneratedMotion, walk: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints, valid = torch.from_numpy(walk)[None], torch.ones(1, 45, dtype=torch.bool)
    # The command takes a camera that looks level along +y.
    camera = ts.CameraConfig(horizontal_fov_rad=camera_on(joints, valid, 720, 720).horizontal_fov_rad * 1.6)
    keypoints, scores = seen_keypoints(joints, valid, camera, 720, 720)
    folder = tmp_path / "keypoints"
    folder.mkdir()
    whole = coco_json(keypoints.numpy(), scores.numpy())
    for t in range(45):
        people = [a for a in whole["annotations"] if a["image_id"] == t]
        (folder / f"{t:03}.json").write_text(json.dumps({"annotations": people}))
    out = tmp_path / "out"
    fov = str(np.degrees(camera.horizontal_fov_rad))
    height = str(float(motion.people.height_m[0]))
    arguments = ["simulate", str(folder), "--out", str(out), "--fps", "30", "--image-size", "720", "720"]
    cli.main([*arguments, "--camera-fov", fov, "--person-height", height, *QUICK])
    assert {p.name for p in out.iterdir()} == FILES
    pose = np.load(out / "pose.npz")
    np.testing.assert_allclose(pose["keypoints_px"], keypoints.numpy(), atol=1e-3)
    found = pose["joints_m"][0][:, (8, 11), 1].mean(axis=1)
    truth = walk[:, (8, 11), 1].mean(axis=1)
    assert found - truth == pytest.approx(0 * truth, abs=0.4)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["source"] == {"kind": "keypoints", "image_size": [720, 720]}
    assert summary["camera"] is None
    # Where nothing states the camera, it is estimated as for a film.
    cli.main([*arguments, "--person-height", height, *QUICK])
    summary = json.loads((out / "summary.json").read_text())
    assert summary["config"]["pose"]["calibrate"] is True
    assert summary["camera"]["frames"] > 10
    capsys.readouterr()
    with pytest.raises(SystemExit):
        cli.main([*arguments[:-2], "90", "60", *QUICK])
    assert "--image-size: got 90 x 60 pixels, expected" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("walk.npz", ["--detector", "x.onnx"], r"--detector applies to a video only, not to motion capture"),
        (
            "walk.npz",
            ["--camera-fov", "50"],
            r"--camera-fov applies to a video or keypoints .* only, not to motion capture",
        ),
        (
            "walk.npz",
            ["--image-size", "9", "9"],
            r"--image-size applies to keypoints .* not to motion capture",
        ),
        ("walk.json", ["--heading", "9"], r"--heading applies to motion capture .* not to keypoints"),
        ("walk.mp4", ["--clip", "a"], r"--clip applies to motion capture .* not to a video"),
        ("walk.json", ["--image-size", "0", "9"], "--image-size: got 0, expected image side"),
        ("walk.npz", ["--heading", "nan"], "--heading: got nan"),
        ("walk.npz", ["--initial-distance", "1", "2"], "--initial-distance: got .* the first person"),
        ("walk.npz", ["--clip", "nothing"], r"got the motion 'nothing', expected one of joints \(--clip\)"),
        ("walk.npz", ["--stride", "40"], "got 1 of its 30 frames"),
        ("walk.npz", ["--config", "one_bin.yaml"], "range_gate_m: got a gate that holds one range bin"),
        (
            "walk.npz",
            ["--stft-window", "60"],
            r"frames: got 30 at 30 fps, expected at least 1801 for one .* of 60 s",
        ),
        ("walk.npz", ["--end", "0.1"], r"frames: got 3 at 30 fps, expected at least 4 for one .* of 0.109 s"),
        ("nothing.bvh", [], "nothing.bvh: no such file"),
        ("nothing.json", ["--fps", "30"], "nothing.json: no such file"),
        ("walk.json", [], "walk.json: the file has no frame rate; give --fps"),
        ("walk.json", ["--fps", "30"], "walk.json: got a file that cannot be read as JSON"),
    ],
)
def test_bad_options_are_refused_before_work_starts(
    name: str,
    options: list[str],
    message: str,
    walk: np.ndarray,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    np.savez(tmp_path / "walk.npz", joints=walk[:30], fps=FPS)
    (tmp_path / "walk.json").write_text("no JSON")
    (tmp_path / "walk.mp4").touch()
    (tmp_path / "one_bin.yaml").write_text("processing: {range_gate_m: [2.99, 3.0]}")
    options = [str(tmp_path / option) if option.endswith(".yaml") else option for option in options]
    with pytest.raises(SystemExit) as exit_:
        cli.main(["simulate", str(tmp_path / name), "--out", str(tmp_path / "out"), *options, *QUICK])
    assert exit_.value.code == 2
    error = capsys.readouterr().err.strip()
    assert re.search(message, error), error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_body_has_its_scatterers(walk: np.ndarray) -> None:
    joints = torch.from_numpy(walk).float()[None, None]
    valid = torch.ones(1, 1, 45, dtype=torch.bool)
    scenes = {}
    for body, count in (("joints", 14), ("limbs", 36), ("version1", 13)):
        options = ClipOptions(body=body, scene="through-wall")  # type: ignore[arg-type]
        stage = ts.PoseToDoppler.from_config(options.configuration())
        points, rcs = stage.scene(stage.resampler.coefficients(joints, FPS), valid, FPS, 0, 100)
        assert points.shape == (1, 100, count, 3)
        scenes[body] = points[0, 0], rcs[0, 0]
    # Version 1 has a torso of its own instead of neck and hips; its limbs end at the same joints.
    knee = ts.JOINTS.index("right_knee")
    torch.testing.assert_close(scenes["version1"][0][3], scenes["joints"][0][knee])
    assert float(scenes["version1"][1].sum()) == pytest.approx(4.2)


@pytest.mark.parametrize("clip", ["kick", "crawl"])
def test_captured_motion(clip: str, shared_data: Path, tmp_path: Path) -> None:
    file = shared_data / "mocap" / "deepmimic_14joints.npz"
    cli.main(["simulate", str(file), "--clip", clip, "--out", str(tmp_path / "out"), *QUICK])
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES
    pose = np.load(tmp_path / "out" / "pose.npz")
    with np.load(file) as capture:
        bones = np.linalg.norm(capture[clip][:, 8] - capture[clip][:, 9], axis=-1)
    assert np.linalg.norm(pose["joints_m"][0, :, 8] - pose["joints_m"][0, :, 9], axis=-1) == pytest.approx(
        bones, abs=1e-5
    )
    assert pose["joints_m"][..., 1].min() > 1.49
    assert pose["keypoint_scores"].min() == 1, "the whole body is drawn"
