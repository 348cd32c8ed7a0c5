"""People rendered to video and found again by the networks, as a source of labelled clips."""

import hashlib
from dataclasses import replace
from pathlib import Path

import torch

from tensorsim.config import CameraConfig
from tensorsim.data.sets.clips import Clip
from tensorsim.data.sets.generated import GeneratedPeople
from tensorsim.data.sets.people import PeopleFinder, finite_everywhere
from tensorsim.data.sets.recipe import DatasetRecipe, SourceConfig
from tensorsim.data.sets.scene import Scene, part_of, varied
from tensorsim.data.sets.variations import Variation, VariationConfig, draw, seed_of
from tensorsim.data.skeletons import Motion
from tensorsim.device import one_thread
from tensorsim.render.renderer import PersonRenderer

#: Two metres behind the radar, so that a whole body is in view from 1.5 m on.
CAMERA = CameraConfig(position_m=(0.0, -2.0, 1.0))
_FPS, _IMAGE_SIZE = 30.0, (360, 640)
#: Only the position is drawn for a video. Everything else is varied after people are found.
_FILM = VariationConfig(heading_deg=(0.0, 0.0), mirror=0.0)


class RenderedPeople:
    """Generated people in front of a camera, one video per person and activity.

    Args:
        recipe: gives seed, length of the videos, heights and ranges.
        source: the activities, the number of people, frames per second and size of the videos.
        number: number of the source in the recipe.
        cache: folder for the people found; None finds them every time.
    """

    names_people = True
    finds_people = True

    def __init__(
        self, recipe: DatasetRecipe, source: SourceConfig, number: int, cache: str | None = None
    ) -> None:
        self.recipe = recipe
        self.fps = _FPS if source.fps is None else source.fps
        self.size = _IMAGE_SIZE if source.image_size is None else source.image_size
        self.people = GeneratedPeople(replace(recipe, motion_hz=self.fps), source, number)
        self.labels, self.person, self.clip = self.people.labels, self.people.person, self.people.clip
        self.finder = PeopleFinder(source, None if cache is None else Path(cache))

    def __len__(self) -> int:
        return len(self.people)

    def adapted(self, clip: Clip, variation: Variation) -> Variation:
        """The variation, unchanged."""
        return variation

    def scene(self, clip: Clip, variation: Variation) -> Scene:
        """See :class:`~tensorsim.data.sets.clips.ClipSource`."""
        moved = varied(self._motion(clip), variation)
        return part_of(moved, self.recipe.duration_s, self.recipe.motion_hz, variation.start)

    def prepare(self, clip: Clip, again: bool = False) -> None:
        """Render the video and find the people in it."""
        self._motion(clip, again)

    @torch.no_grad()
    def _motion(self, clip: Clip, again: bool = False) -> Motion:
        film, seed = self._filmed(clip), seed_of(self.recipe.seed, clip.name, "look")
        content = hashlib.sha256(self.finder.of_networks)
        content.update(repr((CAMERA, self.size, self.fps, seed)).encode())
        content.update(film.joints.numpy().tobytes())
        name, digest = Path(clip.name), content.hexdigest()
        found = self.finder.kept(name, digest, lambda _: self._watched(film, seed), again)
        return finite_everywhere(found, clip.name)

    def _filmed(self, clip: Clip) -> Scene:
        """The person of a clip as shown in the video."""
        drawn = draw(_FILM, seed_of(self.recipe.seed, clip.name, "film"))
        return self.people.scene(clip, self.people.adapted(clip, drawn))

    def _watched(self, film: Scene, seed: int) -> Motion:
        """The people that the networks find in a rendered video, whose room and clothes follow from the seed."""
        render = PersonRenderer(CAMERA, *self.size)
        with one_thread():  # for the same bits everywhere
            frames = render(film.joints, seed, valid=film.valid).frames
            pose = self.finder.networks.seen_by(CAMERA)(frames[None], self.fps)
        return Motion(pose.joints[0], pose.valid[0], self.fps)
