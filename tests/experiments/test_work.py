import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tensorsim.config.documents import digest
from tensorsim.errors import TensorsimError
from tensorsim.experiments.ablations import EchoConfig
from tensorsim.experiments.catalogue import EXPERIMENTS, configuration, find_experiment, run_experiment
from tensorsim.experiments.networks import NetworksConfig, accuracy, multiply_adds
from tensorsim.experiments.work import Report, Table, Work, mean_and_spread


def test_names() -> None:
    expected = {
        "video-ablation",
        "echo-ablation",
        "denoiser-ablation",
        "networks",
        "snr",
        "inputs",
        "real",
        "paper",
    }
    assert expected <= set(EXPERIMENTS)
    with pytest.raises(TensorsimError, match=r"got 'netwroks', expected one of .*perhaps 'networks'"):
        find_experiment("netwroks")


def test_result_is_computed_once_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    work, calls = Work(tmp_path), []

    def make() -> dict[str, float]:
        calls.append(1)
        return {"x": math.inf, "n": len(calls)}

    assert work.kept("part", {"a": 1}, make) == work.kept("part", {"a": 1}, make) == {"x": math.inf, "n": 1}
    assert work.kept("part", {"a": 2}, make)["n"] == 2
    (tmp_path / "results" / f"part-{digest({'a': 1})}.json").write_text("{")
    with pytest.raises(TensorsimError, match=r"part-\w+\.json: damaged .*remove it"):
        work.kept("part", {"a": 1}, make)


def test_nothing_is_kept_of_a_result_that_fails(tmp_path: Path) -> None:
    def fail() -> dict[str, float]:
        raise TensorsimError("no")

    with pytest.raises(TensorsimError, match="no"):
        Work(tmp_path).kept("part", 1, fail)
    assert not list(tmp_path.rglob("*.json"))


def test_table_in_both_forms() -> None:
    table = Table("Title", ["name", "a dB", "b"], [["x", 1.234, None], ["y, z", math.inf, float("nan")]])
    assert table.markdown() == (
        "## Title\n\n| name | a dB | b |\n| --- | ---: | ---: |\n| x | 1.2 | - |\n| y, z | equal | - |\n"
    )
    assert table.csv() == 'name,a dB,b\nx,1.234,\n"y, z",inf,nan\n'


def test_mean_and_spread() -> None:
    assert mean_and_spread([1.0, 3.0]) == (2.0, pytest.approx(math.sqrt(2)))
    assert math.isnan(mean_and_spread([1.0])[1])
    assert math.isnan(mean_and_spread([])[0])


def test_settings_of_file_and_options(tmp_path: Path) -> None:
    quick = configuration("networks", True, None, {"networks": ("ccln", "spnet"), "seeds": 2})
    assert (quick.networks, quick.seeds, quick.size) == (("ccln", "spnet"), 2, 32)
    file = tmp_path / "own.yaml"
    file.write_text("experiment: networks\nclips: 7\nsnr_db: [20, 10]\n")
    own = configuration("networks", False, file, {"clips": 9})
    assert (own.clips, own.snr_db, own.epochs) == (9, (20.0, 10.0), NetworksConfig().epochs)
    for name, options, message in (
        (
            "echo-ablation",
            {"epochs": 3},
            "--epochs: echo-ablation has no such setting, expected --clips, --seed",
        ),
        ("networks", {"networks": ("resnet",)}, "network: got 'resnet', expected one of spnet"),
        ("networks", {"scenes": ("underwater",)}, "scenes: got 'underwater', expected one of free-space"),
        ("networks", {"seeds": 0}, "seeds: got 0, expected an integer of at least 1"),
        ("snr", {"snr_db": ()}, "snr_db: got no ratios"),
        ("snr", {"snr_db": (50.0, float("nan"))}, "snr_db: got nan, expected finite numbers of dB"),
        ("snr", {"snr_db": (50.0, 10.0, 50.0)}, "snr_db: got 50.0 twice, expected each once"),
        ("denoiser-ablation", {"snr_db": (float("inf"),)}, "snr_db: got inf, expected finite"),
        ("networks", {"networks": ("ccln", "ccln")}, "networks: got 'ccln' twice, expected each once"),
        ("real", {"networks": ("ccln", "ccln")}, "networks: got 'ccln' twice, expected each once"),
        ("networks", {"scenes": ("free-space", "free-space")}, "scenes: got 'free-space' twice"),
        ("inputs", {"inputs": ("doppler", "doppler")}, "inputs: got 'doppler' twice"),
        ("denoiser-ablation", {"denoisers": ("none", "none")}, "denoisers: got 'none' twice"),
        ("networks", {"size": 40}, "size: got 40, expected a multiple of 16"),
        ("inputs", {"epochs": 0}, "epochs, batch: got 0 and 64"),
        ("inputs", {"inputs": ("sound",)}, "inputs: got 'sound', expected one of doppler"),
        ("echo-ablation", {"clips": 1}, "clips: got 1, expected at least 2"),
        ("denoiser-ablation", {"clips": 0}, "clips: got 0"),
        ("video-ablation", {"activities": ("flying",)}, "flying"),
        ("video-ablation", {"length_s": 0.1}, "from 0.5 to 60 s"),
        ("real", {"film_seeds": 0}, "film_seeds: got 0, expected an integer of at least 1"),
        ("real", {"networks": ()}, "networks: got 0, expected an integer of at least 1"),
        ("real", {"group_clips": (6,)}, r"group_clips: got \[6\], expected two numbers"),
        ("real", {"group_clips": (0, 0)}, "expected positive numbers"),
        ("paper", {"maps": "maps"}, "--maps: has no effect without --films"),
        ("real", {"films": "films", "steps": 3}, "--steps: has no effect without --data"),
        ("real", {"data": "data", "film_seeds": 3}, "--film-seeds: has no effect without --films"),
        *(
            (name, {"seed": seed}, f"seed: got {seed}, expected an integer from 0 to 4294967295")
            for name in ("video-ablation", "echo-ablation", "denoiser-ablation", "real")
            for seed in (-1, 10**30)
        ),
        ("inputs", {"inputs": ()}, "inputs: got none"),
        ("video-ablation", {"scenes": ()}, "scenes: got none"),
        ("real", {"size": 40}, "size: got 40, expected a multiple of 16"),
    ):
        with pytest.raises(TensorsimError, match=message):
            configuration(name, False, None, options)
    with pytest.raises(TensorsimError, match="--quick, --config: got both"):
        configuration("networks", True, file, {})
    with pytest.raises(TensorsimError, match="settings of another experiment"):
        configuration("snr", False, file, {})


