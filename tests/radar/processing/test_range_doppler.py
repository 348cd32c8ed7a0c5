"""Arrays: a target at a known range, speed and angle, transmitters in turn or at once, and radars without range."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig, SceneConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.presets import PRESETS
from tensorsim.radar.processing.cfar import CfarDetector, cell_averaging_factor
from tensorsim.radar.processing.doppler import RangeDopplerVideo
from tensorsim.radar.processing.range_doppler import PointDetector, RangeDopplerAngle, RangeDopplerCube
from tensorsim.radar.simulator import RadarSimulator
from tests.radar.scenes import SMALL, SceneCase, complex_noise, swinging, tensors
from tests.stage import StageTester, assert_same

HALF_M = SMALL.doppler_wavelength_m / 2
#: Two transmitters in turn, two receivers: a row of four.
ARRAY = replace(
    SMALL,
    tx_m=tuple((2 * k * HALF_M, 0.0, 1.5) for k in range(2)),
    rx_m=tuple((k * HALF_M, 0.0, 1.5) for k in range(2)),
)
TDM = replace(PRESETS["ti-awr1843-array"].radar, bandwidth_hz=1e9, sample_rate_hz=2e6)


class ChannelsCase(StageTester):
    """Profiles (..., 4, 40, 3) of the array."""

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (complex_noise(*batch, 4, 40, 3, dtype=dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        x = self.inputs((), torch.float32)[0]
        return [
            ((x.real,), "profiles: got dtype"),
            ((x[:3],), "profiles: got shape .* 4 channels"),
            ((x[:, :25],), "got 25 pulses"),
        ]


class TestRangeDopplerCube(ChannelsCase):
    def make(self) -> nn.Module:
        return RangeDopplerCube(ARRAY, overlap=0.5)


class TestRangeDopplerAngle(ChannelsCase):
    def make(self) -> nn.Module:
        return RangeDopplerAngle(ARRAY, torch.linspace(-1, 1, 5), 0.1, overlap=0.5)


class TestPointDetector(ChannelsCase):
    gradient_arguments = ()  # that of a choice of cells: PointCloud has its own test
    exports = False  # data decide which points there are

    def make(self) -> nn.Module:
        cfar = CfarDetector((0, 2), (1, 4), 0.05, edges=("reflect", "circular"))
        return PointDetector(ARRAY, overlap=0.5, points=5, nearest_m=1.0, cfar=cfar)


class TestSimulatorOfAnArray(SceneCase):
    pulses = 35

    def make(self) -> nn.Module:
        return RadarSimulator(ARRAY, snr_db=None, ridge_count=2, pulse_chunk=8)

    @pytest.mark.slow  # as for one antenna
    def test_exports(self) -> None:
        super().test_exports()

    def test_gradients_against_finite_differences(self) -> None:
        """With noise of one seed, as for one antenna: magnitudes next to zero have kinks."""
        module = RadarSimulator(ARRAY, snr_db=10.0).double()
        p, rcs = self.inputs((), torch.float64)

        def function(p: Tensor, rcs: Tensor) -> list[Tensor]:
            torch.manual_seed(0)
            return [x for x in module(p, rcs) if x.requires_grad]

        inputs = (p.requires_grad_(True), rcs.requires_grad_(True))
        assert torch.autograd.gradcheck(function, inputs, fast_mode=True, rtol=1e-3)


def moving(
    azimuth_deg: float, speed_m_s: float, pulses: int, radar: RadarConfig, range_m: float = 3.0
) -> Tensor:
    """A point (M, 1, 3) that comes nearer along its line of sight, seen from the middle of the virtual row."""
    middle = torch.tensor(radar.tx_positions_m + radar.rx_positions_m, dtype=torch.float64).mean(0)
    distance = range_m - speed_m_s * torch.arange(pulses, dtype=torch.float64) / radar.prf_hz
    angle = math.radians(azimuth_deg)
    line = torch.tensor([math.sin(angle), math.cos(angle), 0.0], dtype=torch.float64)
    return (middle + distance[:, None] * line)[:, None]


@pytest.mark.parametrize(("azimuth_deg", "speed_m_s"), [(20.0, 4.0), (-35.0, 4.0), (10.0, -4.0)])
def test_a_target_of_known_range_speed_and_angle(azimuth_deg: float, speed_m_s: float) -> None:
    """Through the whole chain: simulator, canceller, cube, CFAR, points; a row of 8 with transmitters in turn."""
    simulator = RadarSimulator(SceneConfig(TDM, snr_db=10.0))
    torch.manual_seed(0)
    p = moving(azimuth_deg, speed_m_s, 1700, TDM)
    profiles = simulator.profiles(p, torch.ones(1))
    assert profiles.shape == (8, 1700, TDM.samples_per_chirp // 2)
    channels = simulator.mti(profiles)
    found = PointDetector(TDM, points=3)(channels)
    assert bool(found.valid[:, 0].all())
    range_m = 3.0 - speed_m_s * 850 / TDM.prf_hz
    assert float(found.range_m[:, 0].mean()) == pytest.approx(range_m, abs=0.15)
    assert float(found.speed_m_s[:, 0].mean()) == pytest.approx(speed_m_s, abs=0.03)
    sine = math.sin(math.radians(azimuth_deg))
    assert found.sine[:, 0].tolist() == pytest.approx([sine] * len(found.sine), abs=0.02)

    degrees = torch.arange(-60.0, 61.0, 1.0)
    angles = RangeDopplerAngle(TDM, torch.deg2rad(degrees), overlap=0.0)(channels[:, :800])[0]
    near, doppler, direction = np.unravel_index(int(angles.argmax()), angles.shape)
    assert near * TDM.range_resolution_m == pytest.approx(3.0 - speed_m_s * 400 / TDM.prf_hz, abs=0.15)
    assert float(degrees[direction]) == pytest.approx(azimuth_deg, abs=1.0)
    # Without compensation the motion between the transmitters would be taken for a direction.
    angles = RangeDopplerAngle(TDM, torch.deg2rad(degrees), overlap=0.0)
    angles.cube.turn_cycles.zero_()
    wrong = int(angles(channels[:, :800])[0, near, doppler].argmax())
    assert abs(float(degrees[wrong]) - azimuth_deg) > 2.5


def test_the_maps_of_an_array_are_those_of_its_antennas() -> None:
    """Root mean square over the channels; Doppler-time maps add the powers of all."""
    receivers = replace(SMALL, rx_m=((0.1, 0.0, 1.5), (0.5, 0.0, 1.5), (0.1, 0.0, 0.5)))
    p, rcs = tensors(swinging(60, 3, 256.0), np.ones(3))
    whole = RadarSimulator(receivers, snr_db=None, leakage=True)(p, rcs)
    single = [
        RadarSimulator(replace(SMALL, rx_m=rx), snr_db=None, leakage=True)(p, rcs)
        for rx in receivers.rx_positions_m
    ]
    for name, scale in (("range_time", 3), ("range_time_mti", 3), ("doppler_time", 1)):
        power = sum(getattr(maps, name).square() for maps in single)
        assert_same(getattr(whole, name), (power / scale).sqrt(), atol=1e-5)


def test_stream_of_an_array_is_that_of_the_whole() -> None:
    p, rcs = tensors(swinging(90, 3, 256.0), np.ones(3))
    simulator = RadarSimulator(ARRAY, snr_db=10.0, pulse_chunk=4)
    torch.manual_seed(0)
    expected = simulator(p, rcs)
    torch.manual_seed(0)
    assert_same(simulator.stream(lambda a, b: (p[a:b], rcs), 90), expected, atol=1e-6)
    longer = RadarSimulator(ARRAY, snr_db=None, pulse_chunk=128)
    assert_same(
        simulator.recorder.engine(p[None], rcs.expand(1, 90, 3), 0, simulator.echo.displacements(p[None]))[0][
            0
        ],
        longer.profiles(p, rcs).transpose(0, 1).flatten(1),
        atol=1e-6,
    )


def test_profiles_of_one_antenna_are_those_of_the_maps() -> None:
    simulator = RadarSimulator(SMALL, snr_db=10.0)
    p, rcs = tensors(swinging(60, 3, 256.0), np.ones(3))
    torch.manual_seed(0)
    profiles = simulator.profiles(p, rcs)
    torch.manual_seed(0)
    assert_same(profiles.abs().T, simulator(p, rcs).range_time)


def test_every_antenna_has_noise_of_its_own() -> None:
    simulator = RadarSimulator(ARRAY, snr_db=0.0)
    p, rcs = tensors(swinging(400, 3, 256.0, speed_m_s=0.0), np.ones(3))
    noise = simulator.profiles(p, rcs) - RadarSimulator(ARRAY, snr_db=None).profiles(p, rcs)
    flat = noise.flatten(1)
    covariance = (flat @ flat.mH).abs() / flat.shape[1]
    power = float(covariance.diagonal().mean())
    assert covariance.diagonal().tolist() == pytest.approx([power] * 4, rel=0.1)
    assert float((covariance - torch.diag(covariance.diagonal())).max()) < 0.1 * power


def test_the_cube_has_the_power_of_the_video() -> None:
    profiles = complex_noise(40, 3)
    cube = RangeDopplerCube(SMALL, overlap=0.5)(profiles[None])
    assert_same(cube[:, 0].abs().square(), RangeDopplerVideo(SMALL, overlap=0.5)(profiles), atol=1e-5)


def test_the_detector_knows_that_cells_are_means_over_antennas() -> None:
    cfar = PointDetector(TDM).cfar
    assert cfar.factor == cell_averaging_factor(1e-5, cfar.cells, 8)


def test_a_target_does_not_mask_itself() -> None:
    """Zero padding from 13 pulses to 256 makes it 80 bins wide; none of them is a reference cell."""
    radar = RadarConfig.through_wall()
    p = moving(0.0, 1.5, 40, radar)
    profiles = RadarSimulator(radar, snr_db=None).profiles(p, torch.ones(1))
    detector = PointDetector(radar)
    power = detector.cube(profiles[None]).abs().square().mean(-3)
    above = (power / detector.cfar.threshold(power)).flatten(-2)
    at_peak = above.gather(-1, power.flatten(-2).argmax(-1, keepdim=True))
    assert float(at_peak.min()) > 50.0


def test_points_of_a_radar_without_range() -> None:
    """Continuous wave: one bin, speeds alone."""
    radar = PRESETS["cw-24ghz"].radar
    simulator = RadarSimulator(SceneConfig(radar, snr_db=20.0), range_gate_m=(0.0, 10.0))
    torch.manual_seed(0)
    profiles = simulator.mti(simulator.profiles(moving(0.0, 1.5, 1500, radar), torch.ones(1)))
    found = PointDetector(radar, points=2)(profiles[None])
    assert profiles.shape == (1499, 1)
    assert found.speed_m_s[:, 0].tolist() == pytest.approx([1.5] * len(found.valid), abs=0.06)
    assert float(found.sine.abs().max()) == 0
    assert float(found.range_m.max()) == 0


def test_refuses() -> None:
    corner = PRESETS["infineon-bgt60tr13c-array"].radar
    with pytest.raises(TensorsimError, match="expected an evenly spaced row along x"):
        PointDetector(corner)
    with pytest.raises(TensorsimError, match="azimuth_rad: got shape"):
        RangeDopplerAngle(ARRAY, torch.zeros(2, 2))
    with pytest.raises(TensorsimError, match="elevation_rad: got nan"):
        RangeDopplerAngle(ARRAY, torch.zeros(2), math.nan)
    with pytest.raises(TensorsimError, match="nearest_m: got nan"):
        PointDetector(ARRAY, nearest_m=math.nan)
    with pytest.raises(TensorsimError, match="integration: got 'coherent' with several antennas"):
        RadarSimulator(ARRAY, integration="coherent")
