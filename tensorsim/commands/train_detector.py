"""``tensorsim train detector``: train the small person detector on labelled and rendered people."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from tensorsim.commands.arguments import Option
from tensorsim.commands.training import PeopleOptions, digest
from tensorsim.exceptions import check_positive


@dataclass(frozen=True)
class TrainDetector(PeopleOptions):
    """Train the person detector RTMDet on tar shards of people; running it again with the same arguments resumes it.

    Writes the best weights, with calibrated scores, to OUT/detector.safetensors.
    """

    data: Path
    """Folder of the shards coco_small, coco_more, coco_extra, coco_hardneg, films_teacher, lspet, pedestrian and
    backgrounds (NAME-*.tar)."""
    teacher: Option[Path] = None
    """Weights of a better RTMDet (.safetensors, .pth, .onnx), whose output is learned in addition to the labels."""
    variant: Literal["nano-person", "small-person", "m-person"] = "small-person"
    """Variant of RTMDet, for people only."""
    steps: int = 5000
    """Optimiser steps."""
    batch: int = 16
    """Images per step."""
    learning_rate: float = 1e-3
    """Peak learning rate."""
    validate_every: int = 250
    """Steps between validations on the held-out images."""

    def run(self) -> None:
        """Run the command."""
        import torch

        from tensorsim.device import rank_and_processes
        from tensorsim.training.detector import DetectorRecipe, TrainedRTMDet, read_sources
        from tensorsim.training.detector_metrics import calibrate
        from tensorsim.vision.detection.rtmdet import RTMDet
        from tensorsim.weights import save_weights

        check_positive(self.learning_rate, "--learning-rate")
        loop = self.loop(
            steps=self.steps,
            batch=self.batch,
            checkpoint_every=100,
            validate_every=self.validate_every,
        )
        teacher = None if self.teacher is None else RTMDet.from_pretrained(self.teacher)
        torch.manual_seed(self.seed)
        net = TrainedRTMDet(self.variant)
        self.begin(net)
        sources, held_out = read_sources(self.data)
        sources = replace(sources, cutouts=self.rendered_people() or ())
        recipe = DetectorRecipe(net, sources, held_out, self.seed, self.learning_rate, teacher=teacher)
        recipe.settings["teacher"] = digest(self.teacher)
        best = self.train(recipe, loop)
        if rank_and_processes()[0] > 0:
            return
        detector = RTMDet.from_pretrained(best)
        calibrate(detector, held_out, quiet=self.quiet)
        calibrated = self.out / "detector.safetensors"
        save_weights(detector, calibrated, recipe.metadata)
        print(f"{calibrated}: these with calibrated scores")
