"""Slips that change nothing that a test may hold the package to, each with its reason."""

from pathlib import Path

FILE = Path(__file__).with_name("equivalent.txt")


def explained() -> dict[str, str]:
    """Reasons by name of the slip: two lines each, the second indented; lines with # are comments."""
    lines = [
        line for line in FILE.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")
    ]
    return {name: reason.strip() for name, reason in zip(lines[::2], lines[1::2], strict=True)}
