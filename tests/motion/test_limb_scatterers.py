"""Ellipsoids of the body: cross sections against closed forms, places against the skeleton, the sum of a walk."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.body.kinematics import BodyPose, forward_kinematics, rest_on_floor, rotation
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.motion.limb_scatterers import SEGMENTS, LimbScatterers, bisector, ellipsoid_rcs
from tests.stage import StageTester, assert_same

TX, RX = (-0.1, 0.0, 1.5), (0.1, 0.0, 1.5)
NAMES = [s.name for s in SEGMENTS]


def walk(heading: float, distance_m: float, pulses: int = 60, height_m: float = 1.75) -> Tensor:
    """One gait cycle (1, M, 14, 3) on the spot: hips to 25, knees to 60, shoulders to 20 degrees."""
    phase = 2 * np.pi * torch.arange(pulses, dtype=torch.float64) / pulses
    pose = BodyPose.standing((pulses,))
    swing, lift = torch.sin(phase), (1 - torch.cos(phase)) / 2
    other = (1 + torch.cos(phase)) / 2
    joints = forward_kinematics(
        pose._replace(
            heading=pose.heading + heading,
            hip=torch.deg2rad(torch.stack((25 * swing, 0 * swing, -25 * swing, 0 * swing), -1)).unflatten(
                -1, (2, 2)
            ),
            knee=torch.deg2rad(torch.stack((5 + 55 * lift, 5 + 55 * other), -1)),
            shoulder=torch.deg2rad(
                torch.stack((-20 * swing, 0 * swing, 0 * swing, 20 * swing, 0 * swing, 0 * swing), -1)
            ).unflatten(-1, (2, 3)),
            elbow=torch.deg2rad(torch.full((pulses, 2), 20.0, dtype=torch.float64)),
        ),
        height_m,
    )
    joints = rest_on_floor(joints, height_m)
    return (joints + torch.tensor([0.0, distance_m, 0.0])).unsqueeze(0)


def dbsm(model: LimbScatterers, joints: Tensor) -> float:
    """Mean over pulses of the summed cross section, in dB above 1 m^2."""
    rcs = model(joints, torch.ones(joints.shape[:-2], dtype=joints.dtype))[1]
    return float(10 * torch.log10(rcs.sum(-1).mean()))


class TestLimbScatterers(StageTester):
    gradient_arguments = (0, 1)
    batched_arguments = (0, 1)

    def make(self) -> nn.Module:
        return LimbScatterers(TX, RX, per_segment=2)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        people = torch.cat((walk(0.3, 2.0, 4), walk(2.0, 4.0, 4))).expand(*batch, 2, 4, 14, 3)
        noise = 0.02 * torch.randn(people.shape, generator=generator, dtype=torch.float64)
        fade = torch.rand((*batch, 2, 4), generator=generator, dtype=torch.float64)
        return (people + noise).to(dtype), fade.to(dtype)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        positions, fade = torch.zeros(2, 5, 14, 3), torch.ones(2, 5)
        return [
            ((positions[..., :13, :], fade), r"positions: got shape \[2, 5, 13, 3\], expected .* 14, 3\)"),
            ((positions, fade[:1]), r"fade: got shape \[1, 5\]"),
            ((positions, fade > 0), "fade: got dtype"),
        ]


# ---- the closed form -------------------------------------------------------------------------------------


def test_ellipsoid_against_the_angles_of_the_book() -> None:
    rng = np.random.default_rng(0)
    a, b, c = rng.uniform(0.05, 0.5, (3, 50))
    theta, phi = rng.uniform(0, np.pi, 50), rng.uniform(0, 2 * np.pi, 50)
    expected = (
        np.pi * a**2 * b**2 * c**2
        / (
            a**2 * np.sin(theta) ** 2 * np.cos(phi) ** 2
            + b**2 * np.sin(theta) ** 2 * np.sin(phi) ** 2
            + c**2 * np.cos(theta) ** 2
        )
        ** 2
    )  # fmt: skip
    view = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)
    actual = ellipsoid_rcs(torch.as_tensor(np.stack((a, b, c), -1)), torch.as_tensor(view**2))
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-12)


def test_a_sphere_and_its_mean() -> None:
    """A sphere has its shadow, pi r^2, from everywhere; a body of any form has a mean of surface / 4.

    The mean of this form over all directions is the surface of the ellipsoid over 4, as for every convex body
    in geometrical optics (Cauchy): here a spheroid with its surface in closed form.
    """
    assert float(ellipsoid_rcs(torch.full((3,), 0.2), torch.tensor([0.2, 0.3, 0.5]))) == pytest.approx(
        np.pi * 0.04, rel=1e-6
    )
    a, c = 0.1, 0.3
    cos = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
    axes = torch.tensor([a, a, c], dtype=torch.float64)
    mean = ellipsoid_rcs(axes, torch.stack((1 - cos**2, 0 * cos, cos**2), -1)).mean()
    e = np.sqrt(1 - a**2 / c**2)
    surface = 2 * np.pi * a**2 * (1 + c / (a * e) * np.arcsin(e))
    assert float(mean) == pytest.approx(surface / 4, rel=1e-3)


def test_bisector_is_between_the_antennas() -> None:
    tx, rx = torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0])
    points = torch.tensor([[0.0, 5.0, 0.0], [0.0, 0.0, 3.0]])
    expected = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    torch.testing.assert_close(bisector(points, tx, rx), expected)
    between = torch.zeros(1, 3, requires_grad=True)  # forward scattering has no bisector
    value = bisector(between, tx, rx)
    value.sum().backward()
    assert between.grad is not None
    assert bool(torch.isfinite(value).all() and torch.isfinite(between.grad).all())


# ---- the body --------------------------------------------------------------------------------------------


def segment_of(x: Tensor, name: str, n: int) -> Tensor:
    """Entries of one segment along the scatterer dimension -1 of (M, S)."""
    i = NAMES.index(name)
    return x[:, i * n : (i + 1) * n]


def test_places_along_the_segments() -> None:
    joints = walk(0.0, 3.0)
    scene, rcs = LimbScatterers(TX, RX, per_segment=4)(joints, torch.ones(1, 60, dtype=torch.float64))
    assert scene.shape == (60, 48, 3)
    assert rcs.shape == (60, 48)
    hip, knee = (joints[0, :, JOINTS.index(n)] for n in ("left_hip", "left_knee"))
    first = NAMES.index("left_thigh") * 4
    for k in range(4):
        place = hip + (k + 0.5) / 4 * (knee - hip)
        torch.testing.assert_close(scene[:, first + k], place, rtol=0, atol=1e-12)


def test_feet_point_forward_whatever_the_leg_does() -> None:
    """Convention: forward is to the left of the body's right side, seen from above; a raised leg has toes up."""
    for heading in (0.0, 1.0, 3.0):
        pose = BodyPose.standing((2,))
        hip = torch.zeros(2, 2, 2, dtype=torch.float64)
        hip[1, 0, 0] = np.pi / 2  # the right leg straight ahead
        joints = forward_kinematics(pose._replace(heading=pose.heading + heading, hip=hip), 1.75).unsqueeze(0)
        scene = LimbScatterers(TX, RX, per_segment=1)(joints, torch.ones(1, 2, dtype=torch.float64))[0]
        foot = scene[:, NAMES.index("right_foot")] - joints[0, :, JOINTS.index("right_ankle")]
        ahead = rotation(2, torch.tensor(heading, dtype=torch.float64)) @ torch.tensor(
            [0.0, 1.0, 0.0], dtype=torch.float64
        )
        down, up = torch.tensor([0.0, 0.0, -1.0]).double(), torch.tensor([0.0, 0.0, 1.0]).double()
        torch.testing.assert_close(foot[0], 1.75 * (0.06 * ahead + 0.039 / 4 * down), rtol=0, atol=1e-9)
        torch.testing.assert_close(foot[1], 1.75 * (0.06 * up + 0.039 / 4 * ahead), rtol=0, atol=1e-9)


