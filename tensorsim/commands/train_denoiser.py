"""``tensorsim train denoiser``: train DnCNN on simulated maps."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrainDenoiser:
    """Train DnCNN on maps with and without noise; run again with the same arguments, it goes on where it stopped.

    Attributes:
        maps: folder of patches of maps; those that are missing are made first.
        out: folder for checkpoints, logs and best.safetensors.
        clips: clips per scene, activity after activity; every tenth is held out.
        depth: convolutions.
        init: weights to start from (.safetensors).
        steps: optimiser steps.
        batch: patches per step.
        seed: of everything random but the maps.
        maps_seed: of people, motion and noise of the maps.
        device: auto, cpu or cuda.
        workers: processes that prepare patches.
        quiet: no progress bar.
    """

    maps: Path
    out: Path
    clips: int = 240
    depth: int = 20
    init: Path | None = None
    steps: int = 20_000
    batch: int = 128
    seed: int = 0
    maps_seed: int = 0
    device: str = "auto"
    workers: int = 0
    quiet: bool = False

    def run(self) -> None:
        """Do it."""
        from tensorsim.training.denoiser import DenoiserRecipe, build_pairs
        from tensorsim.training.loop import LoopConfig, fit

        build_pairs(self.maps, self.clips, self.maps_seed, quiet=self.quiet)
        recipe = DenoiserRecipe(self.maps, self.depth, self.seed, self.init)
        config = LoopConfig(
            out=self.out,
            steps=self.steps,
            batch=self.batch,
            seed=self.seed,
            device=self.device,
            workers=self.workers,
            checkpoint_every=min(100, self.steps),
            validate_every=min(200, self.steps),
            quiet=self.quiet,
        )
        figures = fit(recipe, config)
        print(f"{self.out / 'best.safetensors'}: " + ", ".join(f"{k} {v:.4g}" for k, v in figures.items()))
