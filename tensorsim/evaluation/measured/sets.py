"""The measured sets: what each needs of the simulation, of its folder and of the network."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured import glasgow, radhar, sense2gol
from tensorsim.evaluation.measured.training import Augment
from tensorsim.files import reading

#: Clips that are simulated at once.
_CHUNK = 10


@dataclass(frozen=True)
class MeasuredSet:
    """A measured set and its simulation.

    Attributes:
        name: its folder, and its name in the results.
        file: what is read in that folder.
        classes: names in the order of the labels.
        subset: classes of the figure for a part of them.
        simulator: of some effects, makes something with ``simulate(label, count, generator)`` -> maps (count, H, W).
        effects: dataclass of what the simulation has beside bodies that move, each a bool.
        read: folder -> maps (N, H, W) and labels (N,).
        pictures: maps -> pictures (N, 1, rows, columns).
        augment: changes of pictures in training.
        weights: name of the shipped weights.
        augment_measured: changes of measured pictures in training.
    """

    name: str
    file: str
    classes: tuple[str, ...]
    subset: tuple[str, ...]
    simulator: Callable[[Any], "Simulator"]
    effects: type
    read: Callable[[Path], tuple[Tensor, Tensor]]
    pictures: Callable[[Tensor], Tensor]
    augment: Augment
    weights: str
    augment_measured: Augment

    def load(self, folder: Path) -> tuple[Tensor, Tensor]:
        """Pictures (N, 1, H, W) and labels (N,) of this set in a folder of measured sets.

        Raises:
            TensorsimError: the file is not there, is damaged, or holds no clips.
        """
        path = folder / self.name / self.file
        if not path.is_file():
            raise TensorsimError(f"{path}: no such file, expected the measured clips of {self.name}")
        with reading(path, f"the measured clips of {self.name}"):
            maps, labels = self.read(path.parent)
        if len(labels) == 0:
            raise TensorsimError(f"{path}: got no clips, expected at least one")
        return self.pictures(maps), labels

    @property
    def effect_names(self) -> tuple[str, ...]:
        """What can be left out of the simulation."""
        return tuple(field.name for field in dataclasses.fields(self.effects))

    def simulate(
        self, clips: int, seed: int, quiet: bool, without: str | None = None
    ) -> tuple[Tensor, Tensor]:
        """Simulated pictures (N, 1, H, W) and labels (N,), ``clips`` of each class, perhaps without an effect."""
        simulator = self.simulator(self.effects(**({} if without is None else {without: False})))
        shown, labels = [], []
        bar = tqdm(total=clips * len(self.classes), desc=f"{self.name}: simulated", disable=quiet)
        for label in range(len(self.classes)):
            generator = torch.Generator().manual_seed(1000 * seed + label)
            for first in range(0, clips, _CHUNK):
                count = min(_CHUNK, clips - first)
                with torch.no_grad():
                    shown.append(self.pictures(simulator.simulate(label, count, generator)))
                labels.append(torch.full((count,), label))
                bar.update(count)
        bar.close()
        return torch.cat(shown), torch.cat(labels)


class Simulator(Protocol):
    """What ``MeasuredSet.simulator`` makes."""

    def simulate(self, label: int, count: int, generator: torch.Generator) -> Tensor:
        """Maps (count, H, W) of a class."""
        ...  # pragma: no cover


SETS: tuple[MeasuredSet, ...] = (
    MeasuredSet(
        "glasgow_cfar_masks",
        "masks.npz",
        glasgow.CLASSES,
        ("walking", "sitting_down", "standing_up", "falling"),
        glasgow.Glasgow,
        glasgow.Effects,
        glasgow.read,
        glasgow.pictures,
        glasgow.augment,
        "measured-glasgow",
        glasgow.augment_measured,
    ),
    MeasuredSet(
        "kmkim_cw24_iq",
        "clips.npz",
        sense2gol.CLASSES,
        ("walk", "run", "creep"),
        sense2gol.Sense2Gol,
        sense2gol.Effects,
        sense2gol.read,
        sense2gol.pictures,
        sense2gol.augment,
        "measured-kmkim",
        sense2gol.augment,
    ),
    MeasuredSet(
        "radhar_points",
        "maps.npz",
        radhar.CLASSES,
        ("boxing", "squats", "walk"),
        radhar.RadHar,
        radhar.Effects,
        radhar.read,
        radhar.pictures,
        radhar.augment,
        "measured-radhar",
        radhar.augment,
    ),
)
