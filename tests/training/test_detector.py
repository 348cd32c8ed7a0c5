"""The recipe of the detector: it learns, resumes where it stopped, and is evaluated as by COCO."""

import copy
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.cli import main
from tensorsim.commands.evaluate_detector import EvaluateDetector
from tensorsim.commands.train_detector import TrainDetector
from tensorsim.errors import TensorsimError
from tensorsim.training.detector import HARD, USED_IOU, USED_SIDE, DetectorRecipe, TrainedRTMDet, read_sources
from tensorsim.training.detector_data import Sources
from tensorsim.training.detector_metrics import (
    average_precision,
    calibrate,
    compare_tracks,
    measure,
    people_in,
)
from tensorsim.training.loop import LoopConfig, fit
from tensorsim.training.shards import Sample, read_coco_folder
from tensorsim.types import Detections, Tracks
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.detection.rtmdet_layers import RTMDET_SIZES, RTMDetSize
from tensorsim.weights import save_weights
from tests.networks import terms_of_training
from tests.training.tars import write_tar
from tests.training.test_detector_data import cutouts, encoded, shard


@pytest.fixture
def recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DetectorRecipe:
    """Pictures of 64 pixels, a tiny network."""
    tiny = RTMDetSize(0.167, 0.125, 1, exp_on_reg=True, depthwise=False, share_conv=True, input_size=64)
    monkeypatch.setitem(RTMDET_SIZES, "test", tiny)
    complete, empty = shard(tmp_path / "p.tar", True), shard(tmp_path / "e.tar", False)
    partial = [shard(tmp_path / "s.tar", True, False)]
    sources = Sources(complete, empty, partial, cutouts=cutouts(tmp_path / "c.tar"))
    monkeypatch.setattr("tensorsim.training.detector.SIDES", (64,))
    torch.manual_seed(0)
    return DetectorRecipe(TrainedRTMDet("test"), sources, complete, warm_up=5)


def test_four_pictures_are_learnt(recipe: DetectorRecipe) -> None:
    samples = [recipe.sample(i) for i in range(4)]
    batch = recipe.collate(samples)
    assert int(batch["valid"].sum()) >= 4
    losses = terms_of_training(recipe, batch, 60)
    assert losses[-1] < 0.5 * losses[0]


def test_a_teacher_is_learnt_from_and_stays_as_it_is(recipe: DetectorRecipe) -> None:
    """Without labels, scores and boxes come near to those of the teacher."""
    torch.manual_seed(1)
    teacher = RTMDet("test").eval()
    for module in teacher.modules():  # a fresh network has the same output in every cell
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight)
    before = copy.deepcopy(teacher.state_dict())
    sources = recipe.maker.sources
    taught = DetectorRecipe(TrainedRTMDet("test"), sources, recipe.held_out, warm_up=5, teacher=teacher)
    batch = taught.collate([taught.sample(i) for i in range(4)])
    batch["valid"], batch["known"] = torch.zeros_like(batch["valid"]), torch.zeros_like(batch["known"])
    losses = terms_of_training(taught, batch, 60, "distillation")
    assert losses[-1] < 0.5 * losses[0]
    for name, value in teacher.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert taught.settings != recipe.settings


