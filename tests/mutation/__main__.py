"""``python -m tests.mutation [--count 300] [--seed 0] [FILE ...]``: which slips do the nearest tests not notice?"""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.mutation.slips import Slip, slips

ROOT = Path(__file__).resolve().parents[2]
#: Where the mathematics is.
ROOMS = ("body", "geometry", "motion", "radar", "enhance", "recognition", "vision")
#: No test of one stage takes longer, unless a slip has made it endless.
SECONDS = 300


def nearest_tests(file: Path) -> list[Path]:
    """The test file of the same name, else those of its room that import the module."""
    part = file.relative_to(ROOT / "tensorsim")
    own = ROOT / "tests" / part.with_name(f"test_{part.name}")
    if own.is_file():
        return [own]
    module = ".".join(("tensorsim", *part.with_suffix("").parts))
    room = sorted((ROOT / "tests" / part.parts[0]).rglob("test_*.py"))
    importing = [test for test in room if module in test.read_text(encoding="utf-8")]
    return importing or sorted((ROOT / "tests" / part.parent).glob("test_*.py"))


def notices(file: Path, slip: Slip, tests: list[Path]) -> bool:
    """Whether the tests fail on a copy of the package that has the slip."""
    with tempfile.TemporaryDirectory() as folder:
        copied = Path(folder)
        for name in ("tensorsim", "tests"):
            shutil.copytree(ROOT / name, copied / name, ignore=shutil.ignore_patterns("__pycache__"))
        (copied / "models").symlink_to(ROOT / "models")
        shutil.copy(ROOT / "pyproject.toml", copied)
        (copied / file.relative_to(ROOT)).write_text(slip.source, encoding="utf-8")
        names = [str(test.relative_to(ROOT)) for test in tests]
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *names]
        environment = os.environ | {"PYTHONPATH": folder, "PYTHONDONTWRITEBYTECODE": "1"}
        try:
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, timeout=SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            return True
        return done.returncode != 0


def main() -> None:
    """Sample slips, run the nearest tests on each, print those that pass unnoticed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rooms = [file for room in ROOMS for file in sorted((ROOT / "tensorsim" / room).rglob("*.py"))]
    files = [file.resolve() for file in options.files or rooms if file.name != "__init__.py"]
    every = [(file, slip) for file in files for slip in slips(file.read_text(encoding="utf-8"))]
    sample = random.Random(options.seed).sample(every, min(options.count, len(every)))
    survivors = 0
    for number, (file, slip) in enumerate(sample, 1):
        if not notices(file, slip, nearest_tests(file)):
            survivors += 1
            print(f"survives: {file.relative_to(ROOT)}:{slip.line}: {slip.what}", flush=True)
        print(f"{number} of {len(sample)}, {number - survivors} noticed", file=sys.stderr, flush=True)
    print(
        f"{len(sample) - survivors} of {len(sample)} slips noticed ({100 * (1 - survivors / len(sample)):.0f} %)"
    )


if __name__ == "__main__":
    main()
