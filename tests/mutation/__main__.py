"""Which slips do the nearest tests not notice? Prints them, and the share that is noticed.

``python -m tests.mutation --count 300`` takes the same slips at every call with the same ``--seed`` and goes on
where the results in ``--results`` end, until ``--minutes`` have passed. ``--again`` tries once more those that were
neither noticed nor explained in ``equivalent.txt``. ``FILE`` or ``FILE:LINE`` takes only the slips of that file or
line.
"""

import argparse
import hashlib
import json
import sys
import time
from pathlib import Path

from tqdm import tqdm

from tests.mutation.equivalent import explained
from tests.mutation.nearest import ROOT
from tests.mutation.runner import Runner
from tests.mutation.slips import Slip, slips

#: Where the mathematics is.
ROOMS = ("body", "geometry", "motion", "radar", "enhance", "recognition", "vision")


def sampled(places: list[str], count: int, seed: int) -> dict[str, tuple[Path, Slip]]:
    """``count`` slips by name, those whose hashes with the seed are smallest: an edited line moves no others."""
    rooms = [str(file) for room in ROOMS for file in sorted((ROOT / "tensorsim" / room).rglob("*.py"))]
    every = {}
    for place in places or rooms:
        name, _, line = place.partition(":")
        file = (ROOT / name).resolve()
        if file.name == "__init__.py":
            continue
        for slip in slips(file.read_text(encoding="utf-8")):
            if not line or slip.line == int(line):
                every.setdefault(f"{file.relative_to(ROOT)}: {slip.after}", (file, slip))
    chosen = sorted(every, key=lambda name: hashlib.sha256(f"{seed} {name}".encode()).digest())
    return {name: every[name] for name in chosen[:count]}


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("places", nargs="*", metavar="FILE[:LINE]")
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--results", type=Path, default=Path("out/mutation"))
    parser.add_argument(
        "--again", action="store_true", help="try once more what was neither noticed nor explained"
    )
    return parser.parse_args()


def main() -> None:
    """Sample slips, run the nearest tests on each, print those that pass unnoticed."""
    options, begin = parsed(), time.monotonic()
    sample = sampled(options.places, options.count, options.seed)
    stored = options.results / "outcomes.json"
    results = json.loads(stored.read_text()) if stored.is_file() else {}
    reasons = explained()
    doubtful = [name for name in sample if results.get(name) == "survives" and name not in reasons]
    left = [*(doubtful if options.again else []), *(name for name in sample if name not in results)]
    with Runner(options.results) as runner:
        for name in tqdm(left, unit="slip", file=sys.stderr, mininterval=5):
            if time.monotonic() - begin > 60 * options.minutes:
                break
            results[name] = runner.outcome(*sample[name])
            stored.write_text(json.dumps(results, indent=1))

    done = [name for name in sample if name in results]
    survivors = [name for name in done if results[name] == "survives"]
    for name in survivors:
        file, slip = sample[name]
        state = "explained" if name in reasons else "survives"
        print(f"{state}: {file.relative_to(ROOT)}:{slip.line}\n  - {slip.before}\n  + {slip.after}")
    known = sum(name in reasons for name in survivors)
    print(
        f"{len(done) - len(survivors)} of {len(done)} slips noticed, {known} explained, "
        f"{len(survivors) - known} not; {len(sample) - len(done)} not tried yet"
    )


if __name__ == "__main__":
    main()
