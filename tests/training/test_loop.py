"""The training loop: resume, best weights, logs, refusals."""

import csv
import itertools
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.training.loop import LoopConfig, Recipe, _Shares, fit
from tensorsim.weights import load_state_dict, load_strict


class Line(Recipe):
    """y = 2 x + 1 learnt by a net with batch norm, dropout and a little noise: every kind of state."""

    def __init__(self, rate: float = 0.1) -> None:
        torch.manual_seed(0)
        net = nn.Sequential(nn.Linear(1, 8), nn.BatchNorm1d(8), nn.Dropout(0.1), nn.Linear(8, 1))
        super().__init__(net, {"rate": rate}, {"purpose": "test"})

    def sample(self, index: int) -> dict[str, Any]:
        x = torch.rand(1, generator=torch.Generator().manual_seed(index)) - 0.5
        return {"x": x, "y": 2 * x + 1}

    def loss(self, net: nn.Module, batch: dict[str, Any]) -> dict[str, Tensor]:
        noise = 0.01 * torch.randn_like(batch["x"])
        error = ((net(batch["x"] + noise) - batch["y"]) ** 2).mean()
        return {"loss": error, "rms": error.sqrt()}

    def optimiser(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.net.parameters(), lr=self.settings["rate"])

    def rate(self, step: int, steps: int) -> float:
        return 1 / (1 + step / 20)

    def validate(self, net: nn.Module) -> dict[str, float]:
        x = torch.linspace(-0.5, 0.5, 11).unsqueeze(1)
        error = float(((net(x) - 2 * x - 1) ** 2).mean().detach())
        return {"score": -error, "error": error}


def config(out: Path, steps: int = 40, **options: Any) -> LoopConfig:
    settings = {"workers": 0, "precision": "float32", "ema_decay": 0.9, "quiet": True} | options
    return LoopConfig(out, steps, batch=16, checkpoint_every=10, validate_every=20, log_every=5, **settings)


def weights(folder: Path) -> dict[str, Tensor]:
    return torch.load(folder / "last.pt", weights_only=True)["averaged"]


def test_training_learns(tmp_path: Path) -> None:
    before = Line().validate(Line().net.eval())["error"]
    best = fit(Line(), config(tmp_path, steps=200))
    assert best["error"] < 0.05 * before
    # What is stored is what was validated, up to float16.
    net = Line().net
    load_strict(net, load_state_dict(tmp_path / "best.safetensors"), "best")
    assert Line().validate(net.eval())["error"] == pytest.approx(best["error"], rel=0.2, abs=1e-4)


@pytest.mark.parametrize("workers", [0, 1])
def test_an_interrupted_run_goes_on_to_the_same_result(tmp_path: Path, workers: int) -> None:
    whole = fit(Line(), config(tmp_path / "whole", workers=workers))
    recipe, steps = Line(), itertools.count()

    def interrupted(net: nn.Module, batch: dict[str, Any]) -> dict[str, Tensor]:
        if next(steps) == 27:
            raise KeyboardInterrupt
        return Line.loss(recipe, net, batch)

    recipe.loss = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        fit(recipe, config(tmp_path / "parts", workers=workers))
    with (tmp_path / "parts" / "metrics.csv").open("a") as file:
        file.write("28,loss,0.1\n,loss,0.1\n")  # of steps that are done again; cut short
    parts = fit(Line(), config(tmp_path / "parts", workers=workers))
    assert parts == whole
    for (name, a), b in zip(
        weights(tmp_path / "whole").items(), weights(tmp_path / "parts").values(), strict=True
    ):
        assert torch.equal(a, b), name
    rows = list(csv.reader((tmp_path / "parts" / "metrics.csv").read_text().splitlines()))
    kept = [row[:2] for row in rows[1:] if row[1] == "loss"]
    assert kept == [[str(step), "loss"] for step in range(5, 41, 5)]


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_of_a_worker_is_told_in_one_line(tmp_path: Path, workers: int) -> None:
    class Damaged(Line):
        def sample(self, index: int) -> dict[str, Any]:
            if index == 40:
                raise TensorsimError("a.tar: damaged: cut short")
            return super().sample(index)

    with pytest.raises(TensorsimError) as raised:
        fit(Damaged(), config(tmp_path, workers=workers))
    assert str(raised.value) == "a.tar: damaged: cut short"


def test_logs_are_there(tmp_path: Path) -> None:
    fit(Line(), config(tmp_path))
    rows = list(csv.reader((tmp_path / "metrics.csv").read_text().splitlines()))
    assert rows[0] == ["step", "name", "value"]
    assert {row[1] for row in rows[1:]} == {
        "loss",
        "rms",
        "rate",
        "samples_per_s",
        "validation/score",
        "validation/error",
    }
    assert list(tmp_path.glob("events.out.tfevents*"))


def test_without_tensorboard_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(TensorsimError, match=r'pip install "tensorsim\[train\]"'):
        fit(Line(), config(tmp_path / "out"))
    assert list((tmp_path / "out").glob("*")) == []


