"""The truth loop: clips are true, comparisons are fair, cells are kept, tables say what the cells say."""

import csv
import json
import math
import os
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from tensorsim.body.skeleton import coco_to_body, mid_hips
from tensorsim.config import ACTIVITIES, RadarConfig, SceneConfig
from tensorsim.errors import TensorsimError
from tensorsim.evaluation import films, report, settings, truth
from tensorsim.evaluation.clips import ActivityClip, activity_clips, captured_clips
from tensorsim.evaluation.films import CAMERA, FPS, HEIGHT, WIDTH, project, true_keypoints
from tensorsim.evaluation.scores import FIGURES, MAPS, Maps, compare, mean_maps
from tensorsim.evaluation.settings import STAGES, Pipelines, Setting, true_lifting
from tensorsim.radar.presets import PRESETS
from tensorsim.vision.lifting.metric_pose import MetricPose
from tests.film import RectangleDetector, StandingPose

SCENE = "through-wall"
#: Linear PSNR in dB of the Doppler-time map that every activity reaches, by lifter and source. The pool of nearest
#: matching has the poses of these people.
FLOORS_DB = {"temporal": {"a": 38.0, "b": 17.5}, "nearest": {"a": 38.0, "b": 20.0}}


@pytest.fixture(scope="module")
def pipelines() -> Pipelines:
    return Pipelines({SCENE: PRESETS[SCENE]})


def walk(seconds: float = 1.0, seed: int = 1003) -> ActivityClip:
    return ActivityClip("S8 Walking", "walk", seed, seconds)


# ---- clips -----------------------------------------------------------------------------------------------


def test_a_clip_is_the_same_motion_at_every_rate() -> None:
    clip = walk()
    coarse, fine = clip.joints(30.0), clip.joints(240.0)
    assert coarse.shape == (30, 14, 3)
    assert torch.allclose(coarse, fine[::8], atol=1e-9)
    assert 1.5 < clip.height_m < 1.95


def test_clips_of_a_row_and_of_rows_show_different_people() -> None:
    rows = activity_clips((), 3, 5)
    assert tuple(rows) == ACTIVITIES
    heights = {clip.height_m for clips in rows.values() for clip in clips}
    assert len(heights) == 36
    assert [clip.name for clip in rows["S8 Walking"]] == ["5", "6", "7"]
    assert not rows["S1 Empty"][0].present
    with pytest.raises(TensorsimError, match="perhaps 'walking'"):
        activity_clips(("wakling",), 1, 0)


def test_captured_motion_stands_on_the_floor_in_front_of_the_radar(tmp_path: Path) -> None:
    joints = walk(2.0).joints(60.0).float()
    joints[0] += 5.0  # a calibration pose is left out
    path = tmp_path / "capture.npz"
    np.savez(path, there=joints.numpy(), there_fps=60.0, brief=joints[:5].numpy(), brief_fps=60.0)
    (clip,) = captured_clips(path, 10)
    assert (clip.row, clip.name) == ("capture", "there")
    moved = clip.joints(60.0)
    assert moved.shape[0] == 119
    assert clip.duration_s == pytest.approx(119 / 60)
    assert float(moved[..., 2].min()) == pytest.approx(0.07, abs=0.01)
    y = mid_hips(moved)[:, 1]
    assert 1.5 - 1e-6 <= float(y.min()) <= float(y.max()) <= 7.0 + 1e-6
    torch.testing.assert_close(
        moved - moved[:1, :1], (joints[1:] - joints[1:2, :1]).double(), atol=1e-5, rtol=0
    )
    np.savez(path, brief=joints[:5].numpy(), brief_fps=60.0)
    with pytest.raises(TensorsimError, match="no motion of at least half a second"):
        captured_clips(path, 10)


# ---- films -----------------------------------------------------------------------------------------------


