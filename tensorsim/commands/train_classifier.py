"""``tensorsim train classifier``: train a classifier on maps of generated people, or on a data set of your own."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tensorsim.commands.arguments import Option, Several
from tensorsim.commands.training import TrainOptions, check_size
from tensorsim.exceptions import TensorsimError, check_positive, check_seed

#: Options that apply only to ``maps``.
_OF_MAPS = ("scenes", "people", "snr", "films", "film_maps", "film_people", "maps_seed", "film_seed")


@dataclass(frozen=True)
class TrainClassifier(TrainOptions):
    """Train SPNet or SPGNet on Doppler-time maps; running it again with the same arguments resumes it."""

    maps: Option[Path] = None
    """Folder of maps; missing ones are generated first (hours: 12 clips per person and scene)."""
    data: Option[Path] = None
    """Data set from `tensorsim dataset build` to use instead of --maps: its classes, and its parts for training and
    validation. Besides the weights, the confusion matrix (confusion.md) and the network as TorchScript and ONNX
    (picture_to_label.pt, .onnx) are written. --scenes, --people, --snr, --maps-seed, --films, --film-maps,
    --film-people and --film-seed need --maps; --init may have other classes."""
    labels: Several[str] = ()
    """Classes of --data to train on. Default: all."""
    radars: Several[str] = ()
    """Radars of --data whose maps are used, as input channels. Default: all."""
    network: Literal["spnet", "spgnet"] = "spnet"
    """SPNet on 224x224 images, or SPGNet (s2p6) on 32x32 ones."""
    scenes: tuple[Literal["free-space", "through-wall"], ...] = ("free-space", "through-wall")
    """Scenes to train on."""
    people: int = 300
    """People per scene; each performs all 12 activities, and every fifth is held out."""
    snr: tuple[float, float] = (10.0, 50.0)
    """Lowest and highest signal-to-noise ratio in dB; the paper uses 50 50."""
    size: Option[int] = None
    """Height and width of the images; with --maps, a divisor of 224. Default: that of the network."""
    films: Option[Path] = None
    """Folder of films and what the networks found in them, as kept in films/ by `tensorsim evaluate truth --settings
    c`: their errors are applied to the motion of --film-maps."""
    film_maps: Option[Path] = None
    """Folder of further maps to train on, of motion as the pipeline finds it in films; missing ones are generated
    first, without rendering."""
    film_people: int = 40
    """People per scene in --film-maps."""
    learning_rate: float = 1.47e-3
    """Learning rate for the first half of the epochs; the second half uses a tenth of it. Use less with --init."""
    masks: tuple[float, float] = (0.0, 0.0)
    """Maximum share of the rows (speeds) and of the columns (time) of an image to mask in training, as in SpecAugment;
    0 0 masks nothing."""
    epochs: int = 20
    """Passes over the training clips."""
    batch: int = 64
    """Clips per step."""
    maps_seed: int = 0
    """Random seed for people, motion and noise of --maps."""
    film_seed: int = 2
    """Random seed for people, motion and noise of --film-maps."""

    def run(self) -> None:
        """Run the command."""
        if (self.maps is None) == (self.data is None):
            raise TensorsimError("--maps, --data: got both or none, expected one of them")
        if self.maps is not None:
            if self.labels or self.radars:
                raise TensorsimError("--labels and --radars need --data")
            self._train_on_activities(self.maps)
        elif self.data is not None:
            given = [name for name in _OF_MAPS if getattr(self, name) != getattr(TrainClassifier, name)]
            if given:
                raise TensorsimError(
                    f"--{given[0].replace('_', '-')} needs --maps and cannot be combined with --data"
                )
            self._train_on_data(self.data)

    def _train_on_data(self, data: Path) -> None:
        from tensorsim.device import rank_and_processes
        from tensorsim.training.map_classifier import MapRecipe, write_outcome

        self.loop(steps=1, batch=self.batch)  # refuses invalid options before the data are read
        recipe = MapRecipe(
            data,
            self.network,
            self.labels or None,
            None,
            self.radars or None,
            self.size,
            self.init,
            self.seed,
            self.learning_rate,
            self.masks,
        )
        loop = self.epochs_loop(self.epochs, len(recipe.training), self.batch, ema_decay=0.0)
        best = self.train(recipe, loop)
        if rank_and_processes()[0] == 0:
            write_outcome(recipe, best)

    def _train_on_activities(self, maps: Path) -> None:
        from tensorsim.config import ACTIVITIES
        from tensorsim.training.classifier import ClassifierRecipe, held_out
        from tensorsim.training.film_errors import FilmErrors, watched_films
        from tensorsim.training.maps import MapSettings, MapStore, build_maps

        check_seed(self.maps_seed, "--maps-seed")
        check_seed(self.film_seed, "--film-seed")
        if (self.films is None) != (self.film_maps is None):
            raise TensorsimError("--films, --film-maps: got one of them, expected both or none")
        self._check_recipe()
        people = [self.people] if self.films is None else [self.people, self.film_people]
        trained = sum(not held_out(person) for count in people for person in range(count))
        clips = trained * len(ACTIVITIES) * len(self.scenes)
        loop = self.epochs_loop(self.epochs, clips, self.batch, ema_decay=0.0)
        filmed = None
        if self.films is not None and self.film_maps is not None:
            errors = FilmErrors(watched_films(self.films))
            settings = MapSettings.of_films(self.film_seed, errors)
            build_maps(
                self.film_maps, self.film_people, self.scenes, settings, quiet=self.quiet, errors=errors
            )
            filmed = MapStore(self.film_maps)
        build_maps(maps, self.people, self.scenes, MapSettings(seed=self.maps_seed), quiet=self.quiet)
        recipe = ClassifierRecipe(
            self.network,
            MapStore(maps),
            self.scenes,
            self.people,
            self.snr,
            self.seed,
            self.init,
            self.size,
            filmed,
            self.film_people,
            self.learning_rate,
            self.masks,
        )
        self.train(recipe, loop)

    def _check_recipe(self) -> None:
        """Refuse what the recipe would refuse, before hours of making maps."""
        from tensorsim.training.classifier import check_drawn
        from tensorsim.training.maps import MapSettings

        check_size(self.size, MapSettings().size)
        check_positive(self.learning_rate, "--learning-rate")
        if not self.scenes:
            raise TensorsimError("--scenes: got none, expected at least one")
        check_drawn(self.snr, self.masks, "--snr", "--masks")
        for option, people in (("--people", self.people), ("--film-people", self.film_people)):
            if people < 5:
                raise TensorsimError(f"{option}: got {people}, expected at least 5, of whom one is held out")
