"""``tensorsim train pose``: train the small pose network on labelled and rendered people."""

from dataclasses import dataclass
from pathlib import Path

from tensorsim.commands.training import PeopleOptions
from tensorsim.errors import check_positive


@dataclass(frozen=True)
class TrainPose(PeopleOptions):
    """Train HRNet, small, on tar shards of people; run again with the same arguments, it goes on where it stopped.

    Attributes:
        data: folder of lspet-*.tar, coco_small-*.tar and backgrounds-*.tar.
        size: height and width of the crops.
        first_size: height and width of smaller crops to begin with.
        first_steps: steps with those.
        width: channels of the branch of highest resolution.
        steps: optimiser steps.
        batch: crops per step.
        learning_rate: highest learning rate.
    """

    data: Path
    size: tuple[int, int] = (128, 96)
    first_size: tuple[int, int] = (96, 64)
    first_steps: int = 6000
    width: int = 24
    steps: int = 12000
    batch: int = 32
    learning_rate: float = 2e-3

    def run(self) -> None:
        """Do it."""
        import torch

        from tensorsim.training.pose import HELD_OUT_PERCENT, PoseRecipe
        from tensorsim.training.pose_data import RenderedPeople, people, split, upright
        from tensorsim.training.shards import Shards, find_shards
        from tensorsim.vision.pose2d.hrnet import HRNet, HRNetConfig

        check_positive(self.learning_rate, "--learning-rate")
        loop = self.loop(steps=self.steps, batch=self.batch, validate_every=500)
        torch.manual_seed(self.seed)
        net = HRNet(HRNetConfig(self.width, blocks=2, modules=(1, 1, 1), bottlenecks=2, planes=32), self.size)
        self.begin(net)
        coco, coco_held_out = split(
            Shards(find_shards(self.data, "coco_small")), HELD_OUT_PERCENT["coco_small"]
        )
        lspet, lspet_held_out = split(Shards(find_shards(self.data, "lspet")), HELD_OUT_PERCENT["lspet"])
        places = Shards(find_shards(self.data, "backgrounds"))
        recipe = PoseRecipe(
            net,
            sided=people(coco, least=4, least_px=32),
            unsided=people(lspet),
            validation={"coco": people(coco_held_out), "lspet": upright(people(lspet_held_out))},
            rendered=RenderedPeople(self.rendered_people(), places),
            seed=self.seed,
            learning_rate=self.learning_rate,
            first_size=self.first_size,
            first_samples=self.first_steps * self.batch,
        )
        self.train(recipe, loop)
