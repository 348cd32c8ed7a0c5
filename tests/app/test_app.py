"""The app: values of its controls become options, runs are kept apart and can be cancelled, a real browser uses it."""

import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import loadmat

from tensorsim.app.form import GROUPS, controls, for_demo, options_of
from tensorsim.app.runs import KEPT, Run, Runs
from tensorsim.commands.app import App
from tensorsim.commands.panel import PANEL
from tensorsim.commands.simulate import Simulate
from tensorsim.data.video_writer import write_video
from tensorsim.errors import TensorsimError
from tensorsim.progress import picture, progress_bar
from tensorsim.render.renderer import PersonRenderer
from tests.browser import chromium

ROOT = Path(__file__).resolve().parents[2]


def test_every_parameter_of_the_panel_has_a_control_with_unit_and_help() -> None:
    made = {control.option: control for control in controls()}
    for parameter in PANEL:
        control = made[parameter.option]
        assert control.group == parameter.group
        assert control.label.startswith(parameter.name)
        assert parameter.unit in control.label or control.kind == "choice"
        assert control.help
    assert [group for group in GROUPS if not any(c.group == group for c in made.values())] == []


def test_values_of_controls_become_options() -> None:
    values = {
        "prf_hz": 4096,
        "person_height": "1.75, 1.6",
        "wall_size": "5 0.3 2.5",
        "ridges": 2,
        "range_window": "hann",
        "vital_signs": True,
        "flip_test": False,
        "carrier_hz": None,
        "denoiser": "ksvd",
        "mti": "",
        "clip": "S1/Walking",
        "heading": "30",
        "image_size": "640, 480",
    }
    options = options_of(values)
    assert options == {
        "prf_hz": 4096.0,
        "person_height": (1.75, 1.6),
        "wall_size": (5.0, 0.3, 2.5),
        "ridges": 2,
        "range_window": "hann",
        "denoiser": "ksvd",
        "vital_signs": True,
        "flip_test": False,
        "clip": "S1/Walking",
        "heading": 30.0,
        "image_size": (640, 480),
    }
    command = Simulate(source=Path("film.mp4"), out=Path("out"), scene="through-wall", **options)
    config = command.configuration()
    assert config.scene.radar.prf_hz == 4096.0
    assert config.scene.wall is not None
    assert config.scene.wall.size_m[1] == 0.3
    assert options_of({}) == {}
    with pytest.raises(TensorsimError, match=r"Person height \(m\): got 'tall', expected numbers"):
        options_of({"person_height": "tall"})
    with pytest.raises(TensorsimError, match=r"STFT window \(s\): got 'abc', expected a number$"):
        options_of({"stft_window": "abc"})
    with pytest.raises(TensorsimError, match=r"Number of ridges: got 2.5, expected a whole number"):
        options_of({"ridges": 2.5})
    with pytest.raises(TensorsimError, match=r"Number of ridges: got '1e400', expected a whole number"):
        options_of({"ridges": "1e400"})
    with pytest.raises(TensorsimError, match=r"Image size: got '640', expected 2 whole numbers"):
        options_of({"image_size": "640"})
    with pytest.raises(TensorsimError, match=r"Tx position \(m\): got '1 2', expected 3 numbers"):
        options_of({"tx_position": "1 2"})
    with pytest.raises(
        TensorsimError, match=r"Denoiser: got '/etc/passwd', expected one of none, perona-malik"
    ):
        options_of({"denoiser": "/etc/passwd"})
    with pytest.raises(
        TensorsimError, match="initial distance applies only to files, not to a generated person"
    ):
        for_demo({"initial_distance": (4.0,)})


