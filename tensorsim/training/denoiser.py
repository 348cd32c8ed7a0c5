"""The recipe of the map denoiser: patches of simulated maps with and without noise, the noise to be predicted.

Every clip is simulated twice with one draw of the noise, at a ratio between 0 and 40 dB and at 50 dB, which counts as
clean. Both are scaled as ``MapDenoiser`` scales the noisy one, so the network learns what it will be asked.
"""

import os
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.enhance.dncnn import DnCNN
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.radar.columns import block_rms
from tensorsim.radar.echo import EchoSynthesizer
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.training.loop import Batch, Recipe
from tensorsim.training.maps import SCENES, one_person_many_ways
from tensorsim.types import RadarMaps

CLEAN_DB = 50.0
NOISY_DB = (0.0, 40.0)
#: Stored patches are a little larger than trained ones, which are cut from them at random.
STORED, TRAINED = 64, 50
_MOTION_HZ = 240.0
#: Range-time maps at every pulse hardly change along time; long clips are kept at about this rate.
_DISPLAY_HZ = 256.0


def simulate_pair(scene: str, activity: int, seed: int, snr_db: float) -> tuple[RadarMaps, RadarMaps]:
    """Maps of one clip at ``snr_db`` and clean, with the same draw of the noise; ``seed`` makes person and noise."""
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
            # Kicks and falls are too fast for the through-wall preset; there they alias, as they would for a radar.
            warnings.simplefilter("ignore", TensorsimWarning)
            maps.append(RadarMaps(*(field[0] for field in simulator(points, rcs))))
    return maps[0], maps[1]


def views(maps: RadarMaps, prf_hz: float) -> dict[str, Tensor]:
    """The maps (H, W) that a denoiser is given: Doppler-time, and range-time after MTI at full and at display rate."""
    found = {"doppler_time": maps.doppler_time, "range_time_mti": maps.range_time_mti}
    block = round(prf_hz / _DISPLAY_HZ)
    if block > 1:
        found["range_time_mti, display rate"] = block_rms(maps.range_time_mti, block)
    return found


def on_scale(noisy: Tensor, clean: Tensor) -> tuple[Tensor, Tensor]:
    """Both maps on the scale that brings the noisy one to [0, 1]."""
    low, high = noisy.amin(), noisy.amax()
    return (noisy - low) / (high - low), (clean - low) / (high - low)