def test_several_processes_are_for_those_that_take_them(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="--jobs: got 2, expected 1: only networks, snr, inputs, paper"):
        run_experiment("echo-ablation", tmp_path / "out", EchoConfig(), Work(tmp_path, jobs=2))


def test_report_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tensorsim.experiments import catalogue, figures

    tables = [Table("One", ["a"], [["b"]]), Table("Two", ["a"], [["c"]], file="more")]

    def run(config: EchoConfig, work: Work) -> Report:
        assert config.clips == 3
        return Report(["Note."], tables, {"bars": figures.bars({"x": {"y": (1.0, 0.1)}}, "dB", "t")})

    entry = catalogue.Experiment("Title", EchoConfig, run, EchoConfig)
    monkeypatch.setitem(catalogue.EXPERIMENTS, "own", entry)
    out = tmp_path / "out"
    run_experiment("own", out, EchoConfig(clips=3), Work(out / "work"))
    names = sorted(path.name for path in out.iterdir())
    assert names == ["own-bars.png", "own-bars.svg", "own-more.csv", "own.csv", "own.md", "own.yaml"]
    assert configuration("own", False, out / "own.yaml", {}) == EchoConfig(clips=3)
    assert "# Title\n\nNote.\n\n## One" in (out / "own.md").read_text()

    # The other run has no second table and no figure; other files stay.
    others = [out / name for name in ("own-notes.txt", "owner-more.csv", "more.csv")]
    for path in others:
        path.write_text("kept")
    monkeypatch.setitem(
        catalogue.EXPERIMENTS, "own", replace(entry, run=lambda *_: Report(["Note."], tables[:1]))
    )
    run_experiment("own", out, EchoConfig(clips=3), Work(out / "work"))
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["own.csv", "own.md", "own.yaml", *(path.name for path in others)]
    )

    broken = catalogue.Experiment(
        "Title", EchoConfig, lambda c, w: Report([], tables, {"no": None}), EchoConfig
    )  # type: ignore[dict-item]
    monkeypatch.setitem(catalogue.EXPERIMENTS, "own", broken)
    with pytest.raises(AttributeError):
        run_experiment("own", tmp_path / "other", EchoConfig(clips=3), Work(out / "work"))
    assert not (tmp_path / "other").exists()


def test_accuracy_and_cost_of_a_network() -> None:
    counts = torch.zeros(12, 12, dtype=torch.int64)
    counts[0, 0], counts[1, 2] = 3, 1
    assert accuracy({"confusion": {"50": counts.tolist()}}, 50.0) == 75.0
    layer = torch.nn.Conv2d(1, 4, 3, padding=1)
    assert multiply_adds(layer, 1, 10) == pytest.approx(4 * 9 * 100 / 1e6)
    rows = torch.nn.Sequential(torch.nn.Flatten(1, 2), torch.nn.LSTM(10, 7, batch_first=True))
    assert multiply_adds(rows, 1, 10) == pytest.approx(10 * 4 * 7 * (10 + 7) / 1e6)


def test_figures_of_every_kind(tmp_path: Path) -> None:
    import numpy as np

    from tensorsim.experiments import figures
    from tensorsim.plot import save_figure

    with pytest.raises(TensorsimError, match="bars: got no values for a, expected at least one"):
        figures.bars({"a": {}}, "x", "t")
    matrices = {"a": np.eye(3, dtype=int), "b": np.ones((3, 3), dtype=int)}
    drawn = [
        figures.lines({"n": [1.0, 2.0]}, [50.0, 10.0], "x", "y", "t"),
        figures.confusions(matrices, ["S1", "S2", "S3"], "t"),
        figures.map_grid({"row": {"one": np.ones((4, 5)), "two": np.zeros((4, 5))}}, "t"),
    ]
    for k, figure in enumerate(drawn):
        save_figure(figure, tmp_path / f"{k}.png")
        assert (tmp_path / f"{k}.png").stat().st_size > 1000
    assert json.dumps(to_titles(drawn)) == json.dumps(
        [["t"], ["a: 100 %", "b: 33 %"], ["row: one", "row: two"]]
    )


def to_titles(drawn: list) -> list[list[str]]:  # type: ignore[type-arg]
    return [[axes.get_title() for axes in figure.axes if axes.get_title()] for figure in drawn]
