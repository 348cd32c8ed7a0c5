"""Where the shipped weights and pose pools are."""

import json
from pathlib import Path
from typing import Any

from tensorsim.errors import TensorsimError

_PACKAGE = Path(__file__).resolve().parent


def models_dir() -> Path:
    """The folder of shipped models: inside an installed package, or beside it in a checkout.

    Raises:
        TensorsimError: neither holds a ``manifest.json``.
    """
    folders = (_PACKAGE / "_models", _PACKAGE.parent / "models")
    for folder in folders:
        if (folder / "manifest.json").is_file():
            return folder
    raise TensorsimError(
        f"shipped models: no manifest.json in {folders[0]} nor in {folders[1]}; reinstall tensorsim"
    )


def manifest() -> list[dict[str, Any]]:
    """Every shipped file with its name, SHA-256, licence, source and recipe, as ``manifest.json`` lists them."""
    entries: list[dict[str, Any]] = json.loads((models_dir() / "manifest.json").read_text(encoding="utf-8"))[
        "models"
    ]
    return entries


def model_path(file: str) -> Path:
    """Path of a shipped file by its name, such as ``"pose_library_small.safetensors"``.

    Raises:
        TensorsimError: no such file; the message lists those that exist.
    """
    folder = models_dir()
    path = folder / file
    if not path.is_file():
        there = ", ".join(sorted(p.name for p in folder.glob("*.safetensors"))) or "none"
        raise TensorsimError(f"shipped model: got {file!r}, expected one of: {there}")
    return path
