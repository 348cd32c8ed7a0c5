"""A store of Doppler-time pictures of everyday motion, true and as the pipeline finds it in films, for both presets.

Free space uses :class:`~tensorsim.training.expected_map.ExpectedMap`, the wall the range bins in closed form, each
with one of three body models, and with sway and vital signs in half of the clips. Noise is added in training.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured.motions import Draw
from tensorsim.files import complete_file, keep_settings, read_settings
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.body_scatterers import BodyScatterers
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.scatterers import JointScatterers, visibility_fade
from tensorsim.motion.sway import PosturalSway
from tensorsim.motion.vital_signs import VitalSigns
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.recognition.map_image import MapToImage
from tensorsim.training.everyday import at_rate, bystander, everyday_motion
from tensorsim.training.expected_map import ExpectedMap, noise_rows
from tensorsim.training.keypoint_errors import FilmedMotion
from tensorsim.training.maps import SCENES, from_bytes, to_bytes

#: Frame rates of films, and the rate at which true motion is sampled.
_FILM_HZ, _TRUE_HZ = (15.0, 18.0, 20.0, 25.0), 60.0
#: Rate at which scatterers are sampled for the expected picture.
_EXPECTED_HZ = 256.0
#: Range bins farther away are left out, as nobody is there.
_FARTHEST_M = 12.0
#: Body models and the share of each.
BODIES = {"joints": 0.35, "limbs": 0.15, "surface": 0.5}
#: Share of films with a second person, who stands or sits still.
_COMPANY = 0.22
#: Share of clips with an activity done towards the radar with the timing of a 4 s clip, as in generated data sets.
_REHEARSED = 0.25


@dataclass(frozen=True)
class EverydaySettings:
    """Contents of a store.

    Attributes:
        seed: seed of everything random; group k of a seed is always the same.
        size: height and width of the pictures.
        speed_m_s: largest radial speed shown, in either direction.
        filmed: clips per activity and group as the pipeline finds them in films.
        true: clips per activity and group of the true motion.

    Raises:
        TensorsimError: a size or speed that is not positive, or no clips.
    """

    seed: int = 0
    size: int = 64
    speed_m_s: float = 3.8
    filmed: int = 6
    true: int = 3

    def __post_init__(self) -> None:
        if self.size < 1 or not self.speed_m_s > 0 or min(self.filmed, self.true) < 0 or self.clips < 1:
            raise TensorsimError(f"EverydaySettings: got {self}, expected positive numbers")

    @classmethod
    def read(cls, folder: Path) -> "EverydaySettings":
        """The settings of the store in a folder.

        Raises:
            TensorsimError: no store there, or one of another kind.
        """
        if not (folder / "settings.json").is_file():
            raise TensorsimError(f"{folder}: no settings.json, expected a store of everyday maps")
        stated = read_settings(folder)
        try:
            return cls(**stated)
        except TypeError:
            raise TensorsimError(
                f"{folder}: got the settings {stated}, expected those of a store of everyday maps"
            ) from None

    @property
    def clips(self) -> int:
        """Clips per activity and group."""
        return self.filmed + self.true


class Watched(NamedTuple):
    """A clip in front of the radar.

    Attributes:
        joints: (P, T, 14, 3) m.
        valid: (P, T) bool.
        fps: frames per second.
    """

    joints: Tensor
    valid: Tensor
    fps: float


class Radars:
    """Pictures of clips in both scenes.

    Args:
        size, speed_m_s: see :class:`EverydaySettings`.
    """

    def __init__(self, size: int, speed_m_s: float) -> None:
        free, wall = (PRESETS[scene] for scene in SCENES)
        self.expected = ExpectedMap(free.radar, _EXPECTED_HZ, size, speed_m_s)
        profile = RangeProfile(wall.radar, gate_m=(0.0, _FARTHEST_M))
        self.profiles = RangeBinSynthesizer(
            EchoSynthesizer(wall.radar, wall.wall, multipath=True), profile, near_bins=3
        )
        self.mti = MovingTargetIndicator()
        self.maps = DopplerTimeMap(wall.radar, overlap=0.7)
        self.image = MapToImage.doppler(wall.radar, speed_m_s, size)
        self.noise = [noise_rows(free.radar, self.expected.image), noise_rows(wall.radar, self.image)]
        self.resamplers = [PoseResampler(rate) for rate in (_EXPECTED_HZ, wall.radar.prf_hz)]
        self.bodies: list[dict[str, nn.Module]] = [
            {
                "joints": JointScatterers(),
                "limbs": LimbScatterers(radar.tx_positions_m[0], radar.rx_positions_m[0]),
                "surface": BodyScatterers(
                    radar.tx_positions_m[0],
                    radar.rx_positions_m[0],
                    radar.carrier_hz + radar.bandwidth_hz / 2,
                ),
            }
            for radar in (free.radar, wall.radar)
        ]

    @torch.no_grad()
    def __call__(self, clip: Watched, body: str, alive: bool, seed: int) -> Tensor:
        """Power pictures (2, size, size) of a clip in free space and through the wall, each with peak 1, without noise.

        Args:
            clip: people.
            body: a name of :data:`BODIES`.
            alive: whether they sway, breathe and have a heartbeat.
            seed: seed of these.
        """
        scenes = []
        for resampler, bodies in zip(self.resamplers, self.bodies, strict=True):
            joints = resampler(clip.joints, clip.fps)
            if alive:
                joints = PosturalSway(resampler.prf_hz, seed=seed)(joints)
                joints = VitalSigns(resampler.prf_hz, seed=seed)(joints)
            presence = visibility_fade(clip.valid, clip.fps, resampler.prf_hz, 0, joints.shape[1])
            scenes.append(bodies[body](joints, presence))
        points, rcs = scenes[0]
        free = self.expected(points, rcs, None)
        magnitude = self.maps(self.mti(self.profiles(*scenes[1])))
        pictures = torch.stack([free, self.image.average(magnitude.double().square())])
        return pictures / pictures.amax((1, 2), keepdim=True).clamp(min=1e-30)

    def empty(self, generator: torch.Generator) -> Tensor:
        """Power pictures (2, size, size) of receiver noise, with peak 1."""
        rows = torch.stack(self.noise)[..., None]
        pixels = (*rows.shape[:2], rows.shape[1])
        rough = 1 + 0.08 * torch.randn(pixels, generator=generator, dtype=torch.float64)
        pictures = rows * rough.clamp(min=0.5)
        return pictures / pictures.amax((1, 2), keepdim=True)


class ClipMaker:
    """Everyday motion of one activity, true and filmed."""

    def __init__(self) -> None:
        self.filmed = FilmedMotion()
        self.generator = ActivityGenerator()

    def __call__(self, activity: int, count: int, filmed: bool, generator: torch.Generator) -> list[Watched]:
        """``count`` clips of the same length in front of one camera; fewer if a person was never found."""
        draw = Draw(1, generator)
        rehearsed = bool(draw(0.0, 1.0) < _REHEARSED)
        length_s = 4.0 if rehearsed or bool(draw(0.0, 1.0) < 0.7) else float(draw(2.4, 4.9))
        fps = _FILM_HZ[int(draw(0.0, len(_FILM_HZ)))] if filmed else _TRUE_HZ
        frames = round(length_s * fps)
        if rehearsed:
            made = self.generator.generate(activity, count, generator, length_s, fps)
            people = list(zip(made.joints, made.people.height_m.tolist(), strict=True))
        else:
            motion, heights = everyday_motion(activity, count, torch.full((count,), length_s), generator)
            people = [
                (at_rate(joints, frames, fps), tall)
                for joints, tall in zip(motion, heights.tolist(), strict=True)
            ]
        if not filmed:
            there = torch.ones(1, frames, dtype=torch.bool)
            return [Watched(joints[None], there, fps) for joints, _ in people]
        company = float(draw(0.0, 1.0)) < count * _COMPANY
        if company:
            people.append((at_rate(bystander(length_s, generator), frames, fps), 1.7))
        found, valid = self.filmed(people, fps, generator)
        clips = []
        for k in range(count):
            if int(valid[k].sum()) > 0.2 * frames:
                beside = [k, count] if company and k == 0 else [k]
                clips.append(Watched(found[beside], valid[beside], fps))
        return clips


def make_group(index: int, settings: EverydaySettings, maker: ClipMaker, radars: Radars) -> dict[str, Tensor]:
    """One group: ``pictures`` (N, 2, size, size) in bytes, ``activity`` (N,), ``filmed`` (N,)."""
    generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + index)
    pictures: list[Tensor] = []
    labels: list[int] = []
    films: list[bool] = []
    for activity in range(len(ACTIVITIES)):
        for filmed, count in ((True, settings.filmed), (False, settings.true)):
            if count == 0:
                continue
            if activity == 0:
                pictures += [radars.empty(generator) for _ in range((count + 1) // 2)]
            else:
                for clip in maker(activity, count, filmed, generator):
                    one = Draw(1, generator)
                    shares = torch.tensor(list(BODIES.values()))
                    body = list(BODIES)[int(torch.multinomial(shares, 1, generator=generator))]
                    seed = int(one(0.0, 2.0**20))
                    seen = radars(clip, body, bool(one(0.0, 1.0) < 0.5), seed)
                    # A person beyond the range axis of a radar is of no use for training.
                    if bool((seen.flatten(1).amax(-1) > 0).all()):
                        pictures.append(seen)
            labels += [activity] * (len(pictures) - len(labels))
            films += [filmed] * (len(pictures) - len(films))
    return {
        "pictures": torch.stack([to_bytes(picture) for picture in pictures]),
        "activity": torch.tensor(labels),
        "filmed": torch.tensor(films),
    }


def build_everyday(
    folder: Path, groups: int, settings: EverydaySettings | None = None, first: int = 0, quiet: bool = False
) -> None:
    """Fill a store with the groups ``first`` to ``first + groups``; existing files are kept.

    Raises:
        TensorsimError: the folder holds a store of other settings.
    """
    from safetensors.torch import save_file

    settings = EverydaySettings() if settings is None else settings
    keep_settings(folder, asdict(settings))
    paths = {index: folder / f"everyday-{index:05d}.safetensors" for index in range(first, first + groups)}
    missing = {index: path for index, path in paths.items() if not path.is_file()}
    if not missing:
        return
    maker, radars = ClipMaker(), Radars(settings.size, settings.speed_m_s)
    for index, path in tqdm(missing.items(), desc=folder.name, unit="group", disable=quiet):
        with complete_file(path) as scratch:
            save_file(make_group(index, settings, maker, radars), scratch)


class EverydayStore:
    """Reads a store.

    Args:
        folder: made by :func:`build_everyday`.
        groups: indices of the groups; None takes all existing ones.

    Attributes:
        settings: settings of the store.
        power: (N, 2, size, size) uint8, see :func:`tensorsim.training.maps.to_bytes`; free space first.
        activity: (N,) int64.
        filmed: (N,) bool.
        group: (N,) int64, number of the group; every fifth is held out for validation.

    Raises:
        TensorsimError: no store of everyday maps there, or a group that is missing.
    """

    def __init__(self, folder: Path, groups: Sequence[int] | None = None) -> None:
        from safetensors.torch import load_file

        self.settings = EverydaySettings.read(folder)
        there = sorted(folder.glob("everyday-?????.safetensors"))
        if groups is not None:
            there = [folder / f"everyday-{index:05d}.safetensors" for index in groups]
        if not there or not all(path.is_file() for path in there):
            raise TensorsimError(f"{folder}: got {len(there)} groups, some are missing, expected all of them")
        parts = [load_file(path) for path in there]
        self.power = torch.cat([part["pictures"] for part in parts])
        self.activity = torch.cat([part["activity"] for part in parts])
        self.filmed = torch.cat([part["filmed"] for part in parts])
        self.group = torch.cat(
            [
                torch.full((len(part["activity"]),), int(path.stem[-5:]))
                for path, part in zip(there, parts, strict=True)
            ]
        )

    def picture(self, clip: int, scene: int) -> Tensor:
        """Power (size, size) of a clip in a scene (0 free space, 1 through the wall)."""
        return from_bytes(self.power[clip, scene])
