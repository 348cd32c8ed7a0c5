"""Which part of the way from a film to a label costs accuracy, on everyday motion whose truth is known.

python -m tests.benchmarks.eval_losses [GROUPS]

The shipped classifier on clips of 4 s: of the pipeline's motion, of the same with one part replaced by the truth, and
of the true motion; the share that is labelled rightly in each scene. Groups have four clips of each activity, before
cameras that are known to 4 degrees and 12 %.
"""

import sys

import torch
from torch import Tensor
from torch.nn import functional as F

from tensorsim.body.skeleton import mid_hips
from tensorsim.config import ACTIVITIES
from tensorsim.evaluation.measured.motions import Draw
from tensorsim.geometry.camera import NEAR_M
from tensorsim.radar.presets import PRESETS
from tensorsim.recognition import ActivityRecognizer
from tensorsim.recognition.map_image import scaled
from tensorsim.training.everyday import at_rate, everyday_motion
from tensorsim.training.everyday_maps import BODIES, Radars, Watched
from tensorsim.training.keypoint_errors import (
    FilmedMotion,
    Filming,
    Seen,
    draw_camera,
    find_keypoints,
    project_keypoints,
)
from tensorsim.training.maps import SCENES

CLIPS, SECONDS, STORED, SPEED_M_S = 4, 4.0, 64, 3.8
RATES_HZ = (15.0, 18.0, 20.0, 25.0)

#: Joints (P, T, 14, 3) and presence (P, T) of people.
Motion = tuple[Tensor, Tensor]


def exact_keypoints(joints: Tensor, filming: Filming) -> Seen:
    """Where the keypoints of joints (T, 14, 3) are, all those in the picture."""
    where, depth = project_keypoints(joints, filming)
    size = torch.tensor([filming.width, filming.height])
    inside = ((where >= -0.5) & (where < size)).all(-1) & (depth > NEAR_M)
    return Seen(where, 0.9 * inside.double(), inside.sum(-1) >= 4)


def ways(activity: int, fps: float, generator: torch.Generator, films: FilmedMotion) -> dict[str, Motion]:
    """The motion of the same people by what of it is true."""
    draw = Draw(1, generator)
    motion, heights = everyday_motion(activity, CLIPS, torch.full((CLIPS,), SECONDS), generator)
    truth = torch.stack([at_rate(joints, round(SECONDS * fps), fps) for joints in motion])
    filming = draw_camera(mid_hips(truth).mean(0), draw)
    seen = [
        find_keypoints(joints, height, fps, filming, draw)
        for joints, height in zip(truth, heights.tolist(), strict=True)
    ]
    found, valid = films.lifted(seen, filming, fps)
    apart = (mid_hips(truth) - mid_hips(found))[..., None, :]
    return {
        "as found in films": (found, valid),
        "camera known": films.lifted(seen, filming._replace(believed=filming.camera), fps),
        "keypoints exact": films.lifted([exact_keypoints(one, filming) for one in truth], filming, fps),
        "hips true": (found + apart, valid),
        "limbs true": (truth - apart, valid),
        "all true, while found": (truth, valid),
        "all true": (truth, torch.ones_like(valid)),
    }


@torch.no_grad()
def main() -> None:
    torch.set_num_threads(1)
    groups = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    films, radars = FilmedMotion(), Radars(STORED, SPEED_M_S)
    recognizer = ActivityRecognizer.from_pretrained(PRESETS["free-space"].radar).eval()
    right: dict[str, list[Tensor]] = {}
    for group in range(groups):
        generator = torch.Generator().manual_seed(7000 + group)
        fps, body = RATES_HZ[group % len(RATES_HZ)], list(BODIES)[group % len(BODIES)]
        for activity in range(1, len(ACTIVITIES)):
            for name, (joints, valid) in ways(activity, fps, generator, films).items():
                for k in range(CLIPS):
                    if int(valid[k].sum()) <= 0.2 * valid.shape[1]:
                        continue
                    clip = Watched(joints[k : k + 1], valid[k : k + 1], fps)
                    power = radars(clip, body, alive=False, seed=group)[:, None].float()
                    picture = scaled(
                        F.avg_pool2d(power, STORED // recognizer.size), "db", recognizer.range_db
                    )
                    logits = recognizer.network(picture) + recognizer.network(picture.flip(-2))
                    right.setdefault(name, []).append(logits.argmax(-1) == activity)
    print(f"{'':24s}", *SCENES, "clips")
    for name, hits in right.items():
        share = torch.stack(hits).double().mean(0)
        print(f"{name:24s}", *(f"{x:10.3f}" for x in share.tolist()), f"{len(hits):6d}")


if __name__ == "__main__":
    main()
