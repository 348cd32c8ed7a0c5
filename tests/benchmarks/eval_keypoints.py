"""Where networks mark joints beside the joints of rendered people: ``python -m tests.benchmarks.eval_keypoints``.

People are rendered upright, from all sides; each network of ``--pose`` marks their keypoints. Printed are medians
over people, per joint, of how far the mark is from the joint, in percent of the height of the picture of the body
(right and down positive), and the shares of the segments, found and taken
(:class:`tensorsim.body.skeleton.Marks`).
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import Marks, coco_to_body
from tensorsim.commands.networks import default_networks, load_networks
from tensorsim.config import COCO_KEYPOINTS, JOINTS
from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.training.cutouts import Cutout, render_cutout

MARGIN_PX = 60
#: Marks further than this from the joint, as a share of the height, are mistakes and not a matter of convention.
MISTAKE = 0.06
#: Of each share of :class:`Marks`: the joint that the mark moves, from which joint to which the segment goes.
SEGMENTS = {
    "elbow": ("elbow", "elbow", "shoulder"),
    "hip": ("hip", "neck", "hip"),
    "knee": ("knee", "knee", "ankle"),
    "ankle": ("ankle", "ankle", "knee"),
}


class Marked(NamedTuple):
    """Joints (14, 2) of one person in pixels, marks of them likewise, and the height of the body's picture."""

    joints: npt.NDArray[np.float64]
    marks: npt.NDArray[np.float64]
    height: float


def joints_of(keypoints: Tensor) -> npt.NDArray[np.float64]:
    """Body joints (14, 2) of COCO keypoints (17, 2) that are exact."""
    return coco_to_body(keypoints.double(), torch.ones(17).double())[0].numpy()


def upright(cutout: Cutout) -> bool:
    """Trunk and legs near the vertical of the picture."""
    joints = joints_of(torch.from_numpy(cutout.keypoints[:, :2]))
    ends = [("neck", "right_hip"), ("right_hip", "right_knee"), ("left_hip", "left_knee")]
    ends += [("right_knee", "right_ankle"), ("left_knee", "left_ankle")]
    down = np.array([joints[JOINTS.index(b)] - joints[JOINTS.index(a)] for a, b in ends])
    return bool((np.abs(np.degrees(np.arctan2(down[:, 0], down[:, 1]))) < 25).all())


def people(count: int, seed: int) -> Iterator[Cutout]:
    """Upright people, rendered."""
    poses = sample_poses(max(20 * count, 13), seed)
    found = 0
    for index in torch.randperm(len(poses), generator=torch.Generator().manual_seed(seed)).tolist():
        cutout = render_cutout(poses[index], seed * 1_000_003 + index)
        if upright(cutout):
            yield cutout
            found += 1
            if found == count:
                return


def marked(pose: nn.Module, cutout: Cutout, level: float) -> Marked:
    """What a network marks on one person before an even grey."""
    height, width = cutout.rgba.shape[:2]
    alpha = cutout.rgba[..., 3:] / 255.0
    picture = np.full((height + 2 * MARGIN_PX, width + 2 * MARGIN_PX, 3), level)
    inner = picture[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
    inner[:] = inner * (1 - alpha) + cutout.rgba[..., :3] * alpha
    frame = torch.from_numpy(picture.transpose(2, 0, 1)).round().to(torch.uint8)
    box = torch.tensor([[[MARGIN_PX, MARGIN_PX, MARGIN_PX + width, MARGIN_PX + height]]], dtype=torch.float32)
    with torch.inference_mode():
        found, _ = pose(frame[None], box, torch.ones(1, 1, dtype=torch.bool))
    wanted = joints_of(torch.from_numpy(cutout.keypoints[:, :2]))
    named = found[0, 0].double() - MARGIN_PX
    # As marked: elbows to ankles are not moved to the joints.
    places = dict(zip(COCO_KEYPOINTS, named, strict=True))
    places |= {"head": places["nose"], "neck": named[5:7].mean(0)}
    marks = torch.stack([places[name] for name in JOINTS]).numpy()
    return Marked(wanted, marks, float(height))


def shares(rows: list[Marked]) -> dict[str, float]:
    """Median shares of the segments by which marks lie beside joints."""
    result = {}
    for name, (moved, start, end) in SEGMENTS.items():
        found = []
        for row in rows:
            for side in ("left", "right"):
                a, b, joint = (
                    JOINTS.index(part if part == "neck" else f"{side}_{part}") for part in (start, end, moved)
                )
                segment, offset = row.joints[b] - row.joints[a], row.marks[joint] - row.joints[joint]
                if np.abs(offset).max() < MISTAKE * row.height:
                    found.append(float(offset @ segment / (segment @ segment)))
        result[name] = float(np.median(found))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.eval_keypoints", description=(__doc__ or "").split(":")[0]
    )
    parser.add_argument(
        "--pose", nargs="*", default=[None], help="paths or names of networks (default: ours)"
    )
    parser.add_argument("--people", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cutouts = list(people(options.people, options.seed))
    for source in options.pose:
        networks = default_networks(None, source)
        _, pose = load_networks(*networks, flip_test=True)
        generator = np.random.default_rng(options.seed)
        rows = [marked(pose.eval(), cutout, generator.uniform(60, 200)) for cutout in cutouts]
        offsets = np.array([(row.marks - row.joints) / row.height for row in rows])
        offsets[np.abs(offsets).max(-1) > MISTAKE] = np.nan
        print(f"{Path(networks[1]).name}, {len(rows)} people; marks beside joints, percent of the height:")
        for name, (right, down) in zip(JOINTS, 100 * np.nanmedian(offsets, axis=0), strict=True):
            print(f"  {name:15s} {right:+6.2f} {down:+6.2f}")
        print(f"  {'share':8s} {'found':>7s} {'taken':>7s} {'left':>7s}")
        for name, share in shares(rows).items():
            taken = getattr(Marks(), name)
            print(f"  {name:8s} {share:7.3f} {taken:7.3f} {share - taken:+7.3f}")


if __name__ == "__main__":
    main()
