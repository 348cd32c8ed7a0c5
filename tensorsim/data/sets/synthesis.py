"""One sample: the scene of its people, and what each radar of the recipe makes of it."""

import math
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy.typing as npt
import torch
from torch import Tensor

from tensorsim.config import SimulationConfig
from tensorsim.config.scene import Body
from tensorsim.data.sets import outputs
from tensorsim.data.sets.array_outputs import array_outputs
from tensorsim.data.sets.outputs import OutputConfig, Stored
from tensorsim.data.sets.recipe import DatasetRecipe, RadarView
from tensorsim.data.sets.scene import Scene, seen_from
from tensorsim.data.sets.variations import Variation, seed_of
from tensorsim.errors import collected_warnings
from tensorsim.pipeline.maps import PoseToDoppler
from tensorsim.radar.processing.ambiguity import gate_around
from tensorsim.recognition.map_image import MapToImage

#: How far a body reaches beyond its joints, range bins beside it, and what bounces inside a wall add to the range.
_BODY_M, _MARGIN_BINS, _WALL_M = 0.2, 5, 2.0


class Synthesized(NamedTuple):
    """Arrays of a sample by name, ``RADAR.OUTPUT``, and what the manifest says of them.

    Attributes:
        arrays: as they are stored.
        peaks: magnitude that is 0 dB (or 1) in each.
        warnings: of the simulation.
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
    return config.replace(scene=scene, seed=variation.seed % 2**32)


def people_gate(config: SimulationConfig, scene: Scene) -> tuple[float, float] | float | None:
    """(nearest, farthest) range of the bins that people of a scene reach, within the gate of a configuration."""
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
    with collected_warnings() as warnings, torch.random.fork_rng(devices=[]):
        for view in recipe.radars:
            joints = seen_from(scene.joints, view.x_m, view.y_m, view.yaw_deg)
            torch.manual_seed(seed_of(variation.seed, view.name, "noise"))
            found = _outputs(recipe, view, scene._replace(joints=joints), variation)
            for kind in recipe.outputs.kinds:
                arrays[f"{view.name}.{kind}"] = found[kind].array
                peaks[f"{view.name}.{kind}"] = found[kind].peak
    return Synthesized(arrays, peaks, warnings)


def _outputs(recipe: DatasetRecipe, view: RadarView, scene: Scene, variation: Variation) -> dict[str, Stored]:
    """All outputs of one radar; joints in its axes."""
    config = view_config(recipe, view, variation)
    if recipe.gate_people and not recipe.outputs.has_range:
        config = config.replace(processing__range_gate_m=people_gate(config, scene))
    found = {"joints": outputs.stored_joints(scene.joints, scene.valid)}
    if recipe.outputs.needs_array:
        return found | array_outputs(config, recipe.outputs, scene)
    if set(recipe.outputs.kinds) & set(outputs.OF_PAIR):
        found |= _pair_outputs(config, recipe.outputs, scene, recipe.duration_s)
    return found


def _pair_outputs(
    config: SimulationConfig, wanted: OutputConfig, scene: Scene, duration_s: float
) -> dict[str, Stored]:
    """Outputs of one transmitter and receiver."""
    stage = PoseToDoppler.from_config(config)
    simulator = stage.simulator
    joints, valid = scene.joints[None], scene.valid[None]
    coefficients = stage.resampler.coefficients(joints, scene.fps)
    pulses = stage.resampler.pulses(joints.shape[2], scene.fps)
    points, rcs = stage.scene(coefficients, valid, scene.fps, 0, pulses)
    kinds, found = set(wanted.kinds), {}
    magnitudes: dict[str, Tensor] = {}
    if kinds & set(outputs.SIGNALS):
        target = simulator.echo.target_echo(points, rcs)
        noise: Any = simulator.recorder.noise
        signal = noise(simulator.echo(points, rcs), target)
        profiles = simulator.range_profile(signal)
        moving = simulator.mti(profiles)
        found["if_signal"] = outputs.stored_signal(signal[0])
        found["profiles"] = outputs.stored_signal(profiles[0])
        magnitudes["range_time"] = profiles[0].abs().mT
        magnitudes["range_time_mti"] = moving[0].abs().mT
        magnitudes["doppler_time"] = simulator.doppler(moving)[0]
    elif kinds & {"range_time", "range_time_mti"}:
        maps = stage.denoise(simulator(points, rcs))
        magnitudes = {name: getattr(maps, name)[0] for name in outputs.MAPS}
    else:
        doppler_time = simulator.doppler_time(points, rcs)
        magnitudes["doppler_time"] = (stage.denoiser(doppler_time) if stage.denoises else doppler_time)[0]
    for name in kinds & set(outputs.MAPS):
        found[name] = outputs.stored_map(magnitudes[name], wanted, duration_s)
    doppler = magnitudes["doppler_time"]
    if "ridges" in kinds:
        ridges = simulator.ridges(doppler)
        found["ridges"] = Stored(simulator.doppler.doppler_hz.float()[ridges.indices].numpy(), 1.0)
    if "picture" in kinds:
        picture = MapToImage.doppler(
            simulator.radar,
            simulator.doppler.bins,
            wanted.picture_speed_m_s,
            wanted.picture_size,
            range_db=wanted.picture_range_db,
        )
        found["picture"] = outputs.stored_picture(picture(doppler))
    return found


def peak_db(peak: float) -> float | None:
    """A magnitude in dB; None for 0."""
    return 20 * math.log10(peak) if peak > 0 else None
