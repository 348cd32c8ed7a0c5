"""A store of Doppler-time pictures of generated people, for every signal-to-noise ratio.

The map of an echo with noise is ``sum over bins of |S + s N|^2 = A + 2 s B + s^2 C``, S and N the spectra of echo and
noise, s the noise amplitude, and

    A = sum |S|^2,    B = sum Re(S N*),    C = sum |N|^2.

Pixels average power, so the same holds for pictures: a clip is stored as the pictures of A, ``B / sqrt(A C)`` (which
lies in [-1, 1]) and C, with one byte per pixel each, from which the picture at any ratio follows.

Each person does all twelve activities, each with a different heading, distance and speed. A file holds one person in
one scene, so that whole people can be held out and an interrupted run can continue.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError, check_choice
from tensorsim.evaluation.films import FPS
from tensorsim.files import complete_file, write_text
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.people import People, PeopleConfig, draw_people
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.scatterers import JointScatterers, visibility_fade
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.processing.doppler import DopplerFrames
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.noise import mean_power
from tensorsim.recognition.map_image import MapToImage
from tensorsim.training.film_errors import FilmErrors
from tensorsim.training.film_maps import FilmLoss

SCENES = ("free-space", "through-wall")

#: Rate of the generator's own knots; its spline interpolates between them.
_MOTION_HZ = 240.0
#: Bytes hold decibels below the peak in steps of this size: 102 dB in total.
_STEP_DB = 0.4
#: Range bins computed on either side of the body, and the extra range of reflections inside the wall.
_MARGIN_BINS, _WALL_M = 5, 2.0


@dataclass(frozen=True)
class MapSettings:
    """Contents of a store.

    Attributes:
        seed: seed of people, motion and noise; person k of a seed is always the same.
        size: height and width of the pictures.
        speed_m_s: largest radial speed shown, in either direction.
        duration_s: length of a clip.
        motion_hz: joints are sampled at this rate before the spline to the pulses: 240 is the true motion, 30 what
            remains of it at a camera's rate.
        films: identifies the films whose errors are added to the motion, see
            :class:`~tensorsim.training.film_errors.FilmErrors`; none for true motion.

    Raises:
        TensorsimError: a size below 1, or a span or rate that is not positive.
    """

    seed: int = 0
    size: int = 224
    speed_m_s: float = 3.8
    duration_s: float = 4.0
    motion_hz: float = _MOTION_HZ
    films: str = ""

    def __post_init__(self) -> None:
        if self.size < 1 or not (self.speed_m_s > 0 and self.duration_s > 0 and self.motion_hz > 0):
            raise TensorsimError(f"MapSettings: got {self}, expected positive numbers")

    @classmethod
    def read(cls, path: Path) -> "MapSettings":
        """Read the settings of a store from its ``settings.json``.

        Raises:
            TensorsimError: the file is damaged, or belongs to another kind of store.
        """
        try:
            return cls(**json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise TensorsimError(f"{path}: not the settings of a store of maps ({error})") from error

    @classmethod
    def of_films(cls, seed: int, errors: FilmErrors) -> "MapSettings":
        """Settings for motion as the pipeline estimates it from films with these errors of the networks."""
        return cls(seed=seed, motion_hz=FPS, films=errors.digest)


def one_person_many_ways(
    count: int, generator: torch.Generator, config: PeopleConfig | None = None
) -> People:
    """One drawn body ``count`` times, each time with another heading, start, speed and variation of movements."""
    drawn = draw_people(count, PeopleConfig() if config is None else config, generator)
    body = drawn.take(torch.zeros(count, dtype=torch.int64))
    return drawn._replace(
        height_m=body.height_m,
        mass_kg=body.mass_kg,
        female=body.female,
        left_handed=body.left_handed,
        proportions=body.proportions,
    )


def to_bytes(power: Tensor) -> Tensor:
    """Power relative to a peak of 1 as uint8 in decibels; 0 is no power."""
    level = 255 + 10 * power.clamp_min(1e-30).log10() / _STEP_DB
    return level.round().clamp(0, 255).to(torch.uint8)


def from_bytes(level: Tensor) -> Tensor:
    """The inverse of :func:`to_bytes`, float32."""
    power = 10 ** ((level.float() - 255) * (_STEP_DB / 10))
    return torch.where(level > 0, power, 0.0)


class Moves(NamedTuple):
    """Motion of one person observed by the radar.

    Attributes:
        joints: (12, T, 14, 3) m, by activity.
        valid: (12, T) bool, whether the person is present.
        noise: state of the random generator for the receiver's noise.
    """

    joints: Tensor
    valid: Tensor
    noise: Tensor


class MotionMaker:
    """Generates the motion of the people of a store.

    Args:
        settings: settings of the store.
        errors: errors of films, if the settings name some.

    Raises:
        TensorsimError: errors of other films.
    """

    def __init__(self, settings: MapSettings, errors: FilmErrors | None = None) -> None:
        if settings.films != ("" if errors is None else errors.digest):
            raise TensorsimError(f"MotionMaker: got errors of different films, expected those of {settings}")
        self.settings = settings
        self.film = None if errors is None else FilmLoss(errors)

    def __call__(self, index: int) -> Moves:
        """Motion of person ``index``."""
        generator = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + index)
        people = one_person_many_ways(len(ACTIVITIES), generator)
        motion = ActivityGenerator().generate(
            torch.arange(len(ACTIVITIES)),
            people=people,
            duration_s=self.settings.duration_s,
            rate_hz=self.settings.motion_hz,
        )
        joints, valid = motion.joints.clone(), motion.valid.clone()
        if self.film is not None:
            for k in torch.nonzero(valid.any(-1)).flatten().tolist():
                joints[k], valid[k] = self.film(joints[k], float(people.height_m[k]), generator)
        return Moves(joints, valid, generator.get_state())


class MapMaker:
    """Computes the pictures of one scene.

    Args:
        scene: a name in ``tensorsim.radar.presets.PRESETS``; a wall comes with its multipath.
        settings: settings of the store.
    """

    def __init__(self, scene: str, settings: MapSettings) -> None:
        check_choice(scene, SCENES, "scene")
        preset = PRESETS[scene]
        self.radar, self.settings = preset.radar, settings
        self.echo = EchoSynthesizer(preset.radar, preset.wall, multipath=preset.wall is not None)
        self.behind_wall_m = 0.0 if preset.wall is None else _WALL_M
        self.profile = RangeProfile(self.radar)
        self.mti = MovingTargetIndicator()
        self.scatterers = JointScatterers()
        self.resampler = PoseResampler(self.radar.prf_hz)
        pulses = round(settings.duration_s * self.radar.prf_hz)
        # About one frame per column is enough, unless windows would then leave out pulses.
        usual = DopplerFrames(self.radar)
        hop = max(usual.hop, (pulses - 1 - usual.length) // max(1, settings.size - 1))
        hop = min(hop, usual.length)
        self.frames = DopplerFrames(self.radar, overlap=1 - (hop - 0.5) / usual.length)
        self.image = MapToImage.doppler(self.radar, settings.speed_m_s, settings.size)
        shown = torch.nonzero(self.image.rows(usual.bins).sum(0)).flatten()
        self.first, self.last = int(shown[0]), int(shown[-1]) + 1

    def spectra(self, profiles: Tensor) -> Iterator[Tensor]:
        """Profiles (M, R) to Doppler spectra (r, K, F), a few range bins at a time; only rows shown in the picture."""
        window = self.frames.shifting_window.float()
        for series in self.frames.series(self.mti(profiles))[0].split(8):
            cut = series.unfold(-1, self.frames.length, self.frames.hop) * window
            yield torch.fft.ifft(cut, self.frames.bins, norm="forward")[..., self.first : self.last]

    def picture(self, power: Tensor) -> Tensor:
        """Power (K, F shown) to pixels (size, size)."""
        beside = [self.first, self.frames.bins - self.last]
        return self.image.average(torch.nn.functional.pad(power, beside).double().transpose(0, 1))

    def noise(self, pulses: int, generator: torch.Generator) -> Tensor:
        """Spectra (R, K, F) of receiver noise of power 1 per IF sample."""
        profiles = []
        for first in range(0, pulses, 2048):
            shape = (min(2048, pulses - first), self.profile.samples)
            profiles.append(self.profile(torch.randn(shape, dtype=torch.complex64, generator=generator)))
        return torch.cat(list(self.spectra(torch.cat(profiles))))

    def gate(self, points: Tensor) -> RangeProfile:
        """Profiles of the range bins that scatterers at (M, S, 3) reach."""
        tx, rx = (torch.tensor(antenna, dtype=points.dtype) for antenna in (self.radar.tx_m, self.radar.rx_m))
        reach = (
            torch.linalg.vector_norm(points - tx, dim=-1) + torch.linalg.vector_norm(points - rx, dim=-1)
        ) / 2
        margin = _MARGIN_BINS * self.radar.range_resolution_m
        near, far = float(reach.min()) - margin, float(reach.max()) + margin + self.behind_wall_m
        last = float(self.profile.range_m[-1])
        return RangeProfile(self.radar, gate_m=(max(0.0, near), min(far, last)))

    def echo_pictures(self, joints: Tensor, valid: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """The pictures A and B of a person, joints (T, 14, 3) and presence (T,), with noise of the same duration.

        The mean power of the echo per IF sample is 1.
        """
        rate_hz = self.settings.motion_hz
        pulses = self.resampler.pulses(len(joints), rate_hz)
        presence = visibility_fade(valid[None], rate_hz, self.radar.prf_hz, 0, pulses)
        points, rcs = self.scatterers(self.resampler(joints[None], rate_hz), presence)
        every = max(1, pulses // 512)
        power = mean_power(self.echo.target_echo(points[::every], rcs[::every]))
        gate = self.gate(points)
        bins = RangeBinSynthesizer(self.echo, gate, near_bins=_MARGIN_BINS - 1)
        power_sum, cross_sum, first = torch.zeros(()), torch.zeros(()), gate.first_bin
        for spectra in self.spectra(bins(points, rcs) / power.sqrt()):
            echo, beside = (
                torch.view_as_real(spectra),
                torch.view_as_real(noise[first : first + len(spectra)]),
            )
            power_sum = power_sum + echo.square().sum(0).sum(-1)
            cross_sum = cross_sum + (echo * beside).sum(0).sum(-1)
            first += len(spectra)
        return self.picture(power_sum), self.picture(cross_sum)

    @torch.no_grad()
    def pictures(self, moves: Moves) -> dict[str, Tensor]:
        """Pictures of one person as stored: bytes ``signal`` and ``cross`` (12, H, W) and ``noise`` (H, W).

        ``gain_db`` (12,) is the noise's peak relative to the signal's at a ratio of 0 dB.
        """
        count, frames = moves.valid.shape
        pulses = self.resampler.pulses(frames, self.settings.motion_hz)
        noise = self.noise(pulses, torch.Generator().set_state(moves.noise))
        noise_picture = self.picture(torch.view_as_real(noise).square().sum(0).sum(-1))
        noise_peak = noise_picture.max()
        size = self.settings.size
        signal = torch.zeros(count, size, size, dtype=torch.uint8)
        cross = torch.zeros(count, size, size, dtype=torch.int8)
        gain_db = torch.zeros(count)
        for k in range(count):
            if bool(moves.valid[k].any()):
                a, b = self.echo_pictures(moves.joints[k], moves.valid[k], noise)
                signal[k] = to_bytes(a / a.max())
                cross[k] = (127 * b / (a * noise_picture).sqrt().clamp_min(1e-30)).round().clamp(-127, 127)
                gain_db[k] = 10 * (noise_peak / a.max()).log10()
        return {
            "signal": signal,
            "cross": cross,
            "noise": to_bytes(noise_picture / noise_peak),
            "gain_db": gain_db,
        }


def build_maps(
    folder: Path,
    people: int,
    scenes: tuple[str, ...] = SCENES,
    settings: MapSettings | None = None,
    first: int = 0,
    quiet: bool = False,
    errors: FilmErrors | None = None,
) -> None:
    """Fill a store: people ``first`` to ``first + people`` in each scene; existing files are kept.

    ``errors`` are those of the films named by the settings.

    Raises:
        TensorsimError: the folder holds a store of other settings, or the errors are of other films.
    """
    from safetensors.torch import save_file

    settings = MapSettings() if settings is None else settings
    described = folder / "settings.json"
    if described.is_file():
        there = MapSettings.read(described)
        if there != settings:
            raise TensorsimError(f"{folder}: got maps of {asdict(there)}, expected {asdict(settings)}")
    else:
        write_text(described, json.dumps(asdict(settings), indent=2))
    motion = MotionMaker(settings, errors)
    makers = {scene: MapMaker(scene, settings) for scene in scenes}
    for index in tqdm(range(first, first + people), desc=folder.name, unit="person", disable=quiet):
        files = {scene: folder / f"{scene}-{index:05d}.safetensors" for scene in scenes}
        missing = {scene: path for scene, path in files.items() if not path.is_file()}
        if missing:
            moves = motion(index)
            for scene, path in missing.items():
                with complete_file(path) as scratch:
                    save_file(makers[scene].pictures(moves), scratch)


class MapStore:
    """Reads a store.

    Args:
        folder: made by :func:`build_maps`.

    Attributes:
        settings: settings of the store.
        people: scene -> sorted indices of the people whose file exists.

    Raises:
        TensorsimError: no store there.
    """

    def __init__(self, folder: Path) -> None:
        described = folder / "settings.json"
        if not described.is_file():
            raise TensorsimError(f"{folder}: no settings.json, expected a store of maps")
        self.folder = folder
        self.settings = MapSettings.read(described)
        self.people = {
            scene: sorted(int(p.stem[-5:]) for p in folder.glob(f"{scene}-?????.safetensors"))
            for scene in SCENES
        }

    def power(self, scene: str, person: int, activity: int, snr_db: float | None) -> Tensor:
        """Power picture (H, W) of one clip at this signal-to-noise ratio; None is free of noise.

        The empty scene has only noise, whatever the ratio.
        """
        from safetensors import safe_open

        with safe_open(self.folder / f"{scene}-{person:05d}.safetensors", "pt") as file:
            signal = from_bytes(file.get_slice("signal")[activity])
            if snr_db is None:
                return signal
            cross = file.get_slice("cross")[activity].float() / 127
            noise = from_bytes(file.get_tensor("noise"))
            gain_db = float(file.get_tensor("gain_db")[activity])
        noise = noise * 10 ** ((gain_db - snr_db) / 10)
        return (signal + 2 * cross * (signal * noise).sqrt() + noise).clamp_min(0.0)
