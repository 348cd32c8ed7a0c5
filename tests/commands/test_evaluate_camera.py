"""``tensorsim evaluate camera`` prints what it measured."""

import pytest

from tensorsim import cli
from tensorsim.commands.evaluate_camera import EvaluateCamera
from tensorsim.errors import TensorsimError


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
        "range within 7 % where the standard deviation of the field of view is at most 4 degrees: "
    )
    assert lines[4].split(": ")[1].split("; ")[0].endswith(" of 2")
    assert lines[5] == (
        "field of view within one standard deviation: 2 of 2 (68 % expected), within two: 2 (95 %)"
    )


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
