"""Exceptions of tensorsim and the input checks that all stages share.

The checks compile under TorchScript, so a scripted graph refuses the same inputs with the same words.
"""

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from tensorsim.exceptions import TensorsimError as TensorsimError
from tensorsim.exceptions import TensorsimWarning as TensorsimWarning
from tensorsim.exceptions import check_choice as check_choice
from tensorsim.exceptions import check_count as check_count
from tensorsim.exceptions import check_distinct as check_distinct
from tensorsim.exceptions import check_not_negative as check_not_negative
from tensorsim.exceptions import check_per_person as check_per_person
from tensorsim.exceptions import check_positive as check_positive
from tensorsim.exceptions import check_score as check_score
from tensorsim.exceptions import check_seed as check_seed
from tensorsim.exceptions import collected_warnings as collected_warnings
from tensorsim.exceptions import first_line as first_line


def check_is_tensor(x: Any, name: str) -> None:
    """Refuse anything but a dense tensor with values; not called in a scripted graph, whose types are fixed."""
    if not isinstance(x, Tensor):
        hint = ", as torch.from_numpy gives it" if type(x).__module__ == "numpy" else ""
        raise TensorsimError(f"{name}: got {type(x).__name__}, expected a tensor{hint}")
    if x.layout != torch.strided or (x.is_meta and not is_exporting()):
        kind = "meta" if x.is_meta else str(x.layout).removeprefix("torch.")
        raise TensorsimError(f"{name}: got a {kind} tensor, expected a dense one with values")


def check_tensor(x: Tensor, name: str, layout: str, dtypes: str = "real", finite: bool = True) -> None:
    """Refuse anything but a tensor of this layout and dtype with finite values: the check at the top of a stage.

    Args:
        x: the input.
        name: its name, for the message.
        layout: dimensions in brackets and any remark on them: ``"(..., pulses, 14 joints, 3) metres"``. A dimension
            that begins with a number must have that size; a leading ``...`` stands for any further dimensions.
        dtypes: ``"real"`` for float32 and float64, ``"complex"`` for complex64 and complex128.
        finite: whether NaN and infinity are refused.

    Raises:
        TensorsimError: states what was received and what was expected.
    """
    if not torch.jit.is_scripting():
        check_is_tensor(x, name)
    if dtypes == "complex":
        if x.dtype != torch.complex64 and x.dtype != torch.complex128:
            raise TensorsimError(f"{name}: got dtype {x.dtype}, expected a complex tensor")
        if x.is_conj():
            raise TensorsimError(f"{name}: got a conjugate that is not resolved, expected x.resolve_conj()")
    elif x.dtype != torch.float32 and x.dtype != torch.float64:
        raise TensorsimError(
            f"{name}: got dtype {x.dtype}, expected a real floating point tensor, float32 or float64"
        )
    sizes = layout[1 : layout.find(")")].split(", ")
    open_lead = sizes[0] == "..."
    rank = len(sizes) - int(open_lead)
    fits = x.dim() >= rank if open_lead else x.dim() == rank
    if fits:
        for i in range(1, rank + 1):
            word = sizes[len(sizes) - i].split(" ")[0]
            if word.isdigit() and x.shape[x.dim() - i] != int(word):
                fits = False
    if not fits:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout}")
    if finite:
        check_finite(x, name)


def check_like_weights(x: Tensor, weight: Tensor, name: str) -> None:
    """Refuse images whose dtype or device differs from that of the weights applied to them.

    Under ``torch.autocast``, which casts both, dtypes may differ.
    """
    if (x.dtype != weight.dtype and not is_autocast(x)) or x.device != weight.device:
        raise TensorsimError(
            f"{name}: got {x.dtype} on {x.device}, expected {weight.dtype} on {weight.device} like the weights"
        )


def check_floating(x: Tensor, name: str) -> None:
    """Refuse an integer, boolean or complex tensor."""
    if not torch.jit.is_scripting():
        check_is_tensor(x, name)
    if not x.is_floating_point():
        raise TensorsimError(f"{name}: got dtype {x.dtype}, expected a real floating point tensor")


