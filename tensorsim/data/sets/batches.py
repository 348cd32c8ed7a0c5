"""Process many samples in one pass of the radar chain, on any device; the maps are the same as one by one."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from tensorsim.config import SimulationConfig
from tensorsim.data.sets.outputs import SIGNALS, Stored, stored_joints
from tensorsim.data.sets.pair_outputs import maps_of, scatterers, stored_maps
from tensorsim.data.sets.recipe import DatasetRecipe
from tensorsim.data.sets.scene import Scene
from tensorsim.data.sets.synthesis import View, alone, view_of
from tensorsim.data.sets.variations import Variation
from tensorsim.errors import collected_warnings
from tensorsim.pipeline.maps import PoseToDoppler
from tensorsim.radar.processing.ambiguity import check_unambiguous
from tensorsim.radar.processing.range_profile import gate_bins
from tensorsim.radar.recorder import receiver_noise
from tensorsim.radar.simulator import RadarSimulator

#: Arrays of a sample by name, ``RADAR.OUTPUT``.
Arrays = dict[str, npt.NDArray[Any]]


@torch.no_grad()
def synthesize_batch(
    recipe: DatasetRecipe, samples: Sequence[tuple[Scene, Variation]], device: torch.device
) -> list[Arrays]:
    """The arrays of samples, as :func:`~tensorsim.data.sets.synthesis.synthesize` makes them one by one.

    Samples share a pass if radar, surroundings, scatterers and number of people are the same; their
    signal-to-noise ratios may differ. Noise is drawn on the CPU, so that it is the same on every device. Effects on
    samples of the intermediate frequency, and outputs that are not maps, are computed on the CPU, one by one.

    Raises:
        TensorsimError: motion that a radar cannot follow, in any of the samples.
    """
    arrays: list[Arrays] = [{} for _ in samples]
    with collected_warnings():
        for radar in recipe.radars:
            views = [view_of(recipe, radar, scene, variation) for scene, variation in samples]
            groups: dict[object, list[int]] = defaultdict(list)
            for place, view in enumerate(views):
                groups[_shared_by(view)].append(place)
            for places in groups.values():
                found = _outputs(recipe, [views[place] for place in places], device)
                for place, stored in zip(places, found, strict=True):
                    for kind in recipe.outputs.kinds:
                        arrays[place][f"{radar.name}.{kind}"] = stored[kind].array
    return arrays


def _shared_by(view: View) -> object:
    """What the samples of one pass have in common: everything but noise and the range bins that people reach."""
    scene = view.config.scene
    seeded = scene.sway or scene.vital_signs or scene.clutter is not None
    gate = view.config.processing.range_gate_m
    return (
        view.config.replace(
            scene__snr_db=None if scene.snr_db is None else 0.0,
            processing__range_gate_m=None if isinstance(gate, tuple) else gate,
            seed=view.config.seed if seeded else 0,
        ),
        isinstance(gate, tuple),
        view.scene.joints.shape,
        view.scene.fps,
    )


def _outputs(recipe: DatasetRecipe, views: Sequence[View], device: torch.device) -> list[dict[str, Stored]]:
    """All outputs of one radar for samples that can share a pass."""
    wanted = recipe.outputs
    if not wanted.needs_pair or set(wanted.kinds) & set(SIGNALS) or views[0].config.scene.sampled_effects:
        return [alone(recipe, view) for view in views]
    stage = PoseToDoppler.from_config(_config_of_all(views)).to(device)
    joints = torch.stack([view.scene.joints for view in views]).to(device)
    valid = torch.stack([view.scene.valid for view in views]).to(device)
    points, rcs = scatterers(stage, joints, valid, views[0].scene.fps)
    check_unambiguous(points, rcs, stage.simulator.radar)
    profiles = _profiles(stage.simulator, points, rcs, views)
    maps = {name: map_.cpu() for name, map_ in maps_of(stage, profiles, points, rcs, wanted).items()}
    simulator = stage.simulator.cpu()
    return [
        {"joints": stored_joints(view.scene.joints, view.scene.valid)}
        | stored_maps(simulator, {name: map_[k] for name, map_ in maps.items()}, wanted, recipe.duration_s)
        for k, view in enumerate(views)
    ]


def _config_of_all(views: Sequence[View]) -> SimulationConfig:
    """The configuration of the first sample, with the range bins of all samples."""
    gates = [view.config.processing.range_gate_m for view in views]
    fixed = [gate for gate in gates if isinstance(gate, tuple)]  # all or none
    if not fixed:
        return views[0].config
    near, far = min(gate[0] for gate in fixed), max(gate[1] for gate in fixed)
    return views[0].config.replace(processing__range_gate_m=(near, far))


def _profiles(simulator: RadarSimulator, points: Tensor, rcs: Tensor, views: Sequence[View]) -> Tensor:
    """Profiles (B, M, R) with the noise of each sample: its own range bins, then zeros if others have more."""
    recorder = simulator.recorder
    echoes, levels = recorder.echoes(points, rcs, simulator.span(points))
    clean = torch.cat([echo.mT for echo in echoes], -1)
    bins = [_own_bins(simulator, view) for view in views]
    width = max(own.stop - own.start for own in bins)
    received = clean.new_zeros([len(views), width, clean.shape[2]])
    span = simulator.span(points[:1])
    for k, (view, own) in enumerate(zip(views, bins, strict=True)):
        mine = received[k : k + 1, : own.stop - own.start].mT
        mine.copy_(clean[k : k + 1, own].mT)
        if recorder.noise.noiseless:
            continue
        power = receiver_noise(view.config.scene, simulator.echo).noise_power(levels.signal[k : k + 1].cpu())
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(view.noise_seed)
            for piece in mine.split(span, 1):
                piece += recorder.drawn(torch.empty_like(piece, device="cpu"), power)[0].to(piece.device)
    return received.mT


def _own_bins(simulator: RadarSimulator, view: View) -> slice:
    """The range bins of a sample among those of all."""
    axis, gate = simulator.range_profile, view.config.processing.range_gate_m
    if not isinstance(gate, tuple):
        return slice(0, axis.last_bin + 1 - axis.first_bin)
    first, last = gate_bins(gate, simulator.radar.range_resolution_m, axis.samples // 2)
    return slice(first - axis.first_bin, last + 1 - axis.first_bin)
