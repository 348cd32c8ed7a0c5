"""One sample: the scene with its people, and the outputs of each radar of the recipe."""

import math
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy.typing as npt
import torch

from tensorsim.config import SimulationConfig
from tensorsim.config.scene import Body
from tensorsim.data.sets.array_outputs import array_outputs
from tensorsim.data.sets.outputs import Stored, stored_joints
from tensorsim.data.sets.pair_outputs import of_samples, pair_outputs
from tensorsim.data.sets.recipe import DatasetRecipe, RadarView
from tensorsim.data.sets.scene import Scene, seen_from
from tensorsim.data.sets.variations import Variation, seed_of
from tensorsim.errors import collected_warnings
from tensorsim.radar.processing.ambiguity import gate_around

#: Extent of a body beyond its joints, extra range bins on each side, and range added by bounces inside a wall.
_BODY_M, _MARGIN_BINS, _WALL_M = 0.2, 5, 2.0


class Synthesized(NamedTuple):
    """Arrays of a sample by name, ``RADAR.OUTPUT``, and what the manifest says about them.

    Attributes:
        arrays: arrays as stored.
        peaks: magnitude that corresponds to 0 dB (or 1) in each.
        warnings: warnings of the simulation.
    """

    arrays: dict[str, npt.NDArray[Any]]
    peaks: dict[str, float]
    warnings: list[str]


def view_config(recipe: DatasetRecipe, view: RadarView, variation: Variation) -> SimulationConfig:
    """The simulation of one radar for one sample."""
    config = recipe.simulation(view)
    body = cast(Body, variation.body)
    scene = replace(config.scene, body=body, sway=variation.sway, vital_signs=variation.vital_signs)
    if variation.snr_db is not None:
        scene = replace(scene, snr_db=variation.snr_db)
    if scene.wall is not None:
        wall, thick = scene.wall, variation.wall_thickness_m
        if variation.wall_permittivity is not None:
            wall = replace(wall, relative_permittivity=variation.wall_permittivity)
        if thick is not None:
            # The near face stays where it is.
            (x, y, z), (width, before, height) = wall.center_m, wall.size_m
            wall = replace(wall, center_m=(x, y + (thick - before) / 2, z), size_m=(width, thick, height))
        scene = replace(scene, wall=wall)
    scene = replace(scene, receiver=variation.receiver(scene.receiver))
    processing = config.processing
    if variation.denoiser is not None:
        processing = replace(processing, denoiser=variation.denoiser)
    if scene.sampled_effects:
        processing = of_samples(processing)
    return config.replace(processing=processing, scene=scene, seed=variation.seed % 2**32)


def people_gate(config: SimulationConfig, scene: Scene) -> tuple[float, float] | float | None:
    """(nearest, farthest) range of the bins that a scene's people reach, within the gate of a configuration."""
    gate, radar = config.processing.range_gate_m, config.scene.radar
    if isinstance(gate, float | int) or not bool(scene.valid.any()):
        return gate
    margin = _BODY_M + _MARGIN_BINS * radar.range_resolution_m
    near, far = gate_around(scene.joints[scene.valid].double(), radar, margin)
    behind = _WALL_M if config.scene.wall is not None else 0.0
    low, high = (0.0, math.inf) if gate is None else gate
    last = (radar.samples_per_chirp // 2 - 1) * radar.range_resolution_m
    return max(low, min(near, last - margin)), min(high, far + behind, last)


@torch.no_grad()
def synthesize(recipe: DatasetRecipe, scene: Scene, variation: Variation) -> Synthesized:
    """The arrays of a sample. The same recipe, scene and variation give the same bytes on one thread.

    Raises:
        TensorsimError: motion that a radar cannot follow.
    """
    arrays, peaks = {}, {}
    with collected_warnings() as warnings:
        for view in recipe.radars:
            found = alone(recipe, view_of(recipe, view, scene, variation))
            for kind in recipe.outputs.kinds:
                arrays[f"{view.name}.{kind}"] = found[kind].array
                peaks[f"{view.name}.{kind}"] = found[kind].peak
    return Synthesized(arrays, peaks, warnings)


class View(NamedTuple):
    """What one radar needs to simulate one sample.

    Attributes:
        config: configuration of the simulation.
        scene: the people in the axes of the radar.
        noise_seed: seed of the receiver noise.
    """

    config: SimulationConfig
    scene: Scene
    noise_seed: int


def view_of(recipe: DatasetRecipe, view: RadarView, scene: Scene, variation: Variation) -> View:
    """The :class:`View` of one radar of a recipe for a sample; ``scene`` is in world axes."""
    seen = scene._replace(joints=seen_from(scene.joints, view.x_m, view.y_m, view.yaw_deg))
    config = view_config(recipe, view, variation)
    if recipe.gate_people and not recipe.outputs.has_range:
        config = config.replace(processing__range_gate_m=people_gate(config, seen))
    return View(config, seen, seed_of(variation.seed, view.name, "noise"))


def alone(recipe: DatasetRecipe, view: View) -> dict[str, Stored]:
    """All outputs of one radar for one sample."""
    found = {"joints": stored_joints(view.scene.joints, view.scene.valid)}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(view.noise_seed)
        if recipe.outputs.needs_array:
            found |= array_outputs(view.config, recipe.outputs, view.scene)
        elif recipe.outputs.needs_pair:
            found |= pair_outputs(view.config, recipe.outputs, view.scene, recipe.duration_s)
    return found


def peak_db(peak: float) -> float | None:
    """A magnitude in dB; None for 0."""
    return 20 * math.log10(peak) if peak > 0 else None
