"""``tensorsim train denoiser``: train DnCNN on simulated maps."""

from dataclasses import dataclass
from pathlib import Path

from tensorsim.commands.training import TrainOptions
from tensorsim.exceptions import TensorsimError, check_seed


@dataclass(frozen=True)
class TrainDenoiser(TrainOptions):
    """Train DnCNN on maps with and without noise; running it again with the same arguments resumes it."""

    maps: Path
    """Folder of map patches; missing ones are generated first."""
    clips: int = 240
    """Clips per scene, cycling through the activities; every eleventh is held out."""
    depth: int = 20
    """Number of convolutional layers."""
    steps: int = 20_000
    """Optimiser steps."""
    batch: int = 128
    """Patches per step."""
    maps_seed: int = 0
    """Random seed for people, motion and noise of the maps."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim.training.denoiser import DenoiserRecipe, build_pairs, untrained

        check_seed(self.maps_seed, "--maps-seed")
        if self.clips < 10:
            raise TensorsimError(f"--clips: got {self.clips}, expected at least 10, of which one is held out")
        loop = self.loop(
            steps=self.steps,
            batch=self.batch,
            checkpoint_every=min(100, self.steps),
            validate_every=min(200, self.steps),
        )
        net = untrained(self.depth, self.seed)
        self.begin(net)
        build_pairs(self.maps, self.clips, self.maps_seed, quiet=self.quiet)
        recipe = DenoiserRecipe(net, self.maps, self.clips, self.seed)
        self.train(recipe, loop)
