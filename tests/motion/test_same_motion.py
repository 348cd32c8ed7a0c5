"""The same seed gives the same movements and echoes in every release, so that slips in their many numbers show.

After a change that is meant, ``python -m tests.motion.test_same_motion`` prints the new numbers.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from tensorsim.motion import everyday, martial_arts
from tensorsim.motion.activities import ActivityGenerator, perform
from tensorsim.motion.body13 import Body13Scatterers
from tensorsim.motion.body_scatterers import BodyScatterers
from tensorsim.motion.exercises import EXERCISES
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.people import People, PeopleConfig, draw_people, nominal_people
from tensorsim.motion.pose_sampler import FAMILIES, sample_angles, sample_poses
from tensorsim.motion.scripts import SCRIPTS
from tensorsim.motion.sway import PosturalSway
from tensorsim.motion.vital_signs import VitalSigns

TX, RX = (-0.1, 0.0, 1.5), (0.1, 0.0, 1.5)


def people(count: int = 6) -> People:
    return draw_people(count, PeopleConfig(tempo=(0.6, 0.9)), torch.Generator().manual_seed(2))


def moved(script: Callable[..., object]) -> Tensor:
    """Six people at ten frames a second, from before they begin until they have ended."""
    time = torch.arange(-15, 65, dtype=torch.float64) / 10
    return perform(script, time.expand(6, -1), people())  # type: ignore[arg-type]


def generated() -> Tensor:
    classes = torch.arange(12)
    return ActivityGenerator().generate(classes, seed=5, duration_s=3.0, rate_hz=7.0).joints


def numbers(fields: object) -> Tensor:
    return torch.cat([torch.as_tensor(leaf).double().flatten() for leaf in pytree.tree_leaves(fields)])


def scattered(stage: Callable[..., object]) -> Tensor:
    """Positions and cross sections of two people who walk."""
    joints = moved(SCRIPTS[7]).unflatten(1, (16, 5))[:2, :, 0]
    return numbers(stage(joints, torch.full((2, 16), 0.9, dtype=torch.float64)))


MOVEMENTS: dict[str, Callable[[], Tensor]] = {
    **{script.__name__: lambda script=script: moved(script) for script in SCRIPTS},  # type: ignore[misc]
    **{name: lambda script=script: moved(script) for name, script in EXERCISES.items()},  # type: ignore[misc]
    **{
        script.__name__: lambda script=script: moved(script)  # type: ignore[misc]
        for script in (
            everyday.fall_any_way,
            everyday.fall_on_knees,
            everyday.fall_onto_seat,
            everyday.walk_and_fall_any_way,
            everyday.walk_and_slip,
            everyday.kick_ball,
            everyday.juggle_ball,
            martial_arts.swing_fist,
            martial_arts.punch_once,
            martial_arts.kick_round,
        )
    },
    "people": lambda: numbers(people(30)),
    "nominal people": lambda: numbers(nominal_people(3)),
    "generated": generated,
    "body at 24 GHz": lambda: scattered(BodyScatterers(TX, RX, 24e9).double()),
    "body at 77 GHz": lambda: scattered(BodyScatterers(TX, RX, 77e9, per_segment=2).double()),
    "limbs": lambda: scattered(LimbScatterers(TX, RX).double()),
    "sway": lambda: numbers(PosturalSway(30.0, seed=3).double()(moved(SCRIPTS[0])[:, :20])),
    "vital signs": lambda: numbers(VitalSigns(30.0, seed=3).double()(moved(SCRIPTS[0])[:, :20])),
    "13 parts": lambda: scattered(Body13Scatterers().double()),
    "poses": lambda: sample_poses(200, seed=3, limb_deviation=0.1),
    **{
        f"poses {family}": lambda family=family: numbers(  # type: ignore[misc]
            sample_angles(family, 12, torch.Generator().manual_seed(family))
        )
        for family in range(FAMILIES)
    },
}

#: Mean, root mean square and a weighted mean of the numbers of each.
EXPECTED: dict[str, tuple[float, float, float]] = {
    "stand": (0.314284588, 0.603702867, -0.005962278),
    "punch": (0.375475176, 0.655522771, -0.005016572),
    "kick": (0.364516630, 0.628190968, -0.006079326),
    "grab": (0.349271407, 0.630689605, -0.004795513),
    "sit_down": (0.223440625, 0.515303207, -0.004923896),
    "stand_up": (0.254214874, 0.544205279, -0.005094813),
    "rotate": (0.313505893, 0.609076069, -0.004980647),
    "walk": (1.214094351, 2.259600648, 0.002195436),
    "sit_to_walk": (0.739269386, 1.391900153, -0.002808710),
    "walk_to_sit": (0.568083793, 0.932201975, -0.001137975),
    "fall_to_walk": (0.729617705, 1.276046708, -0.001585436),
    "walk_to_fall": (0.673034194, 1.264576928, 0.002515799),
    "picking up": (0.307070685, 0.574753950, -0.004727978),
    "drinking": (0.322313375, 0.612480570, -0.006029285),
    "bending": (0.313936260, 0.586185803, -0.005047636),
    "falling": (0.387735755, 0.703390000, 0.000683200),
    "lying down": (0.370408443, 0.681446054, 0.001044601),
    "getting up": (0.337911151, 0.631352991, -0.003014793),
    "squats": (0.311530735, 0.575881425, -0.004779734),
    "jumping": (0.330085337, 0.607052823, -0.005606796),
    "jumping jacks": (0.344652485, 0.673148949, -0.006116021),
    "boxing": (0.385874017, 0.664271774, -0.005031633),
    "running": (1.259549070, 2.302388053, 0.002103209),
    "striding": (1.213086023, 2.271211519, 0.002797675),
    "creeping": (1.244937046, 2.306353726, 0.002929482),
    "crawling": (1.243903687, 2.484453263, 0.008004984),
    "fall_any_way": (0.231207977, 0.598085750, -0.002909076),
    "fall_on_knees": (0.350309476, 0.594558217, -0.001579414),
    "fall_onto_seat": (-0.028562151, 0.577834491, -0.004200713),
    "walk_and_fall_any_way": (0.144947516, 0.722729853, -0.002259517),
    "walk_and_slip": (0.147654467, 0.514757437, -0.003353826),
    "kick_ball": (0.947333609, 1.292992995, 0.000326650),
    "juggle_ball": (0.344931426, 0.616629818, -0.005547900),
    "swing_fist": (0.373928282, 0.665195583, -0.005567543),
    "punch_once": (0.349301063, 0.635562337, -0.004892133),
    "kick_round": (0.385739568, 0.649141547, -0.005113955),
    "people": (2.598692943, 11.314073570, 0.274158704),
    "nominal people": (2.639910796, 11.299597557, -0.122049055),
    "generated": (1.353686321, 2.047376603, 0.018808187),
    "body at 24 GHz": (0.908117789, 2.046529922, 0.018789231),
    "body at 77 GHz": (0.919116114, 2.050035550, 0.014323754),
    "limbs": (0.883863794, 2.044384118, 0.024224110),
    "sway": (0.314088726, 0.603705618, 0.001104952),
    "vital signs": (0.314177121, 0.603703908, 0.001155443),
    "13 parts": (0.978188363, 2.060816874, -0.011214040),
    "poses": (0.032511370, 0.185558932, 0.000755826),
    "poses 0": (0.107872149, 0.234981182, -0.011963000),
    "poses 1": (0.281702944, 0.611550721, -0.024892804),
    "poses 2": (0.204623979, 0.504351452, -0.026171213),
    "poses 3": (0.113241238, 0.234281994, -0.003864986),
    "poses 4": (0.280854146, 0.591816789, -0.012720964),
    "poses 5": (0.331119105, 0.585469448, -0.012578828),
    "poses 6": (0.275837128, 0.531211052, -0.020517924),
    "poses 7": (0.376232154, 0.625248477, -0.046188111),
    "poses 8": (0.509123402, 0.860694799, -0.047051768),
    "poses 9": (0.272157684, 0.532766714, 0.002857455),
    "poses 10": (0.281599462, 0.586845060, -0.041148797),
    "poses 11": (0.490919210, 0.798010204, -0.019222462),
    "poses 12": (0.327298223, 0.627686299, -0.014829527),
}


def signature(values: Tensor) -> tuple[float, float, float]:
    values = values.flatten().double()
    wave = torch.sin(0.37 * torch.arange(values.shape[0], dtype=torch.float64).square())
    return float(values.mean()), float(values.square().mean().sqrt()), float((wave * values).mean())


@pytest.mark.parametrize("name", MOVEMENTS)
def test_movements_are_those_of_the_numbers(name: str) -> None:
    assert signature(MOVEMENTS[name]()) == pytest.approx(EXPECTED[name], abs=2e-8)


if __name__ == "__main__":
    for name, values in MOVEMENTS.items():
        print(f"    {name!r}: ({', '.join(f'{x:.9f}' for x in signature(values()))}),".replace("'", '"'))
