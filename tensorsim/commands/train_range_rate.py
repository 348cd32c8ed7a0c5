"""``tensorsim train range-rate``: train the network that corrects speeds along the line of sight."""

from dataclasses import dataclass
from pathlib import Path

from tensorsim.commands.arguments import Several
from tensorsim.commands.training import TrainOptions
from tensorsim.exceptions import TensorsimError, check_positive, check_seed


@dataclass(frozen=True, kw_only=True)
class TrainRangeRate(TrainOptions):
    """Train the network that corrects how fast people come closer or move away, on motion as films show it.

    Running it again with the same arguments resumes it.
    """

    motion: Several[Path] = ()
    """Motion capture files (.npz, .bvh) in addition to the generated motion; every second sequence is held out."""
    groups: int = 300
    """Number of groups of 88 clips, generated first into OUT/clips.safetensors (about 5 s each on one core)."""
    clips_seed: int = 0
    """Random seed for the people, motion, cameras and errors in the clips."""
    steps: int = 6000
    """Optimiser steps."""
    batch: int = 64
    """Clips per step."""
    channels: int = 96
    """Width of the network."""
    learning_rate: float = 2e-3
    """Peak learning rate."""

    def run(self) -> None:
        """Run the command."""
        import torch

        from tensorsim.training.range_rate import RangeRateRecipe, build_clips
        from tensorsim.vision.lifting.range_rate import RangeRateNet

        check_seed(self.clips_seed, "--clips-seed")
        check_positive(self.learning_rate, "--learning-rate")
        for name, value, least in (("--groups", self.groups, 1), ("--channels", self.channels, 8)):
            if value < least:
                raise TensorsimError(f"{name}: got {value}, expected at least {least}")
        loop = self.loop(
            steps=self.steps,
            batch=self.batch,
            checkpoint_every=min(200, self.steps),
            validate_every=min(500, self.steps),
        )
        torch.manual_seed(self.seed)
        net = RangeRateNet(self.channels)
        self.begin(net)
        clips = build_clips(
            self.out / "clips.safetensors", self.groups, self.motion, self.clips_seed, quiet=self.quiet
        )
        judged = build_clips(
            self.out / "held_out.safetensors",
            max(self.groups // 20, 1),
            self.motion,
            self.clips_seed + 1,
            True,
            self.quiet,
        )
        recipe = RangeRateRecipe(net, clips, judged, self.learning_rate, self.seed, self.init is None)
        self.train(recipe, loop)
