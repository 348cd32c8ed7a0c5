"""Recognisers: their accuracy in both scenes, against noise, and by kind of input."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError, check_count, check_distinct
from tensorsim.experiments import figures
from tensorsim.experiments.pictures import INPUTS
from tensorsim.experiments.trials import Trial, run_trials
from tensorsim.experiments.work import Report, Table, Work, check_scenes, counted, mean_and_spread
from tensorsim.recognition.networks import CLASSIFIERS, find_classifier
from tensorsim.training.classifier import check_ratios
from tensorsim.training.maps import SCENES

#: The networks of the paper's comparison in its order; the paper shows confusion matrices only.
PAPER_ORDER = ("adfe-net", "mrw-cn", "mc-gclu", "diat-radharnet", "ccln", "spnet")
#: All but the three wider versions of SPGNet, which take two minutes per epoch on one core.
USUAL = tuple(name for name in CLASSIFIERS if not name.startswith("spgnet-"))
RATIOS_DB = (50.0, 40.0, 30.0, 20.0, 10.0)


@dataclass(frozen=True)
class NetworksConfig:
    """Settings of the experiments ``networks`` and ``snr``.

    Attributes:
        networks: names of recognisers.
        scenes: names of radar presets.
        clips: training clips per class; every fifth person is for validation.
        test_clips: test clips per class, of other people.
        size: height and width of the pictures.
        epochs: passes over the training clips.
        seeds: number of trainings, with different initial weights and order of the clips.
        snr_db: signal-to-noise ratios of the tests; training is at 50 dB.
    """

    networks: tuple[str, ...] = USUAL
    scenes: tuple[str, ...] = SCENES
    clips: int = 300
    test_clips: int = 60
    size: int = 64
    epochs: int = 20
    seeds: int = 3
    snr_db: tuple[float, ...] = RATIOS_DB

    def __post_init__(self) -> None:
        check_trainings(self.networks, self.scenes, self.seeds)
        check_ratios(self.snr_db)
        for trial in self.trials():
            trial.check()

    def trials(self) -> list[Trial]:
        """All trainings, seed after seed, so that an interrupted run has all networks of some seeds."""
        return [
            Trial(name, scene, "doppler", self.clips, self.test_clips, self.size, self.epochs, seed=seed)
            for seed in range(self.seeds)
            for scene in self.scenes
            for name in self.networks
        ]


@dataclass(frozen=True)
class InputsConfig:
    """Settings of the experiment ``inputs``; see :class:`NetworksConfig`.

    Attributes:
        inputs: kinds of pictures, from ``doppler``, ``range``, ``ridges``, ``merged``.
    """

    networks: tuple[str, ...] = ("spnet", "spgnet", "ccln")
    scenes: tuple[str, ...] = ("through-wall",)
    inputs: tuple[str, ...] = tuple(INPUTS)
    clips: int = 300
    test_clips: int = 60
    size: int = 64
    epochs: int = 20
    seeds: int = 3

    def __post_init__(self) -> None:
        check_trainings(self.networks, self.scenes, self.seeds)
        if not self.inputs:
            raise TensorsimError("inputs: got none, expected at least one")
        check_distinct(self.inputs, "inputs")
        for trial in self.trials():
            trial.check()

    def trials(self) -> list[Trial]:
        """All trainings, seed after seed."""
        return [
            Trial(name, scene, inputs, self.clips, self.test_clips, self.size, self.epochs, seed=seed)
            for seed in range(self.seeds)
            for scene in self.scenes
            for inputs in self.inputs
            for name in self.networks
        ]


def check_networks(networks: Sequence[str]) -> None:
    """Refuse unknown names, duplicates, and an empty list."""
    for name in networks:
        find_classifier(name)
    check_count(len(networks), "networks")
    check_distinct(networks, "networks")


def check_trainings(networks: Sequence[str], scenes: Sequence[str], seeds: int) -> None:
    """Refuse unknown or duplicate networks and scenes, empty lists of them, and fewer than one training."""
    check_networks(networks)
    check_scenes(scenes)
    check_count(seeds, "seeds")


def protocol(clips: int, test_clips: int, size: int, epochs: int, seeds: int) -> str:
    """The description of the protocol given with a table of accuracies."""
    return (
        f"{counted(clips, 'clip')} per class in {size}x{size} pixels, split 8:2 by person into training and validation "
        f"(the epoch with the lowest validation loss is kept); accuracy is counted on {counted(test_clips, 'clip')} "
        "per class of people who took no part in that. Adam 1.47e-3, a tenth of it in the second half, L2 1e-4, batch "
        f"64, {counted(epochs, 'epoch')}, 50 dB; {counted(seeds, 'training')} each, spread is the standard deviation "
        "between them. Each picture is in dB below its own peak, cut at 40 dB. The paper trains once on 300 clips per "
        "class of 224x224 pixels and gives confusion matrices of its validation clips as pictures, without numbers; "
        "it says neither how its clips are split over people nor how its pictures are scaled."
    )


def accuracy(result: dict[str, Any], ratio: float) -> float:
    """Share of correct labels at a ratio in dB, in percent."""
    counts = torch.tensor(result["confusion"][f"{ratio:g}"])
    return float(100 * counts.diagonal().sum() / counts.sum())


def multiply_adds(network: nn.Module, channels: int, size: int) -> float:
    """Millions of multiply-adds for one picture, without Fourier transforms."""
    from torch.utils.flop_counter import FlopCounterMode

    # In float64: in float32 an LSTM is a single oneDNN operation, which is counted as zero.
    network = copy.deepcopy(network).double().eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network(torch.zeros(1, channels, size, size, dtype=torch.float64))
    return counter.get_total_flops() / 2e6


def networks_report(config: NetworksConfig, work: Work) -> Report:
    """Table of the networks in both scenes at the highest ratio, with their cost, and their confusion matrices."""
    trials = config.trials()
    results = dict(zip(trials, run_trials(trials, config.snr_db, work), strict=True))
    ratio = max(config.snr_db)

    def found(name: str, scene: str) -> list[float]:
        return [accuracy(r, ratio) for t, r in results.items() if (t.network, t.scene) == (name, scene)]

    rows: list[list[Any]] = []
    shown: dict[str, dict[str, tuple[float, float]]] = {}
    for name in config.networks:
        entry = find_classifier(name)
        network = entry.build(len(ACTIVITIES), 1, config.size)
        means = {scene: mean_and_spread(found(name, scene)) for scene in config.scenes}
        seconds = [r["training_s"] for t, r in results.items() if t.network == name]
        place = str(PAPER_ORDER.index(name) + 1) if name in PAPER_ORDER else "-"
        row = [entry.title, *(x for scene in config.scenes for x in means[scene])]
        count = sum(p.numel() for p in network.parameters()) / 1e6
        cost = multiply_adds(network, 1, config.size)
        rows.append([*row, round(count, 3), cost, sum(seconds) / len(seconds), place, entry.origin])
        shown[entry.title] = means
    rows.sort(key=lambda row: -row[1])
    shown = {row[0]: shown[row[0]] for row in rows}
    heads = [f"{scene}{part} %" for scene in config.scenes for part in ("", ", spread")]
    columns = [
        "network", *heads, "million parameters", "million multiply-adds", "training s",
        "place in the paper's list", "layers",
    ]  # fmt: skip
    title = f"Accuracy on new people at {ratio:g} dB"
    report_figures = {"accuracy": figures.bars(shown, "accuracy on new people, %", title)}
    names = [name.split(" ")[0] for name in ACTIVITIES]
    for scene in config.scenes:
        total = {
            find_classifier(name).title: sum(
                torch.tensor(r["confusion"][f"{ratio:g}"])
                for t, r in results.items()
                if (t.network, t.scene) == (name, scene)
            ).numpy()  # type: ignore[union-attr]
            for name in config.networks
        }
        report_figures[f"confusion-{scene}"] = figures.confusions(total, names, f"{scene}, {ratio:g} dB")
    notes = [protocol(config.clips, config.test_clips, config.size, config.epochs, config.seeds)]
    return Report(notes, [Table(title, columns, rows), _seeds_table(results, ratio)], report_figures)


def _seeds_table(results: dict[Trial, dict[str, Any]], ratio: float) -> Table:
    rows = [
        [
            find_classifier(t.network).title,
            t.scene,
            t.seed,
            accuracy(r, ratio),
            100 * r["validation"],
            r["epoch"],
        ]
        for t, r in results.items()
    ]
    columns = ["network", "scene", "seed", "test %", "validation %", "epoch kept"]
    return Table("Every training", columns, rows, file="trainings")


def snr_report(config: NetworksConfig, work: Work) -> Report:
    """Accuracy against the signal-to-noise ratio, the mean of all seeds."""
    trials = config.trials()
    results = dict(zip(trials, run_trials(trials, config.snr_db, work), strict=True))
    ratios = sorted(config.snr_db, reverse=True)
    tables, drawn = [], {}
    for scene in config.scenes:
        rows: list[list[Any]] = []
        curves: dict[str, list[float]] = {}
        for name in config.networks:
            of_network = [r for t, r in results.items() if (t.network, t.scene) == (name, scene)]
            numbers = [mean_and_spread([accuracy(r, ratio) for r in of_network]) for ratio in ratios]
            rows.append([find_classifier(name).title, *(x for pair in numbers for x in pair)])
            curves[find_classifier(name).title] = [mean for mean, _ in numbers]
        rows.sort(key=lambda row: -sum(row[1::2]))
        columns = ["network", *(f"{ratio:g} dB{part}" for ratio in ratios for part in ("", ", spread"))]
        tables.append(Table(f"Accuracy in % against noise, {scene}", columns, rows, file=scene))
        drawn[scene] = figures.lines(
            curves, ratios, "signal-to-noise ratio per sample, dB", "accuracy on new people, %", scene
        )
        drawn[scene].axes[0].invert_xaxis()
    notes = [
        protocol(config.clips, config.test_clips, config.size, config.epochs, config.seeds),
        "Training is at 50 dB, as in the paper; the test clips are the same at every ratio. The ratio is that of the "
        "people's echo to the noise in a sample of the intermediate frequency; the paper does not say what its ratio "
        "refers to.",
    ]
    return Report(notes, tables, drawn)


def inputs_report(config: InputsConfig, work: Work) -> Report:
    """Accuracy by kind of input."""
    trials = config.trials()
    results = dict(zip(trials, run_trials(trials, (50.0,), work), strict=True))
    rows, shown = [], {}
    for scene in config.scenes:
        for inputs in config.inputs:
            groups = {}
            for name in config.networks:
                chosen = (name, scene, inputs)
                values = [
                    accuracy(r, 50.0) for t, r in results.items() if (t.network, t.scene, t.inputs) == chosen
                ]
                groups[find_classifier(name).title] = mean_and_spread(values)
            rows.append([inputs, scene, *(x for pair in groups.values() for x in pair)])
            shown[f"{inputs}, {scene}"] = groups
    columns = ["input", "scene"]
    columns += [
        f"{find_classifier(name).title}{part} %" for name in config.networks for part in ("", ", spread")
    ]
    notes = [
        protocol(config.clips, config.test_clips, config.size, config.epochs, config.seeds),
        "`doppler` is the Doppler-time map, `range` the range-time map after the moving target indicator, `ridges` "
        "the three ridges alone, `merged` both maps as two channels.",
    ]
    title = "Accuracy on new people by input"
    return Report(
        notes, [Table(title, columns, rows)], {"accuracy": figures.bars(shown, "accuracy, %", title)}
    )


def quick_networks() -> NetworksConfig:
    """Five networks for one epoch, to check that everything works; the accuracies are meaningless."""
    networks = ("spnet", "spgnet", "adfe-net", "ccln", "diat-radharnet")
    return NetworksConfig(networks, ("through-wall",), clips=5, test_clips=2, size=32, epochs=1, seeds=1)


def quick_inputs() -> InputsConfig:
    """One network for one epoch, as a check like :func:`quick_networks`."""
    return replace(InputsConfig(), networks=("ccln",), clips=5, test_clips=2, size=32, epochs=1, seeds=1)
