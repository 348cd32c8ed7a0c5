"""Exceptions of tensorsim and the input checks that every stage shares.

The checks compile under TorchScript, so a scripted graph refuses the same inputs with the same words.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor


class TensorsimError(ValueError):
    """Input that tensorsim refuses; the message says what came and what was expected."""


class TensorsimWarning(UserWarning):
    """A result is returned, but it may not be what the caller expects."""


def check_floating(x: Tensor, name: str) -> None:
    """Refuse an integer, boolean or complex tensor."""
    if not x.is_floating_point():
        raise TensorsimError(f"{name}: got dtype {x.dtype}, expected a real floating point tensor")


def check_min_rank(x: Tensor, rank: int, name: str, layout: str) -> None:
    """Refuse a tensor with fewer than ``rank`` dimensions; ``layout`` names the expected ones."""
    if x.dim() < rank:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout}")


def check_rank(x: Tensor, rank: int, name: str, layout: str) -> None:
    """Refuse a tensor without exactly ``rank`` dimensions; ``layout`` names the expected ones."""
    if x.dim() != rank:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout}")


def check_size(x: Tensor, dim: int, size: int, name: str, layout: str) -> None:
    """Refuse a tensor whose dimension ``dim`` is not ``size`` long."""
    if x.shape[dim] != size:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout}")


def check_not_empty(x: Tensor, name: str) -> None:
    """Refuse a tensor without elements."""
    if x.numel() == 0:
        raise TensorsimError(
            f"{name}: got an empty tensor of shape {list(x.shape)}, expected at least one element"
        )


def is_exporting() -> bool:
    """Whether torch.export is tracing: values are then unknown, and checks of values are skipped."""
    if not torch.jit.is_scripting():
        return torch.compiler.is_exporting()
    return False


def check_finite(x: Tensor, name: str) -> None:
    """Refuse NaN and infinity; skipped while torch.export traces, where values are unknown."""
    if not is_exporting() and not bool(torch.isfinite(x).all()):
        raise TensorsimError(f"{name}: got NaN or infinite values, expected finite numbers")


def check_complex_map(x: Tensor, name: str, layout: str) -> None:
    """Refuse anything but a complex, non-empty (..., M, columns)."""
    check_min_rank(x, 2, name, layout)
    if not x.is_complex():
        raise TensorsimError(f"{name}: got dtype {x.dtype}, expected a complex tensor")
    if x.numel() == 0:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout} without empty dimensions")


def check_scene(positions: Tensor, rcs: Tensor) -> Tensor:
    """Refuse scatterers of which no echo can be computed.

    Args:
        positions: (..., M, S, 3) metres at M pulses.
        rcs: m^2, (..., M, S) per pulse, (..., S) per clip, or (S,) for all clips; the rank says which.

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
    check_finite(positions, "positions")
    check_finite(rcs, "rcs")
    if not is_exporting() and bool((rcs < 0).any()):
        raise TensorsimError(f"rcs: got a minimum of {float(rcs.min())} m^2, expected no negative value")
    if got == per_clip:
        rcs = rcs.unsqueeze(-2)
    return rcs.expand(per_pulse)


def check_positive(value: float, name: str) -> None:
    """Refuse a number that is not finite and above zero."""
    if not (value > 0.0 and value < float("inf")):
        raise TensorsimError(f"{name}: got {value}, expected a positive finite number")


@contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """The messages of tensorsim's own warnings in the block, each once; other warnings pass through."""
    messages: list[str] = []
    show = warnings.showwarning

    def collect(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if not issubclass(category, TensorsimWarning):
            show(message, category, *rest, **more)
        elif str(message) not in messages:
            messages.append(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", TensorsimWarning)
        warnings.showwarning = collect
        yield messages
