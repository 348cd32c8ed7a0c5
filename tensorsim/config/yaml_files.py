"""Read YAML files, and JSON files with the same content."""

import json
import os
from pathlib import Path
from typing import Any

from tensorsim.config.limited_yaml import load_limited_yaml
from tensorsim.exceptions import TensorsimError


def read_yaml(path: str | os.PathLike[str]) -> dict[Any, Any]:
    """The mapping in a YAML file, within the limits of :func:`load_limited_yaml`, or in a ``.json`` file.

    Raises:
        TensorsimError: no such file, not YAML or JSON, a repeated key in YAML, or not a mapping.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        document = json.loads(text) if Path(path).suffix == ".json" else load_limited_yaml(text, f"{path}")
    except OSError as error:
        raise TensorsimError(f"{path}: {error.strerror}") from None
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise TensorsimError(f"{path}: not valid YAML or JSON: {error}") from None
    if not isinstance(document, dict):
        kind = "nothing" if document is None else type(document).__name__
        raise TensorsimError(f"{path}: got {kind}, expected keys with values")
    return dict(document)
