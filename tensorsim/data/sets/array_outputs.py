"""Outputs of a radar with several antennas: range-Doppler-angle cubes and point clouds."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from tensorsim.config import RadarConfig, SimulationConfig
from tensorsim.data.sets.outputs import OutputConfig, Stored, in_decibels
from tensorsim.data.sets.pair_outputs import of_samples
from tensorsim.data.sets.scene import Scene
from tensorsim.errors import TensorsimError
from tensorsim.pipeline.maps import PoseToDoppler
from tensorsim.radar.options import echo_of
from tensorsim.radar.processing.array import (
    align_transmitters,
    row_spacing_m,
    steering_vectors,
    virtual_elements,
)
from tensorsim.radar.processing.doppler import DopplerFrames
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.point_cloud import PointCloud
from tensorsim.radar.processing.range_doppler import point_cfar
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.recorder import Recorder
from tensorsim.radar.synthesis.front_end import Levels
from tensorsim.recognition.map_image import area_weights

#: Pulses used to estimate the powers that noise and converters refer to.
_POWER_PULSES = 256


def array_outputs(config: SimulationConfig, wanted: OutputConfig, scene: Scene) -> dict[str, Stored]:
    """``range_doppler_angle`` and ``point_cloud`` as described in :class:`~tensorsim.data.sets.outputs.OutputConfig`.

    Each frame is a Doppler window of ``processing.window_s``; transmitters that fire in turn are aligned, and static
    echoes are removed by the configured moving target indicator. The powers that noise and converters refer to are
    means over a subset of the pulses.

    Raises:
        TensorsimError: a point cloud for antennas that are not evenly spaced along x.
    """
    radar, processing = config.scene.radar, config.processing
    profile = RangeProfile(radar, processing.range_window, _fixed(processing.range_gate_m))
    frames = DopplerFrames(radar, processing.window_s, processing.overlap)
    cubes = list(_cubes(config, wanted, scene, profile, frames))
    if not cubes:
        raise TensorsimError(
            f"duration_s: got a sample shorter than the window of {processing.window_s:g} s, expected a longer one"
        )
    found = {}
    if "range_doppler_angle" in wanted.kinds:
        beams = torch.stack([_beams(cube, radar, wanted) for cube in cubes])
        found["range_doppler_angle"] = in_decibels(beams, wanted)
    if "point_cloud" in wanted.kinds:
        found["point_cloud"] = _points(torch.stack(cubes), radar, profile, frames, wanted)
    return found


def _fixed(gate_m: tuple[float, float] | float | None) -> tuple[float, float] | None:
    if isinstance(gate_m, float | int):
        raise TensorsimError(f"range_gate_m: got {gate_m} for an array, expected nearest and farthest range")
    return gate_m


def _cubes(
    config: SimulationConfig,
    wanted: OutputConfig,
    scene: Scene,
    profile: RangeProfile,
    frames: DopplerFrames,
) -> Iterator[Tensor]:
    """Complex cubes (V, R, F), one per frame, Doppler ascending, positive = approaching."""
    radar = config.scene.radar
    pair = replace(radar, tx_m=radar.tx_positions_m[0], rx_m=radar.rx_positions_m[0])
    stage = PoseToDoppler.from_config(config.replace(scene__radar=pair, processing__near_bins=None))
    joints, valid = scene.joints[None], scene.valid[None]
    coefficients = stage.curve(joints, valid, scene.fps)
    pulses = stage.resampler.pulses(joints.shape[2], scene.fps)
    points, rcs = stage.scene(coefficients, valid, scene.fps, 0, pulses)
    echo = echo_of(config.scene, config.processing.pulse_chunk, None, ())
    recorder = Recorder(config.scene, of_samples(config.processing), echo, profile, config.seed)
    ahead = echo.displacements(points)
    some = slice(None, None, max(1, pulses // _POWER_PULSES))
    few, nothing = points[:, some], torch.zeros(1, dtype=torch.float64)
    _, energies = recorder.survey(few, rcs[:, some], 0, None if ahead is None else ahead[:, some])
    levels = recorder.add(Levels(nothing, nothing), energies, few.shape[1])
    mti = MovingTargetIndicator(config.processing.mti, radar)
    length = frames.length + mti.lost_pulses
    hop = max(1, round(radar.prf_hz / wanted.frames_per_s))
    window = frames.shifting_window.float()
    for first in range(0, pulses - length + 1, hop):
        own = slice(first, first + length)
        way = None if ahead is None else ahead[:, own]
        received, _ = recorder.received(points[:, own], rcs[:, own], first, way, levels, [])
        channels = received[0].unflatten(-1, [recorder.channels, -1]).transpose(0, 1)
        moving = mti(align_transmitters(channels, len(radar.tx_positions_m)))
        yield torch.fft.ifft(moving.transpose(-2, -1) * window, frames.bins, norm="forward")


def _beams(cube: Tensor, radar: RadarConfig, wanted: OutputConfig) -> Tensor:
    """Power (R', F', D) of D beams equally spaced in sine, averaged over cells of range and Doppler."""
    sines = (torch.arange(wanted.beams, dtype=torch.float64) + 0.5) * (2 / wanted.beams) - 1
    cycles = steering_vectors(virtual_elements(radar), sines.asin(), 0.0, radar.doppler_wavelength_m)
    weights = torch.polar(torch.ones_like(cycles), 2 * torch.pi * cycles).to(cube.dtype) / cycles.shape[1]
    power = torch.einsum("dv,vrf->rfd", weights.conj(), cube).abs().square()
    rows, columns = wanted.cube_size
    for axis, cells in ((0, rows), (1, columns)):
        count = power.shape[axis]
        if count > cells:
            shares = area_weights(torch.arange(count, dtype=torch.float64), 1.0, 0.0, float(count), cells)
            power = torch.tensordot(shares.to(power.dtype), power.movedim(axis, 0), 1).movedim(0, axis)
    return power


def _points(
    cubes: Tensor, radar: RadarConfig, profile: RangeProfile, frames: DopplerFrames, wanted: OutputConfig
) -> Stored:
    """Points (frames, points, 4) from cubes (frames, V, R, F)."""
    cfar = point_cfar(radar, frames)
    cloud = PointCloud(
        radar.range_resolution_m,
        radar.prf_hz / frames.bins * radar.doppler_wavelength_m / 2,
        wanted.points,
        row_spacing_m(radar) / radar.doppler_wavelength_m,
    )
    power = cubes.abs().square().mean(1)
    found = cloud(cubes.conj().resolve_conj(), cfar(power))
    strength = 10 * found.power.clamp_min(1e-30).log10()
    ranges = found.range_m + float(profile.range_m[0])
    rows = torch.stack([ranges, found.speed_m_s, found.sine, strength], dim=-1)
    return Stored(torch.where(found.valid[..., None], rows, torch.nan).float().numpy(), 1.0)
