"""Shadows between people, by geometry."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor, nn

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.errors import TensorsimError
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.motion.shadowing import Shadowing, segment_distance
from tests.stage import StageTester, assert_same

TX, RX = (-0.1, 0.0, 1.2), (0.1, 0.0, 1.2)


def standing(*places: tuple[float, float]) -> Tensor:
    """People (P, 1, 14, 3) who stand at (x, y), hips 0.95 m high."""
    body = forward_kinematics(BodyPose.standing(), 1.75)
    shifts = torch.tensor([[x, y, 0.95] for x, y in places], dtype=torch.float64)
    return (body + shifts.unsqueeze(1)).unsqueeze(1)


def losses_db(positions: Tensor, fade: Tensor | None = None, **options: float) -> Tensor:
    """Loss (P, 14) of the joints of each person at the first pulse."""
    fade = torch.ones(positions.shape[:2], dtype=torch.float64) if fade is None else fade
    free = JointScatterers()(positions, fade)[1]
    shadowed = Shadowing(JointScatterers(), TX, RX, **options)(positions, fade)[1]
    return -10 * torch.log10(shadowed / free)[0].unflatten(0, (-1, 14))


class TestShadowing(StageTester):
    gradient_arguments = (0, 1)
    batched_arguments = (0, 1)

    def make(self) -> nn.Module:
        return Shadowing(JointScatterers(), TX, RX)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        people = standing((0.0, 2.0), (0.15, 3.5), (-0.2, 5.0)).expand(*batch, 3, 4, 14, 3)
        noise = 0.05 * torch.randn(people.shape, generator=generator, dtype=torch.float64)
        fade = torch.rand((*batch, 3, 4), generator=generator, dtype=torch.float64)
        return (people + noise).to(dtype), fade.to(dtype)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        positions, fade = torch.zeros(2, 5, 14, 3), torch.ones(2, 5)
        return [
            ((positions[..., :13, :], fade), r"positions: got shape \[2, 5, 13, 3\]"),
            ((positions, fade[:1]), r"fade: got shape \[1, 5\]"),
        ]


def test_segment_distance_equals_a_search() -> None:
    rng = np.random.default_rng(0)
    for _ in range(30):
        origin, end, start, stop = rng.normal(size=(4, 3))

        def square(x: np.ndarray, o=origin, e=end, a=start, b=stop) -> float:
            return float(np.sum((o + x[0] * (e - o) - a - x[1] * (b - a)) ** 2))

        found = min(
            minimize(square, x0, bounds=[(0, 1), (0, 1)], tol=1e-12).fun
            for x0 in ([0, 0], [0, 1], [1, 0], [1, 1])
        )
        o, e, a, b = (torch.as_tensor(v) for v in (origin, end, start, stop))
        actual = segment_distance(o, e.unsqueeze(0), a.unsqueeze(0), b.unsqueeze(0))
        assert float(actual) == pytest.approx(np.sqrt(found), abs=1e-5)


def test_distance_of_a_long_segment_from_what_is_behind_its_start() -> None:
    """From the origin along y to (0, 100): of the line y = x - 0.4 the origin itself is nearest, to (0.2, -0.2)."""
    points = [[0.0, 100.0, 0.0], [-1.0, -1.4, 0.0], [0.3, -0.1, 0.0]]
    end, start, stop = torch.tensor(points, dtype=torch.float64).split(1)
    found = segment_distance(torch.zeros(3, dtype=torch.float64), end, start, stop)
    assert float(found) == pytest.approx(0.2 * 2**0.5, abs=1e-9)


def test_segments_that_are_points_or_parallel() -> None:
    origin = torch.zeros(3)
    ends = torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    start, stop = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[1.0, 5.0, 0.0]])
    torch.testing.assert_close(segment_distance(origin, ends, start, stop), torch.ones(2, 1))
    torch.testing.assert_close(segment_distance(origin, ends, start, start), torch.ones(2, 1))


@pytest.mark.parametrize("edge_m", [0.0, 0.02])
def test_who_stands_behind_loses_both_legs(edge_m: float) -> None:
    """Convention: the loss is one-way; the person in front and a person beside lose nothing."""
    front, behind, beside = losses_db(standing((0, 2), (0, 4), (1.5, 4)), attenuation_db=15, edge_m=edge_m)
    neck, hip = 1, 8
    assert float(front.abs().max()) < 0.1
    assert float(beside.abs().max()) < 0.1
    assert float(behind[neck]) == pytest.approx(30, abs=0.3)
    assert float(behind[hip]) == pytest.approx(30, abs=2)


def test_the_torso_shadows_and_not_the_legs() -> None:
    """A ray from 1.2 m to an ankle at 4 m passes a person at 2 m at the hips, at 3.5 m below them."""
    ankle = 10
    assert float(losses_db(standing((0, 2), (0, 4)), edge_m=0.0)[1, ankle]) == 0
    legs = standing((0, 2), (0, 4))
    legs[0, ..., 2] -= 0.45  # a person who sits lower blocks it
    assert float(losses_db(legs, edge_m=0.0)[1, ankle]) == pytest.approx(40)


def test_one_leg_can_be_free() -> None:
    """The line from one antenna passes the body, the other does not: the loss of one leg."""
    wide = Shadowing(JointScatterers(), (-1.0, 0.0, 1.2), (1.0, 0.0, 1.2), edge_m=0.0)
    positions, fade = standing((0.5, 2.0), (0.0, 4.0)), torch.ones(2, 1, dtype=torch.float64)
    ratio = (wide(positions, fade)[1] / JointScatterers()(positions, fade)[1])[
        0, 15
    ]  # the neck of the second
    assert float(ratio) == pytest.approx(10 ** (-20 / 10))


def test_losses_of_several_add_up_and_fade_with_the_person() -> None:
    people = standing((0, 2), (0, 3), (0, 5))
    assert float(losses_db(people, attenuation_db=5, edge_m=0.0)[2, 1]) == pytest.approx(20)
    fade = torch.tensor([[0.5], [0.0], [1.0]], dtype=torch.float64)
    free = JointScatterers()(people, fade)[1]
    shadowed = Shadowing(JointScatterers(), TX, RX, attenuation_db=5, edge_m=0.0)(people, fade)[1]
    assert float(-10 * torch.log10(shadowed / free)[0, 29]) == pytest.approx(5)


def test_the_edge_is_soft_and_half_at_the_capsule() -> None:
    """The line from the origin to (x, 4) keeps 2 x / hypot(x, 4) from an axis at (0, 2): x = 0.3008 for 0.15 m."""
    model = Shadowing(JointScatterers(), (0.0, 0.0, 1.2), (0.0, 0.0, 1.2), edge_m=0.02)
    fade, neck = torch.ones(2, 1, dtype=torch.float64), 15
    touching = 4 * 0.15 / np.sqrt(2**2 - 0.15**2)
    found = []
    for shift in (-0.3, -0.1, 0.0, 0.1, 0.3):
        people = standing((0, 2), (touching + shift, 4)).requires_grad_(True)
        loss = -10 * torch.log10(model(people, fade)[1] / JointScatterers()(people, fade)[1])[0, neck]
        found.append(loss.item())
        if shift == 0.0:
            loss.backward()
            assert people.grad is not None
            assert people.grad[1, 0, 1, 0].item() < -10  # dB per metre: further out is less loss
            assert people.grad[0, 0, 1, 0].item() > 10  # and so is a torso in front that steps aside
    assert found[2] == pytest.approx(20, abs=0.2)
    assert found == sorted(found, reverse=True)
    assert found[0] > 39.5
    assert found[-1] < 0.1


def test_lone_people_and_empty_scenes_are_untouched() -> None:
    for people in (0, 1):
        args = torch.randn(people, 3, 14, 3), torch.ones(people, 3)
        assert_same(Shadowing(JointScatterers(), TX, RX)(*args), JointScatterers()(*args))


def test_goes_around_any_scatterer_model() -> None:
    model = LimbScatterers(TX, RX, per_segment=2)
    args = standing((0, 2), (0, 4)), torch.ones(2, 1, dtype=torch.float64)
    scene, rcs = Shadowing(model, TX, RX)(*args)
    free_scene, free_rcs = model(*args)
    assert torch.equal(scene, free_scene)
    assert bool((rcs <= free_rcs).all())
    assert float(rcs[0, 24:].sum() / free_rcs[0, 24:].sum()) < 0.3
    assert float(rcs[0, :24].sum() / free_rcs[0, :24].sum()) > 0.99


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tx_m": (0.0, 0.0)}, "tx_m: got .* three finite numbers"),
        ({"rx_m": (0.0, float("nan"), 0.0)}, "rx_m: got"),
        ({"attenuation_db": -1.0}, "attenuation_db: got -1.0"),
        ({"edge_m": float("inf")}, "edge_m: got inf"),
        ({"radius_m": 0.0}, "radius_m: got 0.0"),
    ],
)
def test_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        Shadowing(JointScatterers(), **({"tx_m": TX, "rx_m": RX} | options))
