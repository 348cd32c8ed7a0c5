"""Steps on top of a movement: where the feet and the hips get to, and bones that keep their lengths."""

import torch

from tensorsim.body.skeleton import mid_hips
from tensorsim.config import JOINTS
from tensorsim.motion import scripts
from tensorsim.motion.activities import perform
from tensorsim.motion.footwork import step_about
from tensorsim.motion.people import PeopleConfig, draw_people

RATE = 120.0
RIGHT, LEFT = JOINTS.index("right_ankle"), JOINTS.index("left_ankle")


def stepped(way_m):
    """Four people who punch before and after, with steps of 0.6 s that begin every second."""
    people = draw_people(4, PeopleConfig(), torch.Generator().manual_seed(3))
    time = (torch.arange(round(4 * RATE), dtype=torch.float64) / RATE).expand(4, -1)
    joints = perform(scripts.punch, time, people)
    way = torch.tensor(way_m, dtype=torch.float64).expand(4, -1, -1)
    start = torch.arange(way.shape[1], dtype=torch.float64).expand(4, -1) + 0.5
    return joints, step_about(joints, time, start, torch.full_like(start, 0.6), way)


def test_feet_and_hips_go_where_the_steps_lead_and_stand_between_them():
    way = [[0.3, 0.1], [-0.1, 0.4]]
    before, after = stepped(way)
    total = torch.tensor([0.2, 0.5, 0.0], dtype=torch.float64)
    moved = (after - before)[:, -1]
    torch.testing.assert_close(moved[:, [RIGHT, LEFT]], total.expand(4, 2, -1), atol=1e-4, rtol=0)
    torch.testing.assert_close(moved[:, 1], total.expand(4, -1), atol=1e-9, rtol=0)
    # A stretched leg straightens ever more slowly, so that feet are reached to a tenth of a millimetre.
    between = after[:, round(1.12 * RATE) : round(1.48 * RATE), [RIGHT, LEFT]]
    assert float(between.diff(dim=1).norm(dim=-1).max()) < 1e-9
    one = torch.tensor([*way[0], 0.0], dtype=torch.float64)
    here = mid_hips(after - before)[:, round(1.3 * RATE)]
    torch.testing.assert_close(here, one.expand(4, -1), atol=1e-9, rtol=0)


def test_one_foot_stands_while_the_other_begins_a_step():
    before, after = stepped([[0.0, 0.5]])
    begun = (after - before)[:, round(0.65 * RATE)]
    assert bool((begun[:, RIGHT, 1] > 0.05).all())
    assert bool((begun[:, RIGHT, 2] > 0.01).all())
    assert float(begun[:, LEFT].norm(dim=-1).max()) < 1e-9
    assert float(after[..., 2].min()) > 0.0


def test_bones_keep_their_lengths_and_no_step_is_none():
    before, after = stepped([[0.0, 0.7], [0.5, -0.2]])
    for a, b in ((8, 9), (9, 10), (11, 12), (12, 13), (1, 0)):
        torch.testing.assert_close(
            (after[:, :, a] - after[:, :, b]).norm(dim=-1), (before[:, :, a] - before[:, :, b]).norm(dim=-1)
        )
    same, unmoved = stepped([[0.0, 0.0]])
    torch.testing.assert_close(unmoved, same, atol=2e-3, rtol=0)