def test_true_keypoints_are_those_of_a_pinhole_behind_the_radar() -> None:
    clip = walk()
    observed = true_keypoints(clip)
    joints = clip.joints(FPS)
    focal = WIDTH / 2 / math.tan(math.pi / 6)
    x, y, z = joints[:, 4].unbind(-1)  # right wrist, which COCO has as number 10
    away = y - CAMERA.position_m[1]
    u = (WIDTH - 1) / 2 + focal * x / away
    v = (HEIGHT - 1) / 2 - focal * (z - CAMERA.position_m[2]) / away
    torch.testing.assert_close(observed.keypoints[0, :, 10], torch.stack([u, v], -1).float())
    assert bool((observed.scores == 1).all())


def test_keypoints_out_of_the_picture_are_not_seen() -> None:
    joints = walk().joints(FPS)
    pixels, inside, _ = project(joints + torch.tensor([0.0, -joints[..., 1].min() - 1.0, 0.0]))
    out = (pixels[..., 1] < -0.5) | (pixels[..., 1] > HEIGHT - 0.5)
    assert bool(out.any())
    assert not bool((inside & out).any())


def test_everybody_is_in_the_picture() -> None:
    for clips in activity_clips((), 2, 3000).values():
        for clip in clips:
            assert not clip.present or float(true_keypoints(clip).scores.mean()) > 0.9, clip


# ---- settings --------------------------------------------------------------------------------------------


def test_true_lifting_places_joints_exactly() -> None:
    clip = walk()
    observed = true_keypoints(clip)
    keypoints, scores = coco_to_body(observed.keypoints[None], observed.scores[None])
    lifted = true_lifting(clip)
    lifted = type(lifted)(*(field[None] for field in lifted))
    stage = MetricPose(CAMERA, (clip.height_m,), range_smoothing_s=1e-3)
    joints, _ = stage(keypoints, scores, lifted, observed.valid[None], HEIGHT, WIDTH, FPS)
    error = joints[0, 0].double() - clip.joints(FPS)
    # The floor is taken from the lower ankle; along the line of sight little is left to guess: feet that stand roll.
    assert float(error[..., 1].abs().max()) < 8e-3


@pytest.mark.parametrize("near", [0.06, 1e-4])
def test_exact_keypoints_stay_where_the_lifter_doubts_them(
    near: float, pipelines: Pipelines, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipelines.lifters[False], "near", near)
    kick = ActivityClip("S3 Kicking", "0", 2)
    errors = truth.pose_errors(*pipelines.joints(Setting("b"), kick, None), kick)
    assert errors["root"] < 0.02
    assert errors["joints"] < 0.01


@pytest.mark.parametrize("stage", STAGES[2:])
def test_a_true_stage_leaves_its_error_out(stage: str, pipelines: Pipelines) -> None:
    clip = walk()
    truth_joints = clip.joints(FPS)

    def error(setting: Setting) -> Tensor:
        return (pipelines.joints(setting, clip, None)[0][0] - truth_joints).float()

    usual, better = error(Setting("b")), error(Setting("b", true_stage=stage))
    if stage == "lifting":
        local = [e - mid_hips(e)[:, None] for e in (usual, better)]
        # The usual lifter, from exact keypoints and with bones of their lengths, is 2 mm off.
        assert float(local[1].square().mean()) < 0.4 * float(local[0].square().mean())
    elif stage == "position":
        assert float(mid_hips(better).abs().max()) < 0.1 * float(mid_hips(usual).abs().max())
    elif stage == "smoothing":
        assert not torch.equal(usual, better)
    else:
        assert torch.equal(usual, better)  # it comes after the joints


def test_true_interpolation_of_true_joints_is_the_truth(pipelines: Pipelines) -> None:
    clip = walk()
    wanted = pipelines.truth(SCENE, clip)
    joints, valid = pipelines.joints(Setting("a"), clip, None)
    usual = pipelines.maps(Setting("a"), SCENE, clip, joints, valid)
    exact = pipelines.maps(Setting("a", true_stage="interpolation"), SCENE, clip, joints, valid)
    for name in MAPS:
        torch.testing.assert_close(getattr(exact, name), getattr(wanted, name), rtol=1e-4, atol=1e-12)
    assert not torch.allclose(usual.doppler_time, wanted.doppler_time, rtol=1e-4)


