"""The recipe of the map denoiser: the network predicts the noise in patches of noisy simulated maps.

Every clip is simulated twice with the same draw of the noise: at a ratio between 0 and 40 dB, and at 50 dB, which
counts as clean. Images and noise are on the ``"floor"`` scale of ``MapDenoiser``, so training matches use. On this
scale the noise has the same strength at all ratios. Relative to the peak of the map its power would span six orders
of magnitude, only the error of the noisiest maps would count, and such a network spoils the others.
"""

import math
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.enhance.dncnn import DnCNN, map_floor
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.files import complete_file, keep_settings, read_settings
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.processing.columns import block_rms
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.training.loop import Batch, Recipe
from tensorsim.training.maps import SCENES, one_person_many_ways
from tensorsim.types import RadarMaps

CLEAN_DB = 50.0
NOISY_DB = (0.0, 40.0)
#: Stored patches are a little larger than trained ones, which are cut from them at random.
STORED, TRAINED = 64, 50
_MOTION_HZ = 240.0
#: Range-time maps hardly change from pulse to pulse; at higher pulse rates, maps at about this rate are used as well.
_DISPLAY_HZ = 256.0


def simulate_pair(scene: str, activity: int, seed: int, snr_db: float) -> tuple[RadarMaps, RadarMaps]:
    """Maps of one clip at ``snr_db``, and at :data:`CLEAN_DB` with the same but weaker noise; ``seed`` determines
    person and noise.
    """
    radar, wall = PRESETS[scene].radar, PRESETS[scene].wall
    people = one_person_many_ways(1, torch.Generator().manual_seed(seed))
    motion = ActivityGenerator().generate(activity, people=people, rate_hz=_MOTION_HZ)
    positions = PoseResampler(radar.prf_hz)(motion.joints, _MOTION_HZ).unsqueeze(0)
    presence = motion.valid[:, :1].double().expand(1, positions.shape[2]).unsqueeze(0)
    points, rcs = JointScatterers()(positions, presence)
    echo = EchoSynthesizer(radar, wall, multipath=wall is not None)
    maps = []
    for ratio in (snr_db, CLEAN_DB):
        simulator = RadarSimulator(radar, echo=echo, snr_db=ratio)
        torch.manual_seed(seed)
        with torch.no_grad(), warnings.catch_warnings():
            # Kicks and falls are too fast for the through-wall preset and alias, as with a real radar.
            warnings.simplefilter("ignore", TensorsimWarning)
            maps.append(RadarMaps(*(field[0] for field in simulator(points, rcs))))
    return maps[0], maps[1]


def views(maps: RadarMaps, prf_hz: float) -> dict[str, Tensor]:
    """The input maps (H, W) of a denoiser: Doppler-time, and range-time after MTI at full and at display rate."""
    found = {"doppler_time": maps.doppler_time, "range_time_mti": maps.range_time_mti}
    block = round(prf_hz / _DISPLAY_HZ)
    if block > 1:
        found["range_time_mti, display rate"] = block_rms(maps.range_time_mti, block)
    return found


def on_scale(noisy: Tensor, clean: Tensor) -> tuple[Tensor, Tensor]:
    """Input of the network for a map (H, W), ``log(1 + noisy / floor)``, and the noise in units of the floor."""
    floor = map_floor(noisy)
    return torch.log1p(noisy / floor), (noisy - clean) / floor


