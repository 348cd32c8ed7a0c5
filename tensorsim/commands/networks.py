"""What several commands ask for: the files of the networks."""

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
