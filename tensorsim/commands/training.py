"""Options that all training commands share, and the run that they describe."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tensorsim.commands.arguments import Option
from tensorsim.exceptions import TensorsimError, check_seed

if TYPE_CHECKING:
    from torch import nn

    from tensorsim.training.cutouts import Cutouts
    from tensorsim.training.loop import LoopConfig, Recipe


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """How a network is trained."""

    out: Path
    """Folder for checkpoints, logs and best.safetensors."""
    init: Option[Path] = None
    """Weights to start from (.safetensors)."""
    seed: int = 0
    """Random seed for everything but stored maps and rendered people."""
    device: str = "auto"
    """Device: cpu, cuda, cuda:1, ...; auto uses a GPU if there is one."""
    workers: int = 1
    """Number of processes that prepare samples."""
    precision: Literal["auto", "bfloat16", "float32"] = "auto"
    """Precision of convolutions and matrix products; auto uses bfloat16 if the device supports it."""
    quiet: bool = False
    """No progress bar."""

    def loop(self, **settings: Any) -> "LoopConfig":
        """The loop with these options; refuses invalid ones before anything is read or made."""
        from tensorsim.device import multiplies_bfloat16, usable_device
        from tensorsim.training.loop import LoopConfig

        check_seed(self.seed, "--seed")
        device, precision = usable_device(self.device), self.precision
        if precision == "auto":
            precision = "bfloat16" if multiplies_bfloat16(device) else "float32"
        return LoopConfig(
            out=self.out,
            seed=self.seed,
            device=self.device,
            workers=self.workers,
            precision=precision,
            quiet=self.quiet,
            **settings,
        )

    def epochs_loop(self, epochs: int, samples: int, batch: int, ema_decay: float) -> "LoopConfig":
        """The loop for this many epochs of ``samples`` training samples, validated after each."""
        epoch = max(1, samples // max(1, batch))
        return self.loop(
            steps=epochs * epoch,
            batch=batch,
            checkpoint_every=min(50, epoch),
            validate_every=epoch,
            ema_decay=ema_decay,
        )

    def begin(self, net: "nn.Module") -> None:
        """Give a network the weights to start from, if there are any."""
        from tensorsim.weights import load_state_dict, load_strict

        if self.init is not None:
            load_strict(net, load_state_dict(self.init), self.init)

    def train(self, recipe: "Recipe", loop: "LoopConfig") -> Path:
        """Train or resume; the first process prints the scores of the best weights. Returns their file."""
        from tensorsim.device import rank_and_processes
        from tensorsim.training.loop import fit

        recipe.settings["init"] = digest(self.init)
        figures = fit(recipe, loop)
        best = self.out / "best.safetensors"
        if rank_and_processes()[0] == 0:  # the others do not validate
            print(f"{best}: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()))
        return best


def digest(weights: Path | None) -> str | None:
    """Digest of the content of a weight file: another file at the same path is another start."""
    from tensorsim.files import sha256_of
    from tensorsim.registry import locate

    return None if weights is None else sha256_of(locate(weights))


def check_size(size: int | None, stored: int) -> None:
    """Refuse a size of pictures that does not divide that of the stored ones."""
    if size is not None and (size < 1 or stored % size):
        raise TensorsimError(f"--size: got {size}, expected a divisor of {stored}")


@dataclass(frozen=True, kw_only=True)
class PeopleOptions(TrainOptions):
    """How a network is trained on labelled and rendered people."""

    cutouts: Option[Path] = None
    """Folder of rendered people, cutouts-*.tar; missing shards are rendered. Default: OUT/cutouts."""
    rendered: int = 0
    """Number of rendered people; one core renders about five per second."""
    rendered_seed: int = 0
    """Random seed for their poses, looks and cameras."""

    def loop(self, **settings: Any) -> "LoopConfig":
        """As for all training commands, after checks of the options for rendered people."""
        check_seed(self.rendered_seed, "--rendered-seed")
        if self.rendered < 0:
            raise TensorsimError(f"--rendered: got {self.rendered}, expected at least 0")
        return super().loop(**settings)

    def rendered_people(self) -> "Cutouts | None":
        """Rendered people, rendered first if missing; None if none are wanted."""
        from tensorsim.training.cutouts import Cutouts, render_cutouts

        if self.rendered == 0:
            return None
        folder = self.out / "cutouts" if self.cutouts is None else self.cutouts
        return Cutouts(render_cutouts(self.rendered, self.rendered_seed, folder, self.quiet))