def test_what_takes_too_long_is_refused_whatever_its_kind(tmp_path: Path) -> None:
    pytest.importorskip("gradio")
    from tensorsim.app.page import _command, check_length

    film, motion, keypoints = (tmp_path / name for name in ("film.mp4", "motion.npz", "people.json"))
    write_video(film, [np.zeros((48, 64, 3), np.uint8)] * 60, 10.0)
    joints = np.random.default_rng(0).random((60, 14, 3)) + np.array([0, 3, 0])
    np.savez(motion, joints_m=joints, fps=10.0)
    person = {"category_id": 1, "score": 1.0, "keypoints": [20.0, 30.0, 1.0] * 17}
    keypoints.write_text(json.dumps([person | {"image_id": number} for number in range(60)]))
    own: dict[str, Any] = {}
    for path in (film, motion):
        for given in (own, {"fps": 1000.0}, {"fps": 5.0, "end": 6.0}, {"start": 0.5}):
            with pytest.raises(TensorsimError, match=f"{path.name}: got .* s, expected at most 5 s"):
                check_length(path, 5.0, given)
        check_length(path, 5.0, {"end": 4.0})
        check_length(path, 6.0, {"fps": 20.0})
    with pytest.raises(TensorsimError, match=r"people.json: got 6.0 s, expected at most 5 s"):
        check_length(keypoints, 5.0, {"fps": 10.0})
    check_length(keypoints, 5.0, {"fps": 20.0})
    with pytest.raises(TensorsimError, match=r"people\.json: the file has no frame rate; set Fps"):
        check_length(keypoints, 5.0, {})
    settings = {"scene": "free-space", "radar": None, "paper": False}
    with pytest.raises(TensorsimError, match=r"got 100 s, expected 0\.5 to 60 s"):
        _command(None, "walking", "100", settings, 120.0)(tmp_path)


class Work:
    """Stands in for a command: counts, draws and writes."""

    def __init__(self, folder: Path, steps: int = 3, error: Exception | None = None) -> None:
        self.folder, self.steps, self.error = folder, steps, error

    def run(self) -> None:
        from tensorsim.config import SimulationConfig
        from tensorsim.files import complete_or_nothing, write_json

        with complete_or_nothing(self.folder) as scratch:
            bar = progress_bar("radar", self.steps, quiet=True)
            for _ in range(self.steps):
                bar.update(1)
                picture("film", lambda: np.zeros((2, 3, 3), np.uint8))
                time.sleep(0.005)
            if self.error is not None:
                raise self.error
            write_json(scratch / "summary.json", {"config": SimulationConfig().to_document(), "files": []})


def ended(run: Run) -> Run:
    assert run.finished.wait(20)
    return run


