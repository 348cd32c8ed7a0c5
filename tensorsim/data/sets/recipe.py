"""The recipe of a data set: which people, how varied, seen by which radars, and how stored."""

import os
import re
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from tensorsim.config import ACTIVITIES, ProcessingConfig, SceneConfig, SimulationConfig
from tensorsim.config.checks import is_finite, require_choices, require_counts, require_positive
from tensorsim.config.documents import from_document, to_document
from tensorsim.config.limited_yaml import dump_limited_yaml
from tensorsim.config.yaml_files import read_yaml
from tensorsim.data.sets.outputs import OutputConfig
from tensorsim.data.sets.variations import VariationConfig
from tensorsim.enhance.choice import check_denoiser
from tensorsim.errors import TensorsimError
from tensorsim.files import write_text
from tensorsim.motion.activities import activity_index
from tensorsim.radar.presets import radar_scene

SourceKind = Literal[
    "generated",
    "rendered",
    "films",
    "table",
    "keypoints",
    "motion",
    "ntu",
    "kinetics",
    "charades",
    "movi",
    "h36m",
]
SplitBy = Literal["person", "source", "table"]
Format = Literal["webdataset", "hdf5", "mat", "png"]

#: Parts of a data set, in the order of ``SplitConfig.shares``.
PARTS = ("train", "validation", "test")


@dataclass(frozen=True)
class SourceConfig:
    """Where people and their labels come from.

    Attributes:
        kind: ``"generated"``: tensorsim's own generator; ``"rendered"``: the same people, rendered by
            :class:`~tensorsim.data.PersonRenderer` and found again by the networks, with their errors; ``"films"``,
            ``"keypoints"`` and ``"motion"``: a folder with one folder per class, of videos, COCO keypoints (.json) or
            captured motion (.bvh, .npz); ``"table"``: a CSV or Parquet table of such files; the others: the layouts of
            public data sets, see ``tensorsim.data.layouts``.
        path: folder or file; relative paths are relative to the working directory.
        table: CSV or Parquet file that the layouts ``kinetics``, ``charades`` and ``movi`` need besides the folder.
        classes: classes to use, in the order of their numbers; empty: all. For generated people these are activities.
        people: number of generated or rendered people.
        fps: frames per second of keypoints, which never state it, of motion files that do not, and of rendered videos
            (30).
        image_size: (height, width) of the images behind keypoints, if the file does not state it, and of rendered
            videos (360, 640).

    Raises:
        TensorsimError: a field that the kind needs is missing, or a given one is not used by the kind.
    """

    kind: SourceKind = "generated"
    path: str | None = None
    table: str | None = None
    classes: tuple[str, ...] = ()
    people: int | None = None
    fps: float | None = None
    image_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        require_choices(self, kind=SourceKind)
        used = {
            "generated": {"people"},
            "rendered": {"people", "fps", "image_size"},
            "keypoints": {"path", "fps", "image_size"},
        }.get(self.kind, {"path", "fps"})
        with_table = ("kinetics", "charades", "movi")
        used = used | {"table"} if self.kind in with_table else used
        used = used | {"image_size"} if self.kind == "table" else used
        for name in ("path", "table", "people", "fps", "image_size"):
            if name not in used and getattr(self, name) is not None:
                raise TensorsimError(
                    f"SourceConfig.{name}: got one for the kind {self.kind!r}, expected none"
                )
        for name in ("path", "table", "people", "fps"):
            needed = name in used and not (name == "table" and self.kind == "movi")
            needed = needed and (name != "fps" or self.kind == "keypoints")
            if needed and getattr(self, name) is None:
                raise TensorsimError(
                    f"SourceConfig.{name}: got none for the kind {self.kind!r}, expected one"
                )
        if self.people is not None:
            require_counts(self, "people")
            names = tuple(ACTIVITIES[activity_index(name)] for name in self.classes) or ACTIVITIES
            object.__setattr__(self, "classes", names)
        if len(set(self.classes)) < len(self.classes):
            raise TensorsimError(f"SourceConfig.classes: got {list(self.classes)}, expected each class once")
        if self.fps is not None:
            require_positive("SourceConfig", fps=self.fps)


@dataclass(frozen=True)
class RadarView:
    """A radar and its position. Every radar sees the same motion.

    Attributes:
        name: prefix of its arrays in a sample; variables of ``.mat`` files begin with it, preceded by ``radar_`` if it
            does not begin with a letter.
        preset: a preset of ``tensorsim.radar.presets`` or a YAML file, with its wall and floor.
        x_m, y_m: position of the radar's origin on the floor.
        yaw_deg: direction in which it looks, counter-clockwise seen from above; 0 is +y.

    Raises:
        TensorsimError: a name that cannot be part of a file name, a preset that does not exist, a position that is not
            finite.
    """

    name: str = "radar"
    preset: str = "free-space"
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        if not self.name.replace("_", "").replace("-", "").isalnum():
            raise TensorsimError(f"RadarView.name: got {self.name!r}, expected letters, digits, '-' and '_'")
        if not all(is_finite(value) for value in (self.x_m, self.y_m, self.yaw_deg)):
            raise TensorsimError(f"RadarView {self.name}: got {self}, expected finite numbers")