def test_nobody_gives_maps_without_an_echo(pipelines: Pipelines) -> None:
    clip = ActivityClip("S1 Empty", "0", 0, 1.0)
    wanted = pipelines.truth(SCENE, clip)
    for source in "ab":
        joints, valid = pipelines.joints(Setting(source), clip, None)
        maps = pipelines.maps(Setting(source), SCENE, clip, joints, valid)
        assert joints.shape[0] == 0
        for name in MAPS:
            assert getattr(maps, name).shape == getattr(wanted, name).shape
            assert not bool(getattr(maps, name).any())


def test_the_film_is_watched_by_the_networks_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(films, "HEIGHT", 45)
    monkeypatch.setattr(films, "WIDTH", 80)
    clip = walk(0.2)
    path = tmp_path / "films" / "one.npz"
    first = films.filmed(path, clip, RectangleDetector(), StandingPose())
    assert first.boxed.keypoints.shape == (1, 6, 17, 2)
    assert first.found.valid.shape[1] == 6
    again = films.filmed(path, clip, torch.nn.Identity(), torch.nn.Identity())  # read, not watched
    for a, b in zip(first, again, strict=True):
        for x, y in zip(a, b, strict=True):
            assert torch.equal(x, y)
    assert [p.name for p in path.parent.iterdir()] == ["one.npz"]


# ---- scores ----------------------------------------------------------------------------------------------


def maps_of(seed: int) -> Maps:
    g = torch.Generator().manual_seed(seed)
    return Maps(*(torch.rand(20, 30, generator=g) for _ in MAPS))


def test_scores_are_those_of_maps_scaled_by_their_peaks() -> None:
    a, b = maps_of(0), maps_of(1)
    speed = torch.linspace(-2, 2, 20)
    found = compare(a, b, speed)
    for name in MAPS:
        x, y = (getattr(m, name).double().numpy() for m in (a, b))
        x, y = x / x.max(), y / y.max()
        mse = np.square(x - y).mean()
        assert found[name]["psnr"] == pytest.approx(-10 * math.log10(mse), abs=1e-3)
        assert found[name]["nmse"] == pytest.approx(mse / np.square(y).mean(), rel=1e-4)
        xd, yd = (np.maximum(20 * np.log10(m), -40) / 40 + 1 for m in (x, y))
        assert found[name]["psnr_db"] == pytest.approx(-10 * math.log10(np.square(xd - yd).mean()), abs=1e-3)
    louder = Maps(*(3 * getattr(a, name) for name in MAPS))
    assert compare(louder, a, speed)["doppler_time"]["psnr"] > 100
    shifted = Maps(*(getattr(a, name).roll(1, -1) for name in MAPS))
    assert compare(shifted, a, speed)["doppler_time"]["psnr"] < 15


def test_equal_maps_and_maps_of_nothing() -> None:
    a = maps_of(0)
    nothing = compare(a.empty(), a.empty(), torch.linspace(-2, 2, 20))["doppler_time"]
    assert nothing["psnr"] == math.inf
    assert nothing["nmse"] == 0
    assert math.isnan(nothing["envelope_m_s"])
    assert compare(a.empty(), a, torch.linspace(-2, 2, 20))["range_time"]["nmse"] == pytest.approx(1)


def test_guesses_fit_the_clip_they_are_compared_with() -> None:
    a, b = maps_of(0), maps_of(1)
    shorter = Maps(*(getattr(b, name)[:, :20] for name in MAPS))
    assert torch.equal(b.like(shorter).range_time, shorter.range_time)
    longer = shorter.like(b).range_time
    assert longer.shape == (20, 30)
    assert not bool(longer[:, 20:].any())
    mean = mean_maps([a, b]).doppler_time
    expected = (a.doppler_time / a.doppler_time.max() + b.doppler_time / b.doppler_time.max()) / 2
    torch.testing.assert_close(mean, expected)


