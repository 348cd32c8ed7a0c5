"""Similarity of estimated maps to the true ones."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.radar.analysis import metrics
from tensorsim.types import RadarMaps

#: The three maps by their names in ``RadarMaps``, with their names in tables.
MAPS = {"range_time": "RTM", "range_time_mti": "processed RTM", "doppler_time": "DTM"}
#: Figures of each map; the envelope is that of the DTM only.
FIGURES = ("psnr", "psnr_db", "ssim", "ssim_db", "nmse", "envelope_m_s")


@dataclass(frozen=True)
class Maps:
    """The maps (R or F, K) of one clip in one scene."""

    range_time: Tensor
    range_time_mti: Tensor
    doppler_time: Tensor

    @classmethod
    def of(cls, maps: RadarMaps) -> "Maps":
        """The maps of one clip."""
        return cls(*(getattr(maps, name).reshape(getattr(maps, name).shape[-2:]) for name in MAPS))

    def like(self, other: "Maps") -> "Maps":
        """The same maps with as many columns as ``other``: cut, or padded with zeros."""
        return Maps(
            *(
                F.pad(
                    getattr(self, name), (0, getattr(other, name).shape[-1] - getattr(self, name).shape[-1])
                )
                for name in MAPS
            )
        )

    def empty(self) -> "Maps":
        """Maps of a scene without echo."""
        return Maps(*(torch.zeros_like(getattr(self, name)) for name in MAPS))


def mean_maps(many: list[Maps]) -> Maps:
    """Mean of maps of one size, each scaled by its peak."""
    return Maps(
        *(torch.stack([metrics.normalise(getattr(m, n), "linear") for m in many]).mean(0) for n in MAPS)
    )


def compare(guess: Maps, truth: Maps, speed_m_s: Tensor) -> dict[str, dict[str, float]]:
    """Scores of each map: PSNR, SSIM (linear, and in dB clipped 40 dB below the peak), NMSE, envelope.

    Each map is scaled by its own peak; nothing is shifted or fitted. Two maps without any echo are equal (PSNR
    infinite, NMSE 0). The envelope error is NaN if one of the maps has no envelope.

    Args:
        guess, truth: maps of one size.
        speed_m_s: (F,) radial speed of each Doppler bin.
    """
    rows: dict[str, dict[str, float]] = {}
    for name in MAPS:
        a, b = getattr(guess, name), getattr(truth, name)
        rows[name] = {
            "psnr": float(metrics.psnr(a, b, "linear")),
            "psnr_db": float(metrics.psnr(a, b, "db")),
            "ssim": float(metrics.ssim(a, b, "linear")),
            "ssim_db": float(metrics.ssim(a, b, "db")),
            "nmse": 0.0 if torch.equal(a, b) else float(metrics.nmse(a, b, "linear")),
        }
    outlines = [metrics.percentile_envelope(m.doppler_time, speed_m_s) for m in (guess, truth)]
    rows["doppler_time"]["envelope_m_s"] = float(metrics.envelope_rmse(*outlines))
    return rows


def similarity(maps: RadarMaps, truth: RadarMaps) -> dict[str, dict[str, float | None]]:
    """Similarity of maps to those of the true motion: PSNR and SSIM of linear and dB maps, each scaled by its peak.

    None where a figure is not finite, as for two empty maps.
    """
    table = {}
    for name in ("range_time", "range_time_mti", "doppler_time"):
        pair = getattr(maps, name), getattr(truth, name)
        figures = {
            "psnr_linear_db": metrics.psnr(*pair, scale="linear"),
            "psnr_of_db_map_db": metrics.psnr(*pair, scale="db"),
            "ssim_linear": metrics.ssim(*pair, scale="linear"),
            "ssim_of_db_map": metrics.ssim(*pair, scale="db"),
        }
        table[name] = {
            key: round(float(value), 4) if bool(value.isfinite()) else None for key, value in figures.items()
        }
    return table