def test_cross_sections_by_aspect() -> None:
    """Far away at the height of a segment: pi c^2 of a limb broadside, the torso's front against its side."""
    far = 1e4
    front, side = (
        forward_kinematics(BodyPose.standing((1,))._replace(heading=torch.tensor([h]).double()), 1.75)
        .add(torch.tensor([0.0, far, 0.0]))
        .unsqueeze(0)
        for h in (0.0, np.pi / 2)
    )
    model = LimbScatterers((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), per_segment=3, reflectivity=1.0)
    fade = torch.ones(1, 1, dtype=torch.float64)
    shank = float(segment_of(model(front, fade)[1], "right_shank", 3).sum())
    assert shank == pytest.approx(np.pi * (0.123 * 1.75) ** 2, rel=1e-3)
    a, b, c = (1.75 * v for v in (0.092, 0.067, 0.144))
    assert float(segment_of(model(front, fade)[1], "torso", 3).sum()) == pytest.approx(
        np.pi * a**2 * c**2 / b**2, rel=1e-3
    )
    assert float(segment_of(model(side, fade)[1], "torso", 3).sum()) == pytest.approx(
        np.pi * b**2 * c**2 / a**2, rel=1e-3
    )


def test_the_aspect_is_that_of_the_bisector() -> None:
    """Antennas at 45 degrees to both sides see what one in the middle sees, not what either sees alone."""
    body = walk(0.2, 0.0, 8) + torch.tensor([0.0, 1e4, 0.0])
    fade = torch.ones(1, 8, dtype=torch.float64)
    left, middle, right = (-1e4, 0.0, 0.0), (0.0, 0.0, 0.0), (1e4, 0.0, 0.0)
    bistatic, monostatic = (
        LimbScatterers(tx, rx)(body, fade)[1] for tx, rx in ((left, right), (middle, middle))
    )
    torch.testing.assert_close(bistatic, monostatic, rtol=1e-2, atol=0)
    alone = LimbScatterers(left, left)(body, fade)[1]
    assert float(((alone - monostatic).abs() / monostatic).max()) > 0.5