def cut_patches(
    noisy: Tensor, clean: Tensor, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """``count`` patches (N, STORED, STORED) of two images, half of them drawn anywhere, half where there is an echo."""
    height, width = noisy.shape
    padded = [
        F.pad(x[None, None], [0, max(0, STORED - width), 0, max(0, STORED - height)], mode="replicate")[0, 0]
        for x in (noisy, clean)
    ]
    height, width = padded[0].shape
    blocks = F.max_pool2d(padded[1][None, None], 8, ceil_mode=True)[0, 0]
    strong = torch.multinomial(
        blocks.clamp_min(1e-9).flatten(), count // 2, replacement=True, generator=generator
    )
    anywhere = torch.randint(blocks.numel(), (count - count // 2,), generator=generator)
    pieces: tuple[list[Tensor], list[Tensor]] = ([], [])
    for place in torch.cat([strong, anywhere]).tolist():
        row, column = divmod(place, blocks.shape[1])
        top = min(max(0, row * 8 - STORED // 2), height - STORED)
        left = min(max(0, column * 8 - STORED // 2), width - STORED)
        for piece, image in zip(pieces, padded, strict=True):
            piece.append(image[top : top + STORED, left : left + STORED])
    return torch.stack(pieces[0]), torch.stack(pieces[1])


def build_pairs(
    folder: Path,
    clips: int,
    seed: int = 0,
    per_map: int = 48,
    scenes: tuple[str, ...] = SCENES,
    quiet: bool = False,
) -> None:
    """Fill a folder with patches of ``clips`` clips per scene, activity after activity; what is there stays."""
    from safetensors.torch import save_file

    folder.mkdir(parents=True, exist_ok=True)
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
        scratch = path.with_suffix(f".{os.getpid()}.tmp")
        stored = {"noisy": torch.cat([p[0] for p in patches]), "clean": torch.cat([p[1] for p in patches])}
        save_file({name: x.half().contiguous() for name, x in stored.items()}, scratch)
        os.replace(scratch, path)


class DenoiserRecipe(Recipe):
    """Residual learning (Zhang et al., 2017): ``1/2 mean (Q(y) - (y - x))^2``, Adam 1e-3 falling to 1e-5 as a cosine.

    Args:
        folder: made by :func:`build_pairs`; every tenth clip is held out.
        depth: of the DnCNN.
        seed: of weights, order and flips.
        init: weights to start from.

    Raises:
        TensorsimError: fewer than 10 clips in the folder.
    """

    def __init__(self, folder: Path, depth: int = 20, seed: int = 0, init: Path | None = None) -> None:
        from safetensors.torch import load_file

        files = sorted(folder.glob("*-?????.safetensors"))
        parts: dict[bool, list[dict[str, Tensor]]] = {True: [], False: []}
        for path in files:
            parts[int(path.stem[-5:]) % 10 == 9].append(load_file(path))
        if not parts[True]:
            raise TensorsimError(
                f"{folder}: got {len(files)} files of patches, expected at least 10 clips per scene"
            )
        self.training, self.held_out = (
            {name: torch.cat([file[name] for file in part]) for name in ("noisy", "clean")}
            for part in (parts[False], parts[True])
        )
        self.seed = seed
        torch.manual_seed(seed)
        net = DnCNN(depth)
        if init is not None:
            from tensorsim.weights import load_state_dict, load_strict

            load_strict(net, load_state_dict(init), init)
        settings: dict[str, Any] = {
            "depth": depth,
            "seed": seed,
            "files": len(files),
            "init": None if init is None else str(init),
        }
        super().__init__(net, settings, {"network": "DnCNN", "depth": str(depth), "scale": "linear"})

    def sample(self, index: int) -> dict[str, Any]:
        """A noisy and a clean patch (1, TRAINED, TRAINED), cut and mirrored at random."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + index)
        which, top, left, mirror = (
            int(torch.randint(most, (), generator=generator))
            for most in (len(self.training["noisy"]), STORED - TRAINED + 1, STORED - TRAINED + 1, 4)
        )
        dims = [dim for dim in (1, 2) if mirror & dim]
        found = {}
        for name, patches in self.training.items():
            cut = patches[which : which + 1, top : top + TRAINED, left : left + TRAINED]
            found[name] = cut.float().flip(dims)
        return found

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Half the mean square error of the residual, which is that of the image."""
        error = (net(batch["noisy"]).float() - batch["clean"]).square().mean()
        return {"loss": error / 2, "psnr": -10 * error.detach().log10()}

    def optimiser(self) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.Adam(self.net.parameters(), lr=1e-3)

    def rate(self, step: int, steps: int) -> float:
        """Cosine from 1 to 0.01, after a short rise."""
        rise = min(1.0, (step + 1) / 20)
        cosine = (1 + torch.cos(torch.tensor(torch.pi * step / steps)).item()) / 2
        return rise * (0.01 + 0.99 * cosine)

    def validate(self, net: nn.Module) -> dict[str, float]:
        """PSNR over the patches of held-out clips, and what it gains over doing nothing."""
        parameter = next(net.parameters())
        error, before, count = 0.0, 0.0, 0
        noisy, clean = self.held_out["noisy"][::4], self.held_out["clean"][::4]
        for a, b in zip(noisy.split(32), clean.split(32), strict=True):
            a, b = a.to(parameter).unsqueeze(1), b.to(parameter).unsqueeze(1)
            with torch.autocast(parameter.device.type, torch.bfloat16):
                cleaned = net(a.to(memory_format=torch.channels_last)).float()
            error += float((cleaned - b).square().sum())
            before += float((a - b).square().sum())
            count += b.numel()
        psnr = -10 * torch.tensor(error / count).log10().item()
        return {
            "score": psnr,
            "psnr": psnr,
            "gain_db": psnr + 10 * torch.tensor(before / count).log10().item(),
        }