def test_the_detector_sees_what_the_recipe_trains_on(recipe: DetectorRecipe) -> None:
    """Normalisation and order of the channels in training are those of use."""
    image = recipe.sample(0)["image"][None]
    seen: list[Tensor] = []

    class Listener(nn.Module):
        def forward(self, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
            seen.append(x)
            return recipe.detector.dense(x)

    batch = {
        "image": image.float(),
        "boxes": torch.zeros(1, 0, 4),
        "valid": torch.zeros(1, 0, dtype=torch.bool),
        "known": torch.ones(1, 40, 40, dtype=torch.bool),
    }
    recipe.loss(Listener(), batch)
    torch.testing.assert_close(seen[0], recipe.detector.preprocess(image))


def test_a_batch_of_another_size_keeps_boxes_on_people(recipe: DetectorRecipe, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr("tensorsim.training.detector.SIDES", (32, 64))
    sizes = set()
    for first in range(8):
        samples = [recipe.sample(2 * first), recipe.sample(2 * first + 1)]
        batch = recipe.collate(samples)
        side = batch["image"].shape[-1]
        sizes.add(side)
        for i, sample in enumerate(samples):
            own = batch["boxes"][i][batch["valid"][i]]
            torch.testing.assert_close(own, sample["boxes"] * side / 64)
    assert sizes == {32, 64}


def test_an_interrupted_run_goes_on_to_the_same_weights(recipe: DetectorRecipe, tmp_path: Path) -> None:
    def config(name: str, steps: int) -> LoopConfig:
        return LoopConfig(
            tmp_path / name, steps, batch=4, workers=0, quiet=True, checkpoint_every=3, validate_every=6
        )

    fresh = copy.deepcopy(recipe.net.state_dict())
    monotone = recipe.rate
    recipe.rate = lambda step, steps: monotone(step, 6)  # type: ignore[method-assign]
    fit(recipe, config("whole", 6))
    recipe.net.load_state_dict(fresh)
    fit(recipe, config("parts", 3))
    recipe.net.load_state_dict(fresh)  # must come from the checkpoint
    fit(recipe, config("parts", 6))
    states = [torch.load(tmp_path / n / "last.pt", weights_only=True)["averaged"] for n in ("whole", "parts")]
    for key, value in states[0].items():
        torch.testing.assert_close(states[1][key], value, rtol=0, atol=0, msg=key)


def test_command_trains_and_goes_on_from_weights(
    recipe: DetectorRecipe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    points = [[50 + 4 * (-1) ** i, 22 + 3 * i, 2] for i in range(19)]
    files = {}
    for n in range(40):
        image = np.full((120, 160, 3), 90, np.uint8)
        image[20:80, 40:70] = (230, 20, 20) if n % 2 else 90
        persons = [{"bbox": [40, 20, 30, 60], "keypoints": points}] if n % 2 else []
        files[f"{n}.jpg"] = encoded(image, ".jpg")
        files[f"{n}.json"] = json.dumps({"all_persons_labelled": True, "persons": persons}).encode()
    write_tar(tmp_path / "coco_small-00.tar", files)
    for name in ("backgrounds", "coco_hardneg"):
        write_tar(tmp_path / f"{name}-00.tar", {"0.jpg": files["0.jpg"]})
    for name in ("lspet", "pedestrian", "coco_more", "coco_extra", "films_teacher"):
        write_tar(tmp_path / f"{name}-00.tar", {key: files[key] for key in ("1.jpg", "1.json")})
    cutouts(tmp_path / "cutouts-000.tar")

    def train(out: str, **options: Path) -> dict[str, Tensor]:
        TrainDetector(
            tmp_path,
            variant="test",
            cutouts=tmp_path,
            rendered=20,
            steps=1,
            batch=2,
            out=tmp_path / out,
            workers=0,
            quiet=True,
            **options,
        ).run()
        assert f"{out}/detector.safetensors" in capsys.readouterr().out
        return RTMDet.from_pretrained(tmp_path / out / "best.safetensors").state_dict()

    first = train("a")
    # The size and the suppression that the network is used with travel with the weights.
    trained = tmp_path / "a" / "detector.safetensors"
    detector = RTMDet.from_pretrained(trained)
    assert (detector.input_size, detector.nms_iou) == (USED_SIDE, USED_IOU)
    detector = RTMDet.from_pretrained(trained, input_size=64, nms_iou=0.7)
    assert (detector.input_size, detector.nms_iou) == (64, 0.7)
    # At a learning rate of next to nothing the second run ends where it began: at the weights of the first.
    monkeypatch.setattr(DetectorRecipe, "rate", lambda self, step, steps: 0.0)
    second = train("b", init=tmp_path / "a" / "best.safetensors", teacher=trained)
    for name, value in second.items():
        if "running" not in name and "num_batches" not in name:
            torch.testing.assert_close(value, first[name], rtol=2e-3, atol=1e-6, msg=name)
    # Of several processes the first one calibrates.
    monkeypatch.setattr(TrainDetector, "train", lambda self, recipe, loop: trained)
    monkeypatch.setenv("RANK", "1")
    TrainDetector(tmp_path, variant="test", out=tmp_path / "c", quiet=True).run()  # type: ignore[arg-type]
    assert not (tmp_path / "c").exists()


def test_only_networks_for_people_alone_can_be_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["train", "detector", "--data", str(tmp_path), "--out", str(tmp_path), "--variant", "tiny"])
    assert "small-person" in capsys.readouterr().err


def test_bad_options_are_refused_before_people_are_rendered(tmp_path: Path) -> None:
    for options, message in (
        ({}, "no coco_small"),
        ({"init": tmp_path / "none.safetensors"}, "no such file"),
        ({"learning_rate": 0.0}, "--learning-rate: got 0"),
    ):
        with pytest.raises(TensorsimError, match=message):
            TrainDetector(tmp_path, out=tmp_path / "out", quiet=True, **options).run()  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_held_out_pictures_must_be_of_both_kinds(tmp_path: Path) -> None:
    for name in ("coco_small", "coco_more", "coco_extra"):
        shard(tmp_path / f"{name}-00.tar", True)
    with pytest.raises(TensorsimError, match="held-out"):
        read_sources(tmp_path)


def test_weights_of_the_small_network_load_by_path(tmp_path: Path) -> None:
    net = TrainedRTMDet("small-person").eval()
    path = tmp_path / "small.safetensors"
    save_weights(net, path, {"model": "RTMDet"})
    assert path.stat().st_size <= 5e6
    loaded = RTMDet.from_pretrained(path)
    assert loaded.variant == "small-person"
    assert loaded.input_size == 320
    x = torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(loaded.dense(x)[0], net.dense(x)[0], rtol=0.02, atol=0.02)


def test_learning_rate_rises_stays_and_falls(recipe: DetectorRecipe) -> None:
    rates = [recipe.rate(step, 100) for step in range(100)]
    assert rates[0] == pytest.approx(0.2)
    assert rates[4] == rates[50] == 1
    assert all(a >= b for a, b in itertools.pairwise(rates[4:]))
    assert rates[-1] == pytest.approx(0.05, abs=0.01)


def test_norms_and_biases_do_not_decay(recipe: DetectorRecipe) -> None:
    decaying, light = (group["params"] for group in recipe.optimiser().param_groups)
    assert len(decaying) + len(light) == len(list(recipe.net.parameters()))
    norms = [p for m in recipe.net.modules() if isinstance(m, nn.BatchNorm2d) for p in m.parameters()]
    assert {id(p) for p in norms} <= {id(p) for p in light}


# ---- measures --------------------------------------------------------------------------------------------


def test_average_precision_by_hand() -> None:
    truth = [torch.tensor([[0.0, 0, 100, 100], [200, 200, 300, 300]])]
    right, wrong = [0.0, 0, 100, 100], [400.0, 0, 500, 100]
    ap, ap50 = average_precision(
        truth, [torch.tensor([[*right, 0.9], [*wrong, 0.8], [200, 200, 300, 300, 0.7]])]
    )
    # Recall up to a half at precision 1, above at 2/3, on 101 points.
    assert ap50 == pytest.approx((51 + 50 * 2 / 3) / 101, abs=1e-6)
    assert ap == pytest.approx(ap50)
    ap, ap50 = average_precision(truth, [torch.tensor([[0.0, 0, 100, 72, 0.9]])])  # overlaps by 0.72
    assert ap50 == pytest.approx(51 / 101)
    assert ap == pytest.approx(5 / 10 * 51 / 101)


def test_figures_of_a_detector_that_is_told_the_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples = shard(tmp_path / "p.tar", True) + shard(tmp_path / "e.tar", False)

    class Told(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("mean", torch.zeros(1))

        def forward(self, images: Tensor) -> Detections:
            boxes = torch.tensor([[[40.0, 20, 70, 80], [0, 0, 10, 10], [100, 0, 120, 30]]])
            scores = torch.tensor([[0.9, 0.6, 0.4]])
            return Detections(boxes, scores, torch.zeros(1, 3, dtype=torch.int64), scores > 0)

    decoded: list[Sample] = []
    image = Sample.image

    def counted(self: Sample) -> Any:
        decoded.append(self)
        return image(self)

    monkeypatch.setattr(Sample, "image", counted)
    figures = measure(Told(), samples)  # type: ignore[arg-type]
    assert len(decoded) == len(samples), "a picture is decoded once"
    assert figures["recall"] == figures["recall_large"] == 1
    assert figures["false_per_picture"] == 1.5  # one, and two in the empty picture; 0.4 does not count
    assert figures["people"] == 1
    with pytest.raises(TensorsimError, match="without people"):
        measure(Told(), samples[1:])  # type: ignore[arg-type]


def test_what_is_found_in_a_crowd_does_not_count(tmp_path: Path) -> None:
    """As COCO's own evaluator has it, from a COCO file."""
    (tmp_path / "images").mkdir()
    person = {"category_id": 1, "image_id": 1, "bbox": [10, 10, 50, 80], "area": 2000, "keypoints": [0] * 51}
    crowd = {"category_id": 1, "iscrowd": 1, "keypoints": [0] * 51}
    annotations = [
        person,
        crowd | {"image_id": 1, "bbox": [100, 10, 90, 180], "area": 16200},
        crowd | {"image_id": 2, "bbox": [0, 0, 160, 200], "area": 32000},
    ]
    images = [{"id": i, "file_name": f"{i}.png"} for i in (1, 2)]
    for image in images:
        path = tmp_path / "images" / str(image["file_name"])
        path.write_bytes(encoded(np.zeros((200, 200, 3), np.uint8), ".png"))
    categories = [{"id": 1, "name": "person"}]
    content = {"images": images, "categories": categories, "annotations": annotations}
    (tmp_path / "people.json").write_text(json.dumps(content))

    class Told(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("mean", torch.zeros(1))

        def forward(self, images: Tensor) -> Detections:
            boxes = torch.tensor([[[10.0, 10, 60, 90], [110, 20, 150, 100], [155, 100, 165, 180]]])
            scores = torch.tensor([[0.6, 0.9, 0.8]])
            return Detections(boxes, scores, torch.zeros(1, 3, dtype=torch.int64), scores > 0)

    samples = read_coco_folder(tmp_path)
    figures = measure(Told(), samples[:1])  # type: ignore[arg-type]
    assert (figures["ap"], figures["false_per_picture"]) == pytest.approx((1, 0))
    # In the second picture the last one lies in the crowd by just a half.
    figures = measure(Told(), samples)  # type: ignore[arg-type]
    assert (figures["ap50"], figures["false_per_picture"]) == pytest.approx((1, 0))
    assert figures["ap"] < 1
    assert np.isnan(figures["alarms_per_picture"])


def test_calibrated_scores_mean_the_same_number_of_alarms(tmp_path: Path, recipe: DetectorRecipe) -> None:
    torch.manual_seed(1)
    detector = RTMDet("test", score_threshold=0.0).eval()
    empty, peopled = shard(tmp_path / "n.tar", False) * 5, shard(tmp_path / "o.tar", True)
    before = [people_in(detector, sample.image()) for sample in empty]
    assert max(float(scores.max()) for _, scores in before) < 0.5
    # However many people there are, and however badly they are found, only the pictures without any count.
    shift = calibrate(detector, empty + 5 * peopled, alarms_per_picture=0.6)
    assert shift > 0
    after = [people_in(detector, sample.image()) for sample in empty]
    for (boxes, scores), (shifted_boxes, shifted_scores) in zip(before, after, strict=True):
        torch.testing.assert_close(shifted_boxes, boxes)
        torch.testing.assert_close(shifted_scores.logit(), scores.logit() + shift, rtol=0, atol=1e-3)
    assert measure(detector, empty + peopled)["alarms_per_picture"] <= 0.6
    # The next one would be one too many.
    highest = torch.cat([scores for _, scores in after]).sort(descending=True).values
    assert 0.495 < float(highest[3]) < 0.5
    with pytest.raises(TensorsimError, match="pictures with people"):
        calibrate(detector, peopled)


def test_shared_person_frames() -> None:
    def tracks(boxes: list[list[list[float]]]) -> Tracks:
        table = torch.tensor(boxes)[None]
        valid = table.flatten(3).any(dim=-1)
        return Tracks(table, valid, valid)

    a, b, none = [0.0, 0, 10, 10], [50.0, 50, 60, 60], [0.0] * 4
    reference = tracks([[a, a, a, a], [b, b, b, none]])
    found = tracks(
        [[a, a, none, none], [none, [51.0, 50, 61, 60], b, b], [none, [200.0, 0, 210, 10], none, none]]
    )
    followed = compare_tracks(found, reference)
    assert followed == (6, 7, 4)
    empty = Tracks(torch.zeros(1, 0, 4, 4), *(torch.zeros(1, 0, 4, dtype=torch.bool),) * 2)
    assert compare_tracks(empty, reference) == (0, 7, 0)
    assert compare_tracks(found, empty) == (6, 0, 0)


def test_pictures_are_deterministic(recipe: DetectorRecipe) -> None:
    first, again = recipe.sample(7), recipe.sample(7)
    np.testing.assert_array_equal(first["image"], again["image"])
    assert not torch.equal(recipe.sample(8)["image"], first["image"])


# ---- sources and commands --------------------------------------------------------------------------------


def test_sources_are_sorted_by_what_they_know(tmp_path: Path) -> None:
    picture = np.full((100, 100, 3), 90, np.uint8)

    def person(points: dict[int, tuple[float, float]]) -> dict[str, object]:
        rows = [[*points.get(i, (0, 0)), 2 if i in points else 0] for i in range(19)]
        return {"bbox": [20, 30, 40, 50], "keypoints": rows}

    def write(name: str, keys: list[str], persons: list[dict[str, object]], everyone: bool) -> None:
        files = {}
        for key in keys:
            files[f"{key}.jpg"] = encoded(picture, ".jpg")
            label = {"all_persons_labelled": everyone, "persons": persons}
            files[f"{key}.json"] = json.dumps(label).encode()
        write_tar(tmp_path / f"{name}-00.tar", files)

    shoulders, hips = {5: (50.0, 30.0), 6: (40.0, 30.0)}, {11: (50.0, 60.0), 12: (40.0, 60.0)}
    lying = {5: (20.0, 30.0), 6: (20.0, 40.0), 11: (60.0, 30.0), 12: (60.0, 40.0)}
    write("coco_small", [f"c{i}" for i in range(40)], [person({})], True)
    write_tar(tmp_path / "coco_small-01.tar", {f"n{i}.jpg": encoded(picture, ".jpg") for i in range(40)})
    write("coco_more", [f"m{i}" for i in range(40)], [person({})], True)
    write("coco_extra", [f"x{i}" for i in range(40)], [person({})], False)
    write_tar(tmp_path / "coco_hardneg-00.tar", {"doll.jpg": encoded(picture, ".jpg")})
    write("films_teacher", ["film"], [person(shoulders | hips)], True)
    write("films_teacher-some", ["crowd"], [person({})], False)
    write("lspet", ["standing"], [person(shoulders | hips)], False)
    write("lspet-nobody", ["nobody"], [], False)
    write_tar(tmp_path / "lspet-01.tar", {
        "lying.jpg": encoded(picture, ".jpg"),
        "lying.json": json.dumps({"all_persons_labelled": False, "persons": [person(lying)]}).encode(),
    })  # fmt: skip
    write("pedestrian", ["street"], [person({})], False)
    write_tar(tmp_path / "backgrounds-00.tar", {"room.jpg": encoded(picture, ".jpg")})

    sources, held_out = read_sources(tmp_path)
    keys, kept = {sample.key for sample in sources.complete}, {sample.key for sample in held_out}
    everyone = {f"{kind}{i}" for kind in "cm" for i in range(40)}
    assert keys == everyone - kept
    assert kept < everyone | {f"n{i}" for i in range(40)}
    assert all(any(key.startswith(kind) for key in kept) for kind in "cmn")
    assert [sample.key for sample in sources.films] == ["film"]
    crowds, everybody, street = sources.partial
    assert 0 < len(crowds) < 40
    assert all(sample.key.startswith("x") for sample in crowds)
    assert {s.key for s in everybody} == {"standing", "lying", "nobody"}
    assert [s.key for s in sources.outlined] == ["standing"]
    empty = [s.key for s in sources.empty]
    assert empty.count("room") == 1
    assert empty.count("doll") == HARD
    assert set(empty) == {"room", "doll", *(f"n{i}" for i in range(40))} - kept
    np.testing.assert_allclose(street[0].boxes, [[20, 30 - 0.18 * 50, 60, 80]], rtol=1e-6)


def test_evaluation_asks_for_something_to_look_at(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="expected --data, --coco or --films"):
        EvaluateDetector(weights=tmp_path / "x.safetensors").run()
    with pytest.raises(TensorsimError, match="--films needs --against"):
        EvaluateDetector(weights=tmp_path / "x.safetensors", films=(tmp_path / "a.mp4",)).run()
    with pytest.raises(TensorsimError, match="got 0 json files"):
        EvaluateDetector(weights=tmp_path / "x.safetensors", coco=tmp_path).run()


def test_evaluation_prints_a_line_per_detector(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], recipe: DetectorRecipe
) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(encoded(recipe.held_out[0].image(), ".jpg"))
    labels = {
        "images": [{"id": 1, "file_name": "a.jpg"}],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": [{"image_id": 1, "category_id": 1, "bbox": [40, 20, 30, 60]}],
    }
    (tmp_path / "labels.json").write_text(json.dumps(labels))
    path = tmp_path / "w.safetensors"
    save_weights(TrainedRTMDet("small-person"), path, {})
    EvaluateDetector(weights=path, coco=tmp_path).run()
    printed = capsys.readouterr()
    assert "1/1" in printed.err, "a progress bar"
    lines = printed.out.splitlines()
    assert len(lines) == 1
    assert "ap50" in lines[0]
    assert "people 1" in lines[0]
    EvaluateDetector(weights=path, against=path, coco=tmp_path, quiet=True).run()
    printed = capsys.readouterr()
    assert len(printed.out.splitlines()) == 2, "also beside itself"
    assert "1/1" not in printed.err
