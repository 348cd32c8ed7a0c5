"""What several commands ask for: the files of the networks, and the device to run on."""

import os
from pathlib import Path

from tensorsim.errors import TensorsimError


def network_path(path: Path | None, role: str, variable: str) -> Path:
    """Path of a network: the one given, else the one named in an environment variable.

    Raises:
        TensorsimError: neither is there, or it is not a file.
    """
    if path is None and os.environ.get(variable):
        path = Path(os.environ[variable])
    if path is None:
        raise TensorsimError(
            f"--{role}: got no weights, expected a path here or in ${variable} (none are shipped yet)"
        )
    if not path.is_file():
        raise TensorsimError(f"--{role}: {path} is not a file")
    return path


def usable_device(name: str):  # type: ignore[no-untyped-def]  # torch is imported on use
    """The torch device of this name; ``"auto"`` takes a GPU where there is one.

    Raises:
        TensorsimError: it is not usable here.
    """
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        raise TensorsimError(f"--device: {name!r} is not usable here: {str(error).splitlines()[0]}") from None
    return torch.device(name)
