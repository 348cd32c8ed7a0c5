"""``tensorsim train acf``: train the ACF person detector, an alternative to RTMDet."""

from dataclasses import dataclass
from pathlib import Path

from tensorsim.exceptions import check_seed
from tensorsim.files import check_folder


@dataclass(frozen=True)
class TrainAcf:
    """Train boosted trees on aggregate channel features of upright people; takes minutes and needs scikit-learn."""

    data: Path
    """Folder of the shards coco_small, coco_more, coco_extra, coco_hardneg, pedestrian and backgrounds
    (NAME-*.tar)."""
    out: Path
    """Folder for acf.safetensors."""
    rounds: tuple[int, ...] = (32, 64, 256)
    """Number of trees in each stage; each stage starts anew with the mistakes of the one before."""
    positives: int = 3000
    """Maximum number of windows with people, including mirrored ones."""
    negatives: int = 3000
    """Number of windows without people that each stage adds."""
    seed: int = 0
    """Random seed for sampling and boosting."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim.training.acf import AcfSettings, AcfTrainer
        from tensorsim.weights import save_weights

        check_seed(self.seed, "--seed")
        check_folder(self.out)
        settings = AcfSettings(self.rounds, self.positives, self.negatives, seed=self.seed)
        trainer = AcfTrainer(self.data, settings, self.quiet)
        detector = trainer.train()
        path = self.out / "acf.safetensors"
        save_weights(detector, path, {"network": "AcfDetector", "trees": str(self.rounds[-1])})
        print(f"{path}: {self.rounds[-1]} trees")
