"""Ablations of the radar module: effects of the wall and its paths, and of each denoiser, on maps of known motion."""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from tensorsim.config import SceneConfig, SimulationConfig
from tensorsim.enhance.choice import DENOISERS, map_denoiser
from tensorsim.errors import TensorsimError, TensorsimWarning, check_count, check_distinct, check_seed
from tensorsim.evaluation.clips import CLIP_S, Clip, activity_clips
from tensorsim.evaluation.films import FPS
from tensorsim.evaluation.scores import MAPS, Maps, compare
from tensorsim.experiments import figures
from tensorsim.experiments.work import Report, Table, Work, check_scenes, counted, mean_and_spread
from tensorsim.files import sha256_of
from tensorsim.pipeline import PoseToDoppler
from tensorsim.radar.presets import PRESETS
from tensorsim.registry import shipped_weights
from tensorsim.training.classifier import check_ratios
from tensorsim.training.denoiser_scores import COLUMNS, Denoisers, scores_of_clip
from tensorsim.training.maps import SCENES

#: Echo models of the through-wall scene by name.
ECHOES: dict[str, dict[str, Any]] = {
    "without wall attenuation": {"wall_attenuation": False},
    "without multipath": {"multipath": False},
    "without both": {"wall_attenuation": False, "multipath": False},
}
#: Trivial guesses as baselines for every PSNR.
GUESSES = ("empty map", "another clip")
SHORT = {"range_time": "RTM", "range_time_mti": "processed RTM", "doppler_time": "DTM"}
NORMALISATION = (
    "Every map is a linear magnitude over its own peak before PSNR and SSIM are taken; nothing is shifted or "
    "fitted. The paper does not say how its maps are scaled before PSNR. An empty map scores high, because most of "
    "a map is dark, and another clip of the class shows what a map that is only roughly right scores: read every "
    "figure against these two."
)


@dataclass(frozen=True)
class EchoConfig:
    """Settings of ``echo-ablation``.

    Attributes:
        clips: clips per activity, at least 2.
        seed: seed of the first clip.
    """

    clips: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        if self.clips < 2:
            raise TensorsimError(f"clips: got {self.clips}, expected at least 2 to compare with each other")
        check_seed(self.seed, "seed")


class _Echoes:
    """Noise-free maps of clips by the complete through-wall model and by each ablation of it."""

    def __init__(self) -> None:
        base = replace(PRESETS["through-wall"], snr_db=None)
        self.stages = {"complete": _stage(base)}
        self.stages |= {name: _stage(replace(base, **changes)) for name, changes in ECHOES.items()}
        simulator = self.stages["complete"].simulator
        self.speed_m_s = simulator.doppler.doppler_hz * (simulator.radar.doppler_wavelength_m / 2)

    @torch.no_grad()
    def maps(self, clip: Clip, echo: str) -> Maps:
        """Maps of the true motion."""
        stage = self.stages[echo]
        positions = clip.joints(FPS).float()[None, None]
        valid = torch.full(positions.shape[:3], clip.present)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TensorsimWarning)  # limbs alias in all of them
            return Maps.of(stage(positions, valid, FPS))


#: Scores of clips by activity and echo model; those of each clip by map and score name.
_Cells = dict[tuple[str, str], list[dict[str, dict[str, float]]]]


def _energy_db(maps: Maps, reference: Maps) -> float:
    """Energy of a Doppler-time map relative to another, dB; -inf for an empty one."""
    share = maps.doppler_time.square().sum() / reference.doppler_time.square().sum()
    return float(10 * share.log10())


def _stage(scene: SceneConfig) -> PoseToDoppler:
    return PoseToDoppler.from_config(SimulationConfig(scene=scene))


def echo_report(config: EchoConfig, work: Work) -> Report:
    """Maps of the ablated echo models compared with those of the complete one."""
    echoes = _Echoes()
    clips = {
        row: found for row, found in activity_clips((), config.clips, config.seed).items() if found[0].present
    }
    names = [*ECHOES, *GUESSES]
    cells: _Cells = {}
    jobs = [(row, k) for row, found in clips.items() for k in range(len(found))]
    for row, k in tqdm(jobs, desc="echo", unit="clip", disable=work.quiet):
        clip, other = clips[row][k], clips[row][(k + 1) % len(clips[row])]

        def make(clip: Clip = clip, other: Clip = other) -> dict[str, dict[str, dict[str, float]]]:
            truth = echoes.maps(clip, "complete")
            guesses = {name: echoes.maps(clip, name) for name in ECHOES}
            guesses |= {
                "empty map": truth.empty(),
                "another clip": echoes.maps(other, "complete").like(truth),
            }
            return {
                name: compare(guess, truth, echoes.speed_m_s) | {"energy": {"db": _energy_db(guess, truth)}}
                for name, guess in guesses.items()
            }

        settings = {"clip": clip.name, "row": row, "other": other.name, "length_s": CLIP_S}
        for name, scored in work.kept("echo", settings, make).items():
            cells.setdefault((row, name), []).append(scored)
    means = {
        name: {
            m: [mean_and_spread([c[m]["psnr"] for c in cells[row, name]])[0] for row in clips] for m in MAPS
        }
        for name in names
    }
    main = [
        [name, *(x for m in MAPS for x in mean_and_spread(means[name][m])), _strength(cells, clips, name)]
        for name in names
    ]
    heads = [
        "echo model",
        *(f"{SHORT[m]}{part}" for m in MAPS for part in ("", ", spread")),
        "echo stronger by dB",
    ]
    by_row = [[row, *(means[name]["doppler_time"][k] for name in names)] for k, row in enumerate(clips)]
    first = {row: found[0] for row, found in list(clips.items())[:4]}
    drawn = {
        row: {echo: echoes.maps(clip, echo).doppler_time.numpy() for echo in echoes.stages}
        for row, clip in first.items()
    }
    notes = [
        "Linear PSNR in dB of maps of the through-wall scene, against those of the complete echo model of the same "
        f"motion, free of noise; {counted(config.clips, 'clip')} of {CLIP_S:g} s per activity. In free space there is "
        "no wall to leave out. Without attenuation the echo keeps its delay in the wall; without multipath the "
        "bounces in the wall are left out. People are behind the wall, which weakens all of their echoes alike: "
        "without noise, and with each map scaled by its own peak, leaving attenuation out changes nothing but the "
        "strength of the echo, which the last column has. The paper compares with measured maps, which are not "
        "published.",
        NORMALISATION,
    ]
    tables = [
        Table("PSNR in dB against the complete echo model, mean and spread of the activities", heads, main),
        Table("Doppler-time maps by activity, PSNR in dB", ["activity", *names], by_row, file="activities"),
    ]
    return Report(notes, tables, {"doppler-time": figures.map_grid(drawn, "Doppler-time maps, through wall")})


