"""Augmentation of batches of maps (B, C, H, W), as modules that run on the batch's device, in training mode only."""

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_min_rank

_LAYOUT = "(B, C, rows, columns)"


class SpecAugment(nn.Module):
    """Sets bands of rows and of columns to 0, different ones in every map.

    Source: D. S. Park et al., "SpecAugment", Interspeech 2019, without its time warping; uses torchaudio.

    Args:
        rows, columns: largest fraction of the rows and columns that a band covers; its width is uniform from 0.

    Raises:
        TensorsimError: fractions outside 0 to 1.
    """

    def __init__(self, rows: float = 0.15, columns: float = 0.15) -> None:
        super().__init__()
        if not (0 <= rows <= 1 and 0 <= columns <= 1):
            raise TensorsimError(
                f"SpecAugment: got shares {rows} and {columns}, expected numbers from 0 to 1"
            )
        self.rows, self.columns = rows, columns

    def forward(self, maps: Tensor) -> Tensor:
        """Maps (B, C, H, W) to the same with bands."""
        check_min_rank(maps, 4, "SpecAugment", _LAYOUT)
        if not self.training:
            return maps
        from torchaudio.functional import mask_along_axis_iid

        for axis, part in ((2, self.rows), (3, self.columns)):
            widest = round(part * maps.shape[axis])
            if widest > 0:
                maps = mask_along_axis_iid(maps, widest, 0.0, axis)
        return maps


class RandomShift(nn.Module):
    """Shifts maps by whole cells along speed (or range) and time; cells shifted in are 0.

    Args:
        rows, columns: largest shift in either direction.

    Raises:
        TensorsimError: negative shifts.
    """

    def __init__(self, rows: int = 4, columns: int = 8) -> None:
        super().__init__()
        if rows < 0 or columns < 0:
            raise TensorsimError(f"RandomShift: got {rows} and {columns}, expected numbers >= 0")
        self.rows, self.columns = rows, columns

    def forward(self, maps: Tensor) -> Tensor:
        """Maps (B, C, H, W) to the same, shifted."""
        check_min_rank(maps, 4, "RandomShift", _LAYOUT)
        if not self.training:
            return maps
        for axis, most in ((2, self.rows), (3, self.columns)):
            size, count = maps.shape[axis], maps.shape[0]
            shift = torch.randint(-most, most + 1, (count, 1), device=maps.device)
            index = torch.arange(size, device=maps.device) - shift
            view = (count, 1, size, 1) if axis == 2 else (count, 1, 1, size)
            inside = ((index >= 0) & (index < size)).reshape(view)
            place = index.clamp(0, size - 1).reshape(view).expand(maps.shape)
            maps = maps.gather(axis, place) * inside
        return maps


class AddNoise(nn.Module):
    """Adds Gaussian noise to the levels of maps, which stay within [0, 1].

    Args:
        deviation: largest standard deviation; for each map it is drawn uniformly from 0.

    Raises:
        TensorsimError: a negative deviation.
    """

    def __init__(self, deviation: float = 0.05) -> None:
        super().__init__()
        if not deviation >= 0:
            raise TensorsimError(f"AddNoise: got the deviation {deviation}, expected a number >= 0")
        self.deviation = deviation

    def forward(self, maps: Tensor) -> Tensor:
        """Maps (B, C, H, W) to the same with noise."""
        check_min_rank(maps, 4, "AddNoise", _LAYOUT)
        if not self.training:
            return maps
        scale = self.deviation * torch.rand(maps.shape[0], 1, 1, 1, dtype=maps.dtype, device=maps.device)
        return (maps + scale * torch.randn_like(maps)).clamp(0.0, 1.0)


class SignFold(nn.Module):
    """Doppler without its sign, as seen by radars with one real channel: the larger of the levels at both signs.

    Rows ascend in Doppler, zero at row H // 2, as in Doppler-time maps. Works in evaluation mode as well.

    Shapes: (..., H, W) -> (..., H // 2, W), row 0 at zero Doppler. Differentiable.
    """

    def forward(self, maps: Tensor) -> Tensor:
        """Maps (..., H, W) to (..., H // 2, W)."""
        check_min_rank(maps, 2, "SignFold", "(..., rows, columns)")
        rows = maps.shape[-2]
        middle, half = rows // 2, rows // 2
        if half < 1:
            raise TensorsimError(f"SignFold: got {rows} row, expected at least 2")
        # With an even number of rows, row 0, the most negative speed, has no positive counterpart and is left out.
        positive = maps[..., middle : middle + half, :]
        negative = maps[..., middle - half + 1 : middle + 1, :].flip(-2)
        return torch.maximum(positive, negative)