def check_min_rank(x: Tensor, rank: int, name: str, layout: str) -> None:
    """Refuse a tensor with fewer than ``rank`` dimensions; ``layout`` names the expected ones."""
    if not torch.jit.is_scripting():
        check_is_tensor(x, name)
    if x.dim() < rank:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout}")


def check_rank(x: Tensor, rank: int, name: str, layout: str) -> None:
    """Refuse a tensor without exactly ``rank`` dimensions; ``layout`` names the expected ones."""
    if not torch.jit.is_scripting():
        check_is_tensor(x, name)
    if x.dim() != rank:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout}")


def check_size(x: Tensor, dim: int, size: int, name: str, layout: str) -> None:
    """Refuse a tensor whose dimension ``dim`` is not ``size`` long."""
    if x.shape[dim] != size:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout}")


def check_shape(x: Tensor, shape: list[int], name: str) -> None:
    """Refuse a tensor of another shape."""
    if not torch.jit.is_scripting():
        check_is_tensor(x, name)
    if list(x.shape) != shape:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {shape}")


def check_mask(x: Tensor, shape: list[int], name: str) -> None:
    """Refuse anything but a boolean tensor of this shape."""
    if not torch.jit.is_scripting():
        check_is_tensor(x, name)
    if x.dtype != torch.bool or list(x.shape) != shape:
        raise TensorsimError(
            f"{name}: got {x.dtype} of shape {list(x.shape)}, expected bool of shape {shape}"
        )


def check_points(x: Tensor, rank: int, count: int, coordinates: int, name: str, layout: str) -> None:
    """Refuse anything but real (..., count, coordinates) of at least this rank."""
    check_floating(x, name)
    check_min_rank(x, rank, name, layout)
    check_size(x, -2, count, name, layout)
    check_size(x, -1, coordinates, name, layout)


def check_keypoints(keypoints: Tensor, scores: Tensor, valid: Tensor, rank: int, layout: str) -> None:
    """Refuse anything but finite keypoints (..., T, 17, 2), scores (..., T, 17) and valid (..., T), bool."""
    check_points(keypoints, rank, 17, 2, "keypoints", layout)
    check_shape(scores, list(keypoints.shape[:-1]), "scores")
    check_mask(valid, list(keypoints.shape[:-2]), "valid")
    check_finite(keypoints, "keypoints")
    check_finite(scores, "scores")


def check_images(images: Tensor) -> None:
    """Refuse anything but images (B, 3, H, W), uint8 or floating point in [0, 1]."""
    layout = "(B, 3, H, W)"
    check_rank(images, 4, "images", layout)
    check_size(images, 1, 3, "images", layout)
    check_not_empty(images, "images")
    if images.is_floating_point():
        if not is_exporting():
            low, high = images.detach().aminmax()
            # Interpolation overshoots a little; images from 0 to 255 or normalised exceed this. NaN fails.
            if not bool((low >= -0.5) & (high <= 1.5)):
                raise TensorsimError(
                    f"images: got values from {float(low)} to {float(high)}, expected RGB in [0, 1]"
                )
    elif images.dtype != torch.uint8:
        raise TensorsimError(f"images: got dtype {images.dtype}, expected uint8 or floating point")


def check_image_size(height: int, width: int) -> None:
    """Refuse an image without pixels."""
    if height < 1 or width < 1:
        raise TensorsimError(f"image: got {height} x {width} pixels, expected at least 1 x 1")


def check_not_empty(x: Tensor, name: str) -> None:
    """Refuse a tensor without elements."""
    if x.numel() == 0:
        raise TensorsimError(
            f"{name}: got an empty tensor of shape {list(x.shape)}, expected at least one element"
        )


def check_replaced(part: str, given: Mapping[str, bool]) -> None:
    """Refuse arguments that have no effect because a ready-made ``part`` was passed as well.

    Args:
        part: name of the argument that takes a ready-made module.
        given: for each argument that the part replaces, by name, whether it was given.
    """
    unused = [name for name, is_given in given.items() if is_given]
    if unused:
        raise TensorsimError(
            f"{part}: got a ready-made one and {', '.join(unused)}, expected one or the other"
        )


