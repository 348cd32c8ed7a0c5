"""Build a data set: missing shards are made one by one, and at the end everything is listed in the manifest."""

import json
import os
import warnings
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from tensorsim.data.sets.engines import Engine, Serial
from tensorsim.data.sets.made_with import difference, made_with
from tensorsim.data.sets.manifest import MANIFESTS, finish, rows_of_shard
from tensorsim.data.sets.plan import Plan, Shard
from tensorsim.data.sets.recipe import DatasetRecipe
from tensorsim.data.sets.samples import make_sample
from tensorsim.data.sets.shards import write_shard
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.files import LOCK, NotWrittenError, locked, reading, shown_name, write_json

#: The folder with the rows of finished shards, and the file in it that is written first: the recipe, the digest of
#: the clips, and the contents of the radars and weights that the recipe names.
ROWS, BEGUN = ".rows", "begun.json"
#: The human-readable recipe, and the file that is written last.
RECIPE, DONE = "recipe.yaml", "dataset.json"


class Job(NamedTuple):
    """What a worker needs to know, as plain values, so that it can be sent to any process.

    Attributes:
        recipe: as JSON.
        out: folder of the data set.
        cache: folder of the people found in videos.
        number: number of the shard, or of the clip to prepare.
        strict: whether the first failure ends the work.
        again: whether to search again in videos in which nobody was found before.
    """

    recipe: str
    out: str
    cache: str
    number: int
    strict: bool
    again: bool = False


class Built(NamedTuple):
    """Result of :func:`build_dataset`.

    Attributes:
        samples: number of samples stored.
        failures: number of clips with failed samples.
        made: number of samples made by this call.
    """

    samples: int
    failures: int
    made: int


@lru_cache(maxsize=2)
def plan_of(recipe: str, cache: str) -> Plan:
    """The plan of a recipe given as JSON; cached, since a worker makes many shards of one recipe."""
    return Plan(DatasetRecipe.from_document(json.loads(recipe)), cache)


def prepare_clip(job: Job) -> int:
    """Find the people in one clip's video, for all its samples. Failures recur when its samples are made."""
    plan = plan_of(job.recipe, job.cache)
    source, clip = plan.clip(job.number)
    try:
        source.prepare(clip, job.again)
    except (TensorsimError, OSError) as error:
        if job.strict or isinstance(error, NotWrittenError):
            raise
    return 1


def build_shard(job: Job) -> int:
    """Make one shard and its rows; returns the number of its samples, made or failed."""
    plan = plan_of(job.recipe, job.cache)
    shard = plan.shards[job.number]
    samples, failures = [], []
    for number in range(shard.first, shard.stop):
        try:
            samples.append(make_sample(plan, number, shard.name))
        except NotWrittenError:
            raise
        except (TensorsimError, OSError) as error:
            if job.strict:
                raise TensorsimError(str(error)) from error
            clip = plan.clip(plan.clip_of_sample(number)[1])[1]
            reason = shown_name(" ".join(str(error).split()))
            failures.append({"clip": clip.name, "path": shown_name(clip.path), "reason": reason})
    out = Path(job.out)
    files = write_shard(out, plan.recipe.storage, shard.name, samples)
    rows = [sample.row for sample in samples]
    sizes = {name: (out / name).stat().st_size for name in files}
    content = {"rows": rows, "failures": failures, "files": files, "bytes": sizes}
    write_json(rows_path(out, shard), content)
    return shard.stop - shard.first


def rows_path(out: Path, shard: Shard) -> Path:
    """Where the rows of a finished shard are stored until the manifest is written."""
    return out / ROWS / f"{shard.name}.json"


