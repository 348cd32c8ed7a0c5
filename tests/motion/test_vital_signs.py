"""Breathing and heartbeat: rates, depths, direction, and what a radar measures of them."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tensorsim.body.kinematics import rotation
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.motion.vital_signs import VitalSigns
from tests.motion.test_sway import standing
from tests.stage import StageTester, assert_same

NECK = JOINTS.index("neck")


class TestVitalSigns(StageTester):
    def make(self) -> nn.Module:
        return VitalSigns(30.0)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        noise = 0.02 * torch.randn(2, 5, 14, 3, generator=generator, dtype=torch.float64)
        return ((standing(2, 5, 0.4) + noise).expand(*batch, 2, 5, 14, 3).to(dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        joints = torch.zeros(1, 2, 5, 14, 3)
        return [
            ((joints[..., :13, :],), "joints: got shape .* 14, 3"),
            ((joints[0, 0],), "joints: got shape"),
            ((joints.int(),), "joints: got dtype"),
        ]


def test_rates_and_depths_of_a_crowd() -> None:
    """Spectra of two minutes of 32 people have their lines where the literature has them."""
    crowd = VitalSigns(30.0, people=32)
    chest = crowd.displacement_m(torch.arange(20 * 120, dtype=torch.float64) / 20).T.numpy()
    spectrum = np.abs(np.fft.rfft(chest * np.hanning(chest.shape[1]))) * 4 / chest.shape[1]
    hz = np.fft.rfftfreq(chest.shape[1], 1 / 20)
    slow, fast = (hz > 0.1) & (hz < 0.6), (hz > 0.8) & (hz < 2.0)
    breath, heart = hz[slow][spectrum[:, slow].argmax(1)], hz[fast][spectrum[:, fast].argmax(1)]
    assert breath.min() > 0.17
    assert breath.max() < 0.43
    assert np.ptp(breath) > 0.1
    assert heart.min() > 0.95
    assert heart.max() < 1.75
    swing = np.ptp(chest, axis=1)
    assert swing.min() > 0.004
    assert swing.max() < 0.0126
    beats = 2 * np.sqrt(
        (spectrum[:, fast] ** 2).sum(1) / 1.5
    )  # a line of a Hann window has 1.5 of its peak power
    assert beats.min() > 0.0002 * 0.6
    assert beats.max() < 0.0005 * 1.5


def test_an_even_rhythm_in_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tensorsim.motion.vital_signs.WANDER_CYCLES", 0.0)
    signs = VitalSigns(30.0, (0.01, 0.01), (0.25, 0.25), (0.0, 0.0), people=1)
    time = torch.arange(400, dtype=torch.float64) / 100
    expected = 0.005 * np.cos(2 * np.pi * (0.25 * time.numpy() + float(signs.phase[0, 0])))
    np.testing.assert_allclose(signs.displacement_m(time)[:, 0].numpy(), expected, atol=1e-12)


def test_only_the_chest_moves_and_forward() -> None:
    joints = standing(1, 200, 0.7)
    signs = VitalSigns(30.0)
    moved = signs(joints) - joints
    others = [j for j in range(14) if j != NECK]
    assert float(moved[:, :, others].abs().max()) == 0.0
    ahead = rotation(2, torch.tensor(0.7).double()) @ torch.tensor([0.0, 1.0, 0.0]).double()
    chest = signs.displacement_m(torch.arange(200, dtype=torch.float64) / 30)[:, :1]
    assert_same(moved[0, :, NECK], chest * ahead, atol=1e-6)


def test_pieces_join_and_people_differ() -> None:
    joints, signs = standing(2, 90), VitalSigns(30.0)
    moved = signs(joints)
    assert not torch.allclose(moved[0], moved[1])
    pieces = [signs(joints[:, a:b], a) for a, b in ((0, 1), (1, 50), (50, 90))]
    assert_same(torch.cat(pieces, 1), moved, atol=1e-12)
    assert not torch.allclose(VitalSigns(30.0, seed=1)(joints), moved)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate_hz": -1.0}, "rate_hz: got -1.0"),
        ({"breath_m": (0.01, 0.005)}, "breath_m: got"),
        ({"breath_m": 0.01}, "breath_m: got 0.01, expected an ascending range from 0 or more"),
        ({"heart_hz": (-1.0, 1.0)}, "heart_hz: got"),
        ({"people": 0}, "people: got 0"),
    ],
)
def test_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        VitalSigns(**(dict[str, Any](rate_hz=30.0) | options))
