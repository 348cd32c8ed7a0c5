"""Recreate a stored sample from its manifest row alone."""

from pathlib import Path

from tensorsim.data.sets.made_with import difference, made_with
from tensorsim.data.sets.manifest import made_of, recipe_of, rows_of
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.samples import Sample, sample_of_row
from tensorsim.errors import TensorsimError


def sample_again(folder: Path, sample: str, cache: Path | None = None) -> Sample:
    """Recreate the sample with this id from its row and the recipe in ``manifest.parquet``; shards are not read.

    Videos and captured motion are needed if the recipe names them.

    Raises:
        TensorsimError: no such data set or sample, sources with different clips, a changed radar or weights, or arrays
            that differ from the stored ones: another version of tensorsim, torch or the videos, or another kind of
            processor.
    """
    row = next(rows_of(folder, id=sample), None)
    if row is None:
        last = max(row["id"] for row in rows_of(folder))
        raise TensorsimError(f"{folder}: got no sample {sample!r}, expected an id such as {last}")
    recipe, there = recipe_of(folder), made_of(folder)
    here = made_with(recipe)
    if there and there | {"version": ""} != here | {"version": ""}:
        raise TensorsimError(
            f"{folder}: got another radar or other weights than the data set was made with (first difference: "
            f"{difference(there | {'version': here['version']}, here)}), expected the same"
        )
    plan = Plan(recipe, str(folder / ".people" if cache is None else cache))
    index, clip = row["clip_index"], row["clip"]
    if index >= plan.clips or plan.clip(index)[1].name != clip:
        raise TensorsimError(
            f"{folder}: got sources in which {clip} is missing or has moved, expected those of the data set"
        )
    made = sample_of_row(plan, row)
    if made.row["sha256"] != row["sha256"]:
        raise TensorsimError(
            f"{folder}: got other arrays for {sample} than were stored, expected the same: has the version of "
            f"tensorsim ({there.get('version', 'an earlier one')} there, {here['version']} here), "
            "of torch, the films or the kind of processor changed?"
        )
    return made
