"""Joints at video rate -> radar maps."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import mid_hips
from tensorsim.config import SimulationConfig
from tensorsim.enhance.choice import map_denoiser
from tensorsim.errors import TensorsimError, check_per_person, check_tensor
from tensorsim.motion.absence import continued
from tensorsim.motion.body13 import Body13Scatterers
from tensorsim.motion.body_scatterers import BodyScatterers
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.resample import PoseResampler
from tensorsim.motion.savgol import SavitzkyGolay
from tensorsim.motion.scatterers import JointScatterers, visibility_fade
from tensorsim.motion.sway import PosturalSway
from tensorsim.motion.vital_signs import VitalSigns
from tensorsim.ops import of_person
from tensorsim.protocols import check_instance, check_part
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.types import RadarMaps


class PoseToDoppler(nn.Module):
    """Joints at video rate -> radar maps: resample to the pulse rate, place scatterers, simulate.

    The people of a clip form one scene: their scatterers add up in one echo. Echoes of people far beyond the
    range axis are filtered out (:meth:`heard`).

    Args:
        simulator: scatterers -> maps.
        resampler: video rate -> pulse rate; default the C2 spline at the PRF of the simulator's radar.
        pulse_smoother: optional filter along the pulses; the paper uses Savitzky-Golay after linear resampling.
        scatterers: joints -> scatterers; default one point per joint with the panel's RCS.
        denoiser: optional module on magnitude maps (..., H, W), e.g. ``tensorsim.enhance.MapDenoiser``. It cleans
            the finished maps; the Doppler-time map is computed from data that was not denoised.
        rcs_scale: factor on each person's cross sections; the last one applies to all further people.
        small_motions: body motions too small for a camera to resolve, added at the pulse rate, e.g.
            :class:`tensorsim.motion.PosturalSway` and :class:`tensorsim.motion.VitalSigns`: modules
            (joints (B, P, M, 14, 3), first pulse) -> joints.

    Raises:
        TensorsimError: a resampler or small motions with a rate other than the PRF of the simulator's radar, factors
            that are not positive, parts that are not suitable stages.
    """

    rcs_scale: Tensor
    radar_m: Tensor

    def __init__(
        self,
        simulator: RadarSimulator,
        resampler: PoseResampler | None = None,
        pulse_smoother: SavitzkyGolay | None = None,
        scatterers: nn.Module | None = None,
        denoiser: nn.Module | None = None,
        rcs_scale: tuple[float, ...] = (1.0,),
        small_motions: Sequence[nn.Module] = (),
    ) -> None:
        super().__init__()
        check_instance(simulator, RadarSimulator, "simulator")
        self.simulator = simulator
        prf_hz = simulator.radar.prf_hz
        self.resampler = resampler if resampler is not None else PoseResampler(prf_hz)
        rates = [("resampler", self.resampler.prf_hz)]
        rates += [("small_motions", getattr(motion, "rate_hz", prf_hz)) for motion in small_motions]
        for name, rate_hz in rates:
            if rate_hz != prf_hz:
                raise TensorsimError(
                    f"{name}: got a rate of {rate_hz:g} Hz, expected the radar's PRF of {prf_hz:g} Hz"
                )
        # Pulses on each side of a piece of motion that the filter needs to give the same values as on the whole.
        self.halo = 0 if pulse_smoother is None else pulse_smoother.window
        self.pulse_smoother = pulse_smoother if pulse_smoother is not None else nn.Identity()
        self.scatterers = check_part(JointScatterers() if scatterers is None else scatterers, "scatterers")
        self.small_motions = nn.ModuleList(small_motions)
        self.denoises = denoiser is not None
        self.denoiser = check_part(nn.Identity() if denoiser is None else denoiser, "denoiser")
        check_per_person(rcs_scale, "rcs_scale")
        self.register_buffer("rcs_scale", torch.tensor(rcs_scale, dtype=torch.float64), persistent=False)
        self.register_buffer(
            "radar_m", torch.tensor(simulator.radar.middle_m, dtype=torch.float64), persistent=False
        )
        self.reach_m = simulator.radar.reach_m
        self.unheard_m = 1.9 * self.reach_m  # from here on the receiver picks up nobody

    @classmethod
    def from_config(cls, config: SimulationConfig) -> "PoseToDoppler":
        """The stage described by a configuration, in evaluation mode, frozen.

        Raises:
            TensorsimError: denoiser weights that do not exist or belong to another network.
        """
        scene, processing, smoothing = config.scene, config.processing, config.smoothing
        prf_hz = scene.radar.prf_hz
        pulse_smoother = None
        if smoothing.smoothing_ratio is not None:
            window = round(smoothing.smoothing_ratio * prf_hz) // 2 * 2 + 1
            pulse_smoother = SavitzkyGolay(window, smoothing.polynomial_order)
        bodies: dict[str, Callable[[], nn.Module]] = {
            "joints": JointScatterers,
            "limbs": lambda: LimbScatterers(scene.radar.tx_positions_m[0], scene.radar.rx_positions_m[0]),
            "version1": Body13Scatterers,
            "surface": lambda: BodyScatterers(
                scene.radar.tx_positions_m[0],
                scene.radar.rx_positions_m[0],
                scene.radar.carrier_hz + scene.radar.bandwidth_hz / 2,
            ),
        }
        small_motions: list[nn.Module] = []
        if scene.sway:
            small_motions.append(PosturalSway(prf_hz, seed=config.seed))
        if scene.vital_signs:
            small_motions.append(VitalSigns(prf_hz, seed=config.seed))
        denoiser = map_denoiser(processing.denoiser)
        people = len(config.pose.person_weight_kg)
        stage = cls(
            RadarSimulator(scene, processing=processing, seed=config.seed),
            PoseResampler(prf_hz, method=smoothing.resampling),
            pulse_smoother,
            bodies[scene.body](),
            denoiser,
            tuple(config.pose.rcs_scale(person) for person in range(people)),
            small_motions,
        )
        return stage.eval().requires_grad_(False)

    def forward(self, joints: Tensor, valid: Tensor, fps: float) -> RadarMaps:
        """Joints (B, P, T, 14, 3) in metres and their validity (B, P, T) -> maps of B scenes.

        Raises:
            TensorsimError: wrong shapes, fewer than 2 frames, fps not positive, motion too fast for the PRF.
        """
        coefficients = self.curve(joints, valid, fps)
        pulses = self.resampler.pulses(joints.shape[2], fps)
        points, rcs = self.scene(coefficients, valid, fps, 0, pulses)
        return self.denoise(self.simulator(points, rcs))

    @torch.jit.export
    def doppler_time(self, joints: Tensor, valid: Tensor, fps: float) -> Tensor:
        """Only the Doppler-time map (B, F, K) of :meth:`forward`, for data sets; identical for the same seed."""
        coefficients = self.curve(joints, valid, fps)
        points, rcs = self.scene(coefficients, valid, fps, 0, self.resampler.pulses(joints.shape[2], fps))
        doppler_time = self.simulator.doppler_time(points, rcs)
        return self.denoiser(doppler_time) if self.denoises else doppler_time

    @torch.jit.export
    def curve(self, joints: Tensor, valid: Tensor, fps: float) -> Tensor:
        """The resampler's coefficients for joints (B, P, T, 14, 3); joints in frames that are not valid do not matter.

        Raises:
            TensorsimError: see :meth:`forward`.
        """
        check_tensor(joints, "joints", "(B, P, T, 14, 3) metres", finite=False)
        return self.resampler.coefficients(continued(joints, valid), fps)

    def scene(
        self, coefficients: Tensor, valid: Tensor, fps: float, start: int, stop: int
    ) -> tuple[Tensor, Tensor]:
        """Scatterers (B, M, S, 3) and their RCS (B, M, S) in pulses ``start`` to ``stop`` of the motion.

        People who are absent in all of these pulses have none, unless there are small motions.

        Args:
            coefficients: of :meth:`curve`, for joints (B, P, T, 14, 3).
            valid: (B, P, T) bool.
            fps: frames per second.
            start, stop: half-open range of pulses.
        """
        presence = visibility_fade(valid, fps, self.resampler.prf_hz, start, stop)
        person = torch.arange(valid.shape[1], device=valid.device)
        # Small motions are seeded per person, by order, so nobody may be dropped.
        if len(self.small_motions) == 0 and person.shape[0] > 1:
            there = (presence > 0).any(-1).any(0)
            there[:1] |= ~there.any()
            person = person[there]
            presence, coefficients = presence[:, person], coefficients[:, person]
        pulses = self.resampler.pulses(valid.shape[2], fps)
        first, last = max(0, start - self.halo), min(pulses, stop + self.halo)
        positions = self.pulse_smoother(self.resampler.evaluate(coefficients, fps, first, last))
        positions = positions[:, :, start - first : stop - first]
        for motion in self.small_motions:
            positions = motion(positions, start)
        # Scatterers scale cross sections with the square of the presence.
        scale = of_person(self.rcs_scale, person).sqrt().unsqueeze(-1)
        presence = presence * scale * self.heard(positions)
        points, rcs = self.scatterers(positions, presence)
        return points, rcs

    @torch.jit.export
    def heard(self, joints: Tensor) -> Tensor:
        """Amplitude factor (..., M) of the receiver's low-pass filter for people with joints (..., M, 14, 3) in metres.

        At twice the range of the last bin the beat frequency equals the sample rate: the echo would alias to range 0.
        Receivers filter before they sample: here the amplitude falls as a raised cosine, from 1 at 1.5 times the range
        of the last bin to 0 at 1.9 times. Echoes from there do not appear in the maps in any case.
        """
        distance = torch.linalg.vector_norm(mid_hips(joints) - self.radar_m.to(joints), dim=-1)
        filtered_m = 1.5 * self.reach_m
        beyond = ((distance - filtered_m) / (self.unheard_m - filtered_m)).clamp(0.0, 1.0)
        # Exactly 0 beyond: people who are filtered out must not affect the noise level.
        return torch.where(beyond < 1, 0.5 + 0.5 * torch.cos(math.pi * beyond), 0.0)

    def denoise(self, maps: RadarMaps) -> RadarMaps:
        """Clean the processed maps and extract the ridges again, if there is a denoiser."""
        if not self.denoises:
            return maps
        doppler_time = self.denoiser(maps.doppler_time)
        ridges = self.simulator.ridges(doppler_time)
        return RadarMaps(
            maps.range_time,
            self.denoiser(maps.range_time_mti),
            doppler_time,
            ridges.indices,
            ridges.magnitudes,
            maps.snr_db,
        )
