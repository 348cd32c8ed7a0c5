"""Bad input gives one clear line: an exception of ours in Python, exit status 2 on the command line."""

import math
import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import tensorsim as ts
from tensorsim.cli import main

RADAR = ts.RadarConfig.through_wall()
POINT = torch.tensor([0.5, 3.0, 1.0])


def still(pulses: int = 64, scatterers: int = 2) -> torch.Tensor:
    return POINT.expand(pulses, scatterers, 3).clone()


def with_nan(x: torch.Tensor) -> torch.Tensor:
    x = x.clone()
    x.view(-1)[0] = math.nan
    return x


def moving(speed_m_s: float, pulses: int = 64) -> torch.Tensor:
    t = torch.arange(pulses) / RADAR.prf_hz
    return still(pulses, 1) + torch.stack((0 * t, speed_m_s * t, 0 * t), dim=-1).unsqueeze(1)


PYTHON_CASES: list[tuple[str, Callable[[], object], str]] = [
    # radar
    ("NaN positions", lambda: ts.radar.EchoSynthesizer(RADAR)(with_nan(still()), torch.ones(2)), "NaN"),
    (
        "positions without xyz",
        lambda: ts.radar.EchoSynthesizer(RADAR)(torch.zeros(8, 2, 2), torch.ones(2)),
        "3",
    ),
    (
        "positions of rank 2",
        lambda: ts.radar.EchoSynthesizer(RADAR)(torch.zeros(8, 3), torch.ones(2)),
        "positions",
    ),
    ("rcs of another count", lambda: ts.radar.EchoSynthesizer(RADAR)(still(), torch.ones(5)), "rcs"),
    ("negative rcs", lambda: ts.radar.EchoSynthesizer(RADAR)(still(), -torch.ones(2)), "rcs"),
    (
        "integer positions",
        lambda: ts.radar.EchoSynthesizer(RADAR)(still().long(), torch.ones(2)),
        "dtype|float",
    ),
    ("unknown wall paths", lambda: ts.radar.EchoSynthesizer(RADAR, wall_paths="all"), "wall_paths"),
    (
        "wall behind the radar",
        lambda: ts.radar.EchoSynthesizer(RADAR, wall=ts.WallConfig(center_m=(0.0, -3.0, 1.5))),
        "wall",
    ),
    (
        "PRF below twice the Doppler",
        lambda: ts.radar.RadarSimulator(RADAR)(moving(6.0), torch.ones(1)),
        "PRF|prf",
    ),
    ("too few pulses", lambda: ts.radar.RadarSimulator(RADAR)(still(4), torch.ones(2)), "pulses|frames|M"),
    ("NaN SNR", lambda: ts.radar.ReceiverNoise(math.nan), "snr_db"),
    ("unknown SNR reference", lambda: ts.radar.ReceiverNoise(10.0, reference="peak"), "reference"),
    ("unknown range window", lambda: ts.radar.RangeProfile(RADAR, window="kaiserish"), "window"),
    (
        "IF of another length",
        lambda: ts.radar.RangeProfile(RADAR)(torch.zeros(3, 7, dtype=torch.complex64)),
        "400",
    ),
    ("unknown MTI", lambda: ts.radar.MovingTargetIndicator("three-card"), "three-card"),
    (
        "one pulse into MTI",
        lambda: ts.radar.MovingTargetIndicator("two-pulse")(torch.zeros(1, 4) + 0j),
        "at least 2 pulses",
    ),
    ("STFT overlap of 1", lambda: ts.radar.DopplerTimeMap(RADAR, overlap=1.0), "overlap"),
    ("STFT window of 0 s", lambda: ts.radar.DopplerTimeMap(RADAR, window_s=0.0), "window_s"),
    ("unknown integration", lambda: ts.radar.DopplerTimeMap(RADAR, integration="coherentish"), "integration"),
    ("no ridges", lambda: ts.radar.RidgeExtractor(count=0), "count"),
    # motion
    ("PRF of 0", lambda: ts.motion.PoseResampler(0.0), "prf_hz"),
    ("unknown interpolation", lambda: ts.motion.PoseResampler(100.0, method="sinc"), "method"),
    ("one frame", lambda: ts.motion.PoseResampler(100.0)(torch.zeros(1, 14, 3), 30.0), "2"),
    ("fps 0", lambda: ts.motion.PoseResampler(100.0)(torch.zeros(5, 14, 3), 0.0), "fps"),
    ("NaN joints", lambda: ts.motion.PoseResampler(100.0)(with_nan(torch.zeros(5, 14, 3)), 30.0), "NaN"),
    ("even window", lambda: ts.motion.SavitzkyGolay(4, 2), "window"),
    ("order not below window", lambda: ts.motion.SavitzkyGolay(5, 5), "order"),
    ("signal shorter than the window", lambda: ts.motion.SavitzkyGolay(9, 2)(torch.zeros(5, 14, 3)), "9"),
    # vision
    ("unknown detector", lambda: ts.vision.RTMDet("huge"), "huge"),
    ("grey images", lambda: ts.vision.RTMDet("nano-person")(torch.zeros(1, 1, 64, 64)), "3"),
    (
        "one image without batch",
        lambda: ts.vision.RTMDet("nano-person")(torch.zeros(3, 64, 64)),
        r"\(B, 3, H, W\)",
    ),
    ("unknown pose width", lambda: ts.vision.HRNet(31), "31"),
    ("unknown Kalman mode", lambda: ts.vision.KalmanSmoother(mode="sideways"), "mode"),
    ("negative Kalman noise", lambda: ts.vision.KalmanSmoother(measurement_noise=-1.0), "measurement_noise"),
    ("no person height", lambda: ts.vision.MetricPose(person_height_m=()), "person_height_m"),
    ("unknown position mode", lambda: ts.vision.MetricPose(mode="gps"), "mode"),
    ("empty library", lambda: ts.vision.NearestPoseLifter(torch.zeros(0, 14, 3)), "library"),
    ("library of 17 joints", lambda: ts.vision.NearestPoseLifter(torch.zeros(5, 17, 3)), "library"),
    ("no neighbours", lambda: ts.vision.NearestPoseLifter(torch.randn(5, 14, 3), neighbours=0), "neighbours"),
    ("no tracks", lambda: ts.vision.GNNTracker(max_tracks=0), "max_tracks"),
    # enhance
    ("shallow DnCNN", lambda: ts.enhance.DnCNN(depth=1), "depth"),
    ("missing weights", lambda: ts.vision.RTMDet.from_pretrained("missing.pth"), "missing.pth"),
    ("unknown suffix", lambda: ts.vision.HRNet.from_pretrained(__file__), "test_bad_input.py"),
]


