"""``tensorsim train pose``: train a small pose network on labelled and rendered people."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tensorsim.commands.arguments import Option
from tensorsim.commands.training import PeopleOptions
from tensorsim.exceptions import TensorsimError, check_positive

if TYPE_CHECKING:
    from tensorsim.training.pose_data import Person


@dataclass(frozen=True)
class TrainPose(PeopleOptions):
    """Train a small HRNet or CPM on tar shards of people; running it again with the same arguments resumes it."""

    data: Path
    """Folder of the shards coco_small, coco_more, coco_extra, films_teacher, lspet and, for rendered people,
    backgrounds (NAME-*.tar)."""
    network: Literal["hrnet", "cpm"] = "hrnet"
    """HRNet, or CPM with three stages."""
    size: tuple[int, int] = (128, 96)
    """Height and width of the crops."""
    first_size: tuple[int, int] = (96, 64)
    """Height and width of the smaller crops used at first."""
    first_steps: Option[int] = None
    """Steps with the smaller crops, fewer than --steps. Default: half of --steps, at most 6000; 0 with --init."""
    width: Option[int] = None
    """Channels of HRNet's highest-resolution branch (default: 24), or of most layers of CPM (default: 32)."""
    steps: int = 12000
    """Optimiser steps."""
    batch: int = 32
    """Crops per step."""
    learning_rate: float = 2e-3
    """Peak learning rate."""
    augmentation: Literal["full", "mild"] = "full"
    """How much crops are rotated, scaled, shifted and cut: "full", or "mild" to end a training with crops that are
    closer to those of films."""
    second_labels: Option[Path] = None
    """Keypoints of the people of lspet from another network, in COCO's results format (.json): where they agree with
    the labels, they correct these and add the face."""
    teacher: Option[Path] = None
    """A better network with COCO-17 heatmaps for crops of the same size (.onnx), whose output the HRNet learns in
    addition to the labels."""
    validate_every: int = 500
    """Steps between validations on held-out people, which select the best weights."""
    presence: bool = False
    """Train only the head of the HRNet in --init that tells which keypoints are inside the image, on crops of one size
    and without rendered people."""

    def run(self) -> None:
        """Run the command."""
        import torch

        from tensorsim.training.pose import (
            SHARES,
            SHARES_CONFIRMED,
            PoseRecipe,
            TrainedCPM,
            held_out_people,
            read_people,
        )
        from tensorsim.training.pose_data import MILD_AUGMENTATION, Augmentation, RenderedPeople
        from tensorsim.training.presence import PresenceRecipe, with_presence_head
        from tensorsim.training.shards import Shards, find_shards
        from tensorsim.vision.pose2d.hrnet import HRNet, HRNetConfig
        from tensorsim.vision.pose2d.onnx_heatmaps import OnnxHeatmaps

        check_positive(self.learning_rate, "--learning-rate")
        if self.presence and (self.init is None or self.network != "hrnet"):
            raise TensorsimError("--presence needs --init with an HRNet")
        without = ("rendered", "cutouts", "augmentation", "first_size", "first_steps", "teacher")
        given = [name for name in without if getattr(self, name) != getattr(TrainPose, name)]
        if self.presence and given:
            raise TensorsimError(f"--presence cannot be combined with --{given[0].replace('_', '-')}")
        first_steps = self.first_steps
        if first_steps is None:
            first_steps = min(6000, self.steps // 2) if self.init is None else 0
        if not 0 <= first_steps < self.steps:
            raise TensorsimError(
                f"--first-steps: got {first_steps}, expected at least 0 and fewer than the {self.steps} of --steps"
            )
        if first_steps > 0 and (min(self.first_size) < 32 or any(side % 32 for side in self.first_size)):
            raise TensorsimError(f"--first-size: got {self.first_size}, expected (H, W), multiples of 32")
        teacher = None if self.teacher is None else OnnxHeatmaps(self.teacher, threads=1)
        if teacher is not None and (
            self.network == "cpm" or first_steps > 0 or teacher.input_size != self.size
        ):
            raise TensorsimError(
                f"--teacher: got a network for crops of {teacher.input_size}, expected --network hrnet, "
                "--first-steps 0 and crops of the same --size"
            )
        loop = self.loop(steps=self.steps, batch=self.batch, validate_every=self.validate_every)
        torch.manual_seed(self.seed)
        net: HRNet | TrainedCPM
        if self.network == "cpm":
            net = TrainedCPM(3, self.size, 32 if self.width is None else self.width)
            self.begin(net)
        elif self.init is not None:
            net = HRNet.from_pretrained(self.init, input_size=self.size)
            if self.width is not None and self.width != net.config.width:
                raise TensorsimError(
                    f"{self.init}: got width {net.config.width}, expected --width {self.width}"
                )
        else:
            width = 24 if self.width is None else self.width
            net = HRNet(HRNetConfig(width, blocks=2, modules=(1, 1, 1), bottlenecks=2, planes=32), self.size)
        persons = read_people(self.data, self.second_labels)
        held_out = held_out_people(self.data)
        for name in ("COCO, large", "LSPE, upright"):
            if not held_out[name]:
                raise TensorsimError(
                    f"{self.data}: got no held-out people of {name}, expected some for validation"
                )
        validation = {"coco": some(held_out["COCO, large"]), "lspet": some(held_out["LSPE, upright"])}
        cutouts = self.rendered_people()
        rendered = None
        if cutouts is not None:
            rendered = RenderedPeople(cutouts, Shards(find_shards(self.data, "backgrounds")))
        if self.presence and isinstance(net, HRNet):
            net = with_presence_head(net)
            head = PresenceRecipe(net, persons, validation, self.seed, self.learning_rate)
            self.train(head, loop)
            return
        recipe = PoseRecipe(
            net,
            persons,
            validation,
            rendered,
            seed=self.seed,
            learning_rate=self.learning_rate,
            sigma=1.0 if self.network == "cpm" else 1.5,
            first_size=self.first_size,
            first_samples=first_steps * self.batch,
            shares=SHARES if self.second_labels is None else SHARES_CONFIRMED,
            augmentation=Augmentation() if self.augmentation == "full" else MILD_AUGMENTATION,
            teacher=teacher,
        )
        self.train(recipe, loop)


def some(persons: "list[Person]", most: int = 240) -> "list[Person]":
    """At most this many of the people, evenly spread, because shards differ in their pictures."""
    return persons[:: math.ceil(len(persons) / most)]
