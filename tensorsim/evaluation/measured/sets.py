"""The measured sets: what each needs from the simulation, its folder and the network."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured import glasgow, radhar, sense2gol
from tensorsim.evaluation.measured.training import Augment
from tensorsim.files import reading

#: Clips simulated at once.
_CHUNK = 10


@dataclass(frozen=True)
class MeasuredSet:
    """A measured set and its simulation.

    Attributes:
        name: name of its folder, also used in the results.
        file: file in that folder, with the classes, label (N,) and an array of the clips.
        array: name of that array.
        shape: shape of each clip in it.
        classes: names in the order of the labels.
        subset: classes for which accuracy is also reported separately.
        simulator: effects -> an object with ``simulate(label, count, generator)`` -> maps (count, H, W).
        effects: dataclass of the effects of the simulation beyond moving bodies, each a bool.
        read: that array -> maps (N, H, W).
        pictures: maps -> pictures (N, 1, rows, columns).
        augment: augmentation of pictures in training.
        weights: name of the shipped weights.
        augment_measured: augmentation of measured pictures in training.
        ignored: classes of the file whose clips are ignored.
    """

    name: str
    file: str
    array: str
    shape: tuple[int, ...]
    classes: tuple[str, ...]
    subset: tuple[str, ...]
    simulator: Callable[[Any], "Simulator"]
    effects: type
    read: Callable[[npt.NDArray[Any]], Tensor]
    pictures: Callable[[Tensor], Tensor]
    augment: Augment
    weights: str
    augment_measured: Augment
    ignored: tuple[str, ...] = ()

    def load(self, folder: Path) -> tuple[Tensor, Tensor]:
        """Pictures (N, 1, H, W) and labels (N,) of this set in a folder of measured sets.

        Raises:
            TensorsimError: the file is missing or damaged, or holds no clips, clips of another shape or class, or
                unequal numbers of labels and clips.
        """
        path = folder / self.name / self.file
        if not path.is_file():
            raise TensorsimError(f"{path}: no such file, expected the measured clips of {self.name}")
        with (
            reading(path, f"the measured clips of {self.name}"),
            np.load(path) as file,
        ):
            clips, names, label = file[self.array], [str(name) for name in file["classes"]], file["label"]
            labels = self._labels(path, names, label)
        if clips.shape != (len(labels), *self.shape):
            raise TensorsimError(
                f"{path}: {self.array}: got shape {list(clips.shape)}, expected {[len(labels), *self.shape]}, a clip "
                "for each label"
            )
        seen = labels >= 0
        if not bool(seen.any()):
            raise TensorsimError(f"{path}: got no clips, expected at least one")
        return self.pictures(self.read(clips[seen.numpy()])), labels[seen]

    def _labels(self, path: Path, names: list[str], label: npt.NDArray[Any]) -> Tensor:
        """Labels (N,) renumbered from these names to the order of ``classes``; -1 for ignored ones."""
        for name in names:
            if name not in self.classes + self.ignored:
                known = ", ".join(self.classes + self.ignored)
                raise TensorsimError(f"{path}: classes: got {name!r}, expected some of {known}")
        if (
            label.ndim != 1
            or label.dtype.kind not in "iu"
            or bool(((label < 0) | (label >= len(names))).any())
        ):
            raise TensorsimError(
                f"{path}: label: got {label.dtype} of shape {list(label.shape)}, expected an integer from 0 to "
                f"{len(names) - 1} for each clip"
            )
        order = [self.classes.index(name) if name in self.classes else -1 for name in names]
        return torch.tensor(order)[torch.from_numpy(label.astype(np.int64))]

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the effects that can be left out of the simulation."""
        return tuple(field.name for field in dataclasses.fields(self.effects))

    def simulate(
        self, clips: int, seed: int, quiet: bool, without: str | None = None
    ) -> tuple[Tensor, Tensor]:
        """Simulated pictures (N, 1, H, W) and labels (N,), ``clips`` per class, optionally without one effect."""
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
    """Type of the objects made by ``MeasuredSet.simulator``."""

    def simulate(self, label: int, count: int, generator: torch.Generator) -> Tensor:
        """Maps (count, H, W) of a class."""
        ...  # pragma: no cover


SETS: tuple[MeasuredSet, ...] = (
    MeasuredSet(
        "glasgow_cfar_masks",
        "masks.npz",
        "dt_packed",
        (256, 32),
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
        "iq",
        (2, 1920),
        sense2gol.CLASSES,
        ("walk", "run", "creep"),
        sense2gol.Sense2Gol,
        sense2gol.Effects,
        sense2gol.read,
        sense2gol.pictures,
        sense2gol.augment,
        "measured-kmkim",
        sense2gol.augment,
        ("empty",),
    ),
    MeasuredSet(
        "radhar_points",
        "maps.npz",
        "dt",
        (16, 60),
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
