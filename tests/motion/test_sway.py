"""Quiet standing: the spectrum of sway, its size, its direction, and pieces of a clip."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.body.kinematics import BodyPose, forward_kinematics, rest_on_floor, rotation
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.motion.random_process import RandomProcess, sinusoids
from tensorsim.motion.sway import MASS_HEIGHT_M, PosturalSway, sway_spectrum
from tests.stage import StageTester, assert_same

NECK, ANKLE = JOINTS.index("neck"), JOINTS.index("right_ankle")


def standing(people: int, frames: int, heading: float = 0.0) -> Tensor:
    """(P, T, 14, 3) float64."""
    pose = BodyPose.standing((people, frames))
    joints = forward_kinematics(pose._replace(heading=pose.heading + heading), 1.75)
    return rest_on_floor(joints, 1.75) + torch.tensor([0.0, 3.0, 0.0])


class TestRandomProcess(StageTester):
    float32_atol = 1e-3

    def make(self) -> nn.Module:
        return RandomProcess(sway_spectrum, (0.03, 4.0), 0.005, 3, 1)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return ((torch.arange(6, dtype=torch.float64) / 64).expand(*batch, 6).to(dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [((torch.arange(6),), "time_s: got dtype")]


class TestPosturalSway(StageTester):
    def make(self) -> nn.Module:
        return PosturalSway(30.0)

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


def test_sinusoids_in_closed_form() -> None:
    time = torch.tensor([0.0, 0.3, 1e6], dtype=torch.float64)
    found = sinusoids(
        time,
        torch.tensor([[2.0, 0.5]]).double(),
        torch.tensor([1.0, 3.0]).double(),
        torch.tensor([[0.1, 0.0]]).double(),
    )
    expected = np.cos(2 * np.pi * np.mod(2 * time.numpy(), 1) + 0.1) + 3 * np.cos(
        2 * np.pi * np.mod(0.5 * time.numpy(), 1)
    )
    np.testing.assert_allclose(found[:, 0].numpy(), expected, atol=1e-9)


def test_spectrum_of_sway() -> None:
    """Welch's density of many people: flat below 0.3 Hz, then an octave costs 6 dB; the rms is as asked."""
    from scipy.signal import welch

    process = RandomProcess(sway_spectrum, (0.03, 4.0), 0.005, 64, 0)
    sway = process(torch.arange(8192, dtype=torch.float64) / 16).T.numpy()
    frequency, density = welch(sway, 16.0, nperseg=1024)
    density = density.mean(0)
    assert sway.std(1).mean() == pytest.approx(0.005, rel=0.05)

    def level(hz: float) -> float:
        near = np.abs(np.log2(frequency[1:] / hz)) < 0.35
        return float(10 * np.log10(density[1:][near].mean()))

    for hz in (0.15, 0.6, 1.2, 2.4):
        expected = 10 * np.log10((1 + (0.075 / 0.3) ** 2) / (1 + (hz / 0.3) ** 2))
        assert level(hz) - level(0.075) == pytest.approx(expected, abs=1.5)


def test_there_are_no_more_processes_than_copies() -> None:
    process = RandomProcess(sway_spectrum, (0.03, 4.0), 0.005, 2, 0)
    assert process(torch.zeros(3), 1).shape == (3, 1)
    with pytest.raises(TensorsimError, match="copies: got 5, expected 0 to 2"):
        process(torch.zeros(3), 5)


def test_processes_are_independent() -> None:
    process = RandomProcess(sway_spectrum, (0.03, 4.0), 1.0, 4, 0)
    values = process(torch.arange(20000, dtype=torch.float64) / 4)
    correlation = np.corrcoef(values.T.numpy()) - np.eye(4)
    assert np.abs(correlation).max() < 0.1


def test_bodies_turn_about_their_ankles() -> None:
    """A joint moves in proportion to its height, along the direction faced for forward sway; ankles stay."""
    joints = standing(1, 600, 0.7)
    moved = PosturalSway(30.0, forward_rms_m=0.005, sideways_rms_m=0.0)(joints) - joints
    ahead = rotation(2, torch.tensor(0.7).double()) @ torch.tensor([0.0, 1.0, 0.0]).double()
    assert float(moved[..., ANKLE, :].abs().max()) < 1e-12
    neck = moved[0, :, NECK]
    assert_same((neck @ ahead)[:, None] * ahead, neck, atol=1e-6)
    lever = (joints[0, 0, NECK, 2] - joints[0, 0, ANKLE, 2]) / MASS_HEIGHT_M
    hip = JOINTS.index("right_hip")
    share = (joints[0, 0, hip, 2] - joints[0, 0, ANKLE, 2]) / (joints[0, 0, NECK, 2] - joints[0, 0, ANKLE, 2])
    assert_same(moved[0, :, hip], share * neck, atol=1e-6)
    assert float((neck @ ahead).square().mean().sqrt() / lever) == pytest.approx(0.005, rel=0.5)


def test_lying_bodies_are_still() -> None:
    lying = standing(1, 30) @ rotation(0, torch.tensor(np.pi / 2).double()).T
    lying = lying - lying[..., 2:].amin() * torch.tensor([0.0, 0.0, 1.0])
    moved = PosturalSway(30.0)(lying) - lying
    assert float(moved.norm(dim=-1).max()) < 0.15 * 0.02


def test_people_sway_apart_and_pieces_join() -> None:
    joints, sway = standing(2, 90), PosturalSway(30.0)
    moved = sway(joints)
    assert not torch.allclose(moved[0], moved[1])
    pieces = [sway(joints[:, a:b], a) for a, b in ((0, 1), (1, 50), (50, 90))]
    assert_same(torch.cat(pieces, 1), moved, atol=1e-12)
    assert_same(PosturalSway(60.0)(standing(2, 180))[:, ::2], moved, atol=1e-12)
    assert not torch.allclose(PosturalSway(30.0, seed=1)(joints), moved)
    assert sway(joints[:0]).shape == (0, 90, 14, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate_hz": 0.0}, "rate_hz: got 0.0"),
        ({"forward_rms_m": -1.0}, "rms: got -1.0"),
        ({"people": 0}, "people: got 0"),
    ],
)
def test_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        PosturalSway(**(dict[str, Any](rate_hz=30.0) | options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"band_hz": (1.0, 0.5)}, "band_hz: got"),
        ({"band_hz": (0.0, 0.5)}, "band_hz: got"),
        ({"copies": 0}, "copies, count: got"),
    ],
)
def test_random_process_refuses(options: dict[str, Any], message: str) -> None:
    values = dict[str, Any](spectrum=sway_spectrum, band_hz=(0.1, 1.0), rms=1.0, copies=1, seed=0) | options
    with pytest.raises(TensorsimError, match=message):
        RandomProcess(**values)
