"""Files of people as a source of labelled clips: videos, keypoints, captured motion, and public data sets."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from tensorsim.data.layouts import listing
from tensorsim.data.sets.clips import Clip
from tensorsim.data.sets.people import PeopleFinder, is_film
from tensorsim.data.sets.recipe import DatasetRecipe, SourceConfig
from tensorsim.data.sets.scene import Scene, part_of, varied
from tensorsim.data.sets.variations import Variation
from tensorsim.data.skeletons import Motion
from tensorsim.errors import TensorsimError
from tensorsim.files import shown_name

#: Memory in MB for motions kept by a source; a minute of one person at 120 frames per second takes 2.4 MB.
_KEPT_MB = 200.0
#: How the clips of each kind of source are listed.
LISTS: dict[str, Callable[[SourceConfig], list[Clip]]] = {
    "films": listing.folder_of_films,
    "keypoints": listing.folder_of_keypoints,
    "motion": listing.folder_of_motion,
    "table": listing.table,
    "ntu": listing.ntu,
    "kinetics": listing.kinetics,
    "charades": listing.charades,
    "movi": listing.movi,
    "h36m": listing.h36m,
}


class FileClips:
    """Clips from files.

    Args:
        recipe: gives length and rate of the motion.
        source: kind and location of the files.
        number: number of the source in the recipe.
        cache: folder of the people found in videos; None finds them every time.

    Raises:
        TensorsimError: a folder or table that does not exist or has no clips, or an unknown class.
    """

    def __init__(
        self, recipe: DatasetRecipe, source: SourceConfig, number: int, cache: str | None = None
    ) -> None:
        self.recipe, self.source = recipe, source
        found = [_in_utf8(clip) for clip in LISTS[source.kind](source)]
        there = sorted({clip.label for clip in found})
        missing = [label for label in source.classes if label not in there]
        if missing:
            raise TensorsimError(
                f"sources: got the class {missing[0]!r} for {source.path}, expected some of {', '.join(there[:50])}"
            )
        self.labels = source.classes or tuple(there)
        self.names_people = not any(clip.person == clip.origin for clip in found)
        self.clips = [_told_apart(clip, source, number) for clip in found if clip.label in self.labels]
        self.finder = PeopleFinder(source, None if cache is None else Path(cache))
        self.finds_people = any(is_film(Path(clip.path)) for clip in self.clips)
        self._motions: dict[tuple[str, str], Motion] = {}

    def __len__(self) -> int:
        return len(self.clips)

    def clip(self, index: int) -> Clip:
        """See :class:`~tensorsim.data.sets.clips.ClipSource`."""
        return self.clips[index]

    def person(self, index: int) -> str:
        """See :class:`~tensorsim.data.sets.clips.ClipSource`."""
        return self.clips[index].person

    def adapted(self, clip: Clip, variation: Variation) -> Variation:
        """The variation, unchanged."""
        return variation

    def scene(self, clip: Clip, variation: Variation) -> Scene:
        """See :class:`~tensorsim.data.sets.clips.ClipSource`."""
        motion = cut(self._motion(clip), clip)
        moved = varied(motion, variation)
        return part_of(moved, self.recipe.duration_s, self.recipe.motion_hz, variation.start)

    def _motion(self, clip: Clip) -> Motion:
        """The people in a clip's file; recent ones are cached, since files with many motions are slow to read."""
        key = (clip.path, clip.key)
        if key not in self._motions:
            self._motions[key] = self.finder.motion(*key)
            used = sum(motion.joints.nbytes for motion in self._motions.values())
            while used > _KEPT_MB * 1e6 and len(self._motions) > 1:
                used -= self._motions.pop(next(iter(self._motions))).joints.nbytes
        return self._motions[key]

    def prepare(self, clip: Clip, again: bool = False) -> None:
        """Find the people in the clip's file."""
        self.finder.motion(clip.path, clip.key, again)


def _in_utf8(clip: Clip) -> Clip:
    """The clip with all text made valid UTF-8 for the data set's files; only the path stays as it is."""
    return replace(
        clip,
        name=shown_name(clip.name),
        label=shown_name(clip.label),
        person=shown_name(clip.person),
        origin=shown_name(clip.origin),
    )


def _told_apart(clip: Clip, source: SourceConfig, number: int) -> Clip:
    """Make a person known only by the file differ from that of an equally named file in another source."""
    return (
        replace(clip, person=f"{source.kind}{number}/{clip.person}") if clip.person == clip.origin else clip
    )


def cut(motion: Motion, clip: Clip) -> Motion:
    """The part of a motion between the times of a clip; a file named like the clip holds only this part.

    Raises:
        TensorsimError: fewer than two frames are left.
    """
    if (clip.start_s is None and clip.end_s is None) or Path(clip.path).stem == clip.name:
        return motion
    count = motion.valid.shape[1]
    first = 0 if clip.start_s is None else round(clip.start_s * motion.fps)
    stop = count if clip.end_s is None else min(count, round(clip.end_s * motion.fps))
    if stop - first < 2:
        raise TensorsimError(
            f"{clip.path}: got {clip.start_s} to {clip.end_s} s of {count / motion.fps:.3g} s, expected at least "
            "two frames in it"
        )
    return motion._replace(joints=motion.joints[:, first:stop], valid=motion.valid[:, first:stop])
