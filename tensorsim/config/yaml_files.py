"""YAML files with each key at most once."""

import os
from pathlib import Path
from typing import Any

from tensorsim.errors import TensorsimError


def read_yaml(path: str | os.PathLike[str]) -> dict[Any, Any]:
    """The mapping that a YAML file holds; nothing in it is run.

    Raises:
        TensorsimError: no such file, no YAML, a repeated key, or no mapping.
    """
    import yaml

    try:
        document = yaml.load(Path(path).read_text(encoding="utf-8"), _unique_keys_loader())
    except OSError as error:
        raise TensorsimError(f"{path}: {error.strerror}") from None
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise TensorsimError(f"{path}: not valid YAML: {error}") from None
    if not isinstance(document, dict):
        raise TensorsimError(f"{path}: got {document!r}, expected keys with values")
    return dict(document)


def _unique_keys_loader() -> type:
    """YAML's safe loader, which would take the last of two equal keys, made to refuse them."""
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            keys = [str(key.value) for key, _ in node.value]
            twice = sorted({key for key in keys if keys.count(key) > 1})
            if twice:
                raise yaml.YAMLError(f"twice the key {', '.join(twice)}")
            return super().construct_mapping(node, deep)

    return Loader
