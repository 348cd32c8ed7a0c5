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
    """Train a small HRNet or CPM on tar shards of people; run again with the same arguments, it goes on where it was.

    Attributes:
        data: folder of the shards coco_small, coco_more, coco_extra, films_teacher, lspet and, for rendered people,
            backgrounds (NAME-*.tar).
        network: HRNet, or CPM with three stages.
        size: height and width of the crops.
        first_size: height and width of smaller crops to begin with.
        first_steps: steps with those, fewer than ``steps``; half of them, at most 6000, if not given, none with init.
        width: channels of HRNet's branch of highest resolution (24 if not given), or of most layers of CPM (32).
        steps: optimiser steps.
        batch: crops per step.
        learning_rate: highest learning rate.
        augmentation: how far crops are turned, scaled, shifted and cut: "full", or "mild" to end a training with crops
            nearer to those of films.
        second_labels: keypoints of the people of lspet by another network, COCO's format of results (.json): where they
            agree with the labels, they put them right and add the face.
        teacher: a better network of COCO-17 heat maps for crops of the same size (.onnx), whose answers the HRNet
            learns besides the labels.
        validate_every: steps between measurements on held-out people, which pick the best weights.
        presence: train nothing but the head of the HRNet in --init that tells which keypoints are in the picture, on
            crops of one size and without rendered people.
    """

    data: Path
    network: Literal["hrnet", "cpm"] = "hrnet"
    size: tuple[int, int] = (128, 96)
    first_size: tuple[int, int] = (96, 64)
    first_steps: Option[int] = None
    width: Option[int] = None
    steps: int = 12000
    batch: int = 32
    learning_rate: float = 2e-3
    augmentation: Literal["full", "mild"] = "full"
    second_labels: Option[Path] = None
    teacher: Option[Path] = None
    validate_every: int = 500
    presence: bool = False

    def run(self) -> None:
        """Do it."""
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
            raise TensorsimError("--presence: got no --init of an HRNet, whose keypoints it is about")
        without = ("rendered", "cutouts", "augmentation", "first_size", "first_steps", "teacher")
        given = [name for name in without if getattr(self, name) != getattr(TrainPose, name)]
        if self.presence and given:
            raise TensorsimError(
                f"--presence: got --{given[0].replace('_', '-')}, which the head is trained without"
            )
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
                f"--teacher: got a network of crops of {teacher.input_size}, expected it with --network hrnet, "
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
                    f"{self.data}: got nobody held out of {name}, expected some to measure on"
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
    """At most this many of the people, evenly spread: shards of unlike pictures follow each other."""
    return persons[:: math.ceil(len(persons) / most)]
