"""Networks to test with, without training one."""

from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.skeleton import body_to_coco
from tensorsim.training.loop import Batch, Recipe

Network = TypeVar("Network", bound=nn.Module)


def settled(network: Network) -> Network:
    """The network in evaluation mode, its normalisations far from the identity, as training leaves them."""
    generator = torch.Generator().manual_seed(5)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            for values, low, high in (
                (module.running_mean, -0.15, 0.15),
                (module.running_var, 0.5, 2.0),
                (module.weight, 0.5, 1.5),
                (module.bias, -0.15, 0.15),
            ):
                nn.init.uniform_(values, low, high, generator=generator)
    return network.eval()


def terms_of_training(recipe: Recipe, batch: Batch, steps: int, term: str = "loss") -> list[float]:
    """A term of the loss before each of so many steps on one batch; the recipe's network learns."""
    optimiser = recipe.optimiser()
    values = []
    for _ in range(steps):
        terms = recipe.loss(recipe.net, batch)
        optimiser.zero_grad()
        terms["loss"].backward()
        optimiser.step()
        values.append(float(terms[term].detach()))
    return values


def _raising_the_arms(frames: int) -> Tensor:
    """Joints (T, 14, 3) of a person who stands at the origin."""
    pose = BodyPose.standing((frames,), torch.float32)
    raised = torch.linspace(0.0, 2.0, frames)[:, None, None] * torch.tensor([1.0, 0.0, 0.0])
    return forward_kinematics(pose._replace(shoulder=raised.expand(-1, 2, -1)), 1.75)


def people_to_move(frames: int) -> tuple[Any, ...]:
    """Arguments of a range rate: a person 4 m in front of the camera who raises the arms."""
    joints = _raising_the_arms(frames) + torch.tensor([0.0, 4.0, 0.0])
    there = torch.ones(frames, dtype=torch.bool)
    return joints, there[:, None].expand(-1, 14), there, torch.tensor([0.0, 0.0, 1.2]), 30.0


def keypoints_to_lift(frames: int) -> tuple[Any, ...]:
    """Arguments of a temporal lifter: a person 4 m in front of a level camera who raises the arms."""
    points = body_to_coco(_raising_the_arms(frames))
    pixels = 500 * torch.stack([points[..., 0], -points[..., 2]], dim=-1) / (4.0 + points[..., 1:2])
    pixels = (pixels + torch.tensor([320.0, 180.0]))[None]
    boxes = torch.cat([pixels.amin(dim=-2) - 8, pixels.amax(dim=-2) + 8], dim=-1)
    return (
        pixels,
        torch.full((1, frames, 17), 0.9),
        boxes,
        torch.ones(1, frames, dtype=torch.bool),
        360,
        640,
        30.0,
    )
