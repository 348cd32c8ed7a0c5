"""``tensorsim train detector``: train the small person detector on labelled and rendered people."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrainDetector:
    """Train RTMDet, small, on tar shards of people; run again with the same arguments, it goes on where it stopped.

    Attributes:
        data: folder of coco_small-*.tar, lspet-*.tar, pedestrian-*.tar and backgrounds-*.tar.
        out: folder for checkpoints, logs, best.safetensors and, of these with calibrated scores, detector.safetensors.
        cutouts: folder of rendered people, cutouts-*.tar; missing shards are rendered. OUT/cutouts if not given.
        rendered: number of rendered people.
        variant: of RTMDet.
        init: weights to start from (.safetensors).
        steps: optimiser steps.
        batch: pictures per step.
        learning_rate: highest learning rate.
        validate_every: steps between measurements on the held-out pictures.
        seed: of everything random.
        device: auto, cpu or cuda.
        workers: processes that prepare pictures.
        quiet: no progress bar.
    """

    data: Path
    out: Path
    cutouts: Path | None = None
    rendered: int = 3000
    variant: str = "small-person"
    init: Path | None = None
    steps: int = 4000
    batch: int = 16
    learning_rate: float = 1.5e-3
    validate_every: int = 250
    seed: int = 0
    device: str = "auto"
    workers: int = 1
    quiet: bool = False

    def run(self) -> None:
        """Do it."""
        import torch

        from tensorsim.training.cutouts import Cutouts, render_cutouts
        from tensorsim.training.detector import DetectorRecipe, TrainedRTMDet, read_sources
        from tensorsim.training.detector_metrics import calibrate
        from tensorsim.training.loop import LoopConfig, fit
        from tensorsim.vision.rtmdet import RTMDet
        from tensorsim.weights import load_state_dict, load_strict, save_weights

        loop = LoopConfig(
            out=self.out,
            steps=self.steps,
            batch=self.batch,
            seed=self.seed,
            device=self.device,
            workers=self.workers,
            checkpoint_every=100,
            validate_every=self.validate_every,
            quiet=self.quiet,
        )
        torch.manual_seed(self.seed)
        net = TrainedRTMDet(self.variant)
        if self.init is not None:
            load_strict(net, load_state_dict(self.init), self.init)
        folder = self.out / "cutouts" if self.cutouts is None else self.cutouts
        cutouts = Cutouts(render_cutouts(self.rendered, self.seed, folder, self.quiet))
        sources, held_out = read_sources(self.data, cutouts)
        recipe = DetectorRecipe(net, sources, held_out, self.seed, self.learning_rate)
        figures = fit(recipe, loop)
        detector = RTMDet.from_pretrained(self.out / "best.safetensors")
        calibrate(detector, held_out)
        save_weights(detector, self.out / "detector.safetensors", recipe.metadata)
        print(
            f"{self.out / 'detector.safetensors'}: " + ", ".join(f"{k} {v:.4g}" for k, v in figures.items())
        )
