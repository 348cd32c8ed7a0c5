"""The arrays of a sample, and their scales."""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from tensorsim.config.checks import require_choices, require_counts, require_positive
from tensorsim.errors import TensorsimError
from tensorsim.recognition.map_image import area_weights

DataType = Literal["uint8", "float16"]

#: Outputs for one transmitter and receiver, those for an array, and those for any radar.
MAPS = ("doppler_time", "range_time", "range_time_mti")
SIGNALS = ("profiles", "if_signal")
OF_PAIR = (*MAPS, *SIGNALS, "ridges", "picture")
OF_ARRAY = ("range_doppler_angle", "point_cloud")
KINDS = (*OF_PAIR, *OF_ARRAY, "joints")


@dataclass(frozen=True)
class OutputConfig:
    """Arrays of a sample.

    Attributes:
        kinds: ``"doppler_time"`` (F, K), ``"range_time"`` and ``"range_time_mti"`` (R, M): maps in decibels below their
            peak; ``"ridges"`` (C, K): Doppler in Hz; ``"picture"`` (size, size) uint8: the input of a classifier, row 0
            the lowest speed; ``"profiles"`` (M, R, 2) and ``"if_signal"`` (M, N, 2): real and imaginary part divided by
            the largest magnitude, float16; ``"range_doppler_angle"`` (frames, R, F, beams) in decibels and
            ``"point_cloud"`` (frames, points, 4) float32: range in m, speed in m/s, sine of the azimuth and power in
            dB, NaN where there is no point, both for an array (above a signal-to-noise ratio of 20 dB, side lobes of
            ``range_window="hamming"`` become points too, those of ``"hann"`` hardly ever); ``"joints"`` (P, T, 14, 3)
            float32: metres, as the radar sees them, NaN where nobody is.
        dtype: type of maps: ``"uint8"``, 255 at the peak and 0 at ``range_db`` below it, or ``"float16"``, decibels.
        range_db: dynamic range of uint8 maps.
        size: (rows, columns) of maps, each cell the mean power of what it covers; None keeps them.
        rate_hz: maximum columns per second of maps, averaged likewise; None keeps them; not used with ``size``.
            Doppler-time maps have at most one column per Doppler frame: about 20 per second with the recipes'
            ``overlap`` of 0.5.
        picture_size, picture_speed_m_s, picture_range_db: settings of pictures.
        frames_per_s, beams, cube_size, points: settings of array outputs: frames per second, directions equally
            spaced in sine, range and Doppler cells of a cube, and points per frame.

    Raises:
        TensorsimError: unknown kinds, kinds that no single radar can give together, ``rate_hz`` together with ``size``,
            or numbers that are not positive.
    """

    kinds: tuple[str, ...] = ("doppler_time",)
    dtype: DataType = "uint8"
    range_db: float = 60.0
    size: tuple[int, int] | None = None
    rate_hz: float | None = 32.0
    picture_size: int = 128
    picture_speed_m_s: float = 3.8
    picture_range_db: float = 40.0
    frames_per_s: float = 10.0
    beams: int = 32
    cube_size: tuple[int, int] = (64, 64)
    points: int = 64

    def __post_init__(self) -> None:
        require_choices(self, dtype=DataType)
        unknown = sorted(set(self.kinds) - set(KINDS))
        if unknown or not self.kinds or len(set(self.kinds)) < len(self.kinds):
            raise TensorsimError(
                f"OutputConfig.kinds: got {list(self.kinds)}, expected different ones of {', '.join(KINDS)}"
            )
        if self.needs_array and self.needs_pair:
            raise TensorsimError(
                f"OutputConfig.kinds: got {list(self.kinds)}, expected outputs of an array ({', '.join(OF_ARRAY)}) or "
                "of one transmitter and receiver"
            )
        require_counts(self, "picture_size", "beams", "points")
        for name in ("size", "cube_size"):
            value = getattr(self, name)
            if value is not None and (len(value) != 2 or min(value) < 1):
                raise TensorsimError(f"OutputConfig.{name}: got {list(value)}, expected rows and columns")
        if self.size is not None:
            if self.rate_hz not in (None, OutputConfig.rate_hz):
                raise TensorsimError(
                    f"OutputConfig.rate_hz: got {self.rate_hz} together with a size, which sets the number of columns; "
                    "expected none"
                )
            object.__setattr__(self, "rate_hz", None)
        require_positive(
            "OutputConfig",
            range_db=self.range_db,
            picture_speed_m_s=self.picture_speed_m_s,
            picture_range_db=self.picture_range_db,
            frames_per_s=self.frames_per_s,
        )
        if self.rate_hz is not None:
            require_positive("OutputConfig", rate_hz=self.rate_hz)

    @property
    def has_range(self) -> bool:
        """Whether an output has a range axis."""
        return bool(set(self.kinds) & {"range_time", "range_time_mti", *SIGNALS, *OF_ARRAY})

    @property
    def needs_pair(self) -> bool:
        """Whether there are outputs for one transmitter and receiver."""
        return bool(set(self.kinds) & set(OF_PAIR))

    @property
    def needs_array(self) -> bool:
        """Whether there are outputs for an array."""
        return bool(set(self.kinds) & set(OF_ARRAY))


