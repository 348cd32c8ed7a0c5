"""Reading YAML files, and JSON files, which hold the same."""

import json
import os
from pathlib import Path
from typing import Any

from tensorsim.config.limited_yaml import load_limited_yaml
from tensorsim.errors import TensorsimError


def read_yaml(path: str | os.PathLike[str]) -> dict[Any, Any]:
    """The mapping that a YAML file holds, or a ``.json``, within the limits of :func:`load_limited_yaml`.

    Raises:
        TensorsimError: no such file, no YAML, a repeated key, or no mapping.
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