def is_exporting() -> bool:
    """Whether torch.export is tracing: values are then unknown, and value checks are skipped."""
    if not torch.jit.is_scripting():
        return torch.compiler.is_exporting()
    return False


def is_autocast(x: Tensor) -> bool:
    """Whether ``torch.autocast`` is on for the device of a tensor; always False in a scripted graph."""
    if not torch.jit.is_scripting():
        return torch.is_autocast_enabled(x.device.type)
    return False


def is_writing_onnx() -> bool:
    """Whether the ONNX exporter is tracing; ONNX has no complex numbers and few operations."""
    if not torch.jit.is_scripting():
        return torch.onnx.is_in_onnx_export()
    return False


def check_finite(x: Tensor, name: str) -> None:
    """Refuse NaN and infinity; skipped while torch.export traces, where values are unknown."""
    if is_exporting():
        return
    # One pass over the values. Only if the sum is not finite, which large finite values can also cause, is each value
    # checked. A finite sum minus itself is zero; isfinite takes several passes over complex values.
    total = x.detach().sum()
    if not bool(total - total == 0) and not bool(torch.isfinite(x).all()):
        raise TensorsimError(f"{name}: got NaN or infinite values, expected finite numbers")


def check_complex_map(x: Tensor, name: str, layout: str) -> None:
    """Refuse anything but a complex, finite, non-empty (..., M, columns)."""
    check_tensor(x, name, layout, "complex")
    if x.numel() == 0:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout} without empty dimensions")


def check_scatterers(positions: Tensor, rcs: Tensor) -> None:
    """Refuse positions or cross sections that are not finite, and negative cross sections."""
    check_finite(positions, "positions")
    check_finite(rcs, "rcs")
    if not is_exporting() and bool((rcs < 0).any()):
        raise TensorsimError(f"rcs: got a minimum of {float(rcs.min())} m^2, expected no negative value")


def check_scene(positions: Tensor, rcs: Tensor) -> Tensor:
    """Refuse scatterers whose echo cannot be computed.

    Args:
        positions: (..., M, S, 3) metres at M pulses.
        rcs: m^2, (..., M, S) per pulse, (..., S) per clip, or (S,) for all clips; told apart by shape.

    Returns:
        RCS per pulse, (..., M, S).
    """
    layout = "(..., pulses, scatterers, 3) metres"
    check_floating(positions, "positions")
    check_floating(rcs, "rcs")
    check_min_rank(positions, 3, "positions", layout)
    shape = list(positions.shape)
    if shape[-1] != 3:
        raise TensorsimError(f"positions: got shape {shape}, expected {layout}")
    if 0 in shape[:-2]:
        raise TensorsimError(f"positions: got shape {shape}, expected at least one pulse of one clip")
    per_pulse = shape[:-1]
    per_clip = shape[:-3] + shape[-2:-1]
    got = list(rcs.shape)
    if got != per_pulse and got != per_clip and got != shape[-2:-1]:
        raise TensorsimError(
            f"rcs: got shape {got}, expected {per_clip} (per clip) or {per_pulse} (per pulse) m^2"
        )
    check_scatterers(positions, rcs)
    if got == per_clip:
        rcs = rcs.unsqueeze(-2)
    return rcs.expand(per_pulse)


def check_interval(value: object, least: float, most: float, name: str) -> None:
    """Refuse anything but two finite numbers from ``least`` to ``most``, the first not above the second."""
    pair = value if isinstance(value, tuple | list) and len(value) == 2 else ()
    numbers = [float(x) for x in pair if isinstance(x, Real) and math.isfinite(x)]
    if len(numbers) != 2 or not least <= numbers[0] <= numbers[1] <= most:
        within = f"within {least} to {most}" if math.isfinite(most) else f"from {least} or more"
        raise TensorsimError(f"{name}: got {value!r}, expected an ascending range {within}")
