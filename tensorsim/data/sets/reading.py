"""Read data sets for training: by index, as a stream distributed over ranks and workers, or simulated on the fly."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from tensorsim.data.sets.batches import Arrays, synthesize_batch
from tensorsim.data.sets.made_with import digest
from tensorsim.data.sets.manifest import columns_of, made_of, recipe_of
from tensorsim.data.sets.outputs import MAPS, OutputConfig
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.recipe import PARTS, DatasetRecipe
from tensorsim.data.sets.samples import sample_id
from tensorsim.data.sets.scene import Scene
from tensorsim.data.sets.stored import StoredArrays
from tensorsim.data.sets.variations import Variation
from tensorsim.device import rank_and_processes, usable_device
from tensorsim.errors import TensorsimError

#: Outputs that can serve as classifier input.
_PICTURES = ("picture", *MAPS)


def share_of_worker() -> tuple[int, int]:
    """Index of this worker among all workers of all ranks, and their number.

    Ranks are those of ``torchrun``, workers those of a ``DataLoader``.
    """
    rank, world = rank_and_processes()
    worker = get_worker_info()
    if worker is None:
        return rank, world
    return rank * worker.num_workers + worker.id, world * worker.num_workers


def as_picture(array: npt.NDArray[Any], outputs: OutputConfig) -> Tensor:
    """A stored map or picture (H, W) as float32 in [0, 1]: 1 at the peak, 0 at the floor of its range."""
    if array.dtype == np.uint8:
        return torch.from_numpy(np.ascontiguousarray(array)).float() / 255
    return (1 + torch.from_numpy(array.astype(np.float32)) / outputs.range_db).clamp(0.0, 1.0)


def chosen_names(recipe: DatasetRecipe, output: str | None, radars: Sequence[str] | None) -> list[str]:
    """Arrays to stack: one output of some radars.

    Raises:
        TensorsimError: an output that the recipe does not have or that is not a map, or an unknown radar.
    """
    there = [kind for kind in _PICTURES if kind in recipe.outputs.kinds]
    if output is None and there:
        output = there[0]
    if output not in there:
        raise TensorsimError(
            f"MapDataset.output: got {output!r}, expected one of {', '.join(there) or 'none, as it has no maps'}"
        )
    names = [view.name for view in recipe.radars]
    for name in radars or ():
        if name not in names:
            raise TensorsimError(f"MapDataset.radars: got {name!r}, expected some of {', '.join(names)}")
    return [f"{name}.{output}" for name in radars or names]


class MapDataset(Dataset[dict[str, Any]]):
    """Labelled maps of a data set made by ``tensorsim dataset build``, by index.

    Args:
        folder: folder of the data set.
        split: ``"train"``, ``"validation"`` or ``"test"``; None takes all.
        output: which of its outputs; None takes pictures if there are any, else Doppler-time maps.
        radars: radars whose maps are stacked as channels; None takes all.
        labels: classes to use, in the order of their numbers; None takes all.

    Samples: ``{"map": (C, H, W) float32 in [0, 1], "label": int, "id": str}``, 1 at the peak of the map.

    Attributes:
        labels: names of the classes.
        targets: (N,) int64 class of every sample.
        digest: SHA-256 of the recipe and what it was made with, which identifies the data set.

    Raises:
        TensorsimError: no data set there, an unknown part, output, radar or class, or no samples.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        split: str | None = None,
        output: str | None = None,
        radars: Sequence[str] | None = None,
        labels: Sequence[str] | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.recipe = recipe_of(self.folder)
        self.digest = digest(self.recipe, made_of(self.folder))
        if split not in (None, *PARTS):
            raise TensorsimError(f"MapDataset.split: got {split!r}, expected one of {', '.join(PARTS)}")
        self.names = chosen_names(self.recipe, output, radars)
        ids, shards, parts, numbers, names = columns_of(
            self.folder, "id", "shard", "part", "class_index", "label"
        )
        known = [str(names[place]) for place in np.unique(numbers, return_index=True)[1]]
        unknown = [label for label in labels or () if label not in known]
        if unknown:
            raise TensorsimError(
                f"MapDataset.labels: got {unknown[0]!r}, expected some of {', '.join(known)}"
            )
        self.labels = tuple(labels or known)
        kept = np.isin(names, self.labels) & ((parts == split) | (split is None))
        if not kept.any():
            raise TensorsimError(f"{self.folder}: got no samples of the part {split}, expected some")
        self.ids = ids[kept].tolist()
        self.shards, self.parts = shards[kept], parts[kept]
        place = {label: k for k, label in enumerate(self.labels)}
        self.targets = torch.tensor([place[label] for label in names[kept].tolist()])
        self._read = StoredArrays(self.folder, self.recipe)

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        label = int(self.targets[index])
        row = {"id": self.ids[index], "shard": str(self.shards[index]), "part": str(self.parts[index])}
        row["label"] = self.labels[label]
        maps = [as_picture(self._read(row, name), self.recipe.outputs) for name in self.names]
        return {"map": stacked(maps, self.names), "label": label, "id": self.ids[index]}

    def class_weights(self) -> Tensor:
        """(classes,) weights for a cross-entropy that weighs all classes equally; their mean over samples is 1."""
        counts = torch.bincount(self.targets, minlength=len(self.labels)).float()
        weights = torch.where(counts > 0, 1 / counts.clamp_min(1), torch.zeros_like(counts))
        return weights * len(self) / (weights * counts).sum()


