"""Films as a source: people are found once, damaged films are named with the reason, the others arrive."""

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from tensorsim import registry
from tensorsim.config import SimulationConfig
from tensorsim.data.sets.build import build_dataset
from tensorsim.data.sets.manifest import rows_of
from tensorsim.data.sets.people import PeopleFinder
from tensorsim.data.sets.recipe import DatasetRecipe, SourceConfig, SplitConfig
from tensorsim.data.sets.rendered import CAMERA
from tensorsim.data.sets.variations import VariationConfig
from tensorsim.data.video import VideoReader
from tensorsim.errors import TensorsimError
from tensorsim.motion import ActivityGenerator, PeopleConfig
from tensorsim.pipeline import VideoToPose
from tensorsim.render.renderer import PersonRenderer
from tensorsim.streaming import people_of_film
from tests.data.sets.recipes import small_recipe
from tests.film import RectangleDetector, StandingPose, film, walker

FPS = 10.0


def write_film(path: Path, frames: np.ndarray) -> None:
    """A losslessly written film of frames (T, H, W, 3)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    size = (frames.shape[2], frames.shape[1])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), FPS, size)
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


def damage(folder: Path, good: Path, name: str = "") -> list[Path]:
    """Write ten films that cannot be used, each for a different reason."""
    whole = good.read_bytes()
    contents = {
        "empty.avi": b"",
        "cut.avi": whole[:600],
        "header.avi": whole[:40],
        "text.mp4": b"no film at all\n",
        "zeros.mp4": bytes(5000),
        "noise.mkv": np.random.default_rng(0).bytes(5000),
        "picture.mp4": cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes(),
        "html.webm": b"<html>404 Not Found</html>",
    }
    for suffix, content in contents.items():
        (folder / f"{name}{suffix}").write_bytes(content)
    write_film(folder / f"{name}one_frame.avi", good_film(1.0)[:1])
    write_film(folder / f"{name}nobody.avi", np.zeros((5, 120, 160, 3), np.uint8))
    return [folder / f"{name}{suffix}" for suffix in (*contents, "one_frame.avi", "nobody.avi")]


def good_film(speed: float) -> np.ndarray:
    return film(*walker(11, FPS, 4.0, speed, 0.3)).permute(0, 2, 3, 1).numpy()


@pytest.fixture
def films(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A good film of each of two classes and ten damaged ones, each damaged in a different way."""
    folder = tmp_path / "films"
    for label, speed in (("leave", 1.2), ("come", -1.0)):
        write_film(folder / label / "good.avi", good_film(speed))
    damage(folder / "leave", folder / "leave" / "good.avi")
    stage = VideoToPose.from_config(SimulationConfig(), RectangleDetector(), StandingPose())
    monkeypatch.setattr(PeopleFinder, "networks", stage)
    return folder


def films_recipe(folder: Path, **changes: object) -> DatasetRecipe:
    return small_recipe(
        sources=(SourceConfig("films", str(folder)),),
        split=SplitConfig(shares=(1.0, 0.0, 0.0)),
        **changes,
    )


