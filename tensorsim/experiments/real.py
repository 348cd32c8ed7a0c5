"""Every recogniser trained on simulation and tested on measured radar and on real films."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.config.documents import digest
from tensorsim.errors import TensorsimError, check_count, check_seed
from tensorsim.evaluation.labelled_films import read_labels
from tensorsim.evaluation.measured.sets import SETS, MeasuredSet
from tensorsim.evaluation.measured.training import fit_pictures, predict, square
from tensorsim.experiments import figures
from tensorsim.experiments.networks import USUAL, check_networks
from tensorsim.experiments.real_films import (
    SCENES,
    WATCHERS,
    EverydayTraining,
    described,
    film_accuracy,
    film_pictures,
    titled,
)
from tensorsim.experiments.work import Report, Table, Work, counted, mean_and_spread
from tensorsim.files import complete_file, sha256_of
from tensorsim.recognition.networks import find_classifier
from tensorsim.registry import shipped_weights
from tensorsim.training.everyday_maps import EverydaySettings


@dataclass(frozen=True)
class RealConfig:
    """Settings of ``real``.

    Attributes:
        data: folder of measured sets (glasgow_cfar_masks, kmkim_cw24_iq, radhar_points); "" leaves them out.
        films: folder of real films with labels.json; "" leaves them out. At least one of both must be given.
        maps: folder of simulated maps of everyday motion, to train on for films; "" is one in the cache.
        groups: number of groups of these maps; a group has some 100 clips and takes 10 s if it must be made.
        group_clips: clips per activity in a newly made group: as the pipeline finds them in films, and of the true
            motion.
        film_count: number of films to label, from the first of the folder; 0 is all.
        film_steps: batches of 64 of each training for films.
        networks: names of recognisers.
        clips: simulated clips of each class.
        size: height and width of the pictures.
        steps: batches of 64 of each training.
        seeds: number of trainings, with different initial weights and order.
        film_seeds: the same for films.
        seed: seed of the simulated clips.
    """

    data: str = ""
    films: str = ""
    maps: str = ""
    groups: int = 80
    group_clips: tuple[int, int] = (6, 3)
    film_count: int = 0
    film_steps: int = 1000
    networks: tuple[str, ...] = USUAL
    clips: int = 300
    size: int = 64
    steps: int = 600
    seeds: int = 3
    film_seeds: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        check_networks(self.networks)
        for what, count, least in (
            ("clips", self.clips, 1), ("steps", self.steps, 1),
            ("seeds", self.seeds, 1), ("film_seeds", self.film_seeds, 1), ("groups", self.groups, 5),
            ("film_steps", self.film_steps, 1), ("film_count", self.film_count, 0),
        ):  # fmt: skip
            check_count(count, what, least)
        check_seed(self.seed, "seed")
        if len(self.group_clips) != 2:
            raise TensorsimError(
                f"group_clips: got {list(self.group_clips)}, expected two numbers: of clips as the pipeline finds "
                "them, and of clips of the true motion"
            )
        EverydaySettings(filmed=self.group_clips[0], true=self.group_clips[1])
        if self.size < 32 or self.size % 16:
            raise TensorsimError(f"size: got {self.size}, expected a multiple of 16, at least 32")
        if self.films and self.size not in (32, 64):
            raise TensorsimError(f"size: got {self.size} with films, expected 32 or 64")

    def sets(self) -> list[MeasuredSet]:
        """The sets that the folder contains.

        Raises:
            TensorsimError: neither it nor a folder of films is given, or the folder has none of the sets.
        """
        if not self.data:
            if self.films:
                return []
            raise TensorsimError(
                "--data, --films: got nothing, expected a folder of measured sets or of real films"
            )
        found = [measured for measured in SETS if (Path(self.data) / measured.name).is_dir()]
        if not found:
            names = ", ".join(measured.name for measured in SETS)
            raise TensorsimError(
                f"--data: {self.data} has none of the measured sets, expected some of {names}"
            )
        return found

    def unused(self) -> dict[str, str]:
        """Settings without effect, and the missing folder that each belongs to."""
        of = {
            "data": ("clips", "steps", "seeds", "seed"),
            "films": ("maps", "groups", "group_clips", "film_count", "film_steps", "film_seeds"),
        }
        return {
            name: f"--{folder}" for folder, names in of.items() if not getattr(self, folder) for name in names
        }

    def everyday(self, work: Work) -> EverydayTraining:
        """The training for films."""
        filmed, true = self.group_clips
        made = EverydaySettings(filmed=filmed, true=true)
        maps = Path(self.maps) if self.maps else work.cache / f"everyday-maps-{digest(made)}"
        return EverydayTraining(maps, self.groups, self.size, self.film_steps, made, work.quiet)

    def check(self, work: Work) -> None:
        """Refuse folders with unexpected content before hours of training.

        Raises:
            TensorsimError: states what a folder has and what was expected.
        """
        for measured in self.sets():
            measured.load(Path(self.data))
        if self.films:
            read_labels(Path(self.films))
            _ = self.everyday(work).settings


def real_report(config: RealConfig, work: Work) -> Report:
    """Accuracy on measured clips, by set, of networks never trained on measured clips, and on real films."""
    config.check(work)
    sets = config.sets()
    reports = [_on_measured(config, sets, work)] if sets else []
    if config.films:
        reports.append(_on_films(config, work))
    notes = [note for report in reports for note in report.notes]
    tables = [table for report in reports for table in report.tables]
    return Report(notes, tables, {name: f for report in reports for name, f in report.figures.items()})


def _on_measured(config: RealConfig, sets: list[MeasuredSet], work: Work) -> Report:
    jobs = [(s, name, seed) for s in sets for seed in range(config.seeds) for name in config.networks]
    found: dict[tuple[str, str], list[float]] = {}
    for measured, name, seed in tqdm(jobs, desc="real", unit="training", disable=work.quiet):
        settings = {
            "set": measured.name, "network": name, "clips": config.clips, "size": config.size, "steps": config.steps,
            "weights_seed": seed, "seed": config.seed, "data": _identity(Path(config.data), measured),
        }  # fmt: skip

        def make(measured: MeasuredSet = measured, name: str = name, seed: int = seed) -> dict[str, Any]:
            return _trained_and_tested(config, measured, name, seed, work)

        accuracy = work.kept("real", settings, make)["accuracy"]
        found.setdefault((name, measured.name), []).append(100 * accuracy)
    means = {key: mean_and_spread(values) for key, values in found.items()}
    rows: list[list[Any]] = []
    for name in config.networks:
        numbers = [means[name, measured.name] for measured in sets]
        rows.append([find_classifier(name).title, *(x for pair in numbers for x in pair)])
    rows.sort(key=lambda row: -sum(row[1::2]))
    shown = {
        find_classifier(name).title: {measured.name: means[name, measured.name] for measured in sets}
        for name in config.networks
    }
    columns = ["network", *(f"{measured.name}{part} %" for measured in sets for part in ("", ", spread"))]
    shares = []
    for measured in sets:
        labels = measured.load(Path(config.data))[1].tolist()
        answer, share = best_constant([(measured.classes[label],) for label in labels])
        shares.append(
            f"{measured.name} {100 / len(measured.classes):.0f} % and {100 * share:.0f} % ({answer})"
        )
    notes = [
        f"Trained on {counted(config.clips, 'simulated clip')} of each class in {config.size}x{config.size} pixels, "
        f"{config.steps} batches of 64 (AdamW, one cycle), {counted(config.seeds, 'training')} each; tested on all "
        f"measured clips of {config.data}. An answer at random, and always the most frequent class, are right in: "
        f"{', '.join(shares)}. The ranges of the simulation were set while looking at recordings of these sets, so "
        "these are development figures. The paper's measured maps are not published.",
    ]
    title = "Accuracy on measured radar, trained on simulation alone"
    return Report(
        notes, [Table(title, columns, rows)], {"accuracy": figures.bars(shown, "accuracy, %", title)}
    )


def _on_films(config: RealConfig, work: Work) -> Report:
    """Real films labelled by networks that are all trained on the same maps of everyday motion."""
    films = film_pictures(Path(config.films), config.size, work, config.film_count)
    labelled = [
        (*described(film), film.accept)
        for film in read_labels(Path(config.films))[: config.film_count or None]
    ]
    training = config.everyday(work)
    jobs = [(name, seed) for seed in range(config.film_seeds) for name in config.networks]
    results: dict[str, list[dict[str, float]]] = {name: [] for name in config.networks}
    for name, seed in tqdm(jobs, desc="films", unit="training", disable=work.quiet):
        settings = {
            "films": labelled,
            "maps": training.digest, "size": config.size, "steps": config.film_steps,
            "network": name, "seed": seed, "weights": shipped_weights(*WATCHERS),
        }  # fmt: skip
        results[name].append(
            work.kept("real-films", settings, partial(film_accuracy, name, seed, training, films, work))
        )
    answer, share = best_constant([film.accept for film in films])
    chance = sum(len(film.accept) for film in films) / (len(ACTIVITIES) * len(films))
    rows = titled(results)
    columns = ["network", *(f"{scene} {kind} %" for kind in ("clips", "films") for scene in SCENES)]
    notes = [
        f"Films: trained on {config.groups} groups of simulated maps of everyday motion in {config.size}x{config.size} "
        f"pixels, {config.film_steps} batches of 64 (AdamW, cosine), {counted(config.film_seeds, 'training')} each. "
        f"`clips` are held-out ones of the same kind, as the pipeline finds them in films, `films` the {len(films)} of "
        f"{config.films}: people found by the shipped networks, camera estimated. One film is {100 / len(films):.0f} "
        f"points; an answer at random is right in {100 * chance:.0f} %, and always {answer}, the best constant answer, "
        f"in {100 * share:.1f} %. The films of this project were looked at while the pipeline was developed."
    ]
    title = "Accuracy on real films, trained on simulation alone"
    shown = {row[0]: {scene: (row[3 + k], float("nan")) for k, scene in enumerate(SCENES)} for row in rows}
    return Report(
        notes,
        [Table(title, columns, rows, file="films")],
        {"films": figures.bars(shown, "accuracy, %", title)},
    )


def best_constant(accepted: Sequence[Sequence[str]]) -> tuple[str, float]:
    """The constant answer that is right most often, and the share of clips for which it is right.

    Args:
        accepted: for each clip, the answers that are right.
    """
    answer, count = Counter(name for names in accepted for name in dict.fromkeys(names)).most_common(1)[0]
    return answer, count / len(accepted)


def _identity(data: Path, measured: MeasuredSet) -> list[Any]:
    path = data / measured.name / measured.file
    return [measured.name, sha256_of(path) if path.is_file() else ""]


def _trained_and_tested(
    config: RealConfig, measured: MeasuredSet, name: str, seed: int, work: Work
) -> dict[str, Any]:
    shown, labels = _simulated(config, measured, work)
    test, true = measured.load(Path(config.data))
    torch.manual_seed(seed)
    net = find_classifier(name).build(len(measured.classes), 1, config.size)

    def augment(pictures: Tensor, generator: torch.Generator) -> Tensor:
        return square(measured.augment(pictures, generator), config.size)

    net.get_buffer("mean").fill_(float(shown.float().mean()))
    fit_pictures(net, shown, labels, steps=config.steps, augment=augment, seed=seed)
    logits = predict(net, square(test, config.size))
    return {"accuracy": float((logits.argmax(1) == true).float().mean())}


def _simulated(config: RealConfig, measured: MeasuredSet, work: Work) -> tuple[Tensor, Tensor]:
    """Simulated pictures of a set and their labels, kept in the cache."""
    from safetensors.torch import load_file, save_file

    settings = {"set": measured.name, "clips": config.clips, "seed": config.seed}
    path = work.cache / "results" / f"simulated-{digest(settings)}.safetensors"
    if not path.is_file():
        shown, labels = measured.simulate(config.clips, config.seed, work.quiet)
        with complete_file(path) as scratch:
            save_file({"pictures": shown.contiguous(), "labels": labels}, scratch)
    stored = load_file(path)
    return stored["pictures"], stored["labels"]


def quick_real() -> RealConfig:
    """Two small networks on a few clips and three films; the folder of sets or films must still be given."""
    return RealConfig(
        groups=5, group_clips=(1, 1), film_count=3, film_steps=20, networks=("ccln", "diat-radharnet"), clips=4,
        size=32, steps=4, seeds=1, film_seeds=1,
    )  # fmt: skip
