"""Options that all training commands share, and the run that they describe."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tensorsim.training.loop import LoopConfig, Recipe


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """How a network is trained."""

    out: Path
    """Folder for checkpoints, logs and best.safetensors."""
    init: Path | None = None
    """Weights to start from (.safetensors)."""
    seed: int = 0
    """Of everything random but the maps of a folder."""
    device: str = "auto"
    """cpu, cuda, cuda:1, ...; auto takes a GPU where there is one."""
    workers: int = 1
    """Processes that prepare samples."""
    quiet: bool = False
    """No progress bar."""

    def loop(self, **settings: Any) -> "LoopConfig":
        """The loop with these options; refuses what cannot work before anything is read or made."""
        from tensorsim.training.loop import LoopConfig

        return LoopConfig(
            out=self.out,
            seed=self.seed,
            device=self.device,
            workers=self.workers,
            quiet=self.quiet,
            **settings,
        )

    def train(self, recipe: "Recipe", loop: "LoopConfig") -> Path:
        """Train, or go on; prints the figures of the best weights and returns their file."""
        from tensorsim.training.loop import fit

        figures = fit(recipe, loop)
        best = self.out / "best.safetensors"
        print(f"{best}: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()))
        return best