def test_runs_are_watched_and_their_files_are_all_that_can_be_read(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    runs = Runs(tmp_path / "runs")
    run = ended(runs.start(Work))
    assert (run.error, run.stage, run.done, run.total) == (None, "radar", 3, 3)
    assert run.pictures["film"].shape == (2, 3, 3)
    assert [path.name for path in run.files()] == ["all.zip", "configuration.yaml", "summary.json"]
    assert runs.file(run.token, "summary.json") == run.folder / "summary.json"
    for token, name in ((run.token, "../runs"), (run.token, "/etc/passwd"), ("..", "runs"), ("", "")):
        assert runs.file(token, name) is None


def test_a_run_can_be_cancelled_and_leaves_nothing(tmp_path: Path) -> None:
    runs = Runs(tmp_path)
    run = runs.start(lambda folder: Work(folder, steps=10_000))
    while run.done < 2:
        time.sleep(0.005)
    runs.cancel(run.token)
    runs.cancel("unknown")
    runs.cancel(None)
    assert ended(run).error == "cancelled"
    assert run.done < 10_000
    assert run.files() == []


def test_a_run_that_waits_can_be_cancelled(tmp_path: Path) -> None:
    runs = Runs(tmp_path)
    first = runs.start(lambda folder: Work(folder, steps=10_000))
    while first.done < 2:
        time.sleep(0.005)
    second = runs.start(Work)
    runs.cancel(second.token)
    assert ended(second).error == "cancelled"
    assert not first.finished.is_set()
    runs.cancel(first.token)
    ended(first)


def test_no_run_outlives_the_app(tmp_path: Path) -> None:
    """A thread still computing when Python exits aborts the process."""
    runs = Runs(tmp_path)
    started = [runs.start(lambda folder: Work(folder, steps=10_000)) for _ in range(2)]
    while not any(run.done for run in started):
        time.sleep(0.005)
    runs.close()
    assert [(run.finished.is_set(), run.error) for run in started] == [(True, "cancelled")] * 2


class Rendering:
    """Stands in for the command of a generated person."""

    def run(self) -> None:
        PersonRenderer(height=32, width=32)(torch.rand(500, 14, 3) + torch.tensor([0.0, 3.0, 0.0]))


def test_a_run_can_be_cancelled_while_a_film_is_rendered(tmp_path: Path) -> None:
    runs = Runs(tmp_path)
    run = runs.start(lambda folder: Rendering())
    while run.done < 2 and not run.finished.is_set():
        time.sleep(0.005)
    assert (run.stage, run.total) == ("render", 500)
    runs.cancel(run.token)
    assert ended(run).error == "cancelled"
    assert run.done < 500


def test_failures_are_one_sentence_without_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs").mkdir()
    runs = Runs(tmp_path / "runs")
    message = f"{tmp_path}/uploads/ab12/film.mp4: OpenCV cannot read this,\nexpected a video"
    run = ended(runs.start(lambda folder: Work(folder, error=TensorsimError(message))))
    assert run.error == "film.mp4: OpenCV cannot read this, expected a video"
    broken = ended(runs.start(lambda folder: Work(folder, error=RuntimeError("inner"))))
    assert broken.error == "the simulation failed (RuntimeError); see the terminal for details"
    assert "inner" in capsys.readouterr().err


def test_old_runs_are_removed(tmp_path: Path) -> None:
    runs = Runs(tmp_path)
    made = [ended(runs.start(Work)) for _ in range(KEPT + 2)]
    assert len(runs.known) == KEPT
    assert [run.folder.is_dir() for run in made[:3]] == [False, False, True]


def test_an_address_that_cannot_be_used_is_said_before_anything_is_loaded(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(
            TensorsimError,
            match=rf"--host, --port: 127.0.0.1, {port} cannot be used \(Address already in use\)",
        ):
            App(port=port).run()
    with pytest.raises(TensorsimError, match=r"--host, --port: no.such.host, 7860 cannot be used \("):
        App(host="no.such.host").run()
    assert capsys.readouterr().err == ""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """The address of ``tensorsim app`` in a separate process, with its temporary folders in ``tmp_path``."""
    pytest.importorskip("gradio")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = ["-m", "tensorsim", "app", "--port", str(port), "--longest-s", "5", "--largest-mb", "1"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path), "OMP_NUM_THREADS": "2"}
    process = subprocess.Popen([sys.executable, *arguments], env=environment, cwd=ROOT)
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(600):
            time.sleep(0.2)
            try:
                urllib.request.urlopen(address, timeout=2).read()
                break
            except OSError:
                assert process.poll() is None, "the app has ended"
        yield address
        with urllib.request.urlopen(
            f"{address}/gradio_api/heartbeat/open", timeout=10
        ):  # a page that is open
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=30) == 143
    finally:
        process.kill()
    assert list(tmp_path.glob("tensorsim-app-*")) == [], "temporary files are removed"