class Stored(NamedTuple):
    """An array as it is stored, and the magnitude that is 0 dB (or 1) in it."""

    array: npt.NDArray[Any]
    peak: float


def resized(power: Tensor, rows: int, columns: int) -> Tensor:
    """Average power (H, W) to cells (rows, columns), each the mean of what it covers."""

    def weights(cells: int, count: int) -> Tensor:
        return area_weights(torch.arange(cells, dtype=torch.float64), 1.0, 0.0, float(cells), count)

    height, width = power.shape
    across = weights(width, columns).to(power.dtype)
    return weights(height, rows).to(power.dtype) @ power @ across.transpose(0, 1)


def stored_map(magnitude: Tensor, config: OutputConfig, duration_s: float) -> Stored:
    """A map (H, W) of magnitudes stored as :class:`OutputConfig` states; ``duration_s`` spans all its columns."""
    power = magnitude.double().square()
    rows, columns = power.shape
    if config.size is not None:
        rows, columns = config.size
    elif config.rate_hz is not None:
        columns = min(columns, max(1, round(duration_s * config.rate_hz)))
    if (rows, columns) != tuple(power.shape):
        power = resized(power, rows, columns)
    return in_decibels(power, config)


def in_decibels(power: Tensor, config: OutputConfig) -> Stored:
    """Power, of any shape, in decibels below its peak: uint8 or float16."""
    peak = float(power.max())
    level = 10 * (power / (peak if peak > 0 else 1.0)).clamp_min(1e-20).log10()
    if config.dtype == "uint8":
        level = (255 * (1 + level / config.range_db)).round().clamp(0, 255).to(torch.uint8)
    return Stored(level.to(torch.uint8 if config.dtype == "uint8" else torch.float16).numpy(), peak**0.5)


def stored_signal(signal: Tensor) -> Stored:
    """A complex signal (...) as real and imaginary parts (..., 2) divided by the largest magnitude, float16."""
    peak = float(signal.abs().max())
    parts = torch.view_as_real(signal / peak if peak > 0 else signal)
    return Stored(parts.to(torch.float16).numpy(), peak)


def stored_picture(picture: Tensor) -> Stored:
    """A picture (1, H, W) in [0, 1] as uint8 (H, W)."""
    return Stored((255 * picture[0]).round().to(torch.uint8).numpy(), 1.0)


def stored_joints(joints: Tensor, valid: Tensor) -> Stored:
    """Joints (P, T, 14, 3) as float32, NaN where ``valid`` (P, T) is false."""
    return Stored(np.where(valid[..., None, None].numpy(), joints.float().numpy(), np.float32("nan")), 1.0)
