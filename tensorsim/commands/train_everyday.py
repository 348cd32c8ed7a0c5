"""``tensorsim train everyday``: train an activity classifier on everyday motion, as films show it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tensorsim.commands.arguments import Option
from tensorsim.commands.training import TrainOptions, check_size
from tensorsim.exceptions import TensorsimError, check_positive, check_seed


@dataclass(frozen=True, kw_only=True)
class TrainEveryday(TrainOptions):
    """Train SPNet or SPGNet on images of everyday motion in both presets, and calibrate it on held-out ones.

    Writes OUT/classifier.safetensors; running it again with the same arguments resumes it.
    """

    maps: Path
    """Folder of images; missing groups are generated first (about 10 s each on one core)."""
    groups: int = 50
    """Number of groups, each of up to 99 clips and some of an empty scene; every fifth group is held out."""
    maps_seed: int = 0
    """Random seed for the people, motion, cameras and errors in the images."""
    network: Literal["spnet", "spgnet"] = "spgnet"
    """SPGNet (s2p6) on 32x32 images, or SPNet."""
    size: Option[int] = None
    """Height and width of the images, a divisor of 64. Default: 32 for SPGNet, 64 for SPNet."""
    learning_rate: float = 1e-3
    """Peak learning rate."""
    epochs: int = 10
    """Passes over the training images."""
    batch: int = 64
    """Images per step."""
    share: float = 1.0
    """Weight of the trained parameters when averaged with --init, from 0 (only --init) to 1 (only trained)."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim.device import rank_and_processes
        from tensorsim.training.everyday_classifier import EverydayRecipe, load_between, save_calibrated
        from tensorsim.training.everyday_maps import EverydaySettings, EverydayStore, build_everyday

        check_seed(self.maps_seed, "--maps-seed")
        if self.groups < 5:
            raise TensorsimError(
                f"--groups: got {self.groups}, expected at least 5, of which one is held out"
            )
        if not 0 <= self.share <= 1:
            raise TensorsimError(f"--share: got {self.share}, expected a number from 0 to 1")
        if self.share < 1 and self.init is None:
            raise TensorsimError("--share below 1 needs --init")
        settings = EverydaySettings(seed=self.maps_seed)
        check_size(self.size, settings.size)
        check_positive(self.learning_rate, "--learning-rate")
        self.loop(steps=self.epochs, batch=self.batch)  # refuses invalid options before maps are made
        build_everyday(self.maps, self.groups, settings, quiet=self.quiet)
        recipe = EverydayRecipe(
            self.network,
            EverydayStore(self.maps, range(self.groups)),
            self.size,
            self.seed,
            self.init,
            self.learning_rate,
        )
        loop = self.epochs_loop(self.epochs, len(recipe.training), self.batch, ema_decay=0.99)
        best = self.train(recipe, loop)
        if rank_and_processes()[0] > 0:
            return
        load_between(recipe.net, best if self.init is None else self.init, best, self.share)
        path = self.out / "classifier.safetensors"
        temperature, error = save_calibrated(recipe, path)
        print(f"{path}: temperature {temperature:.3f}, calibration error of held-out films {error:.3f}")
        for name, value in recipe.validate(recipe.net).items():
            print(f"  {name} {value:.3f}")
