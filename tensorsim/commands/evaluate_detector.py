"""``tensorsim evaluate detector``: how well a person detector finds people that it was not trained on."""

from dataclasses import dataclass
from pathlib import Path

from tensorsim.commands.arguments import Option, Several
from tensorsim.exceptions import TensorsimError


@dataclass(frozen=True)
class EvaluateDetector:
    """Print average precision and recall on held-out images, and compare how long two detectors follow people in
    films."""

    weights: Option[Path] = None
    """Weights of RTMDet (.safetensors, .pth, .onnx) or ACF (.safetensors). Default: the shipped ones."""
    against: Option[Path] = None
    """Weights of another detector, evaluated in the same way; needed for --films."""
    data: Option[Path] = None
    """Folder of coco_small-*.tar, coco_more-*.tar and coco_extra-*.tar, whose held-out images are used."""
    coco: Option[Path] = None
    """Folder with one COCO annotation file (*.json) and its images in images/."""
    films: Several[Path] = ()
    """Videos in which to follow people."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Run the command."""
        import torch
        from tqdm import tqdm

        from tensorsim.pipeline.networks import pretrained_detector
        from tensorsim.training.detector_metrics import compare_tracks, measure, tracks_of_film
        from tensorsim.training.shards import Sample, read_coco_folder, read_coco_shards

        groups: dict[str, list[Sample]] = {}
        if self.data is not None:
            held_out = read_coco_shards(self.data)[1]
            groups["COCO, held out"] = [sample for sample in held_out if sample.all_labelled]
        if self.coco is not None:
            groups[str(self.coco)] = read_coco_folder(self.coco)
        if not groups and not self.films:
            raise TensorsimError(
                "evaluate detector: got nothing to evaluate on, expected --data, --coco or --films"
            )
        if self.films and self.against is None:
            raise TensorsimError("--films needs --against, the detector to compare with")

        files = [self.weights] if self.against is None else [self.weights, self.against]
        detectors = [("shipped" if file is None else str(file), pretrained_detector(file)) for file in files]
        with torch.inference_mode():
            for name, samples in groups.items():
                for source, detector in detectors:
                    bar = tqdm(samples, desc=f"{name}, {source}", unit="picture", disable=self.quiet)
                    figures = measure(detector, bar)
                    told = ", ".join(f"{key} {value:.3g}" for key, value in figures.items())
                    print(f"{name}, {source}: {told}")
            for film in self.films:
                bar = tqdm(detectors, desc=film.name, unit="detector", disable=self.quiet)
                tracks = [tracks_of_film(detector, film) for _, detector in bar]
                followed = compare_tracks(*tracks)
                share = followed.shared / max(followed.reference_frames, 1)
                print(
                    f"{film}: {tracks[0].valid.shape[1]} people in {followed.frames} person-frames, "
                    f"{tracks[1].valid.shape[1]} in {followed.reference_frames}, shared {share:.3f}"
                )
