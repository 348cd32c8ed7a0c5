"""How exactly joints must be known along the line of sight: ``python -m tests.benchmarks.eval_depth [--clips N]``.

A Doppler-time map is a sum of echoes that interfere: it is right only where the ways to the joints are right to a part
of the wavelength, 3.9 mm at 77 GHz and 15 cm at 2 GHz. The true joints of the twelve activities are moved along the
line of sight from the camera, each joint by its own Gaussian error that changes within about half a second, and the
maps are compared with the true ones as the truth loop compares them: linear PSNR in dB, mean over the activities.
"""

import argparse
import math

import torch
from torch import Tensor

from tensorsim.evaluation.clips import activity_clips
from tensorsim.evaluation.films import CAMERA, FPS
from tensorsim.evaluation.scores import compare
from tensorsim.evaluation.settings import Pipelines, Setting
from tensorsim.radar.presets import PRESETS

ERRORS_MM = (1, 2, 5, 10, 20, 50, 100)
SCENES = ("free-space", "through-wall")
CORRELATION_S = 0.5


def smooth_noise(frames: int, joints: int, generator: torch.Generator) -> Tensor:
    """(T, J) of deviation 1 that forgets itself within ``CORRELATION_S``."""
    reach = round(2 * CORRELATION_S * FPS)
    kernel = torch.exp(-((torch.arange(-reach, reach + 1) / (CORRELATION_S * FPS)) ** 2)).double()
    white = torch.randn(joints, 1, frames + 2 * reach, generator=generator, dtype=torch.float64)
    return torch.nn.functional.conv1d(white, kernel[None, None] / kernel.norm())[:, 0].T


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=1, help="clips per activity")
    count = parser.parse_args().clips
    torch.set_grad_enabled(False)
    pipelines = Pipelines({name: PRESETS[name] for name in SCENES})
    camera = torch.tensor(CAMERA.position_m, dtype=torch.float64)
    found: dict[tuple[str, int], list[float]] = {}
    for row, clips in activity_clips((), count, 0).items():
        for clip in clips:
            if not clip.present:
                continue
            joints = clip.joints(FPS)
            sight = joints - camera
            sight = sight / sight.norm(dim=-1, keepdim=True)
            error = smooth_noise(len(joints), 14, torch.Generator().manual_seed(clip.seed))
            valid = torch.ones(1, len(joints), dtype=torch.bool)
            for scene in SCENES:
                truth = pipelines.truth(scene, clip)
                for error_mm in ERRORS_MM:
                    moved = joints + sight * (error_mm * 1e-3 * error)[..., None]
                    guess = pipelines.maps(Setting("a"), scene, clip, moved[None], valid).like(truth)
                    figures = compare(guess, truth, pipelines.speed_m_s(scene))
                    found.setdefault((scene, error_mm), []).append(figures["doppler_time"]["psnr"])
        print(f"{row} done", flush=True)
    print(f"{'error, mm':>12s}" + "".join(f"{scene:>16s}" for scene in SCENES))
    for error_mm in ERRORS_MM:
        means = [math.fsum(found[s, error_mm]) / len(found[s, error_mm]) for s in SCENES]
        print(f"{error_mm:12d}" + "".join(f"{m:16.1f}" for m in means))


if __name__ == "__main__":
    main()