def cut_patches(
    image: Tensor, noise: Tensor, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """``count`` patches (N, STORED, STORED) of an image and its noise, half at random places, half near an echo."""
    height, width = image.shape
    beyond = [0, max(0, STORED - width), 0, max(0, STORED - height)]
    padded = [F.pad(x[None, None], beyond, mode="replicate")[0, 0] for x in (image, noise)]
    height, width = padded[0].shape
    # The clean map in units of the floor, recovered from the floor scale.
    echo = (padded[0].expm1() - padded[1]).clamp_min(0.0)
    blocks = F.max_pool2d(echo[None, None], 8, ceil_mode=True)[0, 0]
    strong = torch.multinomial(
        blocks.clamp_min(1e-9).flatten(), count // 2, replacement=True, generator=generator
    )
    anywhere = torch.randint(blocks.numel(), (count - count // 2,), generator=generator)
    pieces: tuple[list[Tensor], list[Tensor]] = ([], [])
    for place in torch.cat([strong, anywhere]).tolist():
        row, column = divmod(place, blocks.shape[1])
        top = min(max(0, row * 8 - STORED // 2), height - STORED)
        left = min(max(0, column * 8 - STORED // 2), width - STORED)
        for piece, whole in zip(pieces, padded, strict=True):
            piece.append(whole[top : top + STORED, left : left + STORED])
    return torch.stack(pieces[0]), torch.stack(pieces[1])


def build_pairs(
    folder: Path,
    clips: int,
    seed: int = 0,
    per_map: int = 48,
    scenes: tuple[str, ...] = SCENES,
    quiet: bool = False,
) -> None:
    """Fill a folder with patches of ``clips`` clips per scene, cycling through activities; existing files are kept.

    Raises:
        TensorsimError: the folder holds patches of another seed, or of another number per map.
    """
    from safetensors.torch import save_file

    keep_settings(folder, {"seed": seed, "per_map": per_map})
    jobs = [(clip, scene) for clip in range(clips) for scene in scenes]
    for clip, scene in tqdm(jobs, desc="maps", unit="clip", disable=quiet):
        path = folder / f"{scene}-{clip:05d}.safetensors"
        if path.is_file():
            continue
        own_seed = seed * 1_000_003 + clip * len(SCENES) + SCENES.index(scene)
        generator = torch.Generator().manual_seed(own_seed)
        snr_db = NOISY_DB[0] + (NOISY_DB[1] - NOISY_DB[0]) * float(torch.rand((), generator=generator))
        noisy, clean = simulate_pair(scene, clip % len(ACTIVITIES), own_seed, snr_db)
        prf_hz = PRESETS[scene].radar.prf_hz
        pairs = zip(views(noisy, prf_hz).values(), views(clean, prf_hz).values(), strict=True)
        patches = [cut_patches(*on_scale(a.float(), b.float()), per_map, generator) for a, b in pairs]
        stored = {"image": torch.cat([p[0] for p in patches]), "noise": torch.cat([p[1] for p in patches])}
        with complete_file(path) as scratch:
            save_file({name: x.half().contiguous() for name, x in stored.items()}, scratch)


def untrained(depth: int = 20, seed: int = 0) -> DnCNN:
    """A DnCNN whose last layer is zero, so that it starts as the identity; ``seed`` determines the other weights."""
    torch.manual_seed(seed)
    net = DnCNN(depth)
    nn.init.zeros_(net.model[-1].get_parameter("weight"))
    return net


class DenoiserRecipe(Recipe):
    """Residual learning (Zhang et al., 2017): ``1/2 mean (Q(y) - (y - x))^2``, Adam, 1e-3 to 1e-5 along a cosine.

    Args:
        net: the network.
        folder: made by :func:`build_pairs`.
        clips: clips per scene to use; every eleventh is held out, so that all activities take turns.
        seed: seed of patches and flips.

    Raises:
        TensorsimError: the folder has none of the first clips, none to hold out, or no settings file.
    """

    def __init__(self, net: DnCNN, folder: Path, clips: int, seed: int = 0) -> None:
        from safetensors.torch import load_file

        files = {path: int(path.stem[-5:]) for path in sorted(folder.glob("*-?????.safetensors"))}
        files = {path: clip for path, clip in files.items() if clip < clips}
        parts: dict[bool, list[dict[str, Tensor]]] = {True: [], False: []}
        for path, clip in files.items():
            parts[clip % 11 == 9].append(load_file(path))
        if not parts[True]:
            raise TensorsimError(
                f"{folder}: got {len(files)} files of patches, expected at least 10 clips per scene"
            )
        self.training, self.held_out = (
            {name: torch.cat([file[name] for file in part]) for name in ("image", "noise")}
            for part in (parts[False], parts[True])
        )
        self.seed = seed
        settings = {"depth": net.depth, "seed": seed, "files": len(files), "maps": read_settings(folder)}
        super().__init__(net, settings, {"network": "DnCNN", "depth": str(net.depth), "scale": "floor"})

    def sample(self, index: int) -> dict[str, Any]:
        """A patch and its noise (1, TRAINED, TRAINED), cut and mirrored at random."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + index)
        which, top, left, mirror = (
            int(torch.randint(most, (), generator=generator))
            for most in (len(self.training["image"]), STORED - TRAINED + 1, STORED - TRAINED + 1, 4)
        )
        dims = [dim for dim in (1, 2) if mirror & dim]
        found = {}
        for name, patches in self.training.items():
            cut = patches[which : which + 1, top : top + TRAINED, left : left + TRAINED]
            found[name] = cut.float().flip(dims)
        return found

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Half the mean squared error of the residual, in units of the floor."""
        error = (batch["image"] - net(batch["image"]).float() - batch["noise"]).square().mean()
        before = batch["noise"].square().mean()
        return {"loss": error / 2, "gain_db": -10 * (error.detach() / before).log10()}

    def optimiser(self) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(self.net.parameters(), lr=1e-3)

    def rate(self, step: int, steps: int) -> float:
        """Cosine from 1 to 0.01, after a short warm-up."""
        rise = min(1.0, (step + 1) / 20)
        cosine = (1 + torch.cos(torch.tensor(torch.pi * step / steps)).item()) / 2
        return rise * (0.01 + 0.99 * cosine)

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Reduction of the error on patches of held-out clips."""
        parameter = next(net.parameters())
        error, before = 0.0, 0.0
        images, noises = self.held_out["image"][::4], self.held_out["noise"][::4]
        for image, noise in zip(images.split(32), noises.split(32), strict=True):
            x, wanted = image.to(parameter).unsqueeze(1), noise.to(parameter).unsqueeze(1)
            found = x - net(x.to(memory_format=torch.channels_last))
            error += float((found - wanted).square().sum())
            before += float(wanted.square().sum())
        gain_db = 10 * math.log10(before / error)
        return {"score": gain_db, "gain_db": gain_db}
