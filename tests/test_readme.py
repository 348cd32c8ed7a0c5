"""What the README states works as written."""

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import tensorsim as ts
from tensorsim import cli
from tensorsim.model_files import manifest
from tests.bvh import write_bvh
from tests.film import STANDING
from tests.test_sources import coco_json

PROJECT = Path(__file__).parents[1]
README = (PROJECT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_python_without_files_runs() -> None:
    (block,) = (b for b in blocks("python") if "torch.randn" in b)
    done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, check=True)
    assert "torch.Size([4, 1024, " in done.stdout


def test_generated_motion_becomes_maps_and_film() -> None:
    (block,) = (b for b in blocks("python") if "PersonRenderer" in b)
    done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, check=True)
    assert "torch.Size([5, 3, 180, 320])" in done.stdout


def test_the_recipe_for_data_sets_cuts_nobody_off() -> None:
    (block,) = (b for b in blocks("python") if "range_gate_m" in b)
    names: dict[str, Any] = {}
    exec(block, names)
    joints, rcs = names["joints"], torch.tensor(ts.JOINT_RCS_M2)
    whole = ts.radar.RadarSimulator(names["radar"], engine="range-bins", snr_db=None).doppler_time(
        joints, rcs
    )
    # What 8 bins beside each path leave out, and the noise.
    assert float((names["doppler_time"] - whole).norm() / whole.norm()) < 0.02


def test_the_picture_is_small() -> None:
    pictures = re.findall(r"!\[.*\]\((.*)\)", README)
    assert pictures
    assert all((PROJECT / path).stat().st_size < 150_000 for path in pictures)


def test_recipes_of_the_shipped_files_are_commands() -> None:
    recipes = [line for entry in manifest() for line in entry["recipe"].split("; ")]
    assert len(recipes) >= 6
    for recipe in recipes:
        program, *words = shlex.split(recipe)
        assert program == "tensorsim"
        assert callable(cli.parse(words).run)


@pytest.mark.parametrize("card", sorted((PROJECT / "models").glob("*.md")), ids=lambda card: card.stem)
def test_commands_of_cards_are_commands(card: Path) -> None:
    text = card.read_text(encoding="utf-8").replace("\\\n", " ")
    commands = re.findall(r"^ {4}(tensorsim .*)$|`(tensorsim [^`]*--[^`]*)`", text, flags=re.MULTILINE)
    for command in (indented or within for indented, within in commands):
        assert callable(cli.parse(shlex.split(command)[1:]).run), command
    for name in re.findall(r"python -m (tests\.benchmarks\.\w+)", text):
        assert importlib.util.find_spec(name), name


@pytest.mark.slow
def test_commands_run_verbatim(tmp_path: Path, shared_data: Path) -> None:
    import cv2

    # Seven seconds, for the command that cuts out seconds 2 to 6.
    reader = cv2.VideoCapture(str(shared_data / "video" / "juggle_kick_1person_24fps.mp4"))
    writer = cv2.VideoWriter(str(tmp_path / "clip.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 24, (640, 360))
    for _ in range(7 * 24):
        writer.write(cv2.resize(reader.read()[1], (640, 360)))
    writer.release()
    walk = ts.motion.ActivityGenerator().generate("walking", duration_s=1.0).joints.numpy()
    write_bvh(tmp_path / "walk.bvh", walk[0], 30.0)
    np.savez(tmp_path / "capture.npz", first=walk[0], second=walk[0])
    standing = 300 * np.array(STANDING)[None, None] + np.linspace(100, 150, 30)[None, :, None, None]
    people = coco_json(standing, np.ones((1, 30, 17)), size=(480, 640))
    (tmp_path / "keypoints.json").write_text(json.dumps(people))
    ts.SimulationConfig.through_wall().to_yaml(tmp_path / "run.yaml")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = dict(os.environ, PATH=path)
    commands = [
        line.removeprefix("pip install . && ")
        for block in blocks("bash")
        for line in block.splitlines()
        if "tensorsim" in line
    ]
    assert len(commands) >= 5
    for command in commands:
        subprocess.run(command, shell=True, check=True, cwd=tmp_path, env=environment)
        for folder, files in (("out", 9), ("demo", 12)):
            if f"--out {folder}/" in command:
                assert len(list((tmp_path / folder).iterdir())) == files
                if folder == "out":  # a picture is made of the files in the other
                    shutil.rmtree(tmp_path / folder)
    assert (tmp_path / "notebooks" / "overview.png").is_file()


@pytest.mark.slow
def test_python_runs_as_one_session(tmp_path: Path, shared_data: Path) -> None:
    film = ts.data.read_video(shared_data / "video" / "juggle_kick_1person_24fps.mp4", end_s=0.5)
    small = torch.nn.functional.interpolate(film.video[0], (180, 320)).permute(0, 2, 3, 1)
    ts.data.write_video(tmp_path / "clip.mp4", small.numpy(), film.fps)
    for label in ("juggling", "kicking"):
        (tmp_path / "films" / label).mkdir(parents=True)
        for name in ("a", "b", "c"):
            shutil.copy(tmp_path / "clip.mp4", tmp_path / "films" / label / f"{name}.mp4")
    session = "\n".join(blocks("python"))
    session += "\nassert out.doppler_time.shape[0] == 1\nassert label(video, fps).logits.shape == (1, 12)\n"
    done = subprocess.run([sys.executable, "-c", session], stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    assert done.returncode == 0
    assert any(name in done.stdout for name in ts.ACTIVITIES)
    assert "('sit', 'walk')" in done.stdout
