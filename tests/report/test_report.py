"""The report: its data equal the run, it stays small, and a real browser plays it without a network."""

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import tensorsim as ts
from tensorsim.data.video import VideoReader
from tensorsim.plot import RIDGE_COLOURS, MapStyle, decibels
from tensorsim.report import FilmStrip, write_report
from tensorsim.report import film as film_module
from tensorsim.report.page import STORED_DB, map_contents, timeline_content
from tensorsim.results import Axes, Pictures, axes_of, doppler_figure
from tensorsim.summary import people_of
from tensorsim.types import Pose, RadarMaps
from tests.browser import chromium

FPS, FRAMES = 20.0, 40


@pytest.fixture(scope="module")
def run() -> tuple[Pose, RadarMaps, Axes, dict[str, Any]]:
    """A person who walks, seen through a wall, and a second person who is never present."""
    motion = ts.motion.ActivityGenerator().generate(
        "walking", batch=1, seed=1, duration_s=FRAMES / FPS, rate_hz=FPS
    )
    joints = torch.stack([torch.zeros(FRAMES, 14, 3), motion.joints[0].float()])[None]
    valid = torch.stack([torch.zeros(FRAMES, dtype=torch.bool), motion.valid[0]])[None]
    config = ts.SimulationConfig.through_wall().replace(scene__radar__prf_hz=256.0)
    stage = ts.PoseToDoppler.from_config(config)
    maps = RadarMaps(*(field[0] for field in stage(joints, valid, FPS)))
    blank = torch.zeros(1, 2, FRAMES, 17, 2)
    pose = Pose(torch.zeros(1, 2, FRAMES, 4), blank, blank[..., 0], joints, valid)
    document = config.to_document()
    summary = {
        "label": "S8 Walking",
        "probabilities": {"S8 Walking": 0.75, "S1 Empty": 0.25},
        "timeline": [{"start_s": 0.0, "end_s": 2.0, "label": "S8 Walking", "probability": 0.75}],
        "people": people_of(pose, FPS, config.scene.radar),
        "warnings": [
            "</script><script>document.title = 'broken out'</script>",
            f"/{'long' * 30}.mp4: cut off",
        ],
        "config": document,
        **{part: document["scene"][part] for part in ("radar", "wall")},
    }
    return pose, maps, axes_of(stage, maps), summary


def strip(folder: Path, frames: int = FRAMES) -> FilmStrip:
    with FilmStrip(folder, frames, FPS) as film:
        for index in range(frames):
            film.add(np.full((180, 640, 3), 5 * index % 256, np.uint8))
    return film


def written(
    folder: Path,
    run: tuple[Pose, RadarMaps, Axes, dict[str, Any]],
    film: FilmStrip,
    range_db: float = 50.0,
) -> dict[str, Any]:
    pose, maps, axes, summary = run
    pictures = Pictures(MapStyle(dynamic_range_db=range_db), subtitle="a walk")
    write_report(folder, summary, pose, FPS, maps, axes, film, pictures)
    page = (folder / "report.html").read_text(encoding="utf-8")
    content: dict[str, Any] = json.loads(page.split('id="content">')[1].split("</script>")[0])
    return content


def picture(data: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)


def test_content_equals_the_run(tmp_path: Path, run: tuple[Pose, RadarMaps, Axes, dict[str, Any]]) -> None:
    pose, maps, axes, summary = run
    content = written(tmp_path, run, strip(tmp_path))
    people = content["people"]
    assert people["numbers"] == [2], "somebody who is never there is left out"
    joints = np.frombuffer(base64.b64decode(people["joints_cm"]), "<i2").reshape(1, FRAMES, 14, 3)
    assert np.abs(joints / 100 - pose.joints[0, 1:].numpy()).max() <= 0.0051
    assert len(content["film"]["pictures"]) == FRAMES
    assert picture(content["film"]["pictures"][7]).shape == (135, 480, 3)
    assert abs(int(picture(content["film"]["pictures"][7]).mean()) - 35) <= 1
    doppler, moving, still = content["maps"]
    expected = decibels(maps.range_time.numpy(), STORED_DB)
    shown = picture(still["png"])[::-1] / 255 * STORED_DB - STORED_DB
    assert np.abs(shown - expected).max() < 0.5 * STORED_DB / 255 + 1e-4
    assert (still["start_s"], still["end_s"]) == (0.0, pytest.approx(2.0))
    assert moving["start_s"] == pytest.approx(0.5 / 256)
    rows = picture(doppler["png"]).shape[0]
    assert doppler["high"] - doppler["low"] == pytest.approx(rows * np.diff(axes.doppler_hz)[0])
    assert content["ridge_colours"] == list(RIDGE_COLOURS), "those of the pictures"
    assert content["scene"]["wall"]["size_m"] == [5.0, 0.24, 2.5]
    assert content["summary"]["warnings"] == summary["warnings"]


