"""Generated people as a source of labelled clips."""

import math
from dataclasses import replace

import torch

from tensorsim.data.sets.clips import Clip
from tensorsim.data.sets.recipe import DatasetRecipe, SourceConfig
from tensorsim.data.sets.scene import Scene
from tensorsim.data.sets.variations import Range, Variation, seed_of
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.people import PeopleConfig, draw_people


class GeneratedPeople:
    """People of :class:`~tensorsim.motion.ActivityGenerator`; everybody does every activity.

    For a given recipe seed a person keeps the same body; manner, place and noise depend on the sample.

    Args:
        recipe: gives seed, length and rate of the motion, heights and ranges.
        source: the activities and the number of people.
        number: number of the source in the recipe.
    """

    names_people = True
    finds_people = False

    def __init__(self, recipe: DatasetRecipe, source: SourceConfig, number: int) -> None:
        self.recipe, self.labels = recipe, source.classes
        self.people = source.people or 0
        self.prefix = f"{source.kind}{number}"

    def __len__(self) -> int:
        return self.people * len(self.labels)

    def person(self, index: int) -> str:
        """See :class:`~tensorsim.data.sets.clips.ClipSource`."""
        return f"{self.prefix}-{index // len(self.labels):06d}"

    def clip(self, index: int) -> Clip:
        """See :class:`~tensorsim.data.sets.clips.ClipSource`."""
        label, person = self.labels[index % len(self.labels)], self.person(index)
        return Clip(f"{person}/{label}", label, person, person)

    def adapted(self, clip: Clip, variation: Variation) -> Variation:
        """The variation, with the person's height."""
        body = draw_people(1, self._config(variation), self._body_generator(clip.person))
        return replace(variation, height_m=float(body.height_m[0]))

    def scene(self, clip: Clip, variation: Variation) -> Scene:
        """See :class:`~tensorsim.data.sets.clips.ClipSource`."""
        config = self._config(variation)
        body = draw_people(1, config, self._body_generator(clip.person))
        manner = draw_people(1, config, torch.Generator().manual_seed(variation.seed))
        heading = math.pi + math.radians(variation.heading_deg)
        who = manner._replace(
            height_m=body.height_m,
            mass_kg=body.mass_kg,
            female=body.female,
            proportions=body.proportions,
            left_handed=torch.tensor([variation.mirrored]),
            heading_rad=torch.full_like(manner.heading_rad, heading),
            start_m=torch.stack(
                [torch.full_like(manner.heading_rad, variation.side_m), manner.start_m[:, 1]], -1
            ),
        )
        # So that the motion has the right duration after its change of speed.
        motion = ActivityGenerator(config).generate(
            clip.label,
            people=who,
            duration_s=self.recipe.duration_s * variation.speed,
            rate_hz=self.recipe.motion_hz / variation.speed,
        )
        return Scene(motion.joints.float(), motion.valid, self.recipe.motion_hz)

    def prepare(self, clip: Clip, again: bool = False) -> None:
        """Nothing is shared."""

    def _config(self, variation: Variation) -> PeopleConfig:
        varied = self.recipe.variations
        usual = PeopleConfig()
        distance = variation.distance_m
        start: Range = usual.start_range_m if distance is None else (distance, distance)
        return replace(
            usual,
            height_m=usual.height_m if varied.height_m is None else varied.height_m,
            start_range_m=start,
            keep_range_m=varied.keep_m,
        )

    def _body_generator(self, person: str) -> torch.Generator:
        return torch.Generator().manual_seed(seed_of(self.recipe.seed, "body", person))