def test_another_run_is_refused(tmp_path: Path) -> None:
    fit(Line(), config(tmp_path, steps=10))
    with pytest.raises(TensorsimError, match=r"another run \(rate: 0.2 for 0.1\)"):
        fit(Line(rate=0.2), config(tmp_path, steps=20))
    with pytest.raises(TensorsimError, match=r"seed: 1 for 0"):
        fit(Line(), config(tmp_path, steps=20, seed=1))

    class Other(Line):
        pass

    with pytest.raises(TensorsimError, match=r"another run \(recipe: 'Other' for 'Line'\)"):
        fit(Other(), config(tmp_path, steps=20))
    wider = Line()
    wider.net[3] = nn.Linear(8, 2)  # type: ignore[operator]
    with pytest.raises(
        TensorsimError, match=r"another run \(3.bias: \(2,\) for \(1,\), 3.weight: \(2, 8\) for"
    ):
        fit(wider, config(tmp_path, steps=20))


@pytest.mark.parametrize("damage", ["empty", "cut", "text", "changed", "other"])
def test_a_damaged_checkpoint_is_told_in_one_line(tmp_path: Path, damage: str) -> None:
    fit(Line(), config(tmp_path, steps=10))
    last = tmp_path / "last.pt"
    data = last.read_bytes()
    if damage == "other":
        torch.save({"step": 3}, last)
    else:
        middle = len(data) // 2
        changed = {
            "empty": b"",
            "cut": data[:middle],
            "text": b"not a checkpoint",
            "changed": bytes(64) + data[64:],
        }
        last.write_bytes(changed[damage])
    with pytest.raises(TensorsimError, match=r"last\.pt: (damaged|not a training checkpoint)") as refused:
        fit(Line(), config(tmp_path, steps=20))
    assert "\n" not in str(refused.value)


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path: Path) -> None:
    class Broken(Line):
        def loss(self, net: nn.Module, batch: dict[str, Any]) -> dict[str, Tensor]:
            return {"loss": net(batch["x"]).sum() * float("nan")}

    with pytest.raises(TensorsimError, match="the loss of step 0 is nan"):
        fit(Broken(), config(tmp_path))


def test_a_score_that_is_not_a_number_stops_the_run(tmp_path: Path) -> None:
    """Otherwise no weights would be the best, and those of an earlier run would be taken for them."""

    class Unjudged(Line):
        def validate(self, net: nn.Module) -> dict[str, float]:
            return {"score": float("nan")}

    with pytest.raises(TensorsimError, match="the score of step 20 is nan, expected a number"):
        fit(Unjudged(), config(tmp_path))


def test_processes_divide_each_batch_among_them(tmp_path: Path) -> None:
    shares = [list(_Shares(2, config(tmp_path, steps=4), rank, 2)) for rank in range(2)]
    for step, parts in enumerate(zip(*shares, strict=True), start=2):
        assert [len(part) for part in parts] == [8, 8]
        assert sorted(itertools.chain(*parts)) == list(range(16 * step, 16 * (step + 1)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps: got 0, expected an integer of at least 1"),
        ({"ema_decay": 1.0}, "ema_decay 1.0"),
        ({"precision": "half"}, "precision 'half'"),
        ({"workers": -1}, "workers -1"),
    ],
)
def test_bad_settings_are_refused(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        config(tmp_path, **options)


def test_the_average_of_weights_begins_short(tmp_path: Path) -> None:
    """A weight that falls by 0.1 a step: its mean keeps min(decay, (1 + n) / (10 + n)) of itself at update n.

    So does the mean of what batch norm has seen.
    """
    seen: list[Tensor] = []

    class Falling(Line):
        def loss(self, net: nn.Module, batch: dict[str, Any]) -> dict[str, Tensor]:
            found = net(batch["x"])
            seen.append(net[1].running_mean.clone())  # type: ignore[index]
            return {"loss": found.mean() * 0 + net[3].bias.sum()}

        def optimiser(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.net.parameters(), lr=0.1)

        def rate(self, step: int, steps: int) -> float:
            return 1.0

    first = float(Falling().net[3].bias.detach())
    fit(Falling(), config(tmp_path, steps=12, ema_decay=0.5))
    mean, mean_seen = first - 0.1, seen[0]
    for count in range(1, 12):
        kept = min(0.5, (1 + count) / (10 + count))
        mean = kept * mean + (1 - kept) * (first - 0.1 * (count + 1))
        mean_seen = kept * mean_seen + (1 - kept) * seen[count]
    assert float(weights(tmp_path)["module.3.bias"]) == pytest.approx(mean, abs=1e-6)
    torch.testing.assert_close(weights(tmp_path)["module.1.running_mean"], mean_seen)


def test_nets_learn_in_training_mode_and_are_judged_in_evaluation(tmp_path: Path) -> None:
    modes: dict[str, set[bool]] = {"loss": set(), "validate": set()}

    class Watched(Line):
        def loss(self, net: nn.Module, batch: dict[str, Any]) -> dict[str, Tensor]:
            modes["loss"].add(net.training)
            return super().loss(net, batch)

        def validate(self, net: nn.Module) -> dict[str, float]:
            modes["validate"].add(net.training)
            assert not torch.is_grad_enabled()
            return super().validate(net)

    fit(Watched(), config(tmp_path))
    assert modes == {"loss": {True}, "validate": {False}}
