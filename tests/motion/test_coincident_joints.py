"""Coinciding joints, as of a skeleton that was not found, give finite values and gradients in every stage."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts

HERE = (0.0, 0.0, 1.0)
STAGES: dict[str, Callable[[], nn.Module]] = {
    "joints": ts.motion.JointScatterers,
    "limbs": lambda: ts.motion.LimbScatterers(HERE, HERE),
    "version1": ts.motion.Body13Scatterers,
    "surface": lambda: ts.motion.BodyScatterers(HERE, HERE, 77e9),
    "sway": lambda: ts.motion.PosturalSway(30.0),
    "vital signs": lambda: ts.motion.VitalSigns(30.0),
}


@pytest.mark.parametrize("name", STAGES)
def test_coincident_joints(name: str) -> None:
    joints = torch.tensor([0.0, 3.0, 1.0]).expand(1, 1, 6, 14, 3).clone().requires_grad_()
    presence = () if name in ("sway", "vital signs") else (torch.ones(1, 1, 6),)
    found = STAGES[name]()(joints, *presence)
    values: tuple[Tensor, ...] = (found,) if isinstance(found, Tensor) else tuple(found)
    for value in values:
        assert bool(torch.isfinite(value).all())
    sum(value.double().square().sum() for value in values).backward()  # type: ignore[union-attr]
    assert joints.grad is not None
    assert bool(torch.isfinite(joints.grad).all())
