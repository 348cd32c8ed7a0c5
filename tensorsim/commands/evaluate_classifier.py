"""``tensorsim evaluate classifier``: accuracy on generated people, against noise, and on poses from films."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tensorsim.commands.arguments import Option
from tensorsim.exceptions import TensorsimError, check_count, check_distinct, check_seed
from tensorsim.files import check_folder, write_text

if TYPE_CHECKING:
    from tensorsim.recognition import ActivityRecognizer
    from tensorsim.training.film_maps import LabelledPose


@dataclass(frozen=True)
class EvaluateClassifier:
    """Print accuracy against signal-to-noise ratio, and confusion matrices at the lowest and highest ratios."""

    weights: Path
    """Weights of SPNet or SPGNet (.safetensors); if they say so, the logits of each image and of its copy with approach
    and retreat exchanged are averaged."""
    maps: Option[Path] = None
    """Folder of maps; missing ones are generated first, at 224 pixels or at the network's image size."""
    scenes: tuple[Literal["free-space", "through-wall"], ...] = ("free-space", "through-wall")
    """Scenes to evaluate on."""
    people: int = 40
    """People per scene; each performs all 12 activities."""
    held_out: bool = False
    """Use only every fifth person: for a folder that the network was trained on."""
    maps_seed: int = 1
    """Random seed for people, motion and noise; for a test set, use a seed the network was not trained on."""
    snr: tuple[float, ...] = (50.0, 40.0, 30.0, 20.0, 10.0)
    """Signal-to-noise ratios in dB; films are evaluated at the highest."""
    films: Option[Path] = None
    """Folder of films and what the networks found in them, as kept in films/ by `tensorsim evaluate truth --settings
    c`."""
    poses: Option[Path] = None
    """Folder with a pose.npz from `tensorsim simulate` per film, in subfolders whose names begin with S1 to S12."""
    out: Option[Path] = None
    """Folder for the confusion matrices as CSV and PNG."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> None:
        """Run the command."""
        if self.maps is None and self.films is None and self.poses is None:
            raise TensorsimError(
                "evaluate classifier: got nothing to classify, expected --maps, --films or --poses"
            )
        check_seed(self.maps_seed, "--maps-seed")
        check_count(self.people, "--people", 5 if self.held_out else 1)
        check_count(len(self.scenes), "--scenes")
        check_distinct(self.scenes, "--scenes")
        if self.maps is not None:
            check_folder(self.maps, "--maps")
        if self.out is not None:
            check_folder(self.out)
        from tensorsim.training.classifier import check_ratios
        from tensorsim.training.film_maps import film_poses, labelled_poses

        check_ratios(self.snr, "--snr")
        recognizer = self._recognizer()
        if self.maps is not None:
            self._on_maps(recognizer)
        if self.films is not None:
            self._on_films(film_poses(self.films))
        if self.poses is not None:
            self._on_films(labelled_poses(self.poses))

    def _recognizer(self) -> "ActivityRecognizer":
        """The network with the picture settings stated in its file, which must match those of the maps."""
        from tensorsim.config import ACTIVITIES, RadarConfig
        from tensorsim.recognition import ActivityRecognizer
        from tensorsim.training.classifier import RANGE_DB
        from tensorsim.training.maps import MapSettings

        found = ActivityRecognizer.from_pretrained(RadarConfig(), self.weights)
        needed: dict[str, Any] = {"class_names": ACTIVITIES}
        if self.maps is not None:
            needed |= {"inputs": "doppler", "speed_m_s": MapSettings().speed_m_s, "range_db": RANGE_DB}
        for name, expected in needed.items():
            if getattr(found, name) != expected:
                raise TensorsimError(
                    f"{self.weights}: {name}: got {getattr(found, name)}, expected {expected}"
                )
        return found

    def _on_maps(self, recognizer: "ActivityRecognizer") -> None:
        import torch

        from tensorsim import plot
        from tensorsim.config import ACTIVITIES
        from tensorsim.recognition.confusion import confusion
        from tensorsim.training.classifier import clips_of, logits_of
        from tensorsim.training.maps import MapSettings, MapStore, build_maps

        assert self.maps is not None
        network, size, either_way = recognizer.network, recognizer.size, recognizer.either_way
        settings = MapSettings(seed=self.maps_seed)
        if settings.size % size:
            settings = replace(settings, size=size)
        build_maps(self.maps, self.people, self.scenes, settings, quiet=self.quiet)
        store = MapStore(self.maps)
        print(f"{'scene':14s}" + "".join(f"{ratio:8g} dB" for ratio in self.snr) + "   clips")
        matrices = {}
        for scene in self.scenes:
            clips = clips_of(store, (scene,), self.people, validation=True if self.held_out else None)
            row, labels = [], torch.tensor([clip.activity for clip in clips])
            for ratio in self.snr:
                logits = logits_of(network, store, clips, (ratio, ratio), size, either_way=either_way)
                counts = confusion(logits, labels)
                row.append(float(counts.diagonal().sum()) / len(clips))
                matrices[scene, ratio] = counts.numpy()
            print(f"{scene:14s}" + "".join(f"{100 * a:9.1f} %" for a in row) + f"{len(clips):8d}", flush=True)
        names = [name.split(" ")[0] for name in ACTIVITIES]
        for (scene, ratio), matrix in matrices.items():
            if ratio in (min(self.snr), max(self.snr)):
                print(f"\n{scene}, {ratio:g} dB: true class in rows, predicted in columns")
                print("     " + "".join(f"{name:>5s}" for name in names))
                for name, numbers in zip(names, matrix, strict=True):
                    print(f"{name:5s}" + "".join(f"{n:5d}" for n in numbers))
            if self.out is not None:
                stem = f"confusion_{scene}_{ratio:g}dB"
                lines = [",".join(["", *names])]
                lines += [
                    ",".join([name, *map(str, numbers)]) for name, numbers in zip(names, matrix, strict=True)
                ]
                write_text(self.out / f"{stem}.csv", "\n".join(lines) + "\n")
                figure = plot.confusion_figure(matrix, names, f"{scene}, {ratio:g} dB")
                plot.save_figure(figure, self.out / f"{stem}.png")

    def _on_films(self, poses: "list[LabelledPose]") -> None:
        from tensorsim.training.film_maps import classify_poses

        true = [pose.activity for pose in poses]
        for scene in self.scenes:
            found = classify_poses(self.weights, poses, scene, max(self.snr), self.quiet)
            wrong = Counter(f"S{a + 1} as S{b + 1}" for a, b in zip(true, found, strict=True) if a != b)
            right = len(poses) - wrong.total()
            print(f"{scene:14s} films: {100 * right / len(poses):.1f} % of {len(poses)}")
            if wrong:
                print("  " + ", ".join(f"{count} {which}" for which, count in wrong.items()), flush=True)