# ---- the loop --------------------------------------------------------------------------------------------


def test_errors_of_joints_are_those_of_the_frames_in_which_somebody_is_followed() -> None:
    clip = walk()
    found = clip.joints(FPS)[None].clone()
    found[0, :20, :, 0] += 0.1
    found[0, 20:] += 5.0  # what the smoother makes of frames without a person
    valid = torch.ones(1, 30, dtype=torch.bool)
    valid[0, 20:] = False
    errors = truth.pose_errors(found, valid, clip)
    assert errors["followed"] == pytest.approx(2 / 3)
    assert errors["root"] == pytest.approx(0.1)
    assert errors["joints"] == pytest.approx(0.0, abs=1e-9)
    nobody = truth.pose_errors(found[:0], valid[:0], clip)
    assert nobody == truth.pose_errors(found, valid & False, clip) | {"people": 0.0}
    assert nobody == {"people": 0.0, "followed": 0.0}
    empty = ActivityClip("S1 Empty", "0", 0, 1.0)
    assert truth.pose_errors(found, valid, empty) == {"people": 1.0}


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[truth.TruthLoop, list[dict[str, object]]]:
    out = tmp_path_factory.mktemp("loop")
    loop = truth.TruthLoop(out, clips=2, activities=("grabbing", "empty"), scenes=(SCENE,), seed=2000)
    return loop, loop.run(quiet=True)


