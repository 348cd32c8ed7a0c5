"""How well positions and radial speeds of people are estimated from a film.

python -m tests.benchmarks.eval_range [SEED]

Everyday motion with the keypoints that networks find, before cameras that are known to 4 degrees and 12 %; the
distance of the hips from the radar, lifted, placed and smoothed, against the true one: its mean error but for a
constant, and the root mean square and mean errors of its rate of change, which is where Doppler comes from, and the
slope of that rate against the true one. Then, from exact keypoints and with a known camera, the share of the speed that
is found when somebody walks away slowly.
"""

import sys
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import mid_hips
from tensorsim.config import ACTIVITIES, CameraConfig
from tensorsim.geometry.framing import keypoint_boxes, seen_keypoints
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.people import PeopleConfig
from tensorsim.pipeline import VideoToPose
from tensorsim.training.everyday import at_rate, everyday_motion
from tensorsim.training.keypoint_errors import FilmedMotion
from tensorsim.types import Tracks

GROUPS, PEOPLE, SECONDS = 12, 4, 4.0
RATES_HZ = (15.0, 18.0, 20.0, 25.0)
MATTRESS_M = 0.2


class Row(NamedTuple):
    """People who do one activity, and what those who lie are raised by."""

    name: str
    activity: int
    raised_m: float = 0.0


ROWS = (
    *(Row(ACTIVITIES[k], k) for k in (3, 7, 9, 10)),
    Row(ACTIVITIES[11], 11),
    Row("... onto a mattress", 11, MATTRESS_M),
)


def onto_mattress(joints: Tensor, height_m: float, thick_m: float) -> Tensor:
    """Joints (T, 14, 3) raised as the trunk tilts, by all of the thickness when it is level."""
    trunk = (joints[:, 1] - mid_hips(joints))[:, 2] / (0.3 * height_m)
    up = torch.zeros_like(joints)
    up[..., 2] = thick_m * (1 - trunk).clamp(0.0, 1.0)[:, None]
    return joints + up


def errors(row: Row, seed: int, films: FilmedMotion) -> Tensor:
    """Mean error of the range (m), and of its rate of change root mean square, mean (m/s), and slope."""
    off: list[Tensor] = []
    wrong_rates: list[Tensor] = []
    true_rates: list[Tensor] = []
    for group in range(GROUPS):
        generator = torch.Generator().manual_seed((seed + group) * 1000 + row.activity)
        fps = RATES_HZ[group % len(RATES_HZ)]
        motion, heights = everyday_motion(row.activity, PEOPLE, torch.full((PEOPLE,), SECONDS), generator)
        people = [
            (onto_mattress(at_rate(joints, round(SECONDS * fps), fps), height, row.raised_m), height)
            for joints, height in zip(motion, heights.tolist(), strict=True)
        ]
        found, valid = films(people, fps, generator)
        for k, (joints, _) in enumerate(people):
            there = valid[k]
            if int(there.sum()) < 8:
                continue
            true = mid_hips(joints)[:, :2].norm(dim=-1)
            wrong = mid_hips(found[k])[:, :2].norm(dim=-1) - true
            off.append((wrong - wrong[there].median())[there].abs().mean())
            both = there[1:] & there[:-1]
            wrong_rates.append((wrong.diff() * fps)[both])
            true_rates.append((true.diff() * fps)[both])
    wrong_rate, true_rate = torch.cat(wrong_rates), torch.cat(true_rates)
    slope = 1 + (wrong_rate * true_rate).sum() / true_rate.square().sum()
    sizes = [torch.stack(off).mean(), wrong_rate.square().mean().sqrt(), wrong_rate.abs().mean(), slope]
    return torch.stack(sizes)


def share_of_walk(speed_m_s: float) -> float:
    """Speed found of people who walk away from a known camera, over the true one."""
    config = PeopleConfig(speed_m_s=(speed_m_s, speed_m_s), heading_rad=0.0, facing_radar_share=0.0)
    camera, fps, inside, shares = CameraConfig(position_m=(0.0, 0.0, 1.2)), 30.0, slice(20, 100), []
    for seed in range(6):
        made = ActivityGenerator(config).generate("walking", seed=seed, duration_s=4.0, rate_hz=fps)
        true = made.joints[0] + torch.tensor([0.0, 1.5, 0.0])
        there = torch.ones(1, len(true), dtype=torch.bool)
        keypoints, scores = seen_keypoints(true[None], there, camera, 480, 640)
        tall = (float(made.people.height_m[0]),)
        stage = VideoToPose(nn.Identity(), nn.Identity(), camera=camera, person_height_m=tall).eval()
        tracks = Tracks(keypoint_boxes(keypoints, scores)[None], there[None], there[None])
        found = stage.lift(tracks, keypoints[None], scores[None], 480, 640, fps).joints[0, 0]
        ways = [mid_hips(joints)[inside, 1] for joints in (found, true)]
        shares.append(float((ways[0][-1] - ways[0][0]) / (ways[1][-1] - ways[1][0])))
    return sum(shares) / len(shares)


@torch.no_grad()
def main() -> None:
    torch.set_num_threads(1)
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    films = FilmedMotion()
    print(f"{'':24s} range m   speed m/s: rms, mean, slope")
    for row in ROWS:
        print(f"{row.name:24s}", *(f"{x:8.3f}" for x in errors(row, seed, films).tolist()), flush=True)
    for speed_m_s in (0.3, 0.5, 0.8, 1.2):
        print(f"walks at {speed_m_s} m/s: {share_of_walk(speed_m_s):.2f} of the speed")


if __name__ == "__main__":
    main()
