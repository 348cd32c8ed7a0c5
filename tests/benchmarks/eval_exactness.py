"""How exactly a camera must see a body: ``python -m tests.benchmarks.eval_exactness [--clips N]``.

A Doppler-time map is a sum of echoes that interfere: it is right only where the ways to the joints are right to a part
of the wavelength, 3.9 mm at 77 GHz and 15 cm at 2 GHz. Errors are put on the truth of the twelve activities, and the
maps are compared with the true ones as the truth loop compares them: linear PSNR in dB, mean over the activities.

- depth: the true joints are moved along the line of sight from the camera;
- keypoints: the true ones are moved in the picture of 640x360 pixels, lifted and placed by the pipeline; the better of
  what it makes of them when told that they are exact (setting b of the truth loop) and when not (c).

Each joint has its own Gaussian error, which changes within about half a second, as those of pose networks do.
"""

import argparse
import math

import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.evaluation.clips import Clip, activity_clips
from tensorsim.evaluation.films import CAMERA, FPS, true_keypoints
from tensorsim.evaluation.scores import Maps, compare
from tensorsim.evaluation.settings import Pipelines, Setting
from tensorsim.radar.presets import PRESETS

DEPTH_MM = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
PIXELS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
SCENES = ("free-space", "through-wall")
CORRELATION_S = 0.5


def smooth_noise(frames: int, joints: int, generator: torch.Generator) -> Tensor:
    """Noise (T, J) of deviation 1 with a correlation time of ``CORRELATION_S``."""
    reach = round(2 * CORRELATION_S * FPS)
    kernel = torch.exp(-((torch.arange(-reach, reach + 1) / (CORRELATION_S * FPS)) ** 2)).double()
    white = torch.randn(joints, 1, frames + 2 * reach, generator=generator, dtype=torch.float64)
    return torch.nn.functional.conv1d(white, kernel[None, None] / kernel.norm())[:, 0].T


class Figures:
    """Linear PSNR of Doppler-time maps by what was done and scene; the mean over clips."""

    def __init__(self) -> None:
        self.pipelines = Pipelines({name: PRESETS[name] for name in SCENES})
        self.found: dict[tuple[str, float, str], list[float]] = {}

    def add(
        self, name: str, size: float, clip: Clip, truths: dict[str, Maps], *poses: tuple[Tensor, Tensor]
    ) -> None:
        """Add the best of some poses (joints, valid) of a clip."""
        for scene, truth in truths.items():
            speed_m_s = self.pipelines.speed_m_s(scene)
            maps = [self.pipelines.maps(Setting("a"), scene, clip, *pose).like(truth) for pose in poses]
            best = max(compare(guess, truth, speed_m_s)["doppler_time"]["psnr"] for guess in maps)
            self.found.setdefault((name, size, scene), []).append(best)

    def table(self, name: str, sizes: tuple[float, ...]) -> str:
        """Rows of error sizes, columns of scenes."""
        lines = [f"{name:>14s}" + "".join(f"{scene:>16s}" for scene in SCENES)]
        for size in sizes:
            values = [self.found[name, size, scene] for scene in SCENES]
            lines.append(f"{size:14g}" + "".join(f"{math.fsum(v) / len(v):16.1f}" for v in values))
        return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--clips", type=int, default=1, help="clips per activity")
    count = parser.parse_args().clips
    torch.set_grad_enabled(False)
    figures = Figures()
    pipelines = figures.pipelines
    camera = torch.tensor(CAMERA.position_m, dtype=torch.float64)
    present = [clip for row in activity_clips((), count, 0).values() for clip in row if clip.present]
    for clip in tqdm(present, unit="clip"):
        truths = {scene: pipelines.truth(scene, clip) for scene in SCENES}
        joints = clip.joints(FPS)
        valid = torch.ones(1, len(joints), dtype=torch.bool)
        sight = joints - camera
        sight = sight / sight.norm(dim=-1, keepdim=True)
        generator = torch.Generator().manual_seed(clip.seed)
        error = smooth_noise(len(joints), 14, generator)
        for size in DEPTH_MM:
            moved = joints + sight * (size * 1e-3 * error)[..., None]
            figures.add("depth, mm", size, clip, truths, (moved[None], valid))
        seen = true_keypoints(clip)
        shift = smooth_noise(len(joints), 34, generator).unflatten(-1, [17, 2]).to(seen.keypoints.dtype)
        for size in PIXELS:
            observed = seen._replace(keypoints=seen.keypoints + size * shift)
            poses = [pipelines.lifted(Setting(source), clip, observed) for source in ("b", "c")]
            figures.add("keypoints, px", size, clip, truths, *poses)
    print(figures.table("depth, mm", DEPTH_MM), figures.table("keypoints, px", PIXELS), sep="\n\n")


if __name__ == "__main__":
    main()