def test_every_cell_is_there_and_is_made_once(
    done: tuple[truth.TruthLoop, list[dict[str, object]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, cells = done
    names = [s.name for s in loop.settings()]
    assert names == ["a", "b", "a-paper", "b-paper", *(f"b+{stage}" for stage in STAGES[2:])]
    assert len(cells) == 2 * 2 * (len(names) + 3)
    monkeypatch.setattr(truth, "Pipelines", None)  # nothing is left to do
    assert loop.run(quiet=True) == cells


def test_an_interrupted_loop_goes_on(done: tuple[truth.TruthLoop, list[dict[str, object]]]) -> None:
    loop, cells = done
    clip = loop.rows()["S4 Grabbing"][1]
    for name in ("b", "shuffled"):
        loop.cell("S4 Grabbing", clip, name).unlink()
    assert len(loop.read_cells()) == len(cells) - 2
    assert loop.run(quiet=True) == cells


def test_true_joints_beat_keypoints_and_guesses(
    done: tuple[truth.TruthLoop, list[dict[str, object]]],
) -> None:
    def psnr(setting: str) -> float:
        chosen = [c for c in done[1] if c["setting"] == setting and c["row"] == "S4 Grabbing"]
        return report.figure_of(chosen, SCENE, "doppler_time", "psnr")

    assert psnr("a") > 35
    assert psnr("a") > psnr("b") + 6
    assert psnr("a") > psnr("a-paper") + 6
    assert psnr("b+lifting") > psnr("b") + 1
    for guess in truth.GUESSES:
        assert psnr("a") > psnr(guess) + 6
    empty = [c for c in done[1] if c["row"] == "S1 Empty"]
    assert report.figure_of(empty, SCENE, "doppler_time", "psnr") == math.inf


def test_tables_say_what_the_cells_say(
    done: tuple[truth.TruthLoop, list[dict[str, object]]], tmp_path: Path
) -> None:
    _, cells = done
    report.write_csv(tmp_path / "truth.csv", cells)
    with (tmp_path / "truth.csv").open() as file:
        lines = list(csv.DictReader(file))
    chosen = [x for x in lines if (x["row"], x["setting"], x["map"]) == ("S4 Grabbing", "a", "doppler_time")]
    mean = sum(float(x["psnr"]) for x in chosen) / 2
    text = report.markdown(cells)
    table = text[text.index(f"## DTM, {SCENE}") :].splitlines()
    heads = [cell.strip() for cell in table[2].strip("|").split("|")]
    row = next(line for line in table if line.startswith("| S4 Grabbing"))
    values = [cell.strip() for cell in row.strip("|").split("|")]
    assert heads[1:3] == ["a", "b"]
    assert values[1] == f"{mean:.1f}"
    assert next(line for line in table if line.startswith("| S1 Empty")).count("equal") == 7
    means = next(line for line in table if line.startswith("| **mean**"))
    assert means.split("|")[2].strip() == f"{mean:.1f}"  # the empty row is not part of it
    assert "## b with one stage replaced by the truth" in text


def test_tables_count_what_is_left_out_and_leave_empty_scenes_out_for_everybody(tmp_path: Path) -> None:
    """A person found in an empty room does not raise the mean of a setting above that of a correct one."""

    def cell(row: str, clip: str, setting: str, psnr: float | None, people: float) -> dict[str, object]:
        figures = dict.fromkeys(FIGURES, 1.0) | {"psnr": psnr}
        scores = {} if psnr is None else {SCENE: dict.fromkeys(MAPS, figures)}
        return {"row": row, "clip": clip, "setting": setting, "scores": scores, "pose": {"people": people}}

    cells = [
        cell("S1 Empty", "0", "a", math.inf, 0.0),
        cell("S1 Empty", "0", "b", 60.0, 1.0),
        cell("S1 Empty", "1", "b", math.inf, 0.0),
        cell("S8 Walking", "0", "a", 20.0, 1.0),
        cell("S8 Walking", "0", "b", 20.0, 1.0),
        cell("S8 Walking", "1", "b", None, 1.0),
    ]
    text = report.markdown(cells)
    assert "| S1 Empty | equal | 60.0 |" in text
    assert "| **mean** | 20.0 | 20.0 |" in text
    assert "## People found per clip of S1 Empty" in text
    assert "| people | 0.00 | 0.50 |" in text
    report.write_csv(tmp_path / "truth.csv", cells)
    with (tmp_path / "truth.csv").open() as file:
        assert [line["people"] for line in csv.DictReader(file) if line["map"] == "range_time"] == [
            "0.0", "1.0", "0.0", "1.0", "1.0",
        ]  # fmt: skip
    assert f"Clips left out, whose motion the radar cannot follow: b, {SCENE}: 1 of 4." in text


def test_the_picture_shows_truth_and_guess_side_by_side(
    done: tuple[truth.TruthLoop, list[dict[str, object]]], tmp_path: Path
) -> None:
    import cv2

    loop = done[0]
    pipelines = Pipelines({SCENE: PRESETS[SCENE]})
    pictures = truth.example_maps(loop, pipelines, SCENE)
    assert [name for name, _ in pictures["S4 Grabbing"]] == ["truth", "a", "b"]
    report.save_pictures(tmp_path / "maps.png", pictures, pipelines.speed_m_s(SCENE))
    picture = cv2.imread(str(tmp_path / "maps.png"))
    assert picture is not None
    assert picture.std() > 10


def test_bad_requests_are_refused(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    def walks(folder: str) -> Path:
        path = tmp_path_factory.mktemp(folder) / "walk.npz"
        np.savez(path, joints_m=walk().joints(30.0).numpy(), fps=30.0)
        return path

    for options, message in (
        ({"scenes": ("cave",)}, "scene: got 'cave'"),
        ({"sources": ("d",)}, "setting: got 'd'"),
        ({"sources": ("c",)}, "setting c: got no networks"),
        ({"clips": 0}, "clips: got 0"),
        ({"scenes": ()}, "scenes: got 0"),
        ({"motions": (walks("a"), walks("b"))}, "after another walk, expected files with different names"),
    ):
        with pytest.raises(TensorsimError, match=message):
            truth.TruthLoop(tmp_path, **options).run(quiet=True)
    assert not list(tmp_path.iterdir())


def test_motion_that_a_radar_cannot_follow_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = SceneConfig(RadarConfig.through_wall(prf_hz=16.0))
    monkeypatch.setitem(PRESETS, SCENE, slow)
    loop = truth.TruthLoop(tmp_path, 1, ("walking",), scenes=(SCENE,), sources=("a",), stages=False)
    with pytest.warns(UserWarning, match="S8 Walking 0, through-wall: left out"):
        cells = loop.run(quiet=True)
    assert all(cell["scores"].get(SCENE, {}) == {} for cell in cells)


def test_the_command_writes_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tensorsim.commands.evaluate_truth import EvaluateTruth

    out = tmp_path / "out"
    EvaluateTruth(
        out, 1, ("standing up",), scenes=("through-wall",), settings=("a",), stages=False, quiet=True
    ).run()
    assert {p.name for p in out.iterdir()} == {"cells", "truth.md", "truth.csv", f"doppler_time_{SCENE}.png"}
    assert (out / "truth.md").read_text() in capsys.readouterr().out
    cells = [json.loads(path.read_text()) for path in (out / "cells").glob("*/*.json")]
    (cell,) = (c for c in cells if c["setting"] == "a")
    assert cell["scores"][SCENE]["doppler_time"]["psnr"] > 35


def test_names_of_settings_are_those_of_the_tables() -> None:
    assert Setting("b", paper=True).name == "b-paper"
    assert Setting("c", true_stage="pose").name == "c+pose"
    assert settings.SOURCES.keys() == {"a", "b", "c"}


def test_files_of_cells_and_films_tell_networks_and_frame_rates_apart(tmp_path: Path) -> None:
    def best(folder: str) -> Path:
        (tmp_path / folder).mkdir(exist_ok=True)
        path = tmp_path / folder / "best.safetensors"
        path.write_bytes(b"")
        return path

    def loop(**options: object) -> truth.TruthLoop:
        networks = {"detector": best("a"), "pose": best("b")}
        return truth.TruthLoop(tmp_path, **(networks | options))  # type: ignore[arg-type]

    one, other = loop(), loop(pose=best("c"))
    clip = walk()
    assert one.film(clip) == one.film(clip) != other.film(clip)
    assert one.cell("row", clip, "c") != other.cell("row", clip, "c")
    assert one.cell("row", clip, "b") == other.cell("row", clip, "b")
    before = one.film(clip)
    os.utime(best("b"), (0, 0))
    assert one.film(clip) != before, "the network was trained further"
    assert one.cell("row", clip, "mean") != loop(seed=3).cell("row", clip, "mean"), "of other clips"
    np.savez(tmp_path / "walk.npz", joints_m=clip.joints(30.0).numpy(), fps=30.0)
    captured = captured_clips(tmp_path / "walk.npz", 1)
    captured += captured_clips(tmp_path / "walk.npz", 1, fps=20.0)
    np.savez(tmp_path / "walk.npz", joints_m=clip.joints(30.0).numpy() + 0.1, fps=30.0)
    captured += captured_clips(tmp_path / "walk.npz", 1)
    assert len({one.cell("walk", each, "a") for each in captured}) == 3
    assert len({one.film(each) for each in captured}) == 3


def test_cells_of_other_lifter_weights_are_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loop, clip = truth.TruthLoop(tmp_path), walk()
    before = loop.cell("row", clip, "b")
    files = settings.lifting_files()
    assert "pose_library_small" in files
    for name in files:
        monkeypatch.setattr(truth, "lifting_files", lambda name=name: files | {name: "0"})
        assert loop.cell("row", clip, "b") != before


def test_cells_of_another_version_are_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loop, clip = truth.TruthLoop(tmp_path), walk()
    before = [loop.cell("row", clip, name) for name in ("b", "mean")]
    monkeypatch.setattr("tensorsim.config.documents.version", lambda _: "99.0")
    assert not {loop.cell("row", clip, name) for name in ("b", "mean")} & set(before)


def test_films_of_another_version_are_watched_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loop, clip = truth.TruthLoop(tmp_path), walk()
    before = loop.film(clip)
    monkeypatch.setattr("tensorsim.config.documents.version", lambda _: "99.0")
    assert loop.film(clip) != before


def test_a_scene_that_no_row_can_be_shown_in_has_no_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from tensorsim.commands.evaluate_truth import EvaluateTruth

    monkeypatch.setitem(PRESETS, SCENE, SceneConfig(RadarConfig.through_wall(prf_hz=16.0)))
    EvaluateTruth(
        tmp_path / "out", 1, ("walking",), scenes=("through-wall",), settings=("a",), stages=False, quiet=True
    ).run()
    assert "left out" in capsys.readouterr().err
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"cells", "truth.md", "truth.csv"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"detector": "x.onnx"}, "apply to --settings c only"),
        ({"motion_fps": 30.0}, "--motion-fps needs --motion"),
        ({"seed": -1}, "--seed: got -1"),
    ],
)
def test_the_command_refuses_options_without_effect(
    options: dict[str, object], message: str, tmp_path: Path
) -> None:
    from tensorsim.commands.evaluate_truth import EvaluateTruth

    with pytest.raises(TensorsimError, match=message):
        EvaluateTruth(tmp_path / "out", **options).run()  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_guess_that_a_radar_cannot_follow_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = Pipelines.maps

    def too_fast(self: Pipelines, setting: Setting, *rest: object) -> Maps:
        if setting.source == "b" and not setting.paper:
            raise TensorsimError("a scene moving at 20 m/s")
        return maps(self, setting, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Pipelines, "maps", too_fast)
    loop = truth.TruthLoop(tmp_path, 1, ("grabbing",), scenes=(SCENE,), stages=False)
    with pytest.warns(UserWarning, match="S4 Grabbing 0, through-wall, b: left out, a scene moving"):
        cells = loop.run(quiet=True)
    scored = {cell["setting"] for cell in cells if cell["scores"].get(SCENE)}
    assert scored == {"a", "a-paper", "b-paper", "empty"}
    assert truth.example_maps(loop, Pipelines({SCENE: PRESETS[SCENE]}), SCENE) == {}


