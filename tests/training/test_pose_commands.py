"""The commands that train and judge the pose network, on made-up shards."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tensorsim.commands.evaluate_pose import EvaluatePose
from tensorsim.commands.train_pose import TrainPose
from tensorsim.errors import TensorsimError
from tensorsim.training.pose import PoseRecipe, held_out_people, read_people
from tensorsim.vision.pose2d.hrnet import HRNet, HRNetConfig
from tests.training.tars import write_tar
from tests.training.test_pose_data import BOX, standing, write_cutouts
from tests.training.test_shards import jpg, label
from tests.vision.pose2d.test_onnx_heatmaps import WEIGHT, write_network


@pytest.fixture
def data(tmp_path: Path) -> Path:
    left, top, right, bottom = BOX.tolist()
    person = {"bbox": [left, top, right - left, bottom - top], "keypoints": standing().tolist()}
    pictures = {f"im{n}.jpg": jpg(n, 280, 200) for n in range(40)}
    labels = {f"im{n}.json": label([person]) for n in range(40)}
    for name in ("coco_small-00", "coco_more-00", "coco_extra-00", "films_teacher-00", "lspet-00"):
        write_tar(tmp_path / f"{name}.tar", pictures | labels)
    write_tar(tmp_path / "backgrounds-00.tar", {"place.jpg": jpg(0, 80, 60)})
    write_cutouts(tmp_path / "cutouts-000.tar")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("network", ["hrnet", "cpm"])
def test_train_then_evaluate(network: str, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = data / "out"
    options = {"cutouts": data, "rendered": 13, "size": (64, 64), "first_size": (32, 32), "width": 4}
    options["network"] = network
    TrainPose(data, out=out, steps=2, first_steps=1, batch=2, workers=0, quiet=True, **options).run()  # type: ignore[arg-type]
    weights = out / "best.safetensors"
    assert str(weights) in capsys.readouterr().out

    EvaluatePose(weights, data=data).run()
    printed = capsys.readouterr()
    assert "cut: 100%" in printed.err, "a progress bar"
    rows = printed.out.splitlines()
    held_out = {name: len(persons) for name, persons in held_out_people(data).items()}
    assert min(held_out.values()) > 0
    assert len(rows) == 1 + len(held_out)
    for row, (name, count) in zip(rows[1:], held_out.items(), strict=True):
        assert row.startswith(f"{name}, held out   ")
        assert int(row.split()[-7]) == count
        assert all(0 <= float(figure) <= 1 for figure in row.split()[-6:])
    EvaluatePose(weights, data=data, engine="onnxruntime").run()
    for row, other in zip(rows[1:], capsys.readouterr().out.splitlines()[1:], strict=True):
        figures = ([float(figure) for figure in line.split()[-6:]] for line in (row, other))
        assert next(figures) == pytest.approx(next(figures), abs=0.0011)
    # Training continues from those weights.
    more = TrainPose(
        data,
        out=data / "more",
        steps=1,
        first_steps=0,
        batch=2,
        workers=0,
        quiet=True,
        init=weights,
        augmentation="mild",
        **options,
    )  # type: ignore[arg-type]
    more.run()
    assert (data / "more" / "best.safetensors").is_file()
    if network == "hrnet":
        head = TrainPose(
            data, out=data / "head", steps=1, batch=2, workers=0, quiet=True, init=weights, presence=True
        )
        head.run()
        gated = HRNet.from_pretrained(data / "head" / "best.safetensors")
        assert gated.config.presence == 128
        # Such a network can be trained further as well.
        again = replace(more, init=data / "head" / "best.safetensors", out=data / "again", width=None)
        again.run()
        assert HRNet.from_pretrained(data / "again" / "best.safetensors").config == gated.config


def test_nobody_held_out_is_trained_on(data: Path) -> None:
    persons, held_out = read_people(data), held_out_people(data)
    for trained, kept in (("sided", "COCO"), ("unsided", "LSPE")):
        keys = {person.sample.key for person in getattr(persons, trained)}
        apart = {person.sample.key for person in held_out[kept]}
        assert keys
        assert apart
        assert not keys & apart
        assert keys | apart == {f"im{n}" for n in range(40)}
    assert len(persons.films) == 40
    # What the teacher leaves out of films is beyond the edge.
    labelled = standing()[:17, 2]
    assert all(
        (film.keypoints[:17, 2] == np.where(labelled > 0, labelled, -1)).all() for film in persons.films
    )
    assert all((person.keypoints[:17, 2] == labelled).all() for person in persons.sided)


def test_people_of_lspe_who_are_confirmed_have_sides_that_hold(data: Path) -> None:
    before, held_out = read_people(data), held_out_people(data)["LSPE"]
    confirmed, apart = before.unsided[0].sample.key, held_out[0].sample.key
    left, top, right, bottom = BOX.tolist()
    found = {"bbox": [left, top, right - left, bottom - top], "keypoints": standing()[:17].flatten().tolist()}
    path = data / "found.json"
    path.write_text(json.dumps([found | {"image_id": key} for key in (confirmed, apart)]))
    after = read_people(data, path)
    assert len(after.sided) == len(before.sided) + 1
    assert after.sided[-1].sample.key == confirmed
    assert {person.sample.key for person in before.unsided} - {
        person.sample.key for person in after.unsided
    } == {confirmed}
    path.write_text(json.dumps([found | {"image_id": "elsewhere"}]))
    with pytest.raises(TensorsimError, match=r"found.json: confirms nobody, expected image_id and bbox"):
        read_people(data, path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"init": Path("none.safetensors")}, "none.safetensors: no such file"),
        ({"device": "abacus"}, "--device: 'abacus'"),
        ({"seed": -1}, "--seed: got -1"),
        ({"rendered_seed": -1}, "--rendered-seed: got -1"),
        ({"learning_rate": float("nan")}, "--learning-rate: got nan"),
        ({"width": 0}, "HRNetConfig"),
        ({"presence": True}, "--presence needs --init"),
        ({"second_labels": Path("none.json")}, "none.json: not a COCO file of keypoint results"),
        (
            {"steps": 2, "first_steps": 1, "first_size": (192, 144)},
            r"--first-size: got \(192, 144\), expected",
        ),
        ({"steps": 5, "first_steps": 5}, "--first-steps: got 5, expected at least 0 and fewer than the 5 of"),
        ({"rendered": -5}, "--rendered: got -5, expected at least 0"),
        (
            {"presence": True, "init": Path("w")},
            "--presence cannot be combined with --rendered",
        ),
        (
            {"presence": True, "init": Path("w"), "rendered": 0, "first_steps": 0},
            "--presence cannot be combined with --first-steps",
        ),
    ],
)
def test_bad_options_are_refused_before_people_are_rendered(
    data: Path, options: dict[str, object], message: str
) -> None:
    out = data / "out"
    with pytest.raises(TensorsimError, match=message):
        TrainPose(data, out=out, quiet=True, **{"rendered": 13, "steps": 1} | options).run()  # type: ignore[arg-type]
    assert not out.exists()


@pytest.mark.parametrize(
    ("steps", "options", "first"), [(7, {}, 3), (20_000, {}, 6000), (7, {"init": Path("w")}, 0)]
)
def test_most_steps_at_the_size_that_is_asked_for(
    steps: int, options: dict[str, object], first: int, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HRNet, "from_pretrained", lambda path, input_size: HRNet(HRNetConfig(4), input_size))
    recipes: list[PoseRecipe] = []
    monkeypatch.setattr(TrainPose, "train", lambda self, recipe, loop: recipes.append(recipe))
    TrainPose(data, out=data / "out", steps=steps, batch=2, **options).run()  # type: ignore[arg-type]
    assert recipes[0].first_samples == 2 * first


@pytest.mark.parametrize(
    "options", [{"network": "cpm"}, {"size": (64, 32), "first_steps": 1}, {"size": (128, 96)}]
)
def test_a_teacher_of_other_maps_is_refused(options: dict[str, object], data: Path) -> None:
    teacher = write_network(data / "teacher.onnx")  # crops of 64x32
    options = {"size": (64, 32), "first_steps": 0, "steps": 2, "teacher": teacher} | options
    with pytest.raises(TensorsimError, match=r"--teacher: got a network for crops of \(64, 32\)"):
        TrainPose(data, out=data / "out", **options).run()  # type: ignore[arg-type]
    assert not (data / "out").exists()


def test_training_with_a_teacher_goes_on_with_no_other(data: Path) -> None:
    teacher = write_network(data / "teacher.onnx")
    options = TrainPose(
        data,
        out=data / "out",
        steps=1,
        first_steps=0,
        size=(64, 32),
        width=4,
        batch=2,
        workers=0,
        quiet=True,
        teacher=teacher,
    )
    options.run()
    assert "distillation" in (data / "out" / "metrics.csv").read_text()
    write_network(teacher, weight=2 * WEIGHT)
    with pytest.raises(TensorsimError, match=r"another run .*teacher"):
        replace(options, steps=2).run()


def test_nobody_to_measure_on_is_told_before_training(data: Path) -> None:
    write_tar(data / "lspet-00.tar", {"a.jpg": jpg(0, 80, 60)})
    with pytest.raises(
        TensorsimError, match="got no held-out people of LSPE, upright, expected some for validation"
    ):
        TrainPose(data, out=data / "out", steps=1, quiet=True).run()
    assert not (data / "out").exists()


def test_missing_data_is_told(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="no coco_small"):
        TrainPose(tmp_path, out=tmp_path / "out").run()
    with pytest.raises(TensorsimError, match="--data or --coco"):
        EvaluatePose(tmp_path / "x.safetensors").run()
    with pytest.raises(TensorsimError, match="expected one"):
        EvaluatePose(tmp_path / "x.safetensors", coco=tmp_path).run()