def stacked(maps: Sequence[Tensor], names: Sequence[str]) -> Tensor:
    """Maps (H, W) of several radars as channels (C, H, W).

    Raises:
        TensorsimError: maps of different sizes.
    """
    if len({map_.shape for map_ in maps}) > 1:
        sizes = ", ".join(f"{name} {list(m.shape)}" for name, m in zip(names, maps, strict=True))
        raise TensorsimError(
            f"maps: got different sizes ({sizes}), expected one: choose radars, or set outputs.size"
        )
    return torch.stack(list(maps))


def collate_maps(samples: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Samples as a batch, for the ``collate_fn`` of a ``DataLoader``.

    Args:
        samples: B samples of :class:`MapDataset`, with maps (C, H, W) of equal C and H. They are not checked: torch
            raises RuntimeError for maps that do not match.

    Returns:
        ``{"map": (B, C, H, W) float32, "label": (B,) int64, "id": list of B str}``; W is that of the longest map,
        shorter ones are padded at the end with 0, the floor.
    """
    width = max(sample["map"].shape[-1] for sample in samples)
    maps = [torch.nn.functional.pad(s["map"], (0, width - s["map"].shape[-1])) for s in samples]
    return {
        "map": torch.stack(maps),
        "label": torch.tensor([sample["label"] for sample in samples]),
        "id": [sample["id"] for sample in samples],
    }


class MapStream(IterableDataset[dict[str, Any]]):
    """A data set shard by shard, distributed over ranks and workers; every sample comes once per epoch.

    Args:
        maps: data set to read.
        shuffle: shards, and the samples in them, come in a new order in every epoch; call :meth:`set_epoch`.
        seed: random seed of the order.

    Samples: as those of :class:`MapDataset`.

    Raises:
        TensorsimError: while reading, a shard that is missing or damaged.
    """

    def __init__(self, maps: MapDataset, shuffle: bool = True, seed: int = 0) -> None:
        self.maps, self.shuffle, self.seed = maps, shuffle, seed
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # with workers that persist

    def set_epoch(self, epoch: int) -> None:
        """Choose the order; call it before every epoch."""
        self._epoch.fill_(epoch)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        generator = np.random.Generator(np.random.PCG64([self.seed, int(self._epoch)]))
        shards = np.unique(self.maps.shards)
        if self.shuffle:
            shards = generator.permutation(shards)
        number, count = share_of_worker()
        for shard in shards[number::count]:
            places = np.flatnonzero(self.maps.shards == shard)
            for place in generator.permutation(places) if self.shuffle else places:
                yield self.maps[int(place)]


class SimulatedMaps(IterableDataset[dict[str, Any]]):
    """The samples of a recipe, simulated on demand, with new variations in every round.

    Nothing is stored. The first round has exactly the samples of the data set that the recipe describes; use several
    workers of a ``DataLoader`` to simulate on the CPU while the network trains, or a ``device`` and a ``batch`` to
    simulate in the training process.

    Args:
        recipe: as for :class:`MapDataset`.
        split: part of it; None takes all.
        rounds: number of rounds through its samples; None never ends.
        output, radars: see :class:`MapDataset`.
        device: where the radar chain runs and the maps are. People are generated or read on the CPU. A GPU needs
            a ``DataLoader`` without workers.
        batch: samples in one pass of the radar chain, see
            :func:`~tensorsim.data.sets.batches.synthesize_batch`; the maps do not depend on it.
        cache: folder of the people found in videos and rendered videos, such as ``.people`` in a data set's folder.
            None keeps nothing on disk: they are found again in every process, in rendered videos for every sample.

    Samples: as those of :class:`MapDataset`. Clips that fail are left out.

    Raises:
        TensorsimError: an unknown part, output or radar, a source that does not exist, a batch below 1, or a device
            that cannot be used.
    """

    def __init__(
        self,
        recipe: DatasetRecipe,
        split: str | None = "train",
        rounds: int | None = None,
        output: str | None = None,
        radars: Sequence[str] | None = None,
        device: str | torch.device = "cpu",
        batch: int = 1,
        cache: str | os.PathLike[str] | None = None,
    ) -> None:
        if batch < 1:
            raise TensorsimError(f"SimulatedMaps.batch: got {batch}, expected at least 1")
        if split not in (None, *PARTS):
            raise TensorsimError(f"SimulatedMaps.split: got {split!r}, expected one of {', '.join(PARTS)}")
        self.plan = Plan(recipe, None if cache is None else os.fspath(cache))
        self.split, self.rounds = split, rounds
        self.names = chosen_names(recipe, output, radars)
        self.labels = self.plan.labels
        self.device, self.batch = usable_device(str(device)), batch

    def __iter__(self) -> Iterator[dict[str, Any]]:
        number, count = share_of_worker()
        numbers = [n for n in range(len(self.plan)) if self.split in (None, self.plan.clip_of_sample(n)[0])]
        own = numbers[number::count]
        done = 0
        while own and (self.rounds is None or done < self.rounds):
            made = 0
            for first in range(0, len(own), self.batch):
                for sample in self._samples(own[first : first + self.batch], done):
                    made += 1
                    yield sample
            if made == 0:
                raise TensorsimError(f"SimulatedMaps: none of {len(own)} samples of a round could be made")
            done += 1

    def _samples(self, numbers: Sequence[int], done: int) -> Iterator[dict[str, Any]]:
        """The given samples in a round, except those that fail."""
        recipe, clips, drawn = self.plan.recipe, [], []
        for number in numbers:
            part, clip, count = self.plan.clip_of_sample(number)
            variation = self.plan.variation(clip, done * recipe.variations.count + count)
            try:
                drawn.append((self.plan.scene(clip, part, variation), variation))
            except (TensorsimError, OSError):
                continue
            clips.append((number, clip))
        for (number, clip), arrays in zip(clips, self._arrays(drawn), strict=True):
            if arrays is not None:
                label = self.plan.labels.index(self.plan.clip(clip)[1].label)
                maps = [as_picture(arrays[name], recipe.outputs) for name in self.names]
                map_ = stacked(maps, self.names).to(self.device)
                yield {"map": map_, "label": label, "id": f"{sample_id(number)}-{done}"}

    def _arrays(self, drawn: Sequence[tuple[Scene, Variation]]) -> list[Arrays | None]:
        """The arrays of samples, None for those that fail."""
        try:
            return list(synthesize_batch(self.plan.recipe, drawn, self.device))
        except TensorsimError:
            # If one of several fails, they are made one by one.
            return [None] if len(drawn) == 1 else [self._arrays([one])[0] for one in drawn]