def test_all_that_the_pictures_show_is_stored(
    tmp_path: Path, run: tuple[Pose, RadarMaps, Axes, dict[str, Any]]
) -> None:
    still = written(tmp_path, run, strip(tmp_path), 120.0)["maps"][2]
    assert still["stored_db"] == 120.0
    shown = picture(still["png"])[::-1] / 255 * 120 - 120
    assert np.abs(shown - decibels(run[1].range_time.numpy(), 120.0)).max() < 0.5 * 120 / 255 + 1e-4


def test_ridges_are_those_of_the_picture(run: tuple[Pose, RadarMaps, Axes, dict[str, Any]]) -> None:
    """In an empty scene, whose maps refer to the echo of a person, there are none."""
    _, maps, axes, _ = run
    for times, some in ((1.0, True), (1e4, False)):
        peaks = {
            "doppler_time": times * float(maps.doppler_time.max()),
            "range_time": 1.0,
            "range_time_mti": 1.0,
        }
        pictures = Pictures(peaks=peaks)
        picture = [line.get_ydata() for line in doppler_figure(maps, axes, pictures)().axes[0].lines]
        ridges = np.array(map_contents(maps, axes, pictures)[0]["ridges"], dtype=float)
        assert np.allclose(ridges, picture, atol=0.1, equal_nan=True)
        assert np.isfinite(ridges).any() == some


def test_ridges_stay_in_their_map(run: tuple[Pose, RadarMaps, Axes, dict[str, Any]]) -> None:
    """A map shows the part of the Doppler axis in which there is something; ridges in the noise lie anywhere."""
    _, maps, axes, _ = run
    noisy = torch.full_like(maps.doppler_time, 0.01)
    noisy[len(noisy) // 2] = 1.0
    everywhere = torch.arange(maps.ridges.numel()).reshape(maps.ridges.shape) % len(noisy)
    strong = torch.ones_like(maps.ridge_magnitudes)
    noisy_maps = maps._replace(doppler_time=noisy, ridges=everywhere, ridge_magnitudes=strong)
    doppler = map_contents(noisy_maps, axes, Pictures())[0]
    ridges = np.array(doppler["ridges"], dtype=float)
    assert doppler["low"] <= np.nanmin(ridges) < np.nanmax(ridges) <= doppler["high"]


def test_windows_that_overlap_become_stretches_that_do_not() -> None:
    windows = [{"start_s": float(k), "end_s": k + 4.0, "label": str(k), "probability": 0.5} for k in range(3)]
    parts = timeline_content(windows, 6.0)
    assert [(part["start_s"], part["end_s"]) for part in parts] == [(0.0, 2.5), (2.5, 3.5), (3.5, 6.0)]
    assert timeline_content([], 6.0) == []


def test_ten_seconds_of_noise_stay_below_15_megabytes(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (720, 1280, 3), np.uint8)
    with FilmStrip(tmp_path, 300, 30.0) as film:
        for _ in range(3):
            film.add(noise)
    assert 300 * max(map(len, film.pictures)) < 12e6


def test_a_long_film_is_beside_the_page(
    tmp_path: Path,
    run: tuple[Pose, RadarMaps, Axes, dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(film_module, "MOST_FRAMES", 10)
    content = written(tmp_path, run, strip(tmp_path))
    assert content["film"]["pictures"] == []
    assert content["film"]["beside"] == "report.webm"
    beside = VideoReader(tmp_path / "report.webm")
    assert sum(frames.shape[0] for frames in beside.chunks(8)) == FRAMES
    assert beside.fps == pytest.approx(FPS)
    assert capfd.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.parametrize("beside", [False, True])
def test_a_browser_plays_it(
    tmp_path: Path,
    run: tuple[Pose, RadarMaps, Axes, dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    beside: bool,
) -> None:
    if beside:
        monkeypatch.setattr(film_module, "MOST_FRAMES", 10)
    written(tmp_path, run, strip(tmp_path), 120.0)
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 420, "height": 900})
        errors: list[str] = []
        requests: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text))
        page.on("request", lambda request: requests.append(request.url))
        page.goto((tmp_path / "report.html").as_uri())
        page.wait_for_selector("body[data-ready=yes]")
        assert page.title() == "tensorsim report"
        assert page.inner_text("#warnings li").startswith("</script>")
        assert page.evaluate("document.documentElement.scrollWidth") <= 420, "wider than a telephone"

        assert page.input_value("#range") == "120"
        assert page.evaluate(FAR_RADAR) == [[-1, 0, 0], [5.2, 2, 2.5]], "the radar is in view"
        dark = page.evaluate("document.querySelector('#maps canvas').toDataURL()")
        page.select_option("#colours", "gray")
        assert page.evaluate("document.querySelector('#maps canvas').toDataURL()") != dark
        before = page.evaluate("document.querySelector('#scene').toDataURL()")
        page.mouse.move(*centre(page, "#scene"))
        page.mouse.down()
        page.mouse.move(30, 500)
        assert page.evaluate("document.querySelector('#scene').toDataURL()") != before, "it turns"
        page.mouse.up()

        page.click("#play")
        for _ in range(100):  # the page's own policy forbids the library's waiting
            page.wait_for_timeout(50)
            if float(page.input_value("#time")) > 0.5:
                break
        page.click("#play")
        stopped = float(page.input_value("#time"))
        page.wait_for_timeout(300)
        shown_s = page.evaluate(FILM_TIME, FPS)
        assert shown_s == pytest.approx(stopped, abs=0.11), "the film is where the cursor is"
        assert errors == []
        assert all(url.startswith(("file:", "data:", "blob:")) for url in requests)


