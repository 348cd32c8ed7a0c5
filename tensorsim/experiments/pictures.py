"""Pictures for training recognisers: Doppler-time and range-time maps of generated people, stored by person.

Doppler-time pictures come from :class:`~tensorsim.training.maps.MapStore`, which gives them at any signal-to-noise
ratio. Range-time pictures (after the moving target indicator) and pictures of the ridges are made by the full
simulator at one ratio, from the same people and motion.
"""

import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.config.documents import digest
from tensorsim.errors import TensorsimWarning, check_choice
from tensorsim.experiments.work import Work
from tensorsim.files import complete_file
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.scatterers import JointScatterers, visibility_fade
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.recognition.map_image import MapToImage, ridge_map
from tensorsim.training.classifier import Clip, picture
from tensorsim.training.maps import MapSettings, MapStore, MotionMaker, build_maps

#: Kinds of input, with the number of channels of each.
INPUTS = {"doppler": 1, "range": 1, "ridges": 1, "merged": 2}
#: Signal-to-noise ratio of the range-time and ridge pictures: the paper's.
SNR_DB = 50.0


class PictureSet:
    """Pictures of the people of one scene.

    Args:
        work: holds the cache of the pictures; missing ones are made by :meth:`prepare`.
        scene: a name in ``tensorsim.radar.presets.PRESETS``.
        size: height and width in pixels.
        seed: seed of people, motion and noise.
    """

    def __init__(self, work: Work, scene: str, size: int, seed: int = 0) -> None:
        self.work, self.scene, self.size = work, scene, size
        # One set serves 32 and 64 pixels.
        self.settings = MapSettings(seed=seed, size=64 if 64 % size == 0 else size)

    def folder(self, kind: str) -> Path:
        """Folder of Doppler-time pictures (``maps``) or of the other two (``range``)."""
        size = "" if kind == "maps" else f"{self.size}-"
        return self.work.cache / f"{kind}-{size}{digest(self.settings)}"

    def prepare(self, people: int, inputs: str) -> None:
        """Make missing pictures of the first ``people`` people.

        Raises:
            TensorsimError: unknown inputs.
        """
        check_choice(inputs, INPUTS, "inputs")
        if inputs in ("doppler", "merged"):
            build_maps(self.folder("maps"), people, (self.scene,), self.settings, quiet=self.work.quiet)
        if inputs != "doppler":
            self._build_range(people)

    def get(self, people: range, inputs: str, snr_db: float = SNR_DB) -> tuple[Tensor, Tensor]:
        """Pictures (N, C, size, size) in [0, 1] of people and their activities (N,), 12 per person."""
        parts: list[Tensor] = []
        if inputs in ("range", "merged"):
            parts.append(self._stored(people, "range"))
        if inputs == "ridges":
            parts.append(self._stored(people, "ridges"))
        if inputs in ("doppler", "merged"):
            store = MapStore(self.folder("maps"))
            clips = [Clip(self.scene, person, k) for person in people for k in range(len(ACTIVITIES))]
            parts.append(torch.stack([picture(store, clip, snr_db, self.size) for clip in clips]))
        return torch.cat(parts, dim=1), torch.arange(len(ACTIVITIES)).repeat(len(people))

    def _file(self, person: int) -> Path:
        return self.folder("range") / f"{self.scene}-{person:05d}.safetensors"

    def _stored(self, people: range, name: str) -> Tensor:
        from safetensors.torch import load_file

        return (
            torch.cat([load_file(self._file(person))[name] for person in people]).float().unsqueeze(1) / 255
        )

    def _build_range(self, people: int) -> None:
        from safetensors.torch import save_file

        missing = [person for person in range(people) if not self._file(person).is_file()]
        if not missing:
            return
        maker, motion = RangeAndRidges(self.scene, self.size), MotionMaker(self.settings)
        heading = f"{self.scene}, range and ridges"
        for person in tqdm(missing, desc=heading, unit="person", disable=self.work.quiet):
            moves = motion(person)
            seed = self.settings.seed * 1_000_003 + person
            found = maker.pictures(moves.joints, moves.valid, self.settings.motion_hz, seed)
            with complete_file(self._file(person)) as scratch:
                save_file({name: (255 * x).round().to(torch.uint8) for name, x in found.items()}, scratch)


class RangeAndRidges:
    """Makes pictures of the range-time map after the moving target indicator and of the ridges.

    Args:
        scene: a name in ``tensorsim.radar.presets.PRESETS``; a wall comes with its multipath.
        size: height and width in pixels.
    """

    def __init__(self, scene: str, size: int) -> None:
        preset = PRESETS[scene]
        options: dict[str, Any] = {"engine": "range-bins", "near_bins": 4, "display_rate_hz": 256.0}
        self.simulator = RadarSimulator(
            preset.radar, preset.wall, multipath=preset.wall is not None, snr_db=SNR_DB, **options
        )
        self.range_image = MapToImage.range(preset.radar, size=size)
        self.doppler_image = MapToImage.doppler(preset.radar, size=size)
        self.resampler = PoseResampler(preset.radar.prf_hz)
        self.scatterers = JointScatterers()

    @torch.no_grad()
    def pictures(self, joints: Tensor, valid: Tensor, rate_hz: float, seed: int) -> dict[str, Tensor]:
        """Pictures (N, size, size) in [0, 1] of N clips of joints (N, T, 14, 3), present where ``valid`` (N, T)."""
        found: dict[str, list[Tensor]] = {"range": [], "ridges": []}
        prf_hz = self.simulator.radar.prf_hz
        torch.manual_seed(seed)
        with warnings.catch_warnings():
            # Limbs too fast for the through-wall preset alias, as with a real radar.
            warnings.simplefilter("ignore", TensorsimWarning)
            for one, there in zip(joints, valid, strict=True):
                pulses = self.resampler.pulses(len(one), rate_hz)
                fade = visibility_fade(there[None], rate_hz, prf_hz, 0, pulses)
                maps = self.simulator(*self.scatterers(self.resampler(one[None], rate_hz), fade))
                lines = ridge_map(maps.ridges, maps.ridge_magnitudes, maps.doppler_time.shape[-2])
                found["range"].append(self.range_image(maps.range_time_mti)[0])
                found["ridges"].append(self.doppler_image(lines)[0])
        return {name: torch.stack(parts).squeeze(1) for name, parts in found.items()}
