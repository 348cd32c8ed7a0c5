"""Which device to run on."""

import torch

from tensorsim.errors import TensorsimError


def usable_device(name: str) -> torch.device:
    """The torch device of this name; ``"auto"`` takes a GPU where there is one.

    Raises:
        TensorsimError: it is not usable here.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        raise TensorsimError(f"--device: {name!r} is not usable here: {str(error).splitlines()[0]}") from None
    return torch.device(name)
