"""Descriptions of a finished data set: manifest, failures, data card, contact sheet."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensorsim.data.sets.card import card
from tensorsim.data.sets.made_with import digest
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.recipe import DatasetRecipe
from tensorsim.data.sets.samples import columns
from tensorsim.data.sets.sheet import draw_sheet
from tensorsim.errors import TensorsimError
from tensorsim.files import complete_file, reading, write_json, write_text

Row = dict[str, Any]

#: The same rows in two formats, written once all shards exist.
MANIFESTS = ("manifest.parquet", "manifest.csv")


def finish(out: Path, plan: Plan, made: dict[str, Any], finished: Sequence[Path]) -> tuple[list[int], int]:
    """Write everything but the shards of a complete data set; ``dataset.json``, which marks it complete, comes last.

    Args:
        out: folder of the data set.
        plan: plan of its recipe.
        made: see :func:`~tensorsim.data.sets.made_with.made_with`.
        finished: the rows of each shard, in order.

    Returns:
        Number of samples in each shard, and number of clips with failed samples.

    Raises:
        TensorsimError: every sample failed.
    """
    samples: list[int] = []
    counts: Counter[tuple[str, str]] = Counter()
    files: dict[str, str] = {}
    size = 0
    failed: dict[tuple[str, str], dict[str, Any]] = {}
    with _manifest(out, plan.recipe, made) as add_rows:
        for path in finished:
            content = rows_of_shard(path)
            add_rows(content["rows"])
            samples.append(len(content["rows"]))
            counts.update((row["part"], row["label"]) for row in content["rows"])
            files |= content["files"]
            size += sum(content["bytes"].values())
            for failure in content["failures"]:
                clip = failed.setdefault((failure["clip"], failure["path"]), failure | {"samples": 0})
                clip["samples"] += 1
        failures = [failed[key] for key in sorted(failed)]
        _write_failures(out / "failures.csv", failures)
        if sum(samples) == 0:
            reason = failures[0]["reason"] if failures else "there are none"
            for path in finished:
                path.unlink()  # to be tried again
            raise TensorsimError(f"{out}: got no samples ({reason}), expected some")
    draw_sheet(out, plan.recipe)
    write_text(out / "README.md", card(plan, counts, len(failures), size))
    summary = {
        "name": plan.recipe.name,
        "recipe": digest(plan.recipe, made),
        "labels": list(plan.labels),
        "samples": sum(samples),
        "failures": len(failures),
        "bytes": size,
        "sha256": files,
    }
    write_json(out / "dataset.json", summary)
    return samples, len(failures)


def rows_of_shard(path: Path) -> dict[str, Any]:
    """The record of a finished shard: ``rows`` of the manifest, ``failures``, the SHA-256 of ``files`` and their
    ``bytes``.

    Raises:
        TensorsimError: a damaged file.
    """
    with reading(path, "rows of a shard"):
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def _write_failures(path: Path, failures: Sequence[dict[str, Any]]) -> None:
    """List every clip with failed samples, with their number and the first reason."""
    with complete_file(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["clip", "path", "samples", "reason"])
        writer.writeheader()
        writer.writerows(failures)


@contextmanager
def _manifest(
    out: Path, recipe: DatasetRecipe, made: dict[str, Any]
) -> Iterator[Callable[[list[Row]], None]]:
    """Write ``manifest.parquet``, which also holds the recipe and what it was made with, and ``manifest.csv``; gives
    a function that adds rows to both."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    names = columns(recipe)
    schema = pa.schema(
        [(name, kinds[kind]) for name, kind in names.items()],
        metadata={
            "tensorsim.recipe": json.dumps(recipe.to_document()),
            "tensorsim.made_with": json.dumps(made),
        },
    )
    with (
        complete_file(out / MANIFESTS[0]) as parquet,
        complete_file(out / MANIFESTS[1]) as table,
        pq.ParquetWriter(parquet, schema) as writer,
        table.open("w", newline="", encoding="utf-8") as file,
    ):
        lines = csv.DictWriter(file, list(names))
        lines.writeheader()

        def add(rows: list[Row]) -> None:
            if rows:
                writer.write_table(pa.Table.from_pylist(rows, schema))
                lines.writerows(rows)

        yield add


def _finished(out: Path) -> Path:
    """The manifest of a data set, which exists once all its shards do."""
    path = out / "manifest.parquet"
    if not path.is_file():
        raise TensorsimError(f"{out}: got no manifest.parquet, expected a finished data set")
    return path


def recipe_of(out: Path) -> DatasetRecipe:
    """The recipe stored in the manifest of a data set.

    Raises:
        TensorsimError: no manifest there, or a damaged one.
    """
    path = _finished(out)
    with reading(path, "a manifest"):
        stored = json.loads(_metadata(path)[b"tensorsim.recipe"])
    return DatasetRecipe.from_document(stored, str(path))


def made_of(out: Path) -> dict[str, Any]:
    """What a data set was made with, as returned by :func:`~tensorsim.data.sets.made_with.made_with`.

    Empty for data sets of earlier versions, which do not state it.

    Raises:
        TensorsimError: no manifest there, or a damaged one.
    """
    path = _finished(out)
    with reading(path, "a manifest"):
        made: dict[str, Any] = json.loads(_metadata(path).get(b"tensorsim.made_with", b"{}"))
    return made


def _metadata(path: Path) -> dict[bytes, bytes]:
    """The documents stored in a manifest."""
    import pyarrow.parquet as pq

    return pq.read_schema(path).metadata or {}


def rows_of(out: Path, **wanted: str) -> Iterator[Row]:
    """Rows of the manifest whose columns have these values, in sample order.

    Raises:
        TensorsimError: no manifest there, or a damaged one.
    """
    import pyarrow.parquet as pq

    path = _finished(out)
    with reading(path, "a manifest"):
        file = pq.ParquetFile(path)
        for group in range(file.num_row_groups):
            for row in file.read_row_group(group).to_pylist():
                if all(row[name] == value for name, value in wanted.items()):
                    yield row


def columns_of(out: Path, *names: str) -> list[npt.NDArray[Any]]:
    """Columns of the manifest, in sample order.

    Raises:
        TensorsimError: no manifest there, or a damaged one.
    """
    import pyarrow.parquet as pq

    path = _finished(out)
    with reading(path, "a manifest"):
        table = pq.read_table(path, columns=list(names))
        return [np.array(table[name].to_pylist()) for name in names]