@pytest.mark.slow
@pytest.mark.parametrize("lifter", ["temporal", "nearest"])
@pytest.mark.parametrize(
    "activity", ["S2 Punching", "S5 Sitting Down", "S8 Walking", "S12 Walking to Falling"]
)
def test_an_activity_by_itself_has_a_floor(
    activity: str, lifter: Literal["temporal", "nearest"], tmp_path: Path
) -> None:
    """From true joints and from true keypoints, each activity by itself: a mean hides one that is lost."""
    loop = truth.TruthLoop(
        tmp_path, clips=1, activities=(activity,), scenes=(SCENE,), stages=False, seed=3000, lifter=lifter
    )
    cells = loop.run(quiet=True)
    for setting, least in FLOORS_DB[lifter].items():
        chosen = [c for c in cells if c["setting"] == setting]
        assert report.figure_of(chosen, SCENE, "doppler_time", "psnr") > least, setting


def test_another_lifter_has_cells_of_its_own(tmp_path: Path) -> None:
    loops = [
        truth.TruthLoop(tmp_path, clips=1, activities=("S8 Walking",), lifter=name)
        for name in (None, "nearest")
    ]
    clip = loops[0].rows()["S8 Walking"][0]
    assert loops[0].cell("S8 Walking", clip, "b") != loops[1].cell("S8 Walking", clip, "b")
    kinds = [type(loop.pipelines().lifters[False]).__name__ for loop in loops]
    assert kinds == ["TemporalLifter", "NearestPoseLifter"]
    assert type(loops[0].pipelines().lifters[True]).__name__ == "NearestPoseLifter"  # the paper's
