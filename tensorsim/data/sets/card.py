"""The data card: describes a data set in words and tables."""

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
        plan: plan of the recipe.
        counts: samples by part and class.
        failures: number of clips with failed samples.
        size: total size of the shards in bytes.
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
        _split(plan),
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
        *(f"- `{kind}`: {_described(recipe, kind)}." for kind in recipe.outputs.kinds),
        "",
        "`manifest.parquet` and `manifest.csv` have a row per sample: class, part, person, film, all that was varied, "
        "seed and SHA-256 of the arrays; the Parquet file holds the recipe as well. "
        "`tensorsim dataset sample DIR ID` makes a sample again from its row.",
        "",
    ]  # fmt: skip
    return "\n".join(lines)


def _split(plan: Plan) -> str:
    """What the parts have in common."""
    by = plan.recipe.split.by
    if by == "source":
        return "Split by source: no film, file or generated person is in two parts."
    if by == "table":
        return "Split by table: parts are those of the sources."
    unnamed = {source.kind for source, there in zip(plan.recipe.sources, plan.sources, strict=True)
               if not there.names_people}  # fmt: skip
    if not unnamed:
        return "Split by person: nobody is in two parts."
    return (
        f"Split by person: nobody whom a source names is in two parts. Not every clip of {', '.join(sorted(unnamed))} "
        "has a name; without one each file counts as another person, and who is in several may be in several parts."
    )


def _described(recipe: DatasetRecipe, kind: str) -> str:
    """Axes, unit and scale of an output."""
    wanted = recipe.outputs

    def in_bytes(range_db: float) -> str:
        return f"uint8, 255 at the peak, 0 at {range_db:g} dB below it and less"

    scale = in_bytes(wanted.range_db) if wanted.dtype == "uint8" else "float16, dB, 0 at the peak"
    ranges = "range (`processing.range_gate_m`, the nearest first)"
    doppler = "Doppler (from -PRF / 2 up, positive approaching)"
    parts = "real and imaginary part over the largest magnitude, float16"
    speed, frames = wanted.picture_speed_m_s, f"frames ({wanted.frames_per_s:g} per second)"
    return {
        "doppler_time": f"{doppler}, time; {scale}",
        "range_time": f"{ranges}, time; {scale}",
        "range_time_mti": f"{ranges}, time, of what moves; {scale}",
        "ridges": "strongest lines of the Doppler-time map, time; Doppler in Hz, float32",
        "picture": f"radial speed ({-speed:g} to {speed:g} m/s, positive approaching), time; "
        f"{in_bytes(wanted.picture_range_db)}",
        "profiles": f"pulses, {ranges}, parts; {parts}",
        "if_signal": f"pulses, samples of the intermediate frequency, parts; {parts}",
        "range_doppler_angle": f"{frames}, {ranges}, {doppler}, direction (equal steps of the sine of the azimuth from "
        f"-1 to 1); {scale}",
        "point_cloud": f"{frames}, points, (range in m, speed in m/s, sine of the azimuth, power in dB); float32, NaN "
        "where there is no point",
        "joints": f"people, moments ({recipe.motion_hz:g} per second), 14 joints, (x, y, z) as the radar sees them; m, "
        "float32, NaN where nobody is",
    }[kind]


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
