"""``tensorsim train pose``: train the small pose network on labelled and rendered people."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrainPose:
    """Train HRNet, small, on tar shards of people; run again with the same arguments, it goes on where it stopped.

    Attributes:
        data: folder of lspet-*.tar, coco_small-*.tar and backgrounds-*.tar.
        out: folder for checkpoints, logs and best.safetensors.
        cutouts: folder of rendered people, cutouts-*.tar; missing shards are rendered. OUT/cutouts if not given.
        rendered: number of rendered people.
        size: height and width of the crops.
        first_size: height and width of smaller crops to begin with.
        first_steps: steps with those.
        width: channels of the branch of highest resolution.
        init: weights to start from (.safetensors).
        steps: optimiser steps.
        batch: crops per step.
        learning_rate: highest learning rate.
        seed: of everything random.
        device: auto, cpu or cuda.
        workers: processes that prepare crops.
        quiet: no progress bar.
    """

    data: Path
    out: Path
    cutouts: Path | None = None
    rendered: int = 3000
    size: tuple[int, int] = (128, 96)
    first_size: tuple[int, int] = (96, 64)
    first_steps: int = 6000
    width: int = 24
    init: Path | None = None
    steps: int = 12000
    batch: int = 32
    learning_rate: float = 2e-3
    seed: int = 0
    device: str = "auto"
    workers: int = 1
    quiet: bool = False

    def run(self) -> None:
        """Do it."""
        import torch

        from tensorsim.training.cutouts import Cutouts, render_cutouts
        from tensorsim.training.loop import LoopConfig, fit
        from tensorsim.training.pose import HELD_OUT_PERCENT, PoseRecipe
        from tensorsim.training.pose_data import RenderedPeople, people, split, upright
        from tensorsim.training.shards import Shards, find_shards
        from tensorsim.vision.hrnet import HRNet, HRNetConfig
        from tensorsim.weights import load_state_dict, load_strict

        loop = LoopConfig(
            out=self.out,
            steps=self.steps,
            batch=self.batch,
            seed=self.seed,
            device=self.device,
            workers=self.workers,
            validate_every=500,
            quiet=self.quiet,
        )
        coco, coco_held_out = split(
            Shards(find_shards(self.data, "coco_small")), HELD_OUT_PERCENT["coco_small"]
        )
        lspet, lspet_held_out = split(Shards(find_shards(self.data, "lspet")), HELD_OUT_PERCENT["lspet"])
        places = Shards(find_shards(self.data, "backgrounds"))
        folder = self.out / "cutouts" if self.cutouts is None else self.cutouts
        cutouts = Cutouts(render_cutouts(self.rendered, self.seed, folder, self.quiet))

        torch.manual_seed(self.seed)
        net = HRNet(HRNetConfig(self.width, blocks=2, modules=(1, 1, 1), bottlenecks=2, planes=32), self.size)
        if self.init is not None:
            load_strict(net, load_state_dict(self.init), self.init)
        recipe = PoseRecipe(
            net,
            sided=people(coco),
            unsided=people(lspet),
            validation={"coco": people(coco_held_out), "lspet": upright(people(lspet_held_out))},
            rendered=RenderedPeople(cutouts, places),
            seed=self.seed,
            learning_rate=self.learning_rate,
            first_size=self.first_size,
            first_samples=self.first_steps * self.batch,
        )
        figures = fit(recipe, loop)
        print(f"{self.out / 'best.safetensors'}: " + ", ".join(f"{k} {v:.4g}" for k, v in figures.items()))
