"""``tensorsim evaluate films``: label real films of known activity."""

import csv
import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from tensorsim.commands.arguments import Option, Several
from tensorsim.commands.networks import Engine, NetworkOptions, default_networks, load_networks
from tensorsim.commands.options import RadarOptions, at_display_rate, load_recognizer
from tensorsim.exceptions import TensorsimError, check_count, check_seed, collected_warnings, print_warnings
from tensorsim.files import check_folder, complete_file, write_text


@dataclass(frozen=True, kw_only=True)
class EvaluateFilms(NetworkOptions):
    """Label real films of known activity in each scene, as `tensorsim simulate --least-probability 0` would: every film
    gets a label, however uncertain.

    Prints a table and writes films.md, films.json, films.csv and a contact sheet (PNG) per film. What the networks find
    is cached in cache/.
    """

    data: Path
    """Folder of films with a labels.json: a list of {"file", "start_s", "end_s", "accept": [activities]}."""
    out: Path
    """Output folder."""
    scenes: tuple[Literal["free-space", "through-wall"], ...] = ("free-space", "through-wall")
    """Scenes to evaluate in."""
    body: Option[Literal["joints", "limbs", "version1", "surface"]] = None
    """Scatterers of a person, as in `tensorsim simulate`."""
    classifier: Option[str] = None
    """Activity classifier: path or name. Default: the shipped one."""
    only: Several[str] = ()
    """Names of films, or parts of names, to select. Default: all films."""
    lifter: Option[Literal["temporal", "nearest"]] = None
    """How keypoints are lifted to 3D, as in `tensorsim simulate`."""
    stride: int = 1
    """Keep every n-th frame."""
    whole: bool = False
    """Label whole films, not just the seconds in which the activity happens."""
    variants: bool = False
    """Also label five variants of each film (mirrored, shortened at either end, slightly perturbed keypoints), and
    print means over all six. This takes six times as long, except for the networks, which run once."""
    calibrate: bool = True
    """Estimate the camera of each film from the people in it; otherwise assume a level camera that sees 60 degrees
    horizontally."""
    seed: int = 0
    """Random seed for the receiver noise."""
    engine: Engine = "onnxruntime"
    """What runs the networks on the CPU, as in `tensorsim simulate`. ONNX Runtime gives about the same figures on all
    processors."""
    device: str = "auto"
    """Device: cpu, cuda, cuda:1, ...; auto uses a GPU if there is one."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Run the command."""
        check_seed(self.seed, "--seed")
        check_folder(self.out)
        check_count(self.stride, "--stride")
        if len(self.scenes) == 0:
            raise TensorsimError("--scenes: got none, expected at least one")
        networks = default_networks(self.detector, self.pose)

        import torch

        from tensorsim.config import PoseConfig
        from tensorsim.device import usable_device
        from tensorsim.evaluation.labelled_films import FilmReader, Scene, markdown, read_labels, whole_films
        from tensorsim.pipeline import PoseToDoppler, VideoToPose
        from tensorsim.pipeline.networks import pretrained_lifter

        films = read_labels(self.data)
        if self.only:
            films = [film for film in films if any(part in film.file for part in self.only)]
        if self.whole:
            films = whole_films(films)
        if not films:
            raise TensorsimError(f"{self.data}: got no film to label, expected at least one")
        device = usable_device(self.device)
        people = PoseConfig() if self.lifter is None else PoseConfig(lifter=self.lifter)
        stage = VideoToPose(
            *load_networks(*networks, self.flip_test is not False, self.engine),
            lifter=pretrained_lifter(people),
        ).eval()
        stage.to(device)
        reader = FilmReader(stage, networks, self.out / "cache", self.stride, self.calibrate)
        scenes: dict[str, Scene] = {}
        for name in self.scenes:
            options = RadarOptions(scene=name, body=self.body, classifier=self.classifier)
            config = at_display_rate(options.configuration())
            recognizer = load_recognizer(config)
            if recognizer is None:
                raise TensorsimError("--classifier: got 'none', expected weights")
            scenes[name] = Scene(PoseToDoppler.from_config(config).to(device), recognizer)
        self.out.mkdir(parents=True, exist_ok=True)
        rows, stems = [], Counter(_sheet_name(film.file) for film in films)
        with torch.inference_mode():
            for film in films:
                with collected_warnings() as messages:
                    sheet = _sheet_name(film.file)
                    if stems[sheet] > 1:
                        sheet = f"{film.file.replace('/', '_')}_{film.start_s:g}-{film.end_s:g}s"
                    row = self._row(film, reader, scenes, device, self.out / f"{sheet}.png")
                    rows.append(row | {"warnings": messages})
                print_warnings(f"{film.file}: {message}" for message in messages)
        text = markdown(rows)
        write_text(self.out / "films.md", text)
        write_text(self.out / "films.json", json.dumps(rows, indent=2) + "\n")
        write_csv(self.out / "films.csv", rows)
        print(text, end="")

    def _row(
        self, film: Any, reader: Any, scenes: dict[str, Any], device: Any, sheet: Path
    ) -> dict[str, Any]:
        """All results for one film; writes its contact sheet."""
        from tensorsim import plot, results
        from tensorsim.evaluation.film_sheet import contact_sheet
        from tensorsim.evaluation.film_variants import variants
        from tensorsim.evaluation.labelled_films import film_row, followed, judged

        video = reader.open(film)
        seen = reader.observed(film, video, device, self.quiet)
        found = reader.lifted(seen, video.fps)
        pose = found.pose
        shown = []
        for name, how in scenes.items():
            verdict, maps = judged(film, found, video.fps, name, how, self.seed, device, self.quiet)
            axes = None if maps is None else results.axes_of(how.stage, maps)
            shown.append((verdict, maps, axes))
        figure = contact_sheet(film, video, found, reader.stage.keypoint_threshold, shown)
        plot.save_figure(figure, sheet)
        verdicts = [verdict for verdict, _, _ in shown]
        radar = next(iter(scenes.values())).stage.simulator.radar
        people = followed(pose, video.fps, radar)
        row = film_row(film, found, people, pose.valid.shape[2], video.fps, verdicts)
        if not self.variants:
            return row
        of_variants = {}
        for variant, of_variant in variants(seen, video.fps).items():
            changed = reader.lifted(of_variant, video.fps)
            of_variants[variant] = {
                name: asdict(judged(film, changed, video.fps, name, how, self.seed, device, self.quiet)[0])
                for name, how in scenes.items()
            }
        return row | {"variants": of_variants}


def _sheet_name(file: str) -> str:
    """The name of a film with its folder and without its suffix."""
    return str(Path(file).with_suffix("")).replace("/", "_")


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """One line per film and scene."""
    with complete_file(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "file",
                "start_s",
                "end_s",
                "accept",
                "scene",
                "label",
                "probability",
                "right",
                "followed_s",
                "error",
            ]
        )
        for row in rows:
            longest = max((person["followed_s"] for person in row["people"]), default=0.0)
            for verdict in row["scenes"].values():
                writer.writerow(
                    [row["file"], row["start_s"], row["end_s"], "; ".join(row["accept"]), verdict["scene"],
                     verdict["label"], verdict["probability"], verdict["right"], longest, verdict["error"]]
                )  # fmt: skip
