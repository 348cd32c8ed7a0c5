"""One sample of a data set as it is stored: arrays, the row of the manifest, and the hash of both."""

import hashlib
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.recipe import DatasetRecipe
from tensorsim.data.sets.synthesis import peak_db, synthesize
from tensorsim.data.sets.variations import Variation
from tensorsim.device import one_thread


class Sample(NamedTuple):
    """A sample.

    Attributes:
        arrays: arrays by name, ``RADAR.OUTPUT``.
        row: row of the manifest.
    """

    arrays: dict[str, npt.NDArray[Any]]
    row: dict[str, Any]


#: Columns of the manifest before those of the variation, and after them.
FIRST_COLUMNS: dict[str, type] = {
    "id": str, "part": str, "shard": str, "class_index": int, "label": str, "person": str, "origin": str, "clip": str,
    "clip_index": int, "variation": int,
}  # fmt: skip
LAST_COLUMNS: dict[str, type] = {"people": int, "present_s": float, "warnings": str, "sha256": str}
VARIATION_COLUMNS: dict[str, type] = {
    "seed": int, "height_m": float, "distance_m": float, "side_m": float, "heading_deg": float, "mirrored": bool,
    "speed": float, "start": float, "companions": str, "body": str, "snr_db": float, "sway": bool, "vital_signs": bool,
    "wall_permittivity": float, "wall_thickness_m": float, "phase_noise_dbc_hz": float, "iq_imbalance_db": float,
    "iq_phase_rad": float, "dc_offset_db": float, "adc_bits": int, "adc_headroom_db": float, "real_receiver": bool,
    "denoiser": str,
}  # fmt: skip


def columns(recipe: DatasetRecipe) -> dict[str, type]:
    """Names and types of the manifest columns for a recipe."""
    peaks = {f"{view.name}.{kind}.peak_db": float for view in recipe.radars for kind in recipe.outputs.kinds}
    return FIRST_COLUMNS | VARIATION_COLUMNS | LAST_COLUMNS | peaks


def sample_id(number: int) -> str:
    """The name of sample ``number``."""
    return f"{number:08d}"


def content_hash(arrays: dict[str, npt.NDArray[Any]], label: int) -> str:
    """SHA-256 of a sample's arrays and class, whatever files they are stored in."""
    digest = hashlib.sha256(str(label).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def make_sample(plan: Plan, number: int, shard: str) -> Sample:
    """Sample ``number`` of a plan.

    Raises:
        TensorsimError: people that cannot be found, or motion that a radar cannot follow.
    """
    part, clip, count = plan.clip_of_sample(number)
    named = {"id": sample_id(number), "part": part, "shard": shard, "clip_index": clip, "variation": count}
    return _sample(plan, named, plan.variation(clip, count))


def sample_of_row(plan: Plan, row: dict[str, Any]) -> Sample:
    """Recreate the sample of a manifest row.

    Raises:
        TensorsimError: see :func:`make_sample`.
    """
    named = {name: row[name] for name in ("id", "part", "shard", "clip_index", "variation")}
    return _sample(plan, named, Variation.of_row(row))


def _sample(plan: Plan, named: dict[str, Any], variation: Variation) -> Sample:
    there = plan.clip(named["clip_index"])[1]
    with one_thread():  # for the same bits everywhere
        scene = plan.scene(named["clip_index"], named["part"], variation)
        made = synthesize(plan.recipe, scene, variation)
    label = plan.labels.index(there.label)
    row = named | variation.row() | {
        "class_index": label,
        "label": there.label,
        "person": there.person,
        "origin": there.origin,
        "clip": there.name,
        "people": scene.joints.shape[0],
        "present_s": int(scene.valid.any(0).sum()) / scene.fps,
        "warnings": " | ".join(made.warnings),
        "sha256": content_hash(made.arrays, label),
    }  # fmt: skip
    peaks = {f"{name}.peak_db": peak_db(peak) for name, peak in made.peaks.items()}
    order = columns(plan.recipe)
    return Sample(made.arrays, {name: (row | peaks)[name] for name in order})