@dataclass(frozen=True)
class SplitConfig:
    """How samples are split into parts.

    Attributes:
        by: ``"person"``: nobody is in two parts, as far as the source names people; if it does not, each file counts
            as a different person. ``"source"``: no video, file or generated person is in two parts. ``"table"``: as
            stated in the column ``split``.
        shares: shares of the people (or sources) in training, validation and test. A part with a positive share has at
            least one if there are enough.

    Raises:
        TensorsimError: shares that are negative or do not add up to 1.
    """

    by: SplitBy = "person"
    shares: tuple[float, ...] = (0.8, 0.1, 0.1)

    def __post_init__(self) -> None:
        require_choices(self, by=SplitBy)
        shares = all(is_finite(share) and share >= 0 for share in self.shares)
        if len(self.shares) != len(PARTS) or not shares or abs(sum(self.shares) - 1) > 1e-6:
            raise TensorsimError(
                f"SplitConfig.shares: got {list(self.shares)}, expected three numbers from 0 on that add up to 1"
            )


@dataclass(frozen=True)
class StorageConfig:
    """Files of the data set.

    Attributes:
        format: ``"webdataset"``: tar shards; ``"hdf5"`` and ``"mat"``: the same shards in these formats; ``"png"``: one
            picture per sample and radar in a folder per part and class.
        shard_samples: samples per shard; a worker makes one shard at a time.

    Raises:
        TensorsimError: an unknown format or fewer than one sample.
    """

    format: Format = "webdataset"
    shard_samples: int = 64

    def __post_init__(self) -> None:
        require_choices(self, format=Format)
        require_counts(self, "shard_samples")


#: Data sets need only the echo near the people, and half as many Doppler frames as pictures for viewing.
_PROCESSING = ProcessingConfig(
    engine="range-bins", near_bins=8, energy_stride=8, overlap=0.5, range_gate_m=(0.5, 10.0)
)


#: Fields of a scene that have no effect without a wall.
_OF_WALLS = ("multipath", "wall_echo", "wall_paths", "wall_attenuation", "incidence", "bounces")


def folder_name(label: str) -> str:
    """A class as the name of a folder."""
    return re.sub(r"[^\w-]+", "_", label).strip("_") or "class"


def matlab_name(array: str) -> str:
    """The variable name of an array ``RADAR.OUTPUT`` in a ``.mat`` file: ASCII letters, digits and ``_``.

    MATLAB names begin with a letter: if the radar's does not, ``radar_`` is put before it.
    """
    name = re.sub(r"\W", "_", array, flags=re.ASCII)
    return (name if re.match("[A-Za-z]", name) else f"radar_{name}")[:31]


