"""Antenna patterns, arrays, transmitters in turn, and the maps of angles."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S as C
from tensorsim.config import FloorConfig, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.array import AngleMapper, align_transmitters
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.antenna import CosineAntenna, TabulatedAntenna, angles
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.radar import reference
from tests.radar.scenes import SMALL, SceneCase, complex_noise, swinging, tensors
from tests.stage import StageTester, assert_same

FREE = RadarConfig.free_space()
TX = ((-0.1, 0.0, 1.5), (-0.2, 0.0, 1.4))
RX = ((0.1, 0.0, 1.5), (0.15, 0.0, 1.5), (0.1, 0.0, 1.6))
ARRAY = replace(SMALL, tx_m=TX, rx_m=RX)


def f64(*values):
    return torch.tensor(values, dtype=torch.float64)


def half_wave_array(count, **options):
    """Receivers half a wavelength of the middle of the sweep apart, along +x, around x = 0."""
    base = RadarConfig(**options)
    spacing = base.doppler_wavelength_m / 2
    rx = tuple(((a - (count - 1) / 2) * spacing, 0.0, 0.0) for a in range(count))
    return replace(base, tx_m=(0.0, 0.0, 0.0), rx_m=rx)


class DirectionCase(StageTester):
    def inputs(self, batch, dtype):
        count = math.prod(batch) * 5
        generator = np.random.default_rng(4)
        d = generator.uniform([-1, 0.2, -1], [1, 2, 1], (count, 3)).reshape(*batch, 5, 3).astype(np.float32)
        return (torch.as_tensor(d, dtype=dtype),)

    def bad_inputs(self):
        return [
            ((torch.ones(4, 2),), r"direction: got shape \[4, 2\], expected \(\.\.\., 3\)"),
            ((torch.ones(4, 3, dtype=torch.int64),), "direction: got dtype"),
        ]


class TestCosineAntenna(DirectionCase):
    def make(self):
        return CosineAntenna(exponent=3.0)


class TestTabulatedAntenna(DirectionCase):
    def make(self):
        azimuth, elevation = torch.linspace(-1.5, 1.5, 7), torch.linspace(-1.2, 1.2, 5)
        table = -5 * (elevation[:, None] ** 2 + azimuth**2) + azimuth
        return TabulatedAntenna(azimuth, elevation, table)


class ArrayCase(SceneCase):
    pulses = 5


class TestEchoOfAnArray(ArrayCase):
    def make(self):
        return EchoSynthesizer(ARRAY, leakage=True, pulse_chunk=4)


class TestEchoOfEverything(ArrayCase):
    def make(self):
        return EchoSynthesizer(
            ARRAY,
            WallConfig((0, 2.5, 1.5)),
            True,
            True,
            True,
            pulse_chunk=16,
            incidence="oblique",
            floor=FloorConfig(),
            antenna=CosineAntenna(beamwidth_rad=1.4),
        )


class TestAngleMapper(StageTester):
    def make(self):
        return AngleMapper(half_wave_array(4), torch.linspace(-1, 1, 9))

    def inputs(self, batch, dtype):
        return (complex_noise(*batch, 4, 3, 5, dtype=dtype),)

    def test_float32_near_float64(self):
        x = self.inputs((2,), torch.float64)[0]
        assert_same(self.make()(x.to(torch.complex64)), self.make()(x), atol=1e-5)

    def bad_inputs(self):
        x = self.inputs((), torch.float32)[0]
        return [
            ((x.real,), "profiles: got dtype"),
            ((x[0],), "profiles: got shape"),
            ((x[:3],), "4 channels"),
            ((x[:, :0],), "profiles: got an empty tensor"),
        ]


def test_angles_of_directions():
    azimuth, elevation = angles(f64([1.0, 1.0, 0.0], [0.0, 2.0, 2.0], [-1.0, 0.0, 0.0]))
    torch.testing.assert_close(azimuth, f64(math.pi / 4, 0.0, -math.pi / 2))
    torch.testing.assert_close(elevation, f64(0.0, math.pi / 4, 0.0))


def test_cosine_pattern_at_its_half_power_angle_and_behind():
    antenna = CosineAntenna(beamwidth_rad=math.radians(60))
    half = math.radians(30)
    for direction in ((math.sin(half), math.cos(half), 0.0), (0.0, 5 * math.cos(half), -5 * math.sin(half))):
        assert float(antenna(f64(*direction))) ** 2 == pytest.approx(0.5, rel=1e-12)
    assert float(antenna(f64(0.0, 3.0, 0.0))) == pytest.approx(1.0)
    assert float(antenna(f64(0.1, -3.0, 0.0))) == 0.0
    narrow = CosineAntenna(beamwidth_rad=1e-9)  # cos(a)^q = exp(-q a^2 / 2) near the axis
    assert narrow.exponent == pytest.approx(2 * math.log(2) / 0.5e-9**2, rel=1e-12)


def test_table_is_bilinear_in_decibels_and_holds_its_edge():
    from scipy.interpolate import RegularGridInterpolator

    rng = np.random.default_rng(0)
    azimuth, elevation = np.sort(rng.uniform(-1.5, 1.5, 6)), np.sort(rng.uniform(-1.0, 1.0, 4))
    table = rng.uniform(-30, 0, (4, 6))
    antenna = TabulatedAntenna(torch.as_tensor(azimuth), torch.as_tensor(elevation), torch.as_tensor(table))
    a, e = rng.uniform(-2, 2, 200), rng.uniform(-1.4, 1.4, 200)
    direction = np.stack((np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)), -1)
    inside = np.stack((e.clip(elevation[0], elevation[-1]), a.clip(azimuth[0], azimuth[-1])), -1)
    expected = 10 ** (RegularGridInterpolator((elevation, azimuth), table)(inside) / 20)
    np.testing.assert_allclose(antenna(torch.as_tensor(direction)), expected, rtol=1e-9)


def test_pattern_weighs_both_legs_at_their_own_angles():
    antenna = CosineAntenna(exponent=2.0)
    p = f64([[1.0, 2.0, 0.5]])
    ratio = EchoSynthesizer(FREE, antenna=antenna).double()(p, f64(1.0)) / EchoSynthesizer(FREE).double()(
        p, f64(1.0)
    )
    legs = [p[0, 0].numpy() - np.array(a) for a in (FREE.tx_m, FREE.rx_m)]
    expected = math.prod(leg[1] / np.linalg.norm(leg) for leg in legs)
    np.testing.assert_allclose(ratio, np.full((1, 400), expected), rtol=1e-9)


def test_image_legs_leave_the_antenna_as_they_are_seen_in_the_mirror():
    """The image in a wall ahead radiates forwards from the antenna itself; the floor is seen downwards."""
    table = TabulatedAntenna(f64(-3.0, 3.0), f64(-0.01, 0.01), f64([-20.0, -20.0], [0.0, 0.0]))  # looks up
    radar = RadarConfig.through_wall(tx_m=(0, 0, 1.5), rx_m=(0, 0, 1.5))
    point, one = f64([0.0, 3.0, 1.6]), f64(1.0)
    options = {"wall": WallConfig((0, 5.12, 1.5)), "multipath": True, "floor": FloorConfig()}
    shaped = EchoSynthesizer(radar, antenna=table, **options).double().paths(point, one).gain[0].abs()
    plain = EchoSynthesizer(radar, **options).double().paths(point, one).gain[0].abs()
    decibels = 20 * torch.log10(shaped / plain)
    torch.testing.assert_close(decibels, f64(0, 0, 0, 0, -20, -20, -40), rtol=0, atol=1e-9)


@pytest.mark.parametrize("wall", [None, WallConfig((0, 2.5, 1.5))])
def test_an_array_is_its_pairs_one_by_one(wall):
    p, rcs = tensors(swinging(5, 3, 256.0), np.ones(3))
    options = {"wall": wall, "multipath": True, "leakage": True, "wall_echo": True}
    still = p[:1]  # one pulse: nothing moves between transmitters
    channels = EchoSynthesizer(ARRAY, **options).double()(still, rcs)
    assert channels.shape == (6, 1, 24)
    for k, tx in enumerate(TX):
        for a, rx in enumerate(RX):
            single = EchoSynthesizer(replace(SMALL, tx_m=tx, rx_m=rx), **options).double()(still, rcs)
            assert_same(channels[k * 3 + a], single, atol=1e-12)


def test_transmitters_fire_in_turn():
    p, rcs = tensors(swinging(6, 2, 256.0), np.ones(2))
    channels = EchoSynthesizer(ARRAY, pulse_chunk=4).double()(p, rcs)
    later = p.clone()
    later[:-1] = (p[:-1] + p[1:]) / 2  # half a pulse interval on
    later[-1] = p[-1] + (p[-1] - p[-2]) / 2
    for k, (tx, seen) in enumerate(zip(TX, (p, later), strict=True)):
        single = EchoSynthesizer(replace(SMALL, tx_m=tx, rx_m=RX[1])).double()(seen, rcs)
        assert_same(channels[k * 3 + 1], single, atol=1e-12)
    assert (
        reference.relative(
            channels[4], EchoSynthesizer(replace(SMALL, tx_m=TX[1], rx_m=RX[1])).double()(p, rcs)
        )
        > 0.01
    )


def two_by_four(**options):
    """Two transmitters two wavelengths apart, four receivers: a virtual row of eight around x = 0."""
    four = half_wave_array(4, **options)
    return replace(four, tx_m=tuple((k * four.doppler_wavelength_m, 0.0, 0.0) for k in (-0.5, 0.5)))


def test_aligned_transmitters_fire_at_once():
    radar = two_by_four(prf_hz=512.0, bandwidth_hz=0.2e9, sample_rate_hz=1e6)
    t = torch.arange(256).double() / radar.prf_hz
    p = torch.stack((0.3 - 0.1 * t, 4.0 - 0.3 * t, 0.2 * t), -1)[:, None]
    profile, rcs = RangeProfile(radar).double(), f64(1.0)
    channels = profile(EchoSynthesizer(radar).double()(p, rcs))
    at_once = [
        profile(EchoSynthesizer(replace(radar, tx_m=tx, rx_m=radar.rx_m)).double()(p, rcs))
        for tx in radar.tx_positions_m
    ]
    inside = slice(40, -40)
    expected = torch.cat(at_once)[:, inside]
    aligned = align_transmitters(channels, 2)
    assert_same(align_transmitters(channels[:4], 1), channels[:4], atol=1e-12)
    assert reference.relative(aligned[:, inside], expected) < 0.01
    assert reference.relative(channels[:, inside], expected) > 0.3


@pytest.mark.parametrize("speed", [-0.8, 0.8])
def test_a_mover_stays_at_its_azimuth(speed):
    """Unaligned, who approaches on the right seems to be farther to the right, and who leaves farther to the left."""
    radar = two_by_four(prf_hz=2048.0, bandwidth_hz=0.5e9, sample_rate_hz=1e6)
    t = torch.arange(200).double() / radar.prf_hz
    away, degrees = math.radians(15.0), torch.arange(-40.0, 40.25, 0.5)
    distance = 4.0 - speed * t
    p = torch.stack((distance * math.sin(away), distance * math.cos(away), 0 * t), -1)[:, None]
    channels = RangeProfile(radar).double()(EchoSynthesizer(radar).double()(p, f64(1.0)))
    mapper = AngleMapper(radar, torch.deg2rad(degrees))
    assert torch.equal(mapper.azimuth_rad, torch.deg2rad(degrees).double())
    seen = [
        degrees[mapper(x).range_angle.amax(0).argmax()] for x in (channels, align_transmitters(channels, 2))
    ]
    assert float(seen[1]) == pytest.approx(15.0, abs=0.5)
    assert (float(seen[0]) - 15.0) / speed > 1.0


def test_gradient_of_the_alignment():
    x = complex_noise(4, 5, 2, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: align_transmitters(x, 2), (x,), fast_mode=True)
    scripted = torch.jit.script(align_transmitters)
    assert_same(scripted(x.detach(), 2), align_transmitters(x.detach(), 2))
    assert_same(align_transmitters(x[None].detach(), 2)[0], align_transmitters(x.detach(), 2), atol=1e-12)


def test_one_position_in_a_list_is_a_channel():
    p, rcs = tensors(swinging(3, 2, 256.0), np.ones(2))
    single = EchoSynthesizer(SMALL)(p, rcs)
    assert_same(EchoSynthesizer(replace(SMALL, rx_m=(SMALL.rx_m,)))(p, rcs), single[None])
    assert replace(SMALL, rx_m=np.array(RX)).rx_m == RX
    assert replace(SMALL, rx_m=torch.tensor(RX, dtype=torch.float64)).rx_positions_m == RX
    assert SMALL.rx_positions_m == (SMALL.rx_m,)


def test_leakage_of_an_array_has_the_distance_of_each_pair():
    truth = EchoSynthesizer(ARRAY, leakage=True).paths.static()
    expected = [math.dist(t, r) / C for t in TX for r in RX]
    np.testing.assert_allclose(truth.delay_s.flatten(), expected, rtol=1e-12)


def test_side_channels_and_contributions_of_an_array():
    p, rcs = tensors(swinging(5, 3, 256.0), np.ones(3))
    module = EchoSynthesizer(ARRAY).double()
    assert module.side_channels(p, rcs).range_m.shape == (6, 5, 3, 1)
    parts = module.contributions(torch.stack((p, p)), rcs, torch.tensor([0, 1, 0]))
    assert parts.shape == (2, 2, 1, 6, 5, 24)
    assert_same(parts.sum((1, 2))[1], module(p, rcs), atol=1e-12)


def test_chirps_of_all_transmitters_have_to_fit():
    with pytest.raises(TensorsimError, match="4 chirps of 4e-05 s do not fit the pulse interval"):
        RadarConfig(tx_m=((0.0, 0.0, 0.0),) * 4)
    with pytest.raises(TensorsimError, match="rx_m"):
        RadarConfig(rx_m=((0.0, 0.0), (0.0, 1.0)))


@pytest.mark.parametrize("degrees", [-40.0, 0.0, 25.0])
def test_target_at_a_known_azimuth(degrees):
    """Positive is to the right, +x."""
    radar = half_wave_array(16)
    angle, distance = math.radians(degrees), 5.0
    p = f64([[distance * math.sin(angle), distance * math.cos(angle), 0.0]]).expand(3, 1, 3)
    profiles = RangeProfile(radar)(EchoSynthesizer(radar)(p, f64(1.0)))
    azimuth = torch.deg2rad(torch.arange(-60.0, 60.5, 1.0))
    maps = AngleMapper(radar, azimuth)(profiles)
    assert maps.range_angle.shape == (200, 121)
    assert maps.azimuth_time.shape == (121, 3)
    bin_, column = divmod(int(maps.range_angle.argmax()), 121)
    assert bin_ == round(distance / radar.range_resolution_m)
    assert abs(column - 60 - degrees) <= 1
    assert (maps.azimuth_time.argmax(0) - 60 - degrees).abs().max() <= 1
    peak = float(profiles[:, 0, bin_].abs().mean())
    assert float(maps.range_angle.max()) == pytest.approx(peak, rel=0.02)  # the echo of one channel


def test_angle_maps_equal_the_beamformer_written_out():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6, 4, 5)) + 1j * rng.normal(size=(6, 4, 5))
    azimuth = np.linspace(-1, 1, 7)
    # Two receivers stand before and behind the others.
    receivers = ((0.1, 0.0, 1.5), (0.15, 0.02, 1.5), (0.1, -0.01, 1.6))
    maps = AngleMapper(replace(ARRAY, rx_m=receivers), torch.as_tensor(azimuth), 0.2)(torch.as_tensor(x))
    wavelength = C / (ARRAY.carrier_hz + ARRAY.bandwidth_hz / 2)
    beams = np.zeros((7, 4, 5), dtype=complex)
    for d, a in enumerate(azimuth):
        u = np.array([np.sin(a) * np.cos(0.2), np.cos(a) * np.cos(0.2), np.sin(0.2)])
        for k, tx in enumerate(TX):
            for r, rx in enumerate(receivers):
                phase = 2 * np.pi * u @ (np.array(tx) + np.array(rx)) / wavelength
                beams[d] += np.exp(1j * phase) * x[k * 3 + r] / 6
    np.testing.assert_allclose(maps.range_angle.T, np.sqrt((np.abs(beams) ** 2).mean(1)), rtol=1e-9)
    np.testing.assert_allclose(maps.azimuth_time, np.sqrt((np.abs(beams) ** 2).sum(2)), rtol=1e-9)


def test_a_uniform_array_is_a_fourier_transform():
    radar = half_wave_array(8)
    x = torch.randn(8, 1, 1, dtype=torch.complex128)
    sines = np.fft.fftshift(np.fft.fftfreq(8)) * 2
    maps = AngleMapper(radar, torch.as_tensor(np.arcsin(sines)))(x)
    # The nearer element sees less phase: beat phase falls along x for a target on the right.
    expected = np.abs(np.fft.fftshift(np.fft.ifft(x[:, 0, 0].numpy())))
    np.testing.assert_allclose(maps.range_angle[0], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CosineAntenna(), "expected one of them"),
        (lambda: CosineAntenna(2.0, 1.0), "expected one of them"),
        (lambda: CosineAntenna(-1.0), "exponent: got -1"),
        (lambda: CosineAntenna(beamwidth_rad=4.0), "beamwidth_rad: got 4"),
        (lambda: TabulatedAntenna(f64(0.0, 0.0), f64(0.0, 1.0), torch.zeros(2, 2)), "azimuth_rad: got"),
        (lambda: TabulatedAntenna(f64(0.0, 1.0), f64(0.0, 1.0), torch.zeros(2, 3)), "gain_db: got shape"),
        (
            lambda: TabulatedAntenna(f64(0.0, 1.0), f64(0.0, 1.0), torch.full((2, 2), math.nan)),
            "gain_db: got NaN",
        ),
        (lambda: AngleMapper(FREE, f64(0.0)), "one transmitter and one receiver"),
        (lambda: AngleMapper(ARRAY, f64(math.nan)), "azimuth_rad: got"),
        (lambda: align_transmitters(complex_noise(5, 3, 2), 2), "got 5 channels for 2 transmitters"),
        (lambda: align_transmitters(torch.ones(4, 3, 2), 2), "profiles: got dtype"),
        (lambda: AngleMapper(ARRAY, f64(0.0), math.inf), "elevation_rad: got inf"),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(TensorsimError, match=message):
        make()


def test_the_wall_echo_leaves_and_arrives_at_its_own_angles():
    """Antennas of unequal height before a wall: each pattern counts at the angle of its own leg of the mirror path."""
    tx, rx, face = (0.0, 0.0, 1.0), (0.5, 0.0, 3.0), 2.0
    radar = replace(SMALL, tx_m=tx, rx_m=rx)
    azimuth, elevation = (torch.linspace(-1.5, 1.5, 61, dtype=torch.float64) for _ in range(2))

    def gain_db(azimuth, elevation):
        return -20 * (azimuth - 0.3) ** 2 - 30 * (elevation - 0.2) ** 2

    pattern = TabulatedAntenna(azimuth, elevation, gain_db(azimuth[None], elevation[:, None]))
    wall = WallConfig((0.0, face + 0.12, 1.5))
    bare, seen = (
        EchoSynthesizer(radar, wall, wall_echo=True, direct=False, antenna=antenna).paths.static().gain.abs()
        for antenna in (None, pattern)
    )
    # The specular point is halfway between the antennas.
    point = np.array([0.25, face, 2.0])
    decibels = 0.0
    for place in (tx, rx):
        x, y, z = point - np.array(place)
        decibels += gain_db(np.arctan2(x, y), np.arctan2(z, np.hypot(x, y)))
    assert float(20 * torch.log10(seen / bare)) == pytest.approx(decibels, abs=0.1)
