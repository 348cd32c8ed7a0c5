"""The classifier on captured motion: ``python -m tests.benchmarks.eval_captured MOTION [MOTION ...]``.

Captured people walk, kick (most of them a ball, with a run-up) and punch 3.5 m before the radar, each turned to eight
headings, in 4 s about their fastest moment. Shorter sequences begin and end at rest, but for walks, which go on all the
time. No network saw these people: what is wrong is the classifier, or the motion that it has learnt from. Prints how
many headings of each sequence are labelled rightly in free space and behind the wall, and the other labels.
"""

import argparse
import math
from collections import Counter
from pathlib import Path

import torch
from torch import Tensor

from tensorsim import ACTIVITIES, PoseToDoppler, SimulationConfig
from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import mid_hips
from tensorsim.recognition import ActivityRecognizer
from tensorsim.training.lifter_motion import captures
from tensorsim.types import RadarMaps

#: First letters of the names of sequences, and the activity of each.
RIGHT = {"walking": "S8", "soccer": "S3", "kick": "S3", "punch": "S2"}
HEADINGS, SECONDS, RANGE_M = 8, 4.0, 3.5


def excerpt(joints: Tensor, fps: float, walk: bool) -> Tensor:
    """At most 4 s of a sequence (T, 14, 3) about its fastest moment; at least 4 s of one that is no walk."""
    frames = round(SECONDS * fps)
    moved = joints.diff(dim=0).norm(dim=-1).amax(dim=-1)
    if len(joints) >= frames:
        start = min(max(int(moved.argmax()) - frames // 2, 0), len(joints) - frames)
        return joints[start : start + frames]
    if walk:
        return joints
    before = (frames - len(joints)) // 2
    after = frames - len(joints) - before
    return torch.cat([joints[:1].expand(before, -1, -1), joints, joints[-1:].expand(after, -1, -1)])


def turned(joints: Tensor) -> Tensor:
    """A sequence (T, 14, 3) in all headings (HEADINGS, 1, T, 14, 3) before the radar."""
    angles = torch.arange(HEADINGS, dtype=torch.float64) * (2 * math.pi / HEADINGS)
    about = joints - torch.cat([mid_hips(joints)[:, :2].mean(dim=0), joints.new_zeros(1)])
    moved = (rotation(2, angles)[:, None, None] @ about[None, ..., None])[..., 0]
    return (moved + moved.new_tensor([0.0, RANGE_M, 0.0]))[:, None]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("motion", type=Path, nargs="+", help="files of captured motion (npz)")
    parser.add_argument("--classifier", help="weights, default the shipped ones")
    options = parser.parse_args()
    torch.set_grad_enabled(False)
    scenes = []
    for config in (SimulationConfig(), SimulationConfig.through_wall()):
        recognizer = ActivityRecognizer.from_pretrained(config.scene.radar, options.classifier).eval()
        scenes.append((PoseToDoppler.from_config(config), recognizer))
    paths = tuple(options.motion)
    found = captures(paths, held_out=False) | captures(paths, held_out=True)
    totals: Counter[str] = Counter()
    print("| sequence | right is | free space | others | through wall | others |")
    print("| --- | --- | ---: | --- | ---: | --- |")
    for name, (joints, fps) in sorted(found.items()):
        sequence = name.split()[-1]
        label = next((RIGHT[key] for key in RIGHT if sequence.startswith(key)), None)
        if label is None:
            continue
        people = turned(excerpt(joints, fps, label == "S8"))
        cells = []
        for number, (chain, recognizer) in enumerate(scenes):
            torch.manual_seed(0)
            out = chain(people.float(), torch.ones(people.shape[:3], dtype=torch.bool), fps)
            maps = RadarMaps(*(getattr(out, field) for field in RadarMaps._fields))
            told = [ACTIVITIES[k].split()[0] for k in recognizer(maps).argmax(-1).tolist()]
            right = told.count(label)
            totals[f"{label} {number}"] += right
            others = Counter(one for one in told if one != label)
            cells += [f"{right} of {HEADINGS}", ", ".join(f"{n} {one}" for one, n in others.most_common())]
        totals[label] += HEADINGS
        print(f"| {sequence} | {label} | {' | '.join(cells)} |", flush=True)
    for label in ("S8", "S3", "S2"):
        print(f"{label}: {totals[f'{label} 0']} and {totals[f'{label} 1']} of {totals[label]}")


if __name__ == "__main__":
    main()
