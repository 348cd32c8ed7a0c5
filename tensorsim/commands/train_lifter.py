"""``tensorsim train lifter``: train a lifter on motion seen by random cameras."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tensorsim.commands.arguments import Several
from tensorsim.commands.training import TrainOptions
from tensorsim.exceptions import TensorsimError, check_seed


@dataclass(frozen=True)
class TrainLifter(TrainOptions):
    """Train a lifter; running it again with the same arguments resumes it."""

    network: Literal["temporal", "videopose3d"] = "temporal"
    """TemporalLifter, or VideoPose3D with a 27-frame window."""
    motion: Several[Path] = ()
    """Motion capture files (.npz, .bvh) in addition to the generated motion; every second sequence is held out."""
    motions: int = 12_000
    """Number of motions of all kinds; they are generated first, into OUT/motion.pt."""
    steps: int = 7000
    """Optimiser steps."""
    batch: int = 48
    """Windows per step."""
    frames: int = 64
    """Frames per window."""
    channels: int = 256
    """Width of the network."""
    learning_rate: float = 1.5e-3
    """Peak learning rate."""
    motion_seed: int = 0
    """Random seed for the motions."""

    def run(self) -> None:
        """Run the command."""
        import torch

        from tensorsim.training.lifter import LifterRecipe, VideoPoseRecipe
        from tensorsim.training.lifter_motion import FRAMES, build_pool
        from tensorsim.vision.lifting.temporal_net import TemporalNet
        from tensorsim.vision.lifting.videopose3d import VideoPose3D

        check_seed(self.motion_seed, "--motion-seed")
        if self.motions < 100:
            raise TensorsimError(f"--motions: got {self.motions}, expected at least 100")
        if not 16 <= self.frames <= FRAMES // 4:
            raise TensorsimError(f"--frames: got {self.frames}, expected 16 to {FRAMES // 4}")
        if self.channels < 8:
            raise TensorsimError(f"--channels: got {self.channels}, expected at least 8")
        loop = self.loop(
            steps=self.steps,
            batch=self.batch,
            checkpoint_every=min(200, self.steps),
            validate_every=min(500, self.steps),
        )
        torch.manual_seed(self.seed)
        video_pose = self.network == "videopose3d"
        net = VideoPose3D((3, 3, 3), self.channels) if video_pose else TemporalNet(self.channels)
        self.begin(net)
        pool = build_pool(
            self.out / "motion.pt", self.motions, self.motion, self.motion_seed, quiet=self.quiet
        )
        judged = build_pool(
            self.out / "held_out.pt",
            max(self.motions // 20, 48),
            self.motion,
            self.motion_seed + 1,
            True,
            self.quiet,
        )
        recipe = VideoPoseRecipe if video_pose else LifterRecipe
        self.train(recipe(net, pool, judged, self.frames, self.learning_rate, self.seed), loop)
