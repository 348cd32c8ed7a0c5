"""Outputs for a radar with one transmitter and receiver: maps, ridges, pictures, profiles and the signal itself."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tensorsim.config import ProcessingConfig, SimulationConfig
from tensorsim.data.sets.outputs import (
    MAPS,
    SIGNALS,
    OutputConfig,
    Stored,
    stored_map,
    stored_picture,
    stored_signal,
)
from tensorsim.data.sets.scene import Scene
from tensorsim.pipeline.maps import PoseToDoppler
from tensorsim.radar.processing.columns import block_rms
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.recognition.map_image import MapToImage


def of_samples(processing: ProcessingConfig) -> ProcessingConfig:
    """The same processing, with the engine that computes samples of the intermediate frequency."""
    return replace(processing, engine="time", near_bins=None, energy_stride=1)


def pair_outputs(
    config: SimulationConfig, wanted: OutputConfig, scene: Scene, duration_s: float
) -> dict[str, Stored]:
    """The outputs of one sample that :class:`~tensorsim.data.sets.outputs.OutputConfig` names; noise as it comes.

    Raises:
        TensorsimError: motion that the radar cannot follow.
    """
    found = {}
    signals = bool(set(wanted.kinds) & set(SIGNALS))
    if signals:
        config = config.replace(processing=of_samples(config.processing))
    stage = PoseToDoppler.from_config(config)
    points, rcs = scatterers(stage, scene.joints[None], scene.valid[None], scene.fps)
    if signals:
        signal = recorded(stage.simulator, points, rcs)
        profiles = stage.simulator.range_profile(signal)
        found = {"if_signal": stored_signal(signal[0]), "profiles": stored_signal(profiles[0])}
    else:
        profiles = stage.simulator.profiles(points, rcs)
    maps = maps_of(stage, profiles, points, rcs, wanted)
    return found | stored_maps(
        stage.simulator, {name: map_[0] for name, map_ in maps.items()}, wanted, duration_s
    )


def scatterers(stage: PoseToDoppler, joints: Tensor, valid: Tensor, fps: float) -> tuple[Tensor, Tensor]:
    """Scatterers (B, M, S, 3) and their RCS (B, M, S) of joints (B, P, T, 14, 3)."""
    coefficients = stage.curve(joints, valid, fps)
    return stage.scene(coefficients, valid, fps, 0, stage.resampler.pulses(joints.shape[2], fps))


def recorded(simulator: RadarSimulator, points: Tensor, rcs: Tensor) -> Tensor:
    """The intermediate frequency (1, M, N) with all receiver effects."""
    recorder: Any = simulator.recorder
    _, levels = recorder.echoes(points, rcs, points.shape[1])
    power = recorder.noise.noise_power(levels.signal)
    pieces = []
    for start in range(0, points.shape[1], recorder.pulse_chunk):
        piece = slice(start, start + recorder.pulse_chunk)
        samples, _ = recorder.engine.samples(points[:, piece], rcs[:, piece], start)
        if recorder.front_end is not None:
            samples, _ = recorder.front_end(samples, levels, start)
        elif not recorder.noise.noiseless:
            samples = samples + recorder.noise.draw(samples, power)
        pieces.append(samples)
    return torch.cat(pieces, 1)


def maps_of(
    stage: PoseToDoppler, profiles: Tensor, points: Tensor, rcs: Tensor, wanted: OutputConfig
) -> dict[str, Tensor]:
    """Magnitudes of maps by name, with a batch dimension, from profiles (B, M, R); processed ones are denoised."""
    simulator = stage.simulator
    moving = simulator.mti(profiles)
    if simulator.gate is not None:
        late = points.shape[1] - moving.shape[1]
        moving = simulator.gate(moving, points[:, late:], rcs[:, late:])
    maps = {"doppler_time": simulator.doppler(moving)}
    if wanted.has_range:
        maps["range_time_mti"] = block_rms(moving.abs().mT, simulator.range_time_block)
    if stage.denoises:
        maps = {name: stage.denoiser(map_) for name, map_ in maps.items()}
    if wanted.has_range:
        maps["range_time"] = block_rms(profiles.abs().mT, simulator.range_time_block)
    return maps


def stored_maps(
    simulator: RadarSimulator, maps: dict[str, Tensor], wanted: OutputConfig, duration_s: float
) -> dict[str, Stored]:
    """The maps (H, W) of one sample as they are stored, on the CPU."""
    found = {name: stored_map(maps[name], wanted, duration_s) for name in MAPS if name in wanted.kinds}
    doppler = maps["doppler_time"]
    if "ridges" in wanted.kinds:
        ridges = simulator.ridges(doppler)
        found["ridges"] = Stored(simulator.doppler.doppler_hz.cpu().float()[ridges.indices].numpy(), 1.0)
    if "picture" in wanted.kinds:
        picture = MapToImage.doppler(
            simulator.radar,
            wanted.picture_speed_m_s,
            wanted.picture_size,
            range_db=wanted.picture_range_db,
        )
        found["picture"] = stored_picture(picture(doppler))
    return found
