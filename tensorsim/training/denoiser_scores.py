"""Improvement by denoisers on whole maps of held-out motion."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim.config import ACTIVITIES
from tensorsim.radar.analysis.metrics import envelope_rmse, level_envelope, psnr
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.processing.doppler import DopplerFrames
from tensorsim.radar.processing.ridges import RidgeExtractor
from tensorsim.training.denoiser import simulate_pair

#: PSNR of magnitudes scaled by their peak, and of decibels clipped 40 dB below it; speed errors of Doppler-time maps.
COLUMNS = ("PSNR dB", "PSNR of dB map", "envelope m/s", "ridges m/s")
#: Maps are cut to this many columns: the slow methods take minutes for all 32 767 of a free-space range-time map.
COLUMNS_AT_MOST = 1024
Key = tuple[str, str, float, str]
#: Denoisers by name; None does nothing.
Denoisers = dict[str, Callable[[Tensor], Tensor] | None]


def ridge_error(noisy: Tensor, clean: Tensor, speed_m_s: Tensor) -> float:
    """Mean distance in m/s between the strongest local maxima of each frame in both maps.

    Only over frames in which that of the clean map is within 20 dB of the map's peak.
    """
    extract = RidgeExtractor(count=1)
    found, wanted = extract.peaks(noisy), extract.peaks(clean)
    strong = wanted.magnitudes > clean.max() / 10
    error = (speed_m_s[found.indices] - speed_m_s[wanted.indices]).abs()
    return float(error[strong].mean())


def scores(found: Tensor, clean: Tensor, speed_m_s: Tensor | None) -> list[float]:
    """The scores in :data:`COLUMNS` of one map; speed errors only for Doppler-time maps, else NaN."""
    figures = [float(psnr(found, clean, scale)) for scale in ("linear", "db")]
    if speed_m_s is None:
        return [*figures, float("nan"), float("nan")]
    outlines = [level_envelope(x, speed_m_s, level_db=20.0) for x in (found, clean)]
    return [*figures, float(envelope_rmse(*outlines)), ridge_error(found, clean, speed_m_s)]


@torch.no_grad()
def scores_of_clip(
    denoisers: Denoisers,
    scene: str,
    ratio: float,
    clip: int,
    seed: int,
    columns: int = COLUMNS_AT_MOST,
    guesses: bool = False,
) -> dict[str, dict[str, list[float]]]:
    """Scores by map and denoiser for one clip with a person in it, against the same echo at 50 dB.

    Args:
        denoisers: denoisers by name.
        scene: name of a radar preset.
        ratio: signal-to-noise ratio in dB.
        clip: number of the clip; clips cycle through the activities from S2.
        seed: seed of people, motion and noise.
        columns: most columns of each map, from its middle.
        guesses: also score an empty map, and the clean map of another person with the same activity.
    """
    people = len(ACTIVITIES) - 1
    activity = 1 + clip % people
    pair = simulate_pair(scene, activity, seed * 1_000_003 + clip, ratio)
    other = (
        simulate_pair(scene, activity, seed * 1_000_003 + clip + 1000 * people, ratio) if guesses else pair
    )
    radar = PRESETS[scene].radar
    speed = DopplerFrames(radar).doppler_hz * radar.doppler_wavelength_m / 2
    result = {}
    for view, axis in (("range_time_mti", None), ("doppler_time", speed)):
        whole = [getattr(maps, view).float() for maps in (*pair, other[1])]
        first = max(0, (whole[0].shape[1] - columns) // 2)
        noisy, clean, another = (x[:, first : first + columns] for x in whole)
        maps = {name: noisy if denoise is None else denoise(noisy) for name, denoise in denoisers.items()}
        if guesses:
            maps |= {"empty map": torch.zeros_like(clean), "another clip": another}
        result[view] = {name: scores(x, clean, axis) for name, x in maps.items()}
    return result


def compare(
    denoisers: Denoisers,
    scenes: Sequence[str],
    ratios: Sequence[float],
    clips: int,
    seed: int,
    quiet: bool = False,
) -> dict[Key, list[float]]:
    """Mean scores by scene, map, ratio and denoiser, on clips with a person in them."""
    found: dict[Key, list[list[float]]] = {}
    jobs = [(scene, ratio, clip) for scene in scenes for ratio in ratios for clip in range(clips)]
    for scene, ratio, clip in tqdm(jobs, desc="maps", unit="clip", disable=quiet):
        for view, of_view in scores_of_clip(denoisers, scene, ratio, clip, seed).items():
            for name, figures in of_view.items():
                found.setdefault((scene, view, ratio, name), []).append(figures)
    return {key: torch.tensor(figures).nanmean(0).tolist() for key, figures in found.items()}
