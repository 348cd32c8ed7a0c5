"""Recognisers trained on simulated maps of everyday motion and tested on real films of known activity."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.config import ACTIVITIES, SimulationConfig
from tensorsim.config.documents import digest
from tensorsim.errors import TensorsimError, collected_warnings
from tensorsim.evaluation.labelled_films import FilmReader, LabelledFilm, Scene, read_labels
from tensorsim.experiments.work import Work
from tensorsim.files import check_folder, complete_file, sha256_of_arrays
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.recognition import ActivityRecognizer
from tensorsim.recognition.networks import find_classifier
from tensorsim.recognition.timeline import windows_of
from tensorsim.registry import locate, shipped_weights
from tensorsim.streaming import maps_of_pose, within_reach
from tensorsim.training.classifier import RANGE_DB, mean_both_ways
from tensorsim.training.everyday_classifier import EverydayRecipe
from tensorsim.training.everyday_maps import EverydaySettings, EverydayStore, build_everyday
from tensorsim.training.loop import LoopConfig, fit

#: Networks that process the films.
WATCHERS = ("RTMDet", "HRNet", "TemporalLifter")

#: Configurations of the scenes.
SCENES = {"free-space": SimulationConfig.free_space(), "through-wall": SimulationConfig.through_wall()}


class FilmPictures(NamedTuple):
    """Simulated maps of a film as input of a network.

    Attributes:
        accept: the activities that are right.
        windows: for each scene, the windows of four seconds (W, 1, size, size) in [0, 1]; W is 0 if the simulation
            refuses the motion.
    """

    accept: tuple[str, ...]
    windows: dict[str, Tensor]


@dataclass(frozen=True)
class EverydayTraining:
    """A training on maps of everyday motion.

    Attributes:
        maps: folder of the maps; missing ones are made.
        groups: number of groups of maps, every fifth for validation.
        size: height and width of the pictures: 32 or 64.
        steps: batches of 64.
        made: settings of the maps to make if the folder has none yet.
        quiet: no progress bar.
    """

    maps: Path
    groups: int
    size: int
    steps: int
    made: EverydaySettings = field(default_factory=EverydaySettings)
    quiet: bool = False

    @cached_property
    def store(self) -> EverydayStore:
        """The maps, read once for all trainings."""
        build_everyday(self.maps, self.groups, self.settings, quiet=self.quiet)
        return EverydayStore(self.maps, range(self.groups))

    @property
    def settings(self) -> EverydaySettings:
        """Settings of the maps: those of existing ones, else of the ones to make.

        Raises:
            TensorsimError: the folder has maps of another kind, or with pictures whose size is not a multiple of
                ``size``.
        """
        check_folder(self.maps, "--maps")
        there = (self.maps / "settings.json").is_file()
        settings = EverydaySettings.read(self.maps) if there else self.made
        if settings.size % self.size:
            raise TensorsimError(
                f"size: got {self.size}, expected a divisor of the {settings.size} of the maps in {self.maps}"
            )
        return settings

    @cached_property
    def digest(self) -> str:
        """Digest of the content of the maps."""
        store = self.store
        return sha256_of_arrays(store.power.numpy(), store.activity.numpy(), store.filmed.numpy())


def described(film: LabelledFilm) -> tuple[str, int, float, float]:
    """What identifies a part of a film: name, size of the file, start and end in seconds."""
    return film.path.name, film.path.stat().st_size, film.start_s, film.end_s


def film_pictures(folder: Path, size: int, work: Work, count: int = 0) -> list[FilmPictures]:
    """Pictures of the films in a folder with ``labels.json``, by the shipped networks; kept in the cache.

    Args:
        folder: folder of the films.
        size: height and width of the pictures.
        work: cache and progress.
        count: number of films, from the first of the folder; 0 is all.

    Raises:
        TensorsimError: the folder has no valid ``labels.json``.
    """
    from safetensors.torch import load_file, save_file

    films = read_labels(folder)[: count or None]
    settings = {
        "films": [described(film) for film in films], "size": size, "weights": shipped_weights(*WATCHERS),
    }  # fmt: skip
    path = work.cache / "results" / f"films-{digest(settings)}.safetensors"
    if not path.is_file():
        with complete_file(path) as scratch:
            save_file(_made(films, size, work), scratch)
    stored = load_file(path)
    return [
        FilmPictures(film.accept, {scene: stored[f"{scene}/{k}"] for scene in SCENES})
        for k, film in enumerate(films)
    ]


@torch.inference_mode()
def _made(films: list[LabelledFilm], size: int, work: Work) -> dict[str, Tensor]:
    networks = locate(None, "RTMDet"), locate(None, "HRNet")
    stage = VideoToPose.from_config(SimulationConfig()).eval()
    reader = FilmReader(stage, networks, work.cache / "films")
    cpu, speed_m_s = torch.device("cpu"), EverydaySettings().speed_m_s
    scenes = {
        scene: Scene(
            PoseToDoppler.from_config(config),
            ActivityRecognizer(config.scene.radar, nn.Identity(), "doppler", size, speed_m_s, RANGE_DB),
        )
        for scene, config in SCENES.items()
    }
    made = {}
    for k, film in enumerate(tqdm(films, desc="films", unit="film", disable=work.quiet)):
        with collected_warnings():  # `tensorsim evaluate films` prints them
            video = reader.open(film)
            found = reader.people(film, video, cpu, quiet=True)
            for name, scene in scenes.items():
                torch.manual_seed(0)  # for the receiver's noise
                shown = [torch.zeros(0, 1, size, size)]
                # Motion too fast for the radar gives no map and counts as wrong.
                with suppress(TensorsimError):
                    pose = within_reach(found, scene.stage.simulator.radar).pose
                    maps = maps_of_pose(scene.stage, pose, video.fps, cpu, quiet=True)
                    parts = windows_of(maps, pose.valid.shape[2] / video.fps)
                    shown += [scene.recognizer.picture(part)[None] for _, _, part in parts]
                made[f"{name}/{k}"] = torch.cat(shown)
    return made


def film_accuracy(
    name: str, seed: int, training: EverydayTraining, films: list[FilmPictures], work: Work
) -> dict[str, float]:
    """Train a network and label the films.

    Returns:
        For each scene, the share of correct labels on held-out clips as the pipeline finds them in films, and on real
        films.
    """
    recipe = EverydayRecipe(name, training.store, training.size, seed, learning_rate=1e-3)
    settings = {
        "network": name,
        "seed": seed,
        "maps": training.digest,
        "size": training.size,
        "steps": training.steps,
    }
    loop = LoopConfig(
        work.cache / "trials" / f"everyday-{name}-{digest(settings)}",
        steps=training.steps,
        batch=64,
        seed=seed,
        workers=0,
        precision="float32",  # bfloat16 gradients of depthwise convolutions are sometimes NaN
        checkpoint_every=min(50, training.steps),
        validate_every=training.steps,
        ema_decay=0.0,  # use the last weights, not their average
        quiet=work.quiet,
        events=False,
    )
    fit(recipe, loop)
    found = recipe.validate(recipe.net.eval())
    shares = {f"{scene} clips": found[f"{scene} filmed"] for scene in SCENES}
    return shares | {f"{scene} films": right_share(recipe.net, films, scene) for scene in SCENES}


@torch.no_grad()
def right_share(net: nn.Module, films: list[FilmPictures], scene: str) -> float:
    """Share of films whose most probable activity, averaged over windows and both Doppler directions, is right."""
    right = 0
    for film in films:
        windows = film.windows[scene]
        if len(windows) == 0:
            continue
        logits = mean_both_ways(net, windows)
        right += ACTIVITIES[int(logits.softmax(-1).mean(0).argmax())] in film.accept
    return right / len(films)


def titled(results: Mapping[str, list[dict[str, float]]]) -> list[list[Any]]:
    """Rows of the table: network, then the mean of each share over the trainings in percent."""
    rows: list[list[Any]] = []
    for name, trained in results.items():
        keys = [f"{scene} {kind}" for kind in ("clips", "films") for scene in SCENES]
        means = [100 * sum(each[key] for each in trained) / len(trained) for key in keys]
        rows.append([find_classifier(name).title, *means])
    return sorted(rows, key=lambda row: -(row[3] + row[4]))
