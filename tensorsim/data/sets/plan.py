"""Which samples a recipe has, in which part and shard; everything follows from the recipe and the list of clips."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tensorsim.data.sets.clips import Clip, ClipSource
from tensorsim.data.sets.files import FileClips
from tensorsim.data.sets.open_sources import open_source
from tensorsim.data.sets.recipe import PARTS, DatasetRecipe, folder_name
from tensorsim.data.sets.scene import Scene, beside_each_other, kept_inside
from tensorsim.data.sets.variations import Variation, draw, seed_of
from tensorsim.errors import TensorsimError

Indices = npt.NDArray[np.int64]


class Shard(NamedTuple):
    """A run of samples of one part.

    Attributes:
        name: name of its file, without suffix.
        part: training, validation or test.
        first, stop: half-open range of sample numbers.
    """

    name: str
    part: str
    first: int
    stop: int


class Plan:
    """All samples of a recipe, without making any.

    Sample numbers run through the parts in turn; within a part, clips are in random order drawn from the seed, so that
    every shard has samples of many classes.

    Args:
        recipe: the recipe.
        cache: folder of the people found in videos.

    Attributes:
        labels: names of the classes, in the order of the sources.

    Raises:
        TensorsimError: a folder or table that does not exist or has no clips, or classes that would share a folder of
            pictures.
    """

    def __init__(self, recipe: DatasetRecipe, cache: str | None = None) -> None:
        self.recipe = recipe
        self.sources: list[ClipSource] = [
            open_source(recipe, source, number, cache) for number, source in enumerate(recipe.sources)
        ]
        names = [label for source in self.sources for label in source.labels]
        self.labels = tuple(dict.fromkeys(names))
        self.starts = np.cumsum([0] + [len(source) for source in self.sources])
        if self.clips == 0:
            raise TensorsimError("recipe: got sources without clips, expected at least one")
        if recipe.storage.format == "png":
            self._check_folders()

    def _check_folders(self) -> None:
        """Refuse classes whose pictures would share a folder, even on a case-insensitive file system."""
        there: dict[str, str] = {}
        for label in self.labels:
            other = there.setdefault(folder_name(label).casefold(), label)
            if other != label:
                raise TensorsimError(
                    f"recipe: got the classes {other!r} and {label!r}, which would share a folder of pictures "
                    f"({folder_name(label)}), expected names that differ in letters or digits"
                )

    @property
    def clips(self) -> int:
        """Total number of clips in all sources."""
        return int(self.starts[-1])

    def __len__(self) -> int:
        return self.clips * self.recipe.variations.count

    def clip(self, index: int) -> tuple[ClipSource, Clip]:
        """A clip and its source."""
        number, place = self._place(index)
        return self.sources[number], self.sources[number].clip(place)

    def _place(self, index: int) -> tuple[int, int]:
        """The number of a clip's source, and the clip's number in it."""
        number = int(np.searchsorted(self.starts, index, side="right")) - 1
        return number, index - int(self.starts[number])

    @cached_property
    def listing(self) -> str:
        """SHA-256 of the clips in files; those of generated people follow from the recipe."""
        digest = hashlib.sha256()
        for source in self.sources:
            for clip in source.clips if isinstance(source, FileClips) else ():
                digest.update(repr(replace(clip, path="")).encode())  # wherever the files are
        return digest.hexdigest()

    @cached_property
    def parts(self) -> dict[str, Indices]:
        """Clips of each part, in sample order."""
        part = self._part_of_clips()
        order = np.random.Generator(np.random.PCG64(seed_of(self.recipe.seed, "order")))
        return {name: order.permutation(np.flatnonzero(part == k)) for k, name in enumerate(PARTS)}

    def _part_of_clips(self) -> npt.NDArray[np.int8]:
        """Index into ``PARTS`` of every clip."""
        if self.recipe.split.by == "table":
            return self._parts_of_the_table()
        by_person = self.recipe.split.by == "person"
        groups: dict[str, int] = {}
        of_clip = np.empty(self.clips, np.int64)
        for index in range(self.clips):
            number, place = self._place(index)
            source = self.sources[number]
            group = source.person(place) if by_person else source.clip(place).origin
            of_clip[index] = groups.setdefault(group, len(groups))
        return shared_out(list(groups), self.recipe.split.shares, self.recipe.seed)[of_clip]

    def _parts_of_the_table(self) -> npt.NDArray[np.int8]:
        part = np.empty(self.clips, np.int8)
        for index in range(self.clips):
            clip = self.clip(index)[1]
            if clip.part not in PARTS:
                raise TensorsimError(
                    f"split by table: got {clip.part!r} for {clip.name}, expected one of {', '.join(PARTS)}"
                )
            part[index] = PARTS.index(clip.part)
        return part

    @cached_property
    def shards(self) -> list[Shard]:
        """All shards, in sample order."""
        shards, first = [], 0
        for part, clips in self.parts.items():
            stop = first + len(clips) * self.recipe.variations.count
            step = self.recipe.storage.shard_samples
            for number, start in enumerate(range(first, stop, step)):
                shards.append(Shard(f"{part}-{number:06d}", part, start, min(stop, start + step)))
            first = stop
        return shards

    def clip_of_sample(self, sample: int) -> tuple[str, int, int]:
        """Part, clip and variation number of a sample."""
        count = self.recipe.variations.count
        for part, clips in self.parts.items():
            if sample < len(clips) * count:
                variation, place = divmod(sample, len(clips))
                return part, int(clips[place]), variation
            sample -= len(clips) * count
        raise TensorsimError(f"sample: got number {sample} beyond the end, expected less than {len(self)}")

    def variation(self, clip: int, number: int) -> Variation:
        """What is drawn for a variation of a clip."""
        source, there = self.clip(clip)
        seed = seed_of(self.recipe.seed, self._place(clip)[0], there.name, number)
        return source.adapted(there, draw(self.recipe.variations, seed))

    def scene(self, clip: int, part: str, variation: Variation) -> Scene:
        """The people of a sample on the floor: those of the clip, and companions from the same part.

        Raises:
            TensorsimError: a file that cannot be read, or nobody in it.
        """
        source, there = self.clip(clip)
        scenes = [source.scene(there, variation)]
        for word in filter(None, variation.companions.split(",")):
            seed = int(word)
            other_source, other = self._companion(there.person, part, seed)
            # They start beside the first person and head the same way; body, mirroring and speed are their own.
            own = replace(draw(self.recipe.variations, seed), heading_deg=variation.heading_deg)
            scenes.append(other_source.scene(other, other_source.adapted(other, own)))
        together = beside_each_other(scenes, self.recipe.variations.spacing_m)
        return kept_inside(together, self.recipe.variations)

    def _companion(self, person: str, part: str, seed: int) -> tuple[ClipSource, Clip]:
        """A clip of the part with a different person, if there is one."""
        clips = self.parts[part]
        for attempt in range(100):
            found = self.clip(int(clips[seed_of(seed, "who", attempt) % len(clips)]))
            if found[1].person != person:
                break
        return found


def shared_out(groups: Sequence[str], shares: Sequence[float], seed: int) -> npt.NDArray[np.int8]:
    """The part of each group, in proportion to the shares, if possible with at least one group per positive share.

    The assignment depends only on the names of the groups, the shares and the seed.
    """
    order = sorted(
        range(len(groups)), key=lambda k: hashlib.sha256(f"{seed}/{groups[k]}".encode()).hexdigest()
    )
    wanted = [share * len(groups) for share in shares]
    counts = [int(w) for w in wanted]
    if len(groups) >= sum(share > 0 for share in shares):
        counts = [max(n, int(share > 0)) for n, share in zip(counts, shares, strict=True)]
    while sum(counts) < len(groups):
        counts[int(np.argmax(np.subtract(wanted, counts)))] += 1
    while sum(counts) > len(groups):
        # Where several parts have one group each, the largest gives them up.
        counts[max(range(len(counts)), key=lambda k: (counts[k] > 1, counts[k] - wanted[k]))] -= 1
    part = np.empty(len(groups), np.int8)
    for k, (first, count) in enumerate(zip(np.cumsum([0, *counts]), counts, strict=False)):
        part[order[first : first + count]] = k
    return part