@pytest.mark.parametrize(("make", "message"), [c[1:] for c in PYTHON_CASES], ids=[c[0] for c in PYTHON_CASES])
def test_python_refuses(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ts.TensorsimError, match=message):
        make()


class Evil:
    """A pickle that would create a file when loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.path,))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Files that are not what their names suggest."""
    (tmp_path / "text.mp4").write_text("this is no video")
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "text.onnx").write_text("this is no network")
    (tmp_path / "text.safetensors").write_text("this is no network")
    (tmp_path / "network.txt").write_text("nor this")
    state = {"conv0.weight": torch.zeros(3, 3)}
    torch.save(state, tmp_path / "other.pth")
    whole = (tmp_path / "other.pth").read_bytes()
    (tmp_path / "truncated.pth").write_bytes(whole[: len(whole) // 2])
    torch.save(state, tmp_path / "hashed-0123abcd.pth")
    (tmp_path / "evil.pth").write_bytes(pickle.dumps(Evil(tmp_path / "touched")))
    torch.save({"state_dict": Evil(tmp_path / "touched")}, tmp_path / "evil2.pth")
    (tmp_path / "short.safetensors").write_bytes(struct.pack("<Q", 10_000) + b"{}")
    (tmp_path / "a_file").write_text("")
    for name, frames in (("good.avi", 5), ("single.avi", 1)):
        writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
        for _ in range(frames):
            writer.write(np.zeros((48, 64, 3), np.uint8))
        writer.release()
    return tmp_path


GOOD = ["good.avi", "--detector", "other.pth", "--pose", "other.pth"]
COMMAND_LINES: list[tuple[str, list[str], str]] = [
    ("missing video", ["missing.mp4", *GOOD[1:]], "missing.mp4"),
    ("a folder", [".", *GOOD[1:]], "."),
    ("text named mp4", ["text.mp4", *GOOD[1:]], "text.mp4"),
    ("empty file", ["empty.mp4", *GOOD[1:]], "empty.mp4"),
    ("fps 0", [*GOOD, "--fps", "0"], "fps"),
    ("fps NaN", [*GOOD, "--fps", "nan"], "fps"),
    ("start beyond the end", [*GOOD, "--start", "60"], "start"),
    ("end before start", [*GOOD, "--start", "0.3", "--end", "0.2"], "end"),
    ("stride 0", [*GOOD, "--stride", "0"], "stride"),
    ("height 0", [*GOOD, "--person-height", "0"], "person-height"),
    ("distance below 0", [*GOOD, "--initial-distance", "-1"], "initial-distance"),
    ("field of view", [*GOOD, "--camera-fov", "180"], "camera-fov"),
    ("SNR infinite", [*GOOD, "--snr", "inf"], "snr"),
    ("paper position without distance", [*GOOD, "--position", "paper"], "initial-distance"),
    ("unknown device", [*GOOD, "--device", "abacus"], "device"),
    ("out is a file", [*GOOD, "--out", "a_file"], "a_file"),
    ("unknown detector", ["good.avi", "--detector", "rtmdet-m-persn"], "perhaps 'rtmdet-m-person'"),
    ("unknown pose network", ["good.avi", "--pose", "hrnet-w32-coc"], "--pose"),
    ("unknown classifier", ["good.avi", "--classifier", "spgnet-activites"], "--classifier"),
    ("missing detector", ["good.avi", "--detector", "none.onnx", "--pose", "other.pth"], "none.onnx"),
    ("detector of another net", GOOD, "other.pth"),
    ("detector text onnx", ["good.avi", "--detector", "text.onnx", "--pose", "other.pth"], "text.onnx"),
    ("detector text", ["good.avi", "--detector", "network.txt", "--pose", "other.pth"], "network.txt"),
    ("truncated", ["good.avi", "--detector", "truncated.pth", "--pose", "other.pth"], "truncated.pth"),
    ("wrong hash", ["good.avi", "--detector", "hashed-0123abcd.pth", "--pose", "other.pth"], "0123abcd"),
    (
        "broken safetensors",
        ["good.avi", "--detector", "text.safetensors", "--pose", "other.pth"],
        "text.safetensors",
    ),
    (
        "short safetensors",
        ["good.avi", "--detector", "short.safetensors", "--pose", "other.pth"],
        "short.safetensors",
    ),
    ("code in a pickle", ["good.avi", "--detector", "evil.pth", "--pose", "other.pth"], "evil.pth"),
    ("code in a checkpoint", ["good.avi", "--detector", "evil2.pth", "--pose", "other.pth"], "evil2.pth"),
]


@pytest.mark.parametrize(
    ("arguments", "message"), [c[1:] for c in COMMAND_LINES], ids=[c[0] for c in COMMAND_LINES]
)
def test_command_line_refuses(
    arguments: list[str],
    message: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.delenv("TENSORSIM_DETECTOR", raising=False)
    monkeypatch.delenv("TENSORSIM_POSE", raising=False)
    before = sorted(os.listdir())
    if "--out" not in arguments:
        arguments = [*arguments, "--out", "out"]
    with pytest.raises(SystemExit) as exit_:
        main(["simulate", *arguments, "--quiet"])
    assert exit_.value.code == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("tensorsim: error: ")
    assert message in lines[0]
    assert sorted(os.listdir()) == before, "nothing written, nothing run"


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["simulate", "x.mp4", "--out", "o", "--secne", "free-space"], "--scene"),
        (["simulate", "x.mp4", "--out", "o", "--scene", "moon"], "through-wall"),
        (["simulate", "x.mp4"], "--out"),
        (["simulat", "x.mp4"], "simulate"),
        ([], "simulate"),
    ],
)
def test_a_typo_gets_a_suggestion(arguments: list[str], hint: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tensorsim", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert hint in done.stderr
    assert "Traceback" not in done.stderr


def test_libraries_stay_quiet_about_a_broken_video(folder: Path) -> None:
    command = [sys.executable, "-m", "tensorsim", "simulate", "text.mp4", *GOOD[1:], "--out", "out"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.strip().splitlines() == [
        "tensorsim: error: text.mp4: unsupported file type, expected a video (mp4, mov, mkv, avi, ...)"
    ]


def test_the_table_is_long_enough() -> None:
    assert len(PYTHON_CASES) + len(COMMAND_LINES) >= 40
