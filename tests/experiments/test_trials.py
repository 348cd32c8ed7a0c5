import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured.training import predict
from tensorsim.experiments import pictures, trials
from tensorsim.experiments.pictures import PictureSet, RangeAndRidges
from tensorsim.experiments.trials import PaperRecipe, Trial, run_trial
from tensorsim.experiments.work import Work, write_result
from tensorsim.recognition.ccln import CCLN

SMALL = Trial("ccln", "through-wall", clips=5, test_clips=1, size=32, epochs=2, batch=16)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Pictures whose class is the row of a bright line, instead of simulated ones; records which were made."""
    made: list[str] = []

    def prepare(self: PictureSet, people: int, inputs: str) -> None:
        made.append(f"{people} {inputs}")

    def get(
        self: PictureSet, people: range, inputs: str, snr_db: float = 50.0
    ) -> tuple[torch.Tensor, torch.Tensor]:
        generator = torch.Generator().manual_seed(people.start)
        labels = torch.arange(12).repeat(len(people))
        x = 0.1 * torch.rand(len(labels), pictures.INPUTS[inputs], self.size, self.size, generator=generator)
        x[torch.arange(len(labels)), :, 2 * labels] = 1.0
        return x, labels

    monkeypatch.setattr(PictureSet, "prepare", prepare)
    monkeypatch.setattr(PictureSet, "get", get)
    return made


def test_an_interrupted_training_goes_on_to_the_same_numbers(
    drawn: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.set_num_threads(1)
    ratios = (50.0, 10.0)
    recipe_loss, steps = PaperRecipe.loss, []

    def count(self: PaperRecipe, net: nn.Module, batch: Any) -> Any:
        steps.append(1)
        return recipe_loss(self, net, batch)

    monkeypatch.setattr(PaperRecipe, "loss", count)
    monkeypatch.setattr(time, "process_time", lambda: float(len(steps)))
    whole = run_trial(SMALL, ratios, Work(tmp_path / "whole", quiet=True))
    assert set(whole["confusion"]) == {"50", "10"}
    assert torch.tensor(whole["confusion"]["50"]).sum() == 12

    assert whole["training_s"] == len(steps) == 6
    steps.clear()

    def stop(self: PaperRecipe, net: nn.Module, batch: Any) -> Any:
        steps.append(1)
        if len(steps) == 5:
            raise KeyboardInterrupt
        return recipe_loss(self, net, batch)

    monkeypatch.setattr(PaperRecipe, "loss", stop)
    work = Work(tmp_path / "parts", quiet=True)
    with pytest.raises(KeyboardInterrupt):
        run_trial(SMALL, ratios, work)
    folder = tmp_path / "parts" / "trials" / SMALL.name
    assert (folder / "last.pt").is_file()
    assert not (folder / "result.json").exists()
    resumed = run_trial(SMALL, ratios, work)
    assert resumed == whole
    assert not (folder / "last.pt").exists(), "a checkpoint is many times as large as the weights"
    monkeypatch.setattr(trials, "fit", None)  # what is there is not trained again
    more = run_trial(SMALL, (50.0, 20.0), work)
    assert set(more["confusion"]) == {"50", "10", "20"}
    other = run_trial(replace(SMALL, test_clips=2), (50.0,), work)
    assert torch.tensor(other["confusion"]["50"]).sum() == 24
    assert run_trial(SMALL, (50.0,), work) == more


def test_the_recipe_is_the_papers() -> None:
    x, y = torch.rand(30, 1, 32, 32), torch.arange(30) % 12
    recipe = PaperRecipe(SMALL, CCLN(12), (x, y), (x, y))
    assert float(recipe.net.get_buffer("mean")) == pytest.approx(float(x.mean()))
    assert sorted(int(recipe.sample(k)["label"]) for k in range(30)) == sorted(y.tolist()), (
        "an epoch has all clips"
    )
    assert [recipe.sample(k)["label"] for k in range(30)] != [
        recipe.sample(30 + k)["label"] for k in range(30)
    ]
    weights, rest = recipe.optimiser().param_groups
    assert (weights["lr"], weights["weight_decay"], rest["weight_decay"]) == (1.47e-3, 1e-4, 0.0)
    assert all(p.dim() <= 1 for p in rest["params"])
    assert [recipe.rate(k, 4) for k in range(4)] == [1.0, 1.0, 0.1, 0.1]


def test_logits_are_those_of_the_network() -> None:
    net = CCLN(12).eval()
    x = torch.rand(5, 1, 32, 32)
    with torch.no_grad():
        torch.testing.assert_close(predict(net, x, batch=2), net(x), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"network": "vgg"}, "got 'vgg'"),
        ({"inputs": "sound"}, "got 'sound'"),
        ({"clips": 4}, "got 4 to train on"),
        ({"epochs": 0}, "got 0 and 16"),
        ({"size": 40}, "got 40, expected a multiple of 16"),
    ],
)
def test_refuses_bad_trials(change: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        replace(SMALL, **change).check()


def test_a_full_disk_is_one_line(drawn: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise RuntimeError(
            "[enforce fail at inline_container.cc:858] . PytorchStreamWriter failed writing file"
        )

    monkeypatch.setattr(trials, "fit", full)
    with pytest.raises(TensorsimError, match="is the disk full"):
        trials._one_thread(SMALL, (50.0,), Work(tmp_path, quiet=True))


def test_a_damaged_result_is_named(drawn: list[str], tmp_path: Path) -> None:
    path = tmp_path / "trials" / SMALL.name / "result.json"
    write_result(path, {})
    path.write_text("[1]")
    with pytest.raises(TensorsimError, match="got list, expected a result"):
        run_trial(SMALL, (50.0,), Work(tmp_path, quiet=True))


def test_range_and_ridge_pictures_show_the_walker() -> None:
    """Someone who comes from 5 to 3 m: bright rows of the range picture follow; ridges lie on the approaching side."""
    joints = torch.zeros(2, 120, 14, 3, dtype=torch.float64)
    joints[..., 2] = 1.0
    joints[0, ..., 1] = torch.linspace(5.0, 3.0, 120)[:, None]
    valid = torch.tensor([[True], [False]]).expand(2, 120)
    found = RangeAndRidges("through-wall", 32).pictures(joints, valid, 60.0, seed=0)
    assert found["range"].shape == found["ridges"].shape == (2, 32, 32)
    rows = found["range"][0].argmax(0).float()
    assert float(rows[2:6].mean()) > float(rows[-6:-2].mean()) + 5, "nearer with time"
    upper, lower = found["ridges"][0, 16:].sum(), found["ridges"][0, :16].sum()
    assert float(upper) > 3 * float(lower), "positive speed = approaching"
    assert float((found["ridges"][0] - found["ridges"][1]).abs().max()) > 0.5
    again = RangeAndRidges("through-wall", 32).pictures(joints, valid, 60.0, seed=0)
    assert torch.equal(again["range"], found["range"])


@pytest.mark.slow
def test_an_experiment_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tensorsim.cli import main

    out = tmp_path / "out"
    arguments = ["experiment", "networks", "--quick", "--quiet", "--networks", "ccln", "--out", str(out)]
    main(arguments)
    report = (out / "networks.md").read_text(encoding="utf-8")
    assert "| CCLN |" in report
    for suffix in (
        ".csv",
        ".yaml",
        "-accuracy.png",
        "-accuracy.svg",
        "-confusion-through-wall.svg",
        "-trainings.csv",
    ):
        assert (out / f"networks{suffix}").stat().st_size > 0
    main([*arguments[:2], "--quiet", "--config", str(out / "networks.yaml"), "--out", str(out)])
    assert (out / "networks.md").read_text(encoding="utf-8") == report
    assert "Accuracy on new people at 50 dB" in capsys.readouterr().out