@dataclass(frozen=True)
class DatasetRecipe:
    """Everything that the samples of a data set depend on, besides the videos and files that it names.

    Attributes:
        name: name of the data set.
        seed: for everything that is random.
        duration_s: duration of each sample; from longer clips a section is drawn, shorter ones end with an empty scene.
        motion_hz: rate at which the motion of people is assembled.
        sources: sources of people and labels.
        variations: how each clip is varied.
        radars: radars that observe the scene.
        scene: propagation and noise for all radars; its radar and wall come from ``radars``.
        processing: signal to maps.
        gate_people: outputs without a range axis use only the range bins of ``processing.range_gate_m`` that people
            reach in the sample: several times faster, and with the noise of these bins only.
        outputs: arrays of a sample.
        split: split into training, validation and test.
        storage: file format.

    Raises:
        TensorsimError: no source or radar, repeated radar names, or a scene with a radar or wall.

    Example:
        >>> recipe = DatasetRecipe(radars=(RadarView("front", "through-wall"),), duration_s=2.0)
        >>> DatasetRecipe.from_document(recipe.to_document()) == recipe
        True
    """

    name: str = "dataset"
    seed: int = 0
    duration_s: float = 4.0
    motion_hz: float = 120.0
    sources: tuple[SourceConfig, ...] = (SourceConfig(people=10),)
    variations: VariationConfig = field(default_factory=VariationConfig)
    radars: tuple[RadarView, ...] = (RadarView(),)
    scene: SceneConfig = field(default_factory=SceneConfig)
    processing: ProcessingConfig = _PROCESSING
    gate_people: bool = True
    outputs: OutputConfig = field(default_factory=OutputConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    storage: StorageConfig = field(default_factory=StorageConfig)

    def __post_init__(self) -> None:
        require_positive("DatasetRecipe", duration_s=self.duration_s, motion_hz=self.motion_hz)
        if not 0 <= self.seed < 2**32:
            raise TensorsimError(
                f"DatasetRecipe.seed: got {self.seed}, expected an integer from 0 to 2^32 - 1"
            )
        if not self.sources or not self.radars:
            raise TensorsimError("DatasetRecipe: got no source or no radar, expected at least one of each")
        names = [view.name for view in self.radars]
        if len({name.casefold() for name in names}) < len(names):  # WebDataset reads them in lower case
            raise TensorsimError(
                f"DatasetRecipe.radars: got the names {names}, expected ones that differ in more than capitals"
            )
        if self.scene != replace(self.scene, radar=SceneConfig().radar, wall=None):
            raise TensorsimError("DatasetRecipe.scene: got a radar or a wall, expected them in radars")
        usual = SceneConfig()
        for name in ("body", "sway", "vital_signs"):
            if getattr(self.scene, name) != getattr(usual, name):
                raise TensorsimError(f"DatasetRecipe.scene: got {name}, expected it in variations")
        check_denoiser(self.processing.denoiser)
        if self.outputs.needs_array and (self.processing.denoiser or self.variations.denoisers):
            raise TensorsimError(
                f"DatasetRecipe: got a denoiser of maps for {', '.join(self.outputs.kinds)}, expected none"
            )
        if self.storage.format == "png" and set(self.outputs.kinds) - {"picture"}:
            raise TensorsimError(
                f"DatasetRecipe.outputs: got {', '.join(self.outputs.kinds)} for the format png, expected picture"
            )
        if self.storage.format == "mat":
            arrays = [f"{name}.{kind}" for name in names for kind in self.outputs.kinds]
            if len({matlab_name(array) for array in arrays}) < len(arrays):
                raise TensorsimError(
                    f"DatasetRecipe.radars: got the names {names}, expected ones that differ in the first 31 "
                    "characters of RADAR_OUTPUT: names in .mat files are at most that long, and have only English "
                    "letters, digits and '_'"
                )
        if round(self.duration_s * self.motion_hz) < 2:
            raise TensorsimError(
                f"DatasetRecipe.duration_s: got {self.duration_s}, expected at least two moments of motion"
            )
        for view in self.radars:
            self._check_view(view)

    def _check_view(self, view: RadarView) -> None:
        radar = self.simulation(view).scene.radar
        unfit = self.outputs.needs_pair if radar.has_array else self.outputs.needs_array
        if unfit:
            raise TensorsimError(
                f"DatasetRecipe.radars: {view.preset} is {'an' if radar.has_array else 'no'} array, but the outputs "
                f"{', '.join(self.outputs.kinds)} need {'one' if self.outputs.needs_array else 'one antenna pair'}"
            )

    def simulation(self, view: RadarView) -> SimulationConfig:
        """The configuration of one of the radars, before variations."""
        preset = radar_scene(view.preset)
        floor = self.scene.floor if preset.floor is None else preset.floor
        scene = replace(self.scene, radar=preset.radar, wall=preset.wall, floor=floor)
        return SimulationConfig(scene=scene, processing=self.processing, seed=self.seed)

    @property
    def without_effect(self) -> list[str]:
        """Wall settings that the recipe changes although none of its radars has a wall."""
        if any(radar_scene(view.preset).wall is not None for view in self.radars):
            return []
        of_scene, of_variations = SceneConfig(), VariationConfig()
        changed = [
            f"scene.{name}" for name in _OF_WALLS if getattr(self.scene, name) != getattr(of_scene, name)
        ]
        return changed + [
            f"variations.{name}"
            for name in ("wall_permittivity", "wall_thickness_m")
            if getattr(self.variations, name) != getattr(of_variations, name)
        ]

    @classmethod
    def from_document(cls, document: dict[str, Any], where: str = "recipe") -> "DatasetRecipe":
        """The recipe in a mapping; values that it omits keep their defaults.

        Raises:
            TensorsimError: unknown keys, or values that the recipe refuses.
        """
        given = document.get("processing")
        if isinstance(given, dict):
            document = document | {"processing": to_document(_PROCESSING) | given}
        recipe: DatasetRecipe = from_document(where, cls, document)
        return recipe

    def to_document(self) -> dict[str, Any]:
        """Mappings, lists, numbers and strings that :meth:`from_document` turns back into the same recipe."""
        document: dict[str, Any] = to_document(self)
        return document

    @classmethod
    def from_yaml(cls, path: str | os.PathLike[str]) -> "DatasetRecipe":
        """The recipe in a YAML file, such as ``tensorsim dataset example`` prints.

        Raises:
            TensorsimError: no such file, not YAML, unknown keys, or values that the recipe refuses.
        """
        return cls.from_document(read_yaml(path), str(path))

    def to_yaml(self, path: str | os.PathLike[str]) -> None:
        """Write a file that :meth:`from_yaml` reads back unchanged."""
        write_text(path, dump_limited_yaml(self.to_document()))