def build_dataset(
    recipe: DatasetRecipe,
    out: str | os.PathLike[str],
    engine: Engine | None = None,
    cache: Path | None = None,
    strict: bool = False,
    quiet: bool = False,
    retry: bool = False,
) -> Built:
    """Build the data set of a recipe, or the missing part of it.

    The files depend only on the recipe (and the videos that it names), not on the engine, the number of workers, or
    interruptions. A shard is either complete or absent. A finished one is not made again, unless its files are missing
    or of a different size, or some of its samples failed and ``retry`` or ``strict`` asks for it.

    Args:
        recipe: what to make.
        out: folder; new, empty, or with an unfinished data set of the same recipe.
        engine: runs the work; None: this process.
        cache: folder of the people found in videos; None: ``.people`` in ``out``.
        strict: the first clip that fails ends the work, instead of adding a line to ``failures.csv``.
        quiet: no progress bar.
        retry: remake shards in which samples failed.

    Warns:
        TensorsimWarning: the recipe has wall settings but no radar with a wall.

    Raises:
        TensorsimError: another data set or other files in the folder; changed clips, radars, weights or package version
            since it was begun; another run that is writing there; a source that does not exist; every sample failed;
            or, if ``strict``, a clip that fails.
    """
    if recipe.without_effect:
        warnings.warn(
            f"recipe: got {', '.join(recipe.without_effect)}, which have no effect: no radar has a wall",
            TensorsimWarning,
            stacklevel=2,
        )
    out = Path(out)
    with locked(out):
        made = made_with(recipe)
        begun = _begun(out, recipe, made)
        engine = Serial() if engine is None else engine
        people = out / ".people" if cache is None else cache
        document, kept = json.dumps(recipe.to_document(), sort_keys=True), str(people.resolve())
        plan_of.cache_clear()  # files may have changed since the last build
        plan = plan_of(document, kept)
        if begun is None:
            start = {"recipe": recipe.to_document(), "clips": plan.listing, "made_with": made}
            write_json(out / ROWS / BEGUN, start)
        elif begun != plan.listing:
            # Sample numbers would change, and people could end up in two parts.
            raise TensorsimError(
                f"{out}: got sources with other clips, people or labels than when this data set was begun, expected "
                "the same or a new folder"
            )
        if not (out / RECIPE).is_file():
            recipe.to_yaml(out / RECIPE)
        if retry or strict:
            _forget_failures(out, plan)
        missing = [k for k, shard in enumerate(plan.shards) if not _is_there(out, shard)]
        if not missing and (out / DONE).is_file():
            done = json.loads((out / DONE).read_text(encoding="utf-8"))
            return Built(done["samples"], done["failures"], 0)
        for name in (DONE, *MANIFESTS):
            (out / name).unlink(missing_ok=True)  # from a finished data set, which it no longer is

        def job(number: int) -> Job:
            return Job(document, str(out.resolve()), kept, number, strict, retry or strict)

        films = _films(plan) if missing else []
        _run(engine, "people", "film", len(films), engine.run(prepare_clip, map(job, films)), quiet)
        count = sum(plan.shards[k].stop - plan.shards[k].first for k in missing)
        _run(engine, "samples", "sample", count, engine.run(build_shard, map(job, missing)), quiet)
        samples, failures = finish(out, plan, made, [rows_path(out, shard) for shard in plan.shards])
        return Built(sum(samples), failures, sum(samples[k] for k in missing))


def _run(engine: Engine, name: str, unit: str, total: int, done: Iterator[int], quiet: bool) -> None:
    """Go through the results of the workers, with a progress bar."""
    if total == 0:
        return
    with tqdm(desc=f"{name:<8}", total=total, unit=unit, disable=quiet) as bar:
        for count in done:
            bar.update(count)


def _films(plan: Plan) -> list[int]:
    """One clip of every video in which networks have to find people."""
    first: dict[str, int] = {}
    for number, source in enumerate(plan.sources):
        for index in range(len(source) if source.finds_people else 0):
            clip = source.clip(index)
            first.setdefault(clip.path or clip.name, int(plan.starts[number]) + index)
    return list(first.values())


def _begun(out: Path, recipe: DatasetRecipe, made: dict[str, Any]) -> str | None:
    """The digest of the clips with which the folder's data set was begun; None for a new one.

    Incomplete files of an interrupted run are removed.

    Raises:
        TensorsimError: another data set, one made with other radars, weights or another version, or other files.
    """
    path = out / ROWS / BEGUN
    if not path.is_file():
        if any(file.is_file() and file.suffix != ".tmp" and file.name != LOCK for file in out.rglob("*")):
            raise TensorsimError(f"{out}: got a folder with other files, expected a new or an empty one")
        return None
    with reading(path, "the beginning of a data set"):
        content = json.loads(path.read_text(encoding="utf-8"))
        there, listing = DatasetRecipe.from_document(content["recipe"], str(path)), str(content["clips"])
    if there != recipe:
        raise TensorsimError(
            f"{out}: got a data set of another recipe (first difference: "
            f"{difference(there.to_document(), recipe.to_document())}), expected the same or a new folder"
        )
    if content.get("made_with") != made:
        raise TensorsimError(
            f"{out}: got a data set begun with another radar, other weights or another version of tensorsim (first "
            f"difference: {difference(content.get('made_with') or {}, made)}), expected the same or a new folder"
        )
    for left in out.rglob(".*.tmp"):
        left.unlink(missing_ok=True)
    return listing


def _is_there(out: Path, shard: Shard) -> bool:
    """Whether a shard is finished: its rows exist, and the files that they name have the sizes written."""
    path = rows_path(out, shard)
    if not path.is_file():
        return False
    sizes = rows_of_shard(path)["bytes"]
    files = {out / name: size for name, size in sizes.items()}
    return all(file.is_file() and file.stat().st_size == size for file, size in files.items())


def _forget_failures(out: Path, plan: Plan) -> None:
    """Make shards with failed samples count as missing."""
    for shard in plan.shards:
        path = rows_path(out, shard)
        if path.is_file() and rows_of_shard(path)["failures"]:
            path.unlink()