def test_energy_does_not_depend_on_the_number_of_points() -> None:
    joints = walk(0.4, 50.0)
    one, many = (dbsm(LimbScatterers(TX, RX, per_segment=n), joints) for n in (1, 8))
    assert many == pytest.approx(one, abs=0.1)


def test_cross_section_goes_with_the_square_of_the_height() -> None:
    """The same figure, twice as large and twice as far."""
    tx = (0.0, 0.0, 0.0)
    small = dbsm(LimbScatterers(tx, tx, height_m=1.0), walk(0.3, 3.0, height_m=1.0))
    large = dbsm(LimbScatterers(tx, tx, height_m=2.0), walk(0.3, 6.0, height_m=2.0))
    assert large - small == pytest.approx(20 * np.log10(2), abs=1e-6)


@pytest.mark.parametrize("distance_m", [3.0, 5.0, 10.0])
@pytest.mark.parametrize("degrees", range(0, 360, 45))
def test_a_walking_body_has_0_to_minus_8_dbsm(degrees: int, distance_m: float) -> None:
    total = dbsm(LimbScatterers((-0.1, 0.0, 1.0), (0.1, 0.0, 1.0)), walk(np.deg2rad(degrees), distance_m))
    assert -8 < total < 0


def test_a_recorded_walk_has_0_to_minus_8_dbsm(shared_data: Path) -> None:
    with np.load(shared_data / "mocap" / "cmu_14joints_120hz.npz") as clips:
        joints = torch.as_tensor(
            clips["walking_1"][1:], dtype=torch.float64
        )  # the first is a calibration pose
    joints[..., :2] -= joints[:, 8:9, :2].clone()
    for degrees in range(0, 360, 60):
        turned = joints @ rotation(2, torch.tensor(np.deg2rad(degrees))).T + torch.tensor([0.0, 4.0, 0.0])
        assert -8 < dbsm(LimbScatterers((0, 0, 1.0), (0, 0, 1.0)), turned.unsqueeze(0)) < 0


def test_streaming_equals_the_whole() -> None:
    joints, fade = walk(0.5, 3.0), torch.rand(1, 60, dtype=torch.float64)
    model = LimbScatterers(TX, RX)
    whole = model(joints, fade)
    pieces = [model(joints[:, a:b], fade[:, a:b]) for a, b in ((0, 1), (1, 40), (40, 60))]
    assert_same([torch.cat(parts) for parts in zip(*pieces, strict=True)], list(whole), atol=1e-12)


def test_degenerate_bodies_stay_finite() -> None:
    """All joints in one point, and arms stretched sideways, along the line of the shoulders."""
    stretched = torch.zeros(1, 1, 14, 3, dtype=torch.float64)
    stretched[..., 2:8, 0] = torch.tensor([0.2, 0.5, 0.8, -0.2, -0.5, -0.8], dtype=torch.float64)
    for joints in (torch.zeros(1, 1, 14, 3, dtype=torch.float64), stretched):
        joints.requires_grad_(True)
        scene, rcs = LimbScatterers(TX, RX)(joints, torch.ones(1, 1, dtype=torch.float64))
        rcs.sum().backward()
        assert joints.grad is not None
        assert all(bool(torch.isfinite(x).all()) for x in (scene, rcs, joints.grad))


def test_no_people_are_no_scatterers() -> None:
    scene, rcs = LimbScatterers(TX, RX)(torch.zeros(2, 0, 7, 14, 3), torch.zeros(2, 0, 7))
    assert scene.shape == (2, 7, 0, 3)
    assert rcs.shape == (2, 7, 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tx_m": (0.0, 0.0)}, "tx_m: got .* three finite numbers"),
        ({"rx_m": ((0.0, 0.0, 0.0),) * 3}, "rx_m: got"),
        ({"per_segment": 0}, "per_segment: got 0"),
        ({"per_segment": 1.5}, "per_segment: got 1.5"),
        ({"height_m": -1.0}, "height_m: got -1.0"),
        ({"reflectivity": 1.1}, "reflectivity: got 1.1"),
    ],
)
def test_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        LimbScatterers(**({"tx_m": TX, "rx_m": RX} | options))