def test_only_films_that_were_uploaded_are_read(
    server: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    film = tmp_path_factory.mktemp("private") / "film.mp4"
    write_video(film, [np.zeros((48, 64, 3), np.uint8)] * 10, 10.0)
    page = json.load(urllib.request.urlopen(f"{server}/config", timeout=10))
    kinds = {component["id"]: component for component in page["components"]}
    simulate = next(each for each in page["dependencies"] if len(each["inputs"]) > 20)
    values = [kinds[number]["props"].get("value") for number in simulate["inputs"]]
    place = [kinds[number]["type"] for number in simulate["inputs"]].index("file")
    values[place] = {"path": str(film), "meta": {"_type": "gradio.FileData"}}
    body = {"data": values, "fn_index": simulate["id"], "session_hash": "a"}
    asked = urllib.request.Request(
        f"{server}/gradio_api/queue/join", json.dumps(body).encode(), {"Content-Type": "application/json"}
    )
    urllib.request.urlopen(asked, timeout=10).read()
    events = urllib.request.urlopen(f"{server}/gradio_api/queue/data?session_hash=a", timeout=60)
    answer = next(line for line in events if b"process_completed" in line)
    assert json.loads(answer.removeprefix(b"data:"))["success"] is False
    assert list(tmp_path.rglob("film.mp4")) == []
    # Requests under other host names, as in DNS rebinding, are not answered.
    elsewhere = urllib.request.Request(server, headers={"Host": "elsewhere.example"})
    with pytest.raises(urllib.error.HTTPError, match="400"):
        urllib.request.urlopen(elsewhere, timeout=10)


def status_of(address: str) -> int:
    try:
        return int(urllib.request.urlopen(address, timeout=10).status)
    except urllib.error.HTTPError as error:
        return error.code


@pytest.mark.slow
def test_five_tasks_in_a_browser(server: str, tmp_path: Path) -> None:
    """Opens; runs the example; changes a wall and compares; downloads a .mat; a broken film is one sentence."""
    from playwright.sync_api import expect

    shots = Path(os.environ.get("TENSORSIM_SCREENSHOTS", tmp_path))
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"\0\0\0\x18ftypmp42" + bytes(2000))
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1400, "height": 1000}, accept_downloads=True)
        elsewhere: list[str] = []
        page.on(
            "request",
            lambda r: None if r.url.startswith((server, "data:", "blob:")) else elsewhere.append(r.url),
        )
        page.set_default_timeout(180_000)
        page.goto(server)
        page.get_by_role("button", name="Simulate").wait_for()

        page.get_by_label("Length of the generated film (s)").fill("1")
        page.get_by_label("Length of the generated film (s)").press("Tab")
        page.click("#simulate")
        page.locator("#status progress").wait_for()
        page.locator("#result iframe").wait_for()
        report = page.frame_locator("#result iframe").first
        report.locator("body[data-ready=yes]").wait_for()
        assert report.locator("#people tr").count() == 2
        page.screenshot(path=shots / "app_1400.png")

        page.get_by_label("through-wall").check()
        page.get_by_role("button", name=re.compile("^Wall ")).click()
        type_into(page, page.locator("#wall-permittivity").locator("input, textarea"), "4")
        page.click("#compare")
        page.locator("#result section").nth(1).wait_for()
        sources = [frame.get_attribute("src") for frame in page.locator("#result iframe").all()]
        wall = report_text(server, sources[1])
        assert '"relative_permittivity":4.0,"loss_tangent":0.03' in wall, (
            "what is left empty keeps its default"
        )
        assert '"wall":null' in report_text(server, sources[0])

        with page.expect_download() as download:
            page.locator("#result section").nth(1).get_by_role("link", name="maps.mat").click()
        maps = loadmat(io.BytesIO(Path(download.value.path()).read_bytes()))
        assert maps["doppler_time"].shape == (maps["doppler_hz"].size, maps["time_s"].size)
        page.set_viewport_size({"width": 420, "height": 900})
        page.wait_for_timeout(500)
        page.screenshot(path=shots / "app_420.png")
        page.locator("#result iframe").last.scroll_into_view_if_needed()
        page.wait_for_timeout(500)
        page.screenshot(path=shots / "app_420_result.png")
        assert page.evaluate("document.documentElement.scrollWidth") <= 420

        choose_film(page, broken)
        page.click("#simulate")
        sentence = page.locator("#status .failed")
        sentence.wait_for()
        assert re.fullmatch(r"broken\.mp4: OpenCV cannot read this, expected a video", sentence.inner_text())
        expect(page.locator("#status")).to_be_in_viewport()
        assert elsewhere == [], "nothing is asked of the network"

    for path in ("/etc/passwd", str(ROOT / "README.md"), str(broken)):
        assert status_of(f"{server}/gradio_api/file={path}") in (403, 404)
    token = str(sources[0]).split("/")[2]
    for name in ("%2e%2e/%2e%2e/etc/passwd", "..%2fother", "no.npz"):
        assert status_of(f"{server}/runs/{token}/{name}") == 404
    assert status_of(f"{server}/runs/{token}/all.zip") == 200


def type_into(page: Any, field: Any, value: str) -> None:
    """Type a value; once more where Gradio, which builds a group when it is opened, builds it again and forgets it."""
    for _ in range(5):
        field.fill(value)
        field.press("Tab")
        page.wait_for_timeout(1500)
        if field.input_value() == value:
            return
    raise AssertionError(f"{value} was not kept in five attempts")


def choose_film(page: Any, film: Path) -> None:
    """Open the page anew and upload a film; again where Gradio, on a busy machine, loses the upload."""
    from playwright.sync_api import TimeoutError as NotYet

    for _ in range(5):
        page.reload()
        page.get_by_role("button", name="Simulate").wait_for()
        page.wait_for_timeout(1000)
        try:
            page.locator("input[type=file]").first.set_input_files(film, timeout=30_000)
            return page.get_by_text(film.name).first.wait_for(timeout=30_000)
        except NotYet:
            continue
    raise AssertionError(f"{film.name} was not taken in five attempts")


def report_text(server: str, source: Any) -> str:
    return urllib.request.urlopen(f"{server}{source}", timeout=10).read().decode()
