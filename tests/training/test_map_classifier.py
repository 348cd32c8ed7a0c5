"""Training on your own data set: classes, starting weights, and the files written next to the weights."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tensorsim import cli
from tensorsim.config import RadarConfig
from tensorsim.data.sets.build import build_dataset
from tensorsim.data.sets.outputs import OutputConfig
from tensorsim.data.sets.reading import MapDataset
from tensorsim.data.sets.recipe import RadarView
from tensorsim.errors import TensorsimError
from tensorsim.recognition import ActivityRecognizer, SPGNet
from tensorsim.recognition.confusion import confusion
from tensorsim.training.map_classifier import (
    MapRecipe,
    PictureToLabel,
    confusion_markdown,
    logits_of,
    transfer,
)
from tests.data.sets.recipes import small_recipe

pytest.importorskip("tensorboard")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "set"
    outputs = OutputConfig(kinds=("picture", "doppler_time"), picture_size=32)
    build_dataset(small_recipe(outputs=outputs), out, quiet=True)
    return out


@pytest.mark.slow
def test_the_recipe_of_a_data_set(folder: Path) -> None:
    recipe = MapRecipe(folder, masks=(0.1, 0.1))
    assert list(recipe.labels) == ["S8 Walking", "S5 Sitting Down"]
    batch = recipe.collate([recipe.sample(k) for k in range(4)])
    assert batch["map"].shape == (4, 1, 32, 32)
    assert sorted(batch["label"].tolist()) == [0, 0, 1, 1]  # two epochs of two samples
    figures = recipe.loss(recipe.net, batch)
    figures["loss"].backward()  # type: ignore[no-untyped-call]
    assert all(p.grad is not None for p in recipe.net.parameters() if p.requires_grad)
    assert set(recipe.validate(recipe.net.eval())) == {"score", "loss", "accuracy"}
    assert 0 < float(recipe.net.network.get_buffer("mean").mean()) < 1  # type: ignore[operator, union-attr]


def test_maps_of_any_size_become_pictures(folder: Path) -> None:
    net = PictureToLabel(SPGNet(2), 32).eval()
    maps = MapDataset(folder, output="doppler_time")
    logits = logits_of(net, maps)
    one = net(torch.nn.functional.interpolate(maps[0]["map"][None], (32, 32), mode="bilinear"))
    assert torch.allclose(logits[0], one[0], atol=1e-5)
    assert torch.allclose(torch.jit.script(net)(maps[0]["map"][None]), one, atol=1e-5)


def test_weights_for_other_classes_keep_all_but_the_last_layer() -> None:
    old, new = SPGNet(12), SPGNet(3)
    left = transfer(new, old.state_dict())
    assert 1 <= len(left) <= 2
    assert all(new.state_dict()[k].equal(v) for k, v in old.state_dict().items() if k not in left)
    with pytest.raises(TensorsimError, match="weights of another network"):
        transfer(new, {"a": torch.zeros(3)})


def test_confusion_counts_true_by_row(folder: Path) -> None:
    maps = MapDataset(folder)
    logits = torch.nn.functional.one_hot(torch.tensor([0] * len(maps)), 2).float()
    table = confusion(logits, maps.targets)
    assert table.tolist() == [[2, 0], [2, 0]]
    assert "| S5 Sitting Down | 2 | 0 |" in confusion_markdown(table, maps.labels)


def test_one_of_both_kinds_of_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        ([], "got both or none"),
        (["--maps", "m", "--labels", "a"], "--labels and --radars need --data"),
        (["--data", "d", "--snr", "20", "20"], "--snr needs --maps and cannot be combined with --data"),
        (
            ["--data", "d", "--film-people", "3"],
            "--film-people needs --maps and cannot be combined with --data",
        ),
    ):
        with pytest.raises(SystemExit):
            cli.main(["train", "classifier", "--out", str(tmp_path), *arguments])
        assert message in capsys.readouterr().err


@pytest.mark.slow
def test_training_writes_all_that_one_needs(folder: Path, tmp_path: Path) -> None:
    import onnxruntime

    out = tmp_path / "out"
    common = [
        "train",
        "classifier",
        "--data",
        str(folder),
        "--network",
        "spgnet",
        "--batch",
        "2",
        "--workers",
        "0",
    ]
    cli.main([*common, "--epochs", "2", "--out", str(out), "--device", "cpu", "--quiet"])
    assert "| true" in (out / "confusion.md").read_text()
    maps = MapDataset(folder, "validation")
    x = maps[0]["map"][None]
    logits = torch.jit.load(out / "picture_to_label.pt")(x)
    session = onnxruntime.InferenceSession(out / "picture_to_label.onnx")
    found = session.run(None, {session.get_inputs()[0].name: x.numpy()})[0]
    assert np.abs(found - logits.detach().numpy()).max() < 1e-4
    recognizer = ActivityRecognizer.from_pretrained(
        RadarConfig.through_wall(), out / "recognizer.safetensors"
    )
    assert recognizer.class_names == maps.labels
    with torch.no_grad():
        assert torch.allclose(recognizer.network(x), logits, atol=1e-3)
    again = ["--init", str(out / "best.safetensors"), "--labels", "S5 Sitting Down", "--epochs", "1"]
    cli.main([*common, *again, "--out", str(tmp_path / "fine"), "--device", "cpu", "--quiet"])
    assert "| S5 Sitting Down | 1 |" in (tmp_path / "fine" / "confusion.md").read_text()


def test_radars_become_channels(tmp_path: Path) -> None:
    views = (RadarView("front", "through-wall"), RadarView("left", "through-wall", -3.0, 3.5, -90.0))
    outputs = OutputConfig(kinds=("picture",), picture_size=32)
    build_dataset(small_recipe(radars=views, outputs=outputs), tmp_path / "set", quiet=True)
    assert MapRecipe(tmp_path / "set").sample(0)["map"].shape[0] == 2
    assert MapRecipe(tmp_path / "set", radars=["left"]).net(torch.rand(2, 1, 32, 32)).shape == (2, 2)
