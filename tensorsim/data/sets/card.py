"""The data card: what is in a data set, in words and tables."""

from collections import Counter

from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.recipe import PARTS, DatasetRecipe

_LOAD = {
    "webdataset": """\
Tar shards of WebDataset: `ID.RADAR.OUTPUT.npy`, `ID.json` (the row of the manifest) and `ID.cls` (number of the class).

```python
import tensorsim as ts
train = ts.data.MapDataset("DIR", split="train")
```""",
    "hdf5": "HDF5 files with a group per sample: data sets `RADAR.OUTPUT`, the row of the manifest as attributes.",
    "mat": "MATLAB files with the samples of a shard in cells or along the first dimension of `RADAR_OUTPUT`; `id`, "
    "`label`, `class_index` (from 0).",
    "png": "One picture per sample and radar, `PART/CLASS/ID_RADAR.png`, the highest speed on top.",
}


def card(plan: Plan, counts: Counter[tuple[str, str]], failures: int, size: int) -> str:
    """The text of ``README.md`` in the folder of a data set.

    Args:
        plan: of the recipe.
        counts: samples by part and class.
        failures: number of clips of which samples failed.
        size: bytes of all shards.
    """
    recipe = plan.recipe
    total = sum(counts.values())
    lines = [
        f"# {recipe.name}",
        "",
        f"{total} labelled samples of {recipe.duration_s:g} s, {size / 1e6:.1f} MB, simulated by tensorsim from "
        f"`recipe.yaml` (seed {recipe.seed}). Clips of which samples failed: {failures}, see `failures.csv`.",
        "",
        f"| class | {' | '.join(PARTS)} |",
        f"|---|{'---|' * len(PARTS)}",
        *(
            f"| {label} | {' | '.join(str(counts[part, label]) for part in PARTS)} |"
            for label in plan.labels
        ),
        "",
        f"Split by {recipe.split.by}: nobody is in two parts." if recipe.split.by == "person" else
        f"Split by {recipe.split.by}.",
        "",
        "## People",
        *(_source(recipe, number) for number in range(len(recipe.sources))),
        "",
        "## Radars",
        *_radars(recipe),
        "",
        "## Files",
        _LOAD[recipe.storage.format],
        "",
        f"Outputs: {', '.join(recipe.outputs.kinds)}; maps are {_scale(recipe)}.",
        "`manifest.parquet` and `manifest.csv` have a row per sample: class, part, person, film, all that was varied, "
        "seed and SHA-256 of the arrays; the Parquet file holds the recipe as well. "
        "`tensorsim dataset sample DIR ID` makes a sample again from its row.",
        "",
    ]  # fmt: skip
    return "\n".join(lines)


def _scale(recipe: DatasetRecipe) -> str:
    if recipe.outputs.dtype == "uint8":
        return f"uint8: 255 at the peak, 0 at {recipe.outputs.range_db:g} dB below it and less"
    return "float16: decibels below the peak"


def _source(recipe: DatasetRecipe, number: int) -> str:
    source = recipe.sources[number]
    if source.people is not None:
        return f"- {source.people} {source.kind} people, each in {len(source.classes)} activities"
    return f"- {source.kind}: `{source.path}`"


def _radars(recipe: DatasetRecipe) -> list[str]:
    lines = []
    for view in recipe.radars:
        radar = recipe.simulation(view).scene.radar
        lines.append(
            f"- {view.name}: {view.preset}, {radar.carrier_hz / 1e9:g} GHz, {radar.bandwidth_hz / 1e6:g} MHz, PRF "
            f"{radar.prf_hz:g} Hz, at x {view.x_m:g} m, y {view.y_m:g} m, yaw {view.yaw_deg:g} degrees"
        )
    return lines
