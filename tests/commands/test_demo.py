"""``tensorsim demo``: a film of known motion, its maps, and what they should have been."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import loadmat

import tensorsim as ts
from tensorsim.commands import demo
from tensorsim.data.video import VideoReader
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.scores import similarity
from tensorsim.render.renderer import RenderedVideo
from tensorsim.types import Pose, RadarMaps
from tests.film import RectangleDetector, StandingPose
from tests.test_cli import FILES

MADE = FILES | {"film.mp4", "maps_truth.npz", "pose_truth.npz"}


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, str]:
    """Networks that need no weights; they find something red, seldom the person."""
    weights = tmp_path / "w.onnx"
    weights.write_text("")
    monkeypatch.setattr(demo, "load_networks", lambda *_: (RectangleDetector(), StandingPose()))
    return {"detector": str(weights), "pose": str(weights)}


def test_writes_the_film_its_maps_and_the_truth(stand_ins: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "demo"
    demo.Demo("kicking", out, duration=0.6, scene="through-wall", seed=5, quiet=True, **stand_ins).run()
    assert {p.name for p in out.iterdir()} == MADE
    summary = json.loads((out / "summary.json").read_text())
    assert summary["activity"] == "S3 Kicking"
    film = VideoReader(out / "film.mp4")
    assert (film.fps, film.height, film.width) == (30.0, 360, 640)
    assert sum(len(chunk) for chunk in film.chunks(10)) == 18
    truth, maps = np.load(out / "maps_truth.npz"), np.load(out / "maps.npz")
    for name in ("range_time", "range_time_mti", "doppler_time"):
        assert truth[name].shape == maps[name].shape
        error = np.mean((maps[name] / maps[name].max() - truth[name] / truth[name].max()) ** 2)
        psnr_db = summary["film_against_truth"][name]["psnr_linear_db"]
        assert psnr_db == pytest.approx(-10 * np.log10(error), abs=1e-3)
    assert truth["range_time"].shape[1] == round(0.6 * 128)

    # The truth is the generated motion, filmed whole, and simulated from its fine steps without a film.
    pose = np.load(out / "pose_truth.npz")
    assert pose["visibility"].min() >= 1, "nothing of the body is out of the picture"
    people = ts.motion.PeopleConfig(
        start_range_m=(demo.NEAR_M, demo.FAR_M), keep_range_m=(demo.NEAR_M, demo.FAR_M)
    )
    motion = ts.motion.ActivityGenerator(people).generate("kicking", seed=5, duration_s=0.6, rate_hz=240.0)
    np.testing.assert_allclose(pose["joints_m"][0], motion.joints[0, ::8].numpy(), atol=1e-6)
    assert summary["person_height_m"] == pytest.approx(float(motion.people.height_m[0]), abs=1e-4)
    radar = ts.radar.RadarSimulator(
        ts.RadarConfig.through_wall(), ts.WallConfig(), multipath=True, snr_db=None
    )
    exact = ts.PoseToDoppler(radar)(motion.joints[None].float(), motion.valid[None], 240.0)
    expected = exact.doppler_time[0].numpy()
    assert truth["doppler_time"] == pytest.approx(expected, abs=0.02 * float(expected.max()))


@pytest.mark.parametrize("paper", [False, True])
def test_the_camera_is_that_of_the_film_whatever_a_configuration_says(
    stand_ins: dict[str, str], tmp_path: Path, paper: bool
) -> None:
    elsewhere = ts.SimulationConfig().replace(pose__calibrate=True, pose__initial_distance_m=(2.0,))
    elsewhere.to_yaml(tmp_path / "run.yaml")
    out = tmp_path / "demo"
    options = {"scene": "through-wall", "quiet": True, "save": "mat", **stand_ins}
    demo.Demo("kicking", out, 0.5, config=tmp_path / "run.yaml", paper=paper, **options).run()  # type: ignore[arg-type]
    pose, truth = (
        json.loads((out / "summary.json").read_text())["config"]["pose"],
        loadmat(out / "pose_truth.mat"),
    )
    assert pose["calibrate"] is False
    start_m = float(truth["joints_m"][0, 0, (8, 11), 1].mean())
    assert pose["initial_distance_m"] == ([pytest.approx(start_m, abs=1e-6)] if paper else None)


@pytest.mark.slow
def test_nobody_is_filmed_for_empty(
    stand_ins: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "demo"
    demo.Demo("S1", out, duration=0.5, scene="through-wall", quiet=True, **stand_ins).run()
    assert "S1 Empty" in capsys.readouterr().out
    assert not np.load(out / "pose_truth.npz")["valid"].any()
    assert json.loads((out / "summary.json").read_text())["film_against_truth"]["joint_error_m"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"activity": "wlaking"}, "perhaps 'walking'"),
        ({"duration": 0.0}, "--duration: got 0.0"),
        ({"duration": float("nan")}, "--duration: got nan"),
        ({"detector": "none.onnx"}, "--detector: none.onnx is not a file"),
        ({"radar": "nothing"}, "--radar"),
        ({"device": "abacus"}, "--device"),
        ({"seed": -1}, "--seed: got -1"),
    ],
)
def test_bad_options_are_refused(
    options: dict[str, object], message: str, stand_ins: dict[str, str], tmp_path: Path
) -> None:
    with pytest.raises(TensorsimError, match=message):
        demo.Demo(out=tmp_path / "demo", **(stand_ins | options)).run()  # type: ignore[arg-type]
    assert not (tmp_path / "demo").exists()


def maps_of(level: torch.Tensor) -> RadarMaps:
    ridges = torch.zeros(3, level.shape[-1], dtype=torch.int64)
    return RadarMaps(level, level[:, 1:], level, ridges, ridges.float(), torch.tensor(50.0))


def test_similarity_by_hand() -> None:
    truth = torch.zeros(20, 30)
    truth[5, :] = 2.0
    table = similarity(maps_of(truth * 3), maps_of(truth))
    assert table["doppler_time"]["ssim_linear"] == pytest.approx(1)
    assert table["doppler_time"]["psnr_linear_db"] is None, "equal maps, whatever their gain"
    moved = torch.zeros(20, 30)
    moved[9, :] = 2.0
    # Two rows of 20 differ by the peak.
    table = similarity(maps_of(moved), maps_of(truth))
    assert table["doppler_time"]["psnr_linear_db"] == pytest.approx(10.0, abs=1e-3)


def test_joint_errors_by_hand() -> None:
    joints = torch.randn(1, 6, 14, 3)
    valid = torch.ones(1, 6, dtype=torch.bool)
    blank = torch.zeros(1, 2, 6, 17, 2)
    estimate = torch.stack([torch.zeros(6, 14, 3), joints[0] + torch.tensor([0.3, -0.2, 0.0])])
    found = torch.stack([valid[0] & (torch.arange(6) < 2), valid[0]])
    pose = Pose(torch.zeros(1, 2, 6, 4), blank, blank[..., 0], estimate[None], found[None])
    nothing = torch.zeros(0)
    film = RenderedVideo(*[nothing] * 6, joints, valid, ts.CameraConfig())
    assert demo.joint_errors(pose, film) == {"joint_error_m": 0.0, "range_error_m": pytest.approx(0.2)}


@pytest.mark.slow
def test_networks_see_the_person(shared_data: Path, tmp_path: Path) -> None:
    weights = shared_data / "weights"
    demo.Demo(
        "walking",
        tmp_path / "demo",
        detector=str(weights / "rtmdet_nano_person.onnx"),
        pose=str(weights / "simplepose_coco17_256x192.onnx"),
        quiet=True,
    ).run()
    summary = json.loads((tmp_path / "demo" / "summary.json").read_text())
    assert len(summary["people"]) == 1
    assert summary["people"][0]["last_frame"] == 119
    likeness = summary["film_against_truth"]
    assert likeness["doppler_time"]["psnr_linear_db"] > 25
    assert likeness["joint_error_m"] < 0.15
