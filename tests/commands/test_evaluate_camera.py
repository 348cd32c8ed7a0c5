"""``tensorsim evaluate camera`` prints what it measured."""

import math

import pytest
import torch

from tensorsim import cli
from tensorsim.commands.evaluate_camera import EvaluateCamera
from tensorsim.errors import TensorsimError
from tensorsim.evaluation import camera
from tensorsim.vision.calibration.calibrator import CameraEstimate


def test_a_row_per_tilt_and_height(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(
        [
            "evaluate",
            "camera",
            "--tilts",
            "12",
            "--heights",
            "1.5",
            "--fovs",
            "60",
            "--noise",
            "0",
            "--walks",
            "2",
        ]
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("| 12 | 1.5 m | 2 | ")
    assert float(lines[2].split("|")[4].split()[1]) < 2.0  # median, largest
    assert lines[3].startswith("tilt within 2 degrees: 2 of 2; range within 7 %: ")
    assert lines[4].startswith(
        "before uncertain tilts are drawn towards a level camera: tilt within 2 degrees: 2 of"
    )
    assert lines[5].startswith(
        "range within 7 % where the standard deviation of the field of view is at most 4 degrees: "
    )
    assert lines[5].split(": ")[1].split("; ")[0].endswith(" of 2")
    assert lines[6] == (
        "field of view within one standard deviation: 2 of 2 (68 % expected), within two: 2 (95 %)"
    )


def test_the_camera_is_the_one_that_the_pipeline_uses(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An estimate of 40 degrees whose tilt is as good as unknown becomes a level camera."""

    def told(*_: object) -> CameraEstimate:
        known = {"horizontal_fov_rad": math.radians(60.0), "height_m": 1.5, "pitch_rad": -math.radians(40.0)}
        fields = dict.fromkeys(CameraEstimate._fields, 0.0) | known | {"pitch_sd_rad": 1e3}
        return CameraEstimate(
            **{name: torch.tensor(value, dtype=torch.float64) for name, value in fields.items()}
        )

    monkeypatch.setattr(camera, "estimate", told)
    EvaluateCamera(tilts=(0.0,), heights=(1.5,), fovs=(60.0,), walks=1).run()
    lines = capsys.readouterr().out.splitlines()
    assert lines[3] == "tilt within 2 degrees: 1 of 1; range within 7 %: 1 of 1"
    assert lines[4].endswith("tilt within 2 degrees: 0 of 1; range within 7 %: 0 of 1")


@pytest.mark.parametrize("noise", [-3.0, float("nan")])
def test_noise_without_meaning_is_refused(noise: float) -> None:
    with pytest.raises(TensorsimError, match=f"--noise: got {noise:g}, expected at least 0 pixels"):
        EvaluateCamera(noise=noise).run()


@pytest.mark.parametrize("options", ["--tilts", "--tilts 80 --heights 0.5 --fovs 40", "--walks 0"])
def test_no_camera_is_refused(options: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(f"evaluate camera {options}".split())
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert (
        "evaluate camera: got no" in message or "walks: got 0, expected an integer of at least 1" in message
    )