def _strength(cells: _Cells, rows: Iterable[str], name: str) -> float:
    """Mean energy of the Doppler-time maps relative to those of the complete model, dB; NaN for a guess."""
    if name not in ECHOES:
        return float("nan")
    return mean_and_spread([cell["energy"]["db"] for row in rows for cell in cells[row, name]])[0]


@dataclass(frozen=True)
class DenoiserConfig:
    """Settings of ``denoiser-ablation``.

    Attributes:
        denoisers: any of ``none``, ``perona-malik``, ``ksvd``, ``dncnn``, or weight files of DnCNN.
        scenes: names of radar presets.
        clips: clips per scene and ratio, cycling through the activities from S2.
        snr_db: signal-to-noise ratios.
        columns: most columns of each map, from its middle; K-SVD takes minutes for the 32 767 of a range-time map.
        seed: seed of people, motion and noise.
    """

    denoisers: tuple[str, ...] = DENOISERS
    scenes: tuple[str, ...] = SCENES
    clips: int = 22
    snr_db: tuple[float, ...] = (0.0, 10.0, 20.0)
    columns: int = 1024
    seed: int = 1

    def __post_init__(self) -> None:
        check_scenes(self.scenes)
        check_seed(self.seed, "seed")
        check_ratios(self.snr_db)
        check_distinct(self.denoisers, "denoisers")
        counts = {"denoisers": len(self.denoisers), "clips": self.clips, "columns": self.columns}
        for what, count in counts.items():
            check_count(count, what)


def denoiser_report(config: DenoiserConfig, work: Work) -> Report:
    """Each denoiser's maps compared with those of the same echo at 50 dB."""
    denoisers: Denoisers = {name: map_denoiser(name) for name in config.denoisers}
    # Files are identified by their content.
    identities = {name: sha256_of(Path(name)) if Path(name).is_file() else "" for name in config.denoisers}
    found: dict[tuple[str, str, float, str], list[list[float]]] = {}
    jobs = [
        (scene, ratio, clip)
        for scene in config.scenes
        for ratio in config.snr_db
        for clip in range(config.clips)
    ]
    for scene, ratio, clip in tqdm(jobs, desc="denoisers", unit="clip", disable=work.quiet):

        def make(
            scene: str = scene, ratio: float = ratio, clip: int = clip
        ) -> dict[str, dict[str, list[float]]]:
            return scores_of_clip(denoisers, scene, ratio, clip, config.seed, config.columns, guesses=True)

        settings = {
            "scene": scene, "ratio": ratio, "clip": clip, "seed": config.seed, "denoisers": identities,
            "columns": config.columns, "weights": shipped_weights("DnCNN"),
        }  # fmt: skip
        for view, of_view in work.kept("denoiser", settings, make).items():
            for name, figures_of_map in of_view.items():
                found.setdefault((scene, view, ratio, name), []).append(figures_of_map)
    rows = []
    shown: dict[str, dict[str, tuple[float, float]]] = {}
    for (scene, view, ratio, name), values in found.items():
        means = [mean_and_spread([v for v in column if v == v]) for column in zip(*values, strict=True)]
        rows.append([scene, SHORT[view], f"{ratio:g} dB", name, *(mean for mean, _ in means)])
        shown.setdefault(f"{SHORT[view]}, {scene}, {ratio:g} dB", {})[name] = means[0]
    columns = ["scene", "map", "SNR", "denoiser", *COLUMNS]
    notes = [
        f"{counted(config.clips, 'clip')} per scene and ratio, the activities from S2 on in turn; each map against "
        "that of the same echo at 50 dB. RTM is the range-time map after the moving target indicator. Of each map "
        f"{config.columns} columns at most count. Envelope and ridges are speed errors of the Doppler-time map. K-SVD "
        "learns its dictionary by scikit-learn's online method. DnCNN is the shipped network, trained on such maps of "
        "other people; the paper's was trained on photographs.",
        NORMALISATION,
    ]
    drawn = {"psnr": figures.bars(shown, "PSNR, dB", "PSNR of denoised maps")}
    return Report(notes, [Table("Denoisers", columns, rows, digits=2)], drawn)


def quick_echo() -> EchoConfig:
    """Two clips."""
    return EchoConfig(clips=2)


def quick_denoisers() -> DenoiserConfig:
    """A quarter of one clip through the wall at one ratio: K-SVD would take most of a minute for more."""
    return DenoiserConfig(scenes=("through-wall",), clips=1, snr_db=(10.0,), columns=256)