def test_good_films_arrive_bad_ones_are_named_and_people_are_found_once(
    films: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    found = PeopleFinder._found

    def counted(self: PeopleFinder, file: Path) -> object:
        asked.append(file.name)
        return found(self, file)

    monkeypatch.setattr(PeopleFinder, "_found", counted)
    cache = tmp_path / "people"
    assert build_dataset(films_recipe(films), tmp_path / "a", cache=cache, quiet=True) == (2, 10, 2)
    assert len(asked) == 12
    rows = list(rows_of(tmp_path / "a"))
    assert {row["clip"]: row["label"] for row in rows} == {"leave/good.avi": "leave", "come/good.avi": "come"}
    with (tmp_path / "a" / "failures.csv").open(newline="") as file:
        failures = list(csv.DictReader(file))
    bad = {str(path.relative_to(films)) for path in films.rglob("*.*") if path.name != "good.avi"}
    assert {row["clip"] for row in failures} == bad
    assert all(row["path"] in row["reason"] for row in failures)

    # Neither the place of the films nor another data set needs the networks again.
    moved = films.rename(tmp_path / "elsewhere")
    asked.clear()
    build_dataset(films_recipe(moved), tmp_path / "b", cache=cache, quiet=True)
    assert asked == []
    assert [row["sha256"] for row in rows_of(tmp_path / "b")] == [row["sha256"] for row in rows]
    assert str(moved) in (tmp_path / "b" / "failures.csv").read_text()


def test_films_that_failed_are_searched_again_when_asked(
    films: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, trouble = [], [True]
    found = PeopleFinder._found

    def sometimes(self: PeopleFinder, file: Path) -> object:
        asked.append(file.name)
        if trouble and file.parent.name == "come":
            raise TensorsimError("the disk was away")
        return found(self, file)

    monkeypatch.setattr(PeopleFinder, "_found", sometimes)
    for file in films.glob("leave/*.*"):
        if file.name not in ("good.avi", "text.mp4"):
            file.unlink()
    recipe, out = films_recipe(films, variations=VariationConfig(count=2)), tmp_path / "set"
    assert build_dataset(recipe, out, quiet=True) == (2, 2, 2)
    trouble.clear()
    assert build_dataset(recipe, out, quiet=True) == (2, 2, 0)
    assert len(asked) == 3
    assert build_dataset(recipe, out, quiet=True, retry=True).samples == 4
    assert sorted(asked[3:]) == ["good.avi", "text.mp4"]  # once each, not for every sample
    with pytest.raises(TensorsimError, match=r"text\.mp4"):
        build_dataset(recipe, out, quiet=True, strict=True)
    assert asked[5:] == ["text.mp4"]


@pytest.mark.parametrize("library", [cv2, torch])
def test_other_versions_of_what_reads_films_and_runs_networks_find_people_anew(
    library: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    finder = PeopleFinder(SourceConfig("films", "films"), None)
    known = finder.of_networks
    monkeypatch.setattr(library, "__version__", "99.0")
    del finder.of_networks
    assert finder.of_networks != known


def test_strict_stops_at_the_first(films: Path, tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="films/leave/"):
        build_dataset(films_recipe(films), tmp_path / "set", strict=True, quiet=True)
    assert not (tmp_path / "set" / "manifest.csv").exists()


def test_joints_are_those_of_the_pipeline(films: Path) -> None:
    path = films / "leave" / "good.avi"
    motion = PeopleFinder(SourceConfig("films", str(films)), None).motion(str(path), "")
    reader = VideoReader(path)
    pose = people_of_film(
        PeopleFinder.networks,  # type: ignore[arg-type]
        reader, torch.device("cpu"), quiet=True, calibrate=True,
    ).pose  # fmt: skip
    there = pose.valid[0]
    assert motion.fps == FPS
    assert torch.allclose(motion.joints[there], pose.joints[0][there], atol=1e-5)
    assert bool(torch.isfinite(motion.joints).all())


def test_what_is_kept_is_of_the_lifter_too_and_no_fault_of_weights_that_are_missing(
    films: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, located = films / "leave" / "good.avi", registry.locate

    def finder() -> PeopleFinder:
        return PeopleFinder(SourceConfig("films", str(films)), tmp_path / "people")

    def without_lifter(source: None, *kinds: str) -> Path:
        if "TemporalLifter" in kinds:
            raise TensorsimError("weights: no such file")
        return located(source, *kinds)

    def other_lifter(source: None, *kinds: str) -> Path:
        return located(source, "SPGNet") if "TemporalLifter" in kinds else located(source, *kinds)

    known = finder().of_networks
    monkeypatch.setattr(registry, "locate", other_lifter)
    assert finder().of_networks != known
    monkeypatch.setattr(registry, "locate", without_lifter)
    with pytest.raises(TensorsimError, match="weights: no such file"):
        finder().motion(str(path), "")
    assert not list(tmp_path.glob("people/*"))


@pytest.mark.parametrize("stated", [True, False])
def test_frame_rates_of_a_source_serve_motion_that_tells_none(tmp_path: Path, stated: bool) -> None:
    joints = ActivityGenerator().generate("walking", seed=0, duration_s=0.5, rate_hz=120.0).joints
    np.savez(tmp_path / "walk.npz", joints_m=joints.numpy(), **({"fps": 120.0} if stated else {}))
    source = SourceConfig("motion", str(tmp_path), fps=30.0)
    motion = PeopleFinder(source, None).motion(str(tmp_path / "walk.npz"), "")
    assert motion.fps == (120.0 if stated else 30.0)


@pytest.mark.slow
def test_of_two_hundred_films_all_good_ones_arrive_and_all_bad_ones_are_listed(tmp_path: Path) -> None:
    """Very short films, so that the shipped networks, reader and files can be used."""
    folder = tmp_path / "films"
    generator = ActivityGenerator(PeopleConfig(start_range_m=(2.5, 2.5)))
    for number, label in enumerate(("walking", "sitting down")):
        joints = generator.generate(label, seed=number, duration_s=0.4, rate_hz=FPS).joints.float()
        frames = PersonRenderer(CAMERA)(joints, seed=number).frames.permute(0, 2, 3, 1).numpy()
        for k in range(90):
            frames[:, :4, :4] = k  # a film of its own
            write_film(folder / label / f"{k:03d}.avi", frames)
        damage(folder / label, folder / label / "000.avi")
    bad = {str(path.relative_to(folder)) for path in folder.rglob("*.*") if not path.stem.isdigit()}
    assert (len(list(folder.rglob("*.*"))), len(bad)) == (200, 20)
    assert build_dataset(films_recipe(folder), tmp_path / "set", quiet=True) == (180, 20, 180)
    with (tmp_path / "set" / "failures.csv").open(newline="") as file:
        assert {row["clip"] for row in csv.DictReader(file)} == bad
    assert len({row["sha256"] for row in rows_of(tmp_path / "set")}) == 180
