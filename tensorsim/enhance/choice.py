"""Denoisers of radar maps by name."""

from pathlib import Path

from torch import nn

from tensorsim.enhance.dncnn import MapDenoiser
from tensorsim.enhance.ksvd import KSVD
from tensorsim.enhance.perona_malik import PeronaMalik
from tensorsim.errors import TensorsimError

#: Names that stand for a method; any other is a name or file of DnCNN weights.
DENOISERS = ("none", "perona-malik", "ksvd", "dncnn")


def map_denoiser(choice: str | None) -> nn.Module | None:
    """The denoiser of magnitude maps (..., H, W) that a name stands for, in evaluation mode.

    Args:
        choice: ``"none"`` or None; ``"perona-malik"``; ``"ksvd"``, which needs scikit-learn, takes minutes for a long
            map and cannot be scripted; ``"dncnn"``, the shipped network; or the name or file of other DnCNN weights.

    Raises:
        TensorsimError: missing weights or those of another network; scikit-learn missing.
    """
    if choice is None or choice == "none":
        return None
    if choice == "perona-malik":
        return MapDenoiser(PeronaMalik()).eval()
    if choice == "ksvd":
        return KSVD().eval()
    return MapDenoiser.from_pretrained(None if choice == "dncnn" else choice)


def weights_of_denoiser(choice: str | None) -> Path | None:
    """The weight file that :func:`map_denoiser` uses for a name; None for a method without weights.

    Raises:
        TensorsimError: neither a method nor a name of weights; a path is returned even if there is no such file.
    """
    from tensorsim.registry import locate

    if choice is None or (choice in DENOISERS and choice != "dncnn"):
        return None
    return locate(None if choice == "dncnn" else choice, "DnCNN")


def check_denoiser(choice: str | None) -> None:
    """Refuse, before any work is done, what :func:`map_denoiser` would not find; nothing is loaded.

    Raises:
        TensorsimError: neither a method nor a name or file of weights.
    """
    from tensorsim.registry import find

    if choice is None or choice in DENOISERS or Path(choice).is_file():
        return
    if Path(choice).suffix:
        raise TensorsimError(f"denoiser: got {choice!r}, which is not a file, expected weights or a name")
    find(choice, "DnCNN")
