"""Made-up shards to train on."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any


def write_tar(path: Path, files: dict[str, Any]) -> Path:
    """Write a tar of files by name: bytes as they are, anything else as JSON."""
    with tarfile.open(path, "w") as tar:
        for name, content in files.items():
            data = content if isinstance(content, bytes) else json.dumps(content).encode()
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return path
