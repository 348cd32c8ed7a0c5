"""Clips per second of data sets: `python -m tests.benchmarks.bench_dataset [--cpu] [--samples N]`.

In one run: samples of 4 s with one radar in free space and behind a wall (clips per second of one core), three radars
at one place each against three runs with one, two processes against one, the growth of memory and the size of samples.
`--cpu` takes processor time instead of wall time, for a machine that is busy with other work: two processes then count
as if each had a core of its own.
"""

import argparse
import json
import resource
import statistics
import tempfile
import time
from pathlib import Path

import torch

from tensorsim.data.sets.build import Job, build_dataset, build_shard
from tensorsim.data.sets.engines import Processes, Serial
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.recipe import DatasetRecipe, RadarView, SourceConfig, SplitConfig, StorageConfig
from tensorsim.data.sets.samples import make_sample
from tests.benchmarks.timing import Clock, chosen_clock, host, seconds

VIEWS = (
    RadarView("front", "through-wall"),
    RadarView("left", "through-wall", -4.0, 4.0, -90.0),
    RadarView("right", "through-wall", 4.0, 4.0, 90.0),
)


def recipe(*views: RadarView, people: int = 10) -> DatasetRecipe:
    """All activities of some people, 4 s each."""
    return DatasetRecipe(
        sources=(SourceConfig(people=people),), radars=views, storage=StorageConfig(shard_samples=16)
    )


def rate(plan: Plan, samples: int, clock: Clock) -> float:
    """Samples per second, from the median time of one."""
    make_sample(plan, 0, "warm-up")
    times = [seconds(lambda n=n: make_sample(plan, n, ""), clock) for n in range(samples)]  # type: ignore[misc]
    return 1 / statistics.median(times)


def shard_ns(job: Job) -> int:
    """Make a shard; returns its processor time."""
    before = time.process_time_ns()
    build_shard(job)
    return time.process_time_ns() - before


def rate_of(workers: int, wanted: DatasetRecipe, folder: Path, cpu: bool) -> float:
    """Samples per second of some processes once they have started."""
    plan, document = Plan(wanted), json.dumps(wanted.to_document(), sort_keys=True)
    jobs = [Job(document, str(folder), str(folder), k, True) for k in range(len(plan.shards))]
    spent, moments = [], []
    for spent_ns in Processes(workers).run(shard_ns, jobs):
        spent.append(spent_ns / 1e9)
        moments.append(time.perf_counter())
    first = 2 * workers  # a process takes longer for its first shards
    samples = wanted.storage.shard_samples * (len(jobs) - first)
    if cpu:
        return workers * samples / sum(spent[first:])
    return samples / (moments[-1] - moments[first - 1])


def peak_mb() -> float:
    """Largest memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=24)
    parser.add_argument("--people", type=int, default=24, help="of the samples for two workers, 12 each")
    parser.add_argument("--cpu", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    clock = chosen_clock()
    print(host())
    for preset, count in (
        ("through-wall", arguments.samples),
        ("free-space", max(2, arguments.samples // 6)),
    ):
        one = rate(Plan(recipe(RadarView("front", preset))), count, clock)
        print(f"{preset}: {one:.1f} clips of 4 s per second and core")
    single = [rate(Plan(recipe(view)), arguments.samples, clock) for view in VIEWS]
    together = rate(Plan(recipe(*VIEWS)), arguments.samples, clock)
    runs = sum(1 / one for one in single)
    print(
        f"3 radars: {1 / together:.3f} s for a sample with all, {runs:.3f} s for three with one: "
        f"{runs * together:.2f} times as fast"
    )
    with tempfile.TemporaryDirectory() as folder:
        memory = []
        for people in (4, 8, 16):
            build_dataset(
                recipe(VIEWS[0], people=people), Path(folder) / f"serial{people}", Serial(), quiet=True
            )
            memory.append(peak_mb())
        print("peak memory after 48, 96, 192 samples:", ", ".join(f"{mb:.0f} MB" for mb in memory))
        size = json.loads((Path(folder) / "serial16" / "dataset.json").read_text())["bytes"]
        print(f"10 000 Doppler-time maps of 4 s: {size / 192 * 1e4 / 1e9:.2f} GB")
        # One person, all activities: shards of twelve samples.
        build = DatasetRecipe(
            sources=(SourceConfig(people=arguments.people),),
            radars=VIEWS[:1],
            split=SplitConfig(shares=(1.0, 0.0, 0.0)),
            storage=StorageConfig(shard_samples=12),
        )
        rates = {w: rate_of(w, build, Path(folder) / f"workers{w}", arguments.cpu) for w in (1, 2)}
        print(
            f"through-wall, 1 and 2 workers: {rates[1]:.1f} and {rates[2]:.1f} clips of 4 s per second, "
            f"{rates[2] / rates[1]:.2f} times as fast"
        )


if __name__ == "__main__":
    main()
