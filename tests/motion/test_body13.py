"""The 13-scatterer body against the published table."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.config import JOINTS, RadarConfig
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.body13 import NODES, Body13Scatterers
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.pipeline import PoseToDoppler
from tensorsim.radar.simulator import RadarSimulator
from tests.stage import StageTester


class TestBody13(StageTester):
    gradient_arguments = (0, 1)
    batched_arguments = (0, 1)

    def make(self) -> nn.Module:
        return Body13Scatterers()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        positions = torch.randn((*batch, 2, 4, 14, 3), generator=generator, dtype=torch.float64)
        fade = torch.rand((*batch, 2, 4), generator=generator, dtype=torch.float64)
        return positions.to(dtype), fade.to(dtype)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        positions, fade = torch.zeros(2, 5, 14, 3), torch.ones(2, 5)
        return [
            ((positions[..., :13, :], fade), r"positions: got shape \[2, 5, 13, 3\], expected .* 14, 3\)"),
            ((positions, fade[:1]), r"fade: got shape \[1, 5\]"),
        ]


def test_the_tree_has_one_root_and_parents_come_first() -> None:
    names = [node.name for node in NODES]
    assert len(names) == len(set(names)) == 13
    assert [node.name for node in NODES if node.parent is None] == ["torso"]
    for i, node in enumerate(NODES[1:], 1):
        assert node.parent in names[:i]
    for node in NODES:
        assert sum(node.joints.values()) == pytest.approx(1)
        assert set(node.joints) <= set(JOINTS)


def test_places_and_cross_sections_of_a_standing_body() -> None:
    """Torso at 0.6 of the way from the hips to the shoulders; the rest are joints; two people, one scene."""
    body = forward_kinematics(BodyPose.standing(), 1.8)
    shift = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    people = torch.stack((body, body + shift)).unsqueeze(1)
    scene, rcs = Body13Scatterers()(people, torch.tensor([[1.0], [0.5]]))
    assert scene.shape == (1, 26, 3)
    trunk = 0.288 * 1.8  # length from hips to shoulders
    expected = {
        "torso": torch.tensor([0.0, 0.0, 0.6 * trunk], dtype=torch.float64),
        "hip": torch.zeros(3, dtype=torch.float64),
        "head": body[JOINTS.index("head")],
        "left_hand": body[JOINTS.index("left_wrist")],
        "right_knee": body[JOINTS.index("right_knee")],
    }
    for name, place in expected.items():
        index = [node.name for node in NODES].index(name)
        torch.testing.assert_close(scene[0, index], place, rtol=0, atol=1e-12)
        torch.testing.assert_close(scene[0, 13 + index], place + shift, rtol=0, atol=1e-12)
    table = [1, 0.5, 0.1, 0.4, 0.3, 0.4, 0.3, 0.1, 0.3, 0.2, 0.1, 0.3, 0.2]
    torch.testing.assert_close(rcs[0, :13], torch.tensor(table, dtype=torch.float64))
    torch.testing.assert_close(rcs[0, 13:], torch.tensor(table, dtype=torch.float64) / 4)


def test_learnable() -> None:
    model = Body13Scatterers(learnable=True)
    parameters = dict(model.named_parameters())
    assert list(parameters) == ["points.log_rcs_m2"]
    model(torch.zeros(1, 2, 14, 3), torch.ones(1, 2))[1].sum().backward()
    gradient = parameters["points.log_rcs_m2"].grad
    assert gradient is not None
    assert bool((gradient > 0).all())
    assert not list(Body13Scatterers().parameters())


def test_generated_motion_as_13_scatterers() -> None:
    """Maps of the torso alone are those of a point at the torso: 0.6 of the way from the hips to the neck."""
    motion = ActivityGenerator().generate("walking", batch=2, duration_s=1.0, rate_hz=30.0)
    radar = replace(RadarConfig.through_wall(), prf_hz=256.0)
    body = Body13Scatterers()
    weak = [1.0] + [1e-12] * 12
    body.points = JointScatterers(weak)
    simulator = RadarSimulator(radar, snr_db=None)
    maps = PoseToDoppler(simulator, scatterers=body)(motion.joints[:, None], motion.valid[:, None], 30.0)
    assert maps.doppler_time.shape[0] == 2

    hips = motion.joints[:, :, [JOINTS.index("right_hip"), JOINTS.index("left_hip")]].mean(dim=2)
    torso = 0.6 * motion.joints[:, :, JOINTS.index("neck")] + 0.4 * hips
    pulses = PoseResampler(radar.prf_hz)(torso[:, :, None], 30.0)
    expected = simulator(pulses, torch.ones(pulses.shape[:-1], dtype=pulses.dtype))
    torch.testing.assert_close(
        maps.doppler_time, expected.doppler_time, rtol=1e-4, atol=1e-4 * float(maps.doppler_time.max())
    )
