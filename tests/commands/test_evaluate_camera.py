"""``tensorsim evaluate camera`` prints what it measured."""

import pytest

from tensorsim import cli


def test_a_row_per_tilt_and_height(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["evaluate", "camera", "--tilts", "12", "--heights", "1.5", "--fovs", "60", "--noise", "0"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("| 12 | 1.5 m | 1 | ")
    assert float(lines[2].split("|")[4].split()[0]) < 2.0
    assert lines[3].startswith("tilt within 2 degrees: 1 of 1; range within 7 %: ")


@pytest.mark.parametrize("options", ["--tilts", "--tilts 80 --heights 0.5 --fovs 40"])
def test_no_camera_is_refused(options: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(f"evaluate camera {options}".split())
    assert stop.value.code == 2
    assert "evaluate camera: got no" in capsys.readouterr().err