@pytest.mark.slow
def test_a_browser_plays_the_maps_without_the_film_beside(
    tmp_path: Path, run: tuple[Pose, RadarMaps, Axes, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(film_module, "MOST_FRAMES", 10)
    written(tmp_path, run, strip(tmp_path))
    (tmp_path / "report.webm").unlink()
    with chromium() as browser:
        page = browser.new_page()
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto((tmp_path / "report.html").as_uri())
        page.wait_for_selector("body[data-ready=yes]")
        page.click("#play")
        page.wait_for_timeout(300)
        assert page.inner_text("#film figcaption") == "Film (report.webm cannot be read beside this page)"
        assert float(page.input_value("#time")) > 0
        assert errors == []


@pytest.mark.slow
def test_a_browser_shows_a_tall_film_and_tidy_axes(
    tmp_path: Path, run: tuple[Pose, RadarMaps, Axes, dict[str, Any]]
) -> None:
    with FilmStrip(tmp_path, FRAMES, FPS) as film:
        for _ in range(FRAMES):
            film.add(np.full((640, 360, 3), 128, np.uint8))
    written(tmp_path, run, film)
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        page.goto((tmp_path / "report.html").as_uri())
        page.wait_for_selector("body[data-ready=yes]")
        assert page.locator("#film canvas").bounding_box()["height"] < 600, "the whole film is in the window"
        assert page.evaluate("fixed(-0.001, 2)") == "0.00"
        assert [text for _, text in page.evaluate("ticksBetween(-1, 1, 12)")][5] == "0.0"
        assert not page.evaluate(BETWEEN_MAP_AND_SPEEDS), "no tick that looks like a minus sign"


#: The box that a scene without people shows, whose antennas are far to the right.
FAR_RADAR = """() => {
  const nobody = { joints_cm: "", valid: "", count: 0 };
  const scene = new Scene3D(document.createElement("canvas"), nobody, { antennas_m: [[5, 0, 1.5], [5.2, 0, 2.5]] });
  return [scene.low, scene.high];
}"""
#: Whether anything is drawn left of the numbers of the speed axis, where the Doppler-time map has ended.
BETWEEN_MAP_AND_SPEEDS = """() => {
  const canvas = document.querySelector("canvas[data-map=doppler_time]");
  const { width, height } = canvas;
  const pixels = canvas.getContext("2d").getImageData(width - MARGIN.right - 6, 0, 6, height - MARGIN.bottom).data;
  return pixels.some((value) => value > 0);
}"""
#: Seconds that the shown picture is from: of the film beside, or by the grey of the pictures in the page.
FILM_TIME = """(fps) => {
  const video = document.querySelector("#film video");
  if (video) return video.currentTime;
  const canvas = document.querySelector("#film canvas");
  return (canvas.getContext("2d").getImageData(50, 50, 1, 1).data[0] / 5 + 0.5) / fps;
}"""


def centre(page: Any, selector: str) -> tuple[float, float]:
    page.locator(selector).scroll_into_view_if_needed()
    box = page.locator(selector).bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_the_axis_of_the_papers_map_promises_no_sign(run: tuple[Pose, RadarMaps, Axes, Any]) -> None:
    """The spectrum of real magnitudes is symmetric: approaching and receding look the same."""
    pose, _, axes, _ = run
    assert axes.doppler_label == "Doppler in Hz, positive = approaching"
    stage = ts.PoseToDoppler.from_config(ts.SimulationConfig.paper())
    of_paper = RadarMaps(*(field[0] for field in stage(pose.joints, pose.valid, FPS)))
    torch.testing.assert_close(of_paper.doppler_time, of_paper.doppler_time.roll(-1, 0).flip(0))
    assert axes_of(stage, of_paper).doppler_label == "Doppler in Hz, without its sign"
