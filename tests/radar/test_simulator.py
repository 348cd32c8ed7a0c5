"""The chain whole: equal to its stages, to the definition, and to itself in pieces."""

import math
import warnings
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch

from tensorsim.config import FloorConfig, RadarConfig, ReceiverConfig, SceneConfig, WallConfig
from tensorsim.config.processing import Mti
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.radar import AngleMapper, BulkDopplerCompensation, Interference, PhaseNoise
from tensorsim.radar.processing.ambiguity import check_unambiguous, gate_around
from tensorsim.radar.processing.columns import block_rms
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.range_profile import FollowingGate, RangeProfile
from tensorsim.radar.processing.ridges import RidgeExtractor
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.recognition import ActivityRecognizer
from tests.radar import reference
from tests.radar.scenes import SMALL, SceneCase, joint_rcs, recorded_walk, swinging, tensors
from tests.stage import assert_same

FREE = RadarConfig.free_space()
THROUGH = RadarConfig.through_wall()
SCENES = {"free space": (FREE, None), "through wall": (THROUGH, WallConfig())}


class TestRadarSimulator(SceneCase):
    pulses = 35

    def make(self):
        wall = WallConfig(center_m=(0.0, 3.0, 1.5))
        return RadarSimulator(
            SMALL,
            wall,
            multipath=True,
            leakage=True,
            wall_echo=True,
            snr_db=None,
            ridge_count=2,
            pulse_chunk=8,
        )

    def bad_inputs(self):
        p, rcs = self.inputs((), torch.float32)
        return [*super().bad_inputs(), ((p[:26], rcs), "got 26 pulses, expected at least 27")]

    @pytest.mark.slow  # the graph of all paths is large; those of the stages are exported in their own tests
    def test_exports(self):
        super().test_exports()

    def test_gradients_against_finite_differences(self):
        """With noise of one seed: a magnitude map without a noise floor has kinks, where it is next to zero."""
        module = RadarSimulator(SMALL, WallConfig((0.0, 3.0, 1.5)), multipath=True, snr_db=10.0).double()
        p, rcs = self.inputs((), torch.float64)

        def function(p, rcs):
            torch.manual_seed(0)
            return [x for x in module(p, rcs) if x.requires_grad]

        inputs = (p.requires_grad_(True), rcs.requires_grad_(True))
        assert len(function(*inputs)) == 5  # all but the ridge bins
        assert torch.autograd.gradcheck(function, inputs, fast_mode=True, rtol=1e-3)


class TestSimulatorInFreeSpace(TestRadarSimulator):
    def make(self):
        return RadarSimulator(SMALL, snr_db=None, mti="mean", integration="paper", display_rate_hz=50.0)

    def bad_inputs(self):
        return SceneCase.bad_inputs(self)


@pytest.mark.parametrize("scene", SCENES)
def test_maps_equal_the_definition(scene):
    radar, wall = SCENES[scene]
    check_against_definition(
        radar, wall, swinging(1100 if wall is None else 200, 5, radar.prf_hz), np.ones(5)
    )


@pytest.mark.parametrize("scene", SCENES)
def test_maps_equal_the_definition_on_recorded_motion(scene, shared_data):
    radar, wall = SCENES[scene]
    walk = recorded_walk(shared_data, radar.prf_hz, 0.12 if wall is None else 2.5)
    check_against_definition(radar, wall, walk, joint_rcs())


def check_against_definition(radar, wall, p, rcs):
    expected = reference.profiles(reference.echo(radar, p, rcs, wall, multipath=wall is not None))
    moving = reference.two_pulse(expected)
    maps = RadarSimulator(radar, wall, multipath=True, snr_db=None)(*tensors(p, rcs))
    assert maps.range_time.dtype == torch.float32
    assert reference.relative(maps.range_time, np.abs(expected).T) < 1e-5
    assert reference.relative(maps.range_time_mti, np.abs(moving).T) < 1e-5
    assert reference.relative(maps.doppler_time, reference.doppler_time(moving, radar.prf_hz)[0]) < 1e-5
    assert torch.isposinf(maps.snr_db)


def test_simulator_equals_its_stages():
    simulator = RadarSimulator(THROUGH, WallConfig(), leakage=True, snr_db=None)
    p, rcs = tensors(swinging(100, 4, 128.0), np.ones(4))
    profiles = simulator.range_profile(simulator.echo(p, rcs))
    moving = simulator.mti(profiles)
    doppler_time = simulator.doppler(moving)
    ridges = simulator.ridges(doppler_time)
    maps = simulator(p, rcs)
    expected = (profiles.T.abs(), moving.T.abs(), doppler_time, ridges.indices, ridges.magnitudes)
    assert_same(maps[:5], expected, atol=1e-6)


@pytest.mark.parametrize("reference_name", ["echo", "total", "absolute"])
def test_noise_has_the_power_of_its_reference(reference_name):
    """White noise of variance v has v sum(w^2) in every bin, and twice that after the canceller."""
    p, rcs = tensors(swinging(1000, 4, 128.0, speed_m_s=0.0), np.ones(4))
    simulator = RadarSimulator(
        THROUGH, leakage=True, snr_db=10.0, noise_reference=reference_name, transmit_power_w=1e-9
    )
    maps = simulator(p, rcs)
    echo, total = (
        float(EchoSynthesizer(THROUGH, leakage=on)(p, rcs).abs().square().mean()) for on in (False, True)
    )
    assert total > 100 * echo
    thermal = 1.380649e-23 * 290 * 10e6 * 10 / 1e-9
    variance = {"echo": echo / 10, "total": total / 10, "absolute": thermal}[reference_name]
    far = maps.range_time_mti[150:].square().mean()  # beyond 20 m there is nothing but noise
    assert float(far) == pytest.approx(2 * variance * (np.hamming(400) ** 2).sum(), rel=0.03)
    signal = total if reference_name == "total" else echo
    assert float(maps.snr_db) == pytest.approx(10 * math.log10(signal / variance), abs=0.1)


def test_noise_is_set_per_clip():
    near, far = swinging(200, 3, 128.0, distance_m=2.0), swinging(200, 3, 128.0, distance_m=6.0)
    p, rcs = tensors(np.stack((near, far)), np.ones(3))
    maps = RadarSimulator(THROUGH, snr_db=10.0)(p, rcs)
    assert maps.snr_db.tolist() == pytest.approx([10.0, 10.0], abs=0.1)
    floor = maps.range_time[:, 150:].square().mean((1, 2))  # beyond 20 m there is nothing but noise
    assert float(floor[0] / floor[1]) > 5


def test_seed_repeats_and_scripted_draws_the_same():
    simulator = RadarSimulator(SMALL, pulse_chunk=16, snr_db=10.0)
    p, rcs = tensors(swinging(50, 3, 256.0), np.ones(3))
    results = []
    for module in (simulator, simulator, torch.jit.script(simulator)):
        torch.manual_seed(11)
        results.append(module(p, rcs))
    assert_same(results[1], results[0])
    assert_same(results[2], results[0], atol=1e-6)
    assert not torch.equal(simulator(p, rcs).doppler_time, results[0].doppler_time)


def test_empty_scene_has_a_noise_floor():
    empty = torch.zeros(2, 200, 0, 3)
    maps = RadarSimulator(THROUGH, range_window=None, snr_db=20.0)(empty, torch.zeros(2, 0))
    nominal = EchoSynthesizer(RadarConfig.through_wall(tx_m=(0, 0, 0), rx_m=(0, 0, 0)))
    echo = nominal(torch.tensor([[[0.0, 3.0, 0.0]]]), torch.ones(1)).abs().square().mean()
    assert float(maps.range_time.square().mean() / 400) == pytest.approx(float(echo) / 100, rel=0.02)
    assert torch.isneginf(maps.snr_db).all()
    quiet = RadarSimulator(THROUGH, snr_db=None, leakage=True)(empty, torch.zeros(2, 0))
    assert float(quiet.range_time.max()) > 1
    assert float(quiet.range_time_mti.max()) == 0


@pytest.mark.parametrize("pulses", [27, 127, 129, 500])
@pytest.mark.parametrize("display_rate_hz", [None, 50.0])
def test_stream_equals_forward(pulses, display_rate_hz):
    simulator = RadarSimulator(SMALL, snr_db=10.0, pulse_chunk=8, display_rate_hz=display_rate_hz)
    p, rcs = tensors(swinging(pulses, 3, 256.0), np.ones(3))
    torch.manual_seed(2)
    expected = simulator(p, rcs)
    torch.manual_seed(2)
    asked = []

    def source(start, stop):
        asked.append((start, stop))
        return p[start:stop], rcs

    assert_same(simulator.stream(source, pulses), expected, atol=1e-6)
    assert asked[: len(asked) // 2] == asked[len(asked) // 2 :]
    assert asked[len(asked) // 2 - 1][1] == pulses


def test_stream_takes_the_rcs_per_pulse_and_refuses_bad_pieces():
    simulator = RadarSimulator(SMALL, snr_db=None, pulse_chunk=4)
    p, rcs = tensors(swinging(90, 3, 256.0), np.random.default_rng(0).uniform(0, 1, (90, 3)))
    assert_same(simulator.stream(lambda a, b: (p[a:b], rcs[a:b]), 90), simulator(p, rcs), atol=1e-6)
    with pytest.raises(TensorsimError, match=r"source\(0, 32\): got positions of shape \[31, 3, 3\]"):
        simulator.stream(lambda a, b: (p[a : b - 1], rcs[a : b - 1]), 90)
    with pytest.raises(TensorsimError, match="got 20 pulses"):
        simulator.stream(lambda a, b: (p[a:b], rcs[a:b]), 20)
    with pytest.raises(TensorsimError, match="got mti 'mean'"):
        RadarSimulator(SMALL, mti="mean").stream(lambda a, b: (p[a:b], rcs[a:b]), 90)


@pytest.mark.parametrize(
    "options",
    [
        {"engine": "range-bins"},
        {"mti": MovingTargetIndicator("n-pulse", pulses=12)},
        {"mti": MovingTargetIndicator("high-pass", SMALL)},
        {"range_gate_m": (1.0, 2.0)},
        {"range_gate_m": 0.8, "engine": "range-bins", "near_bins": 3},
    ],
)
@pytest.mark.filterwarnings("ignore:positions. some scatterer leaves the range gate")
def test_pieces_and_the_doppler_map_alone_equal_forward(options):
    p, rcs = tensors(np.stack([swinging(300, 3, 256.0, seed=i) for i in (0, 1)]), np.ones(3))
    module = RadarSimulator(SMALL, snr_db=10.0, pulse_chunk=8, **options)
    torch.manual_seed(3)
    expected = module(p, rcs)
    for alone in (module, torch.jit.script(module)):
        torch.manual_seed(3)
        assert_same(alone.doppler_time(p, rcs), expected.doppler_time, atol=1e-6)
    if not module.mti.whole_clip:
        torch.manual_seed(3)
        streamed = module.stream(lambda a, b: (p[0, a:b], rcs), 300)
        torch.manual_seed(3)
        assert_same(streamed, module(p[0], rcs), atol=1e-6)


@pytest.mark.parametrize("method", get_args(Mti))
def test_every_moving_target_indicator_by_name(method):
    p, rcs = tensors(swinging(60, 3, 256.0), np.ones(3))
    ready = RadarSimulator(SMALL, snr_db=None, mti=MovingTargetIndicator(method, SMALL))
    assert_same(RadarSimulator(SMALL, snr_db=None, mti=method)(p, rcs), ready(p, rcs))


@pytest.mark.parametrize("transmitters", [1, 2])
def test_profiles_need_no_doppler_window(transmitters):
    radar = replace(SMALL, tx_m=tuple((0.1 * k, 0.0, 1.5) for k in range(transmitters)))
    p, rcs = tensors(swinging(60, 3, 256.0), np.ones(3))
    simulator = RadarSimulator(radar, snr_db=None)
    expected = simulator.profiles(p, rcs)
    for pulses in (1, 5):
        found = simulator.profiles(p[:pulses], rcs)
        assert found.shape == (*expected.shape[:-2], pulses, expected.shape[-1])
        assert_same(found[..., : pulses - 1, :], expected[..., : pulses - 1, :], atol=1e-6)
    with pytest.raises(TensorsimError, match="got 5 pulses, expected at least 27"):
        simulator.doppler_time(p[:5], rcs)


def test_ready_stages_take_the_place_of_their_settings():
    echo = EchoSynthesizer(SMALL, leakage=True)
    doppler, ridges = DopplerTimeMap(SMALL, overlap=0.5, integration="paper"), RidgeExtractor(1)
    ready = RadarSimulator(
        SMALL, snr_db=None, echo=echo, doppler=doppler, ridges=ridges, mti=MovingTargetIndicator()
    )
    named = {"leakage": True, "overlap": 0.5, "integration": "paper", "ridge_count": 1}
    p, rcs = tensors(swinging(60, 3, 256.0), np.ones(3))
    assert_same(ready(p, rcs), RadarSimulator(SMALL, snr_db=None, **named)(p, rcs))


@pytest.mark.parametrize(
    ("stage", "message"),
    [
        ({"mti": torch.nn.Identity()}, "mti: got a Identity, expected an instance of MovingTargetIndicator"),
        ({"mti": 3}, "mti: got a int"),
        ({"echo": RidgeExtractor()}, "echo: got a RidgeExtractor, expected an instance of EchoSynthesizer"),
        ({"ridges": RidgeExtractor}, "ridges: got the class RidgeExtractor"),
        ({"doppler": 0}, "doppler: got a int"),
    ],
)
def test_ready_stages_of_another_kind_are_refused(stage, message):
    with pytest.raises(TensorsimError, match=message):
        RadarSimulator(SMALL, **stage)


SCENE = SceneConfig(SMALL)


@pytest.mark.parametrize(
    "make",
    [
        lambda: EchoSynthesizer(SCENE),
        lambda: RangeProfile(SCENE),
        lambda: FollowingGate(SCENE, torch.arange(12.0), 0.8),
        lambda: MovingTargetIndicator("high-pass", SCENE),
        lambda: DopplerTimeMap(SCENE),
        lambda: AngleMapper(SCENE, torch.zeros(2)),
        lambda: PhaseNoise(SCENE),
        lambda: Interference(SCENE, SMALL),
        lambda: BulkDopplerCompensation(SCENE),
        lambda: ActivityRecognizer(SCENE, torch.nn.Identity()),
    ],
)
def test_a_scene_such_as_a_preset_is_no_radar(make):
    with pytest.raises(TensorsimError, match="radar: got a SceneConfig, expected an instance of RadarConfig"):
        make()


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"wall": FloorConfig()}, "wall: got a FloorConfig, expected an instance of WallConfig"),
        ({"floor": True}, "floor: got a bool, expected an instance of FloorConfig"),
        ({"antenna": "cosine"}, "antenna: got a str, expected an instance of Module"),
    ],
)
def test_parts_of_a_scene_of_another_kind_are_refused(part, message):
    with pytest.raises(TensorsimError, match=message):
        EchoSynthesizer(SMALL, **part)


def test_positions_that_are_no_tensor_are_refused():
    with pytest.raises(TensorsimError, match="positions: got list, expected a tensor"):
        RadarSimulator(SMALL)([[0.0, 3.0, 1.0]], torch.ones(1))


def test_scene_is_that_of_the_echo_synthesizer():
    p, rcs = tensors(swinging(60, 3, 256.0), np.ones(3))
    scene = {"floor": FloorConfig(), "direct": False}
    ready = RadarSimulator(SMALL, snr_db=None, echo=EchoSynthesizer(SMALL, **scene))
    assert_same(RadarSimulator(SMALL, snr_db=None, **scene)(p, rcs), ready(p, rcs))
    with pytest.raises(TensorsimError, match="echo: got a ready-made one and direct, wall, expected"):
        RadarSimulator(SMALL, WallConfig(), echo=EchoSynthesizer(SMALL), direct=False)


@pytest.mark.filterwarnings("ignore:positions. some scatterer leaves the range gate")
def test_fixed_gate_is_a_cut_through_the_maps():
    p, rcs = tensors(swinging(1000, 3, FREE.prf_hz), np.ones(3))
    whole, gated = (
        RadarSimulator(FREE, snr_db=None),
        RadarSimulator(FREE, snr_db=None, range_gate_m=(2.5, 3.0)),
    )
    chosen = (whole.range_profile.range_m >= 2.5) & (whole.range_profile.range_m <= 3.0)
    assert torch.equal(gated.range_profile.range_m, whole.range_profile.range_m[chosen])
    expected, maps = whole(p, rcs), gated(p, rcs)
    assert_same(maps[:2], (expected.range_time[chosen], expected.range_time_mti[chosen]))
    profiles = whole.mti(whole.range_profile(whole.echo(p, rcs)))[:, chosen]
    assert_same(maps.doppler_time, whole.doppler(profiles), atol=1e-5)
    for gate in ((3.0, 3.01), (9.0, 10.0), (3.0, 2.0), (0.0, math.nan)):
        with pytest.raises(TensorsimError, match="gate_m: got"):
            RadarSimulator(FREE, range_gate_m=gate)
    with pytest.raises(TensorsimError, match="range_gate_m: got 0"):
        RadarSimulator(FREE, range_gate_m=0)


def test_following_gate_follows():
    """Two bodies, the second of little weight and 3 m behind: its bins go, those of the first stay, both moving."""
    p = np.concatenate([swinging(3000, 3, FREE.prf_hz, d, -2.0, seed=i) for i, d in ((0, 3.0), (1, 6.0))], 1)
    p, rcs = tensors(p, [1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])
    simulator = RadarSimulator(FREE, snr_db=None, range_gate_m=1.5)
    maps, whole = simulator(p, rcs), RadarSimulator(FREE, snr_db=None)(p, rcs)
    assert_same(maps.range_time, whole.range_time)
    distance = 0.5 * sum(
        np.linalg.norm(p.numpy() - np.array(antenna), axis=-1) for antenna in (FREE.tx_m, FREE.rx_m)
    )
    center = (distance * rcs.numpy()).sum(1) / rcs.numpy().sum()
    keep = np.abs(simulator.range_profile.range_m.numpy()[:, None] - center[1:]) <= 0.75
    assert np.array_equal(maps.range_time_mti.numpy(), np.where(keep, whole.range_time_mti.numpy(), 0))
    assert abs(center[-1] - center[0]) > 0.3  # else nothing was followed
    nobody = simulator(p, torch.zeros(6, dtype=torch.float64))
    assert float(nobody.range_time_mti.abs().max()) == 0


def test_pulses_without_anybody_are_not_gated():
    """The gate is limited while a person is there; before and after, all bins are kept."""
    gate = FollowingGate(SMALL, 0.375 * torch.arange(12), 0.8)
    profiles = torch.ones(3, 12, dtype=torch.complex64)
    positions = torch.tensor([0.0, 2.0, 1.5]).expand(3, 2, 3)
    rcs = torch.tensor([[0.0, 0.0], [1.0, 0.5], [0.0, 0.0]])
    kept = gate(profiles, positions, rcs).real
    assert kept[0].tolist() == kept[2].tolist() == [1.0] * 12
    assert torch.nonzero(kept[1])[:, 0].tolist() == [5, 6]  # 1.88 and 2.25 m


def test_block_rms():
    x = torch.rand(2, 3, 11, dtype=torch.float64)
    expected = [np.sqrt((x[..., i : i + 4].numpy() ** 2).mean(-1)) for i in (0, 4, 8)]
    np.testing.assert_allclose(block_rms(x, 4), np.stack(expected, -1), rtol=1e-12)
    assert block_rms(x, 1) is x


def test_display_rate_keeps_the_doppler_map():
    p, rcs = tensors(swinging(300, 3, 128.0), np.ones(3))
    full = RadarSimulator(THROUGH, snr_db=None)(p, rcs)
    short = RadarSimulator(THROUGH, snr_db=None, display_rate_hz=32.0)(p, rcs)
    assert short.range_time.shape == (200, 75)
    assert torch.equal(short.doppler_time, full.doppler_time)


@pytest.mark.parametrize(
    "simulator",
    [
        RadarSimulator(SMALL, snr_db=None, display_rate_hz=32.0),
        RadarSimulator(replace(SMALL, rx_m=((0.1, 0.0, 1.5), (0.2, 0.0, 1.5))), snr_db=None),
    ],
    ids=["display rate", "array"],
)
def test_the_gradient_is_zero_where_somebody_stands_still(simulator):
    p = torch.tensor([0.0, 3.0, 1.5]).repeat(40, 2, 1).requires_grad_(True)
    maps = simulator(p, torch.ones(2))
    assert float(maps.range_time_mti.detach().max()) == 0
    assert torch.equal(torch.autograd.grad(maps.range_time_mti.sum(), p)[0], torch.zeros_like(p))


def mover(speed, prf_hz, scatterers=4):
    t = torch.arange(40).double() / prf_hz
    return torch.stack((0 * t, 4 + speed * t, 0 * t + 1.5), -1)[:, None].repeat(1, scatterers, 1)


def test_motion_beyond_the_pulse_rate():
    """2 GHz and 128 Hz follow 3.84 m/s."""
    rcs = torch.ones(40, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_unambiguous(mover(3.7, 128), rcs, THROUGH)
        check_unambiguous(mover(-3.7, 128), rcs, THROUGH)
        check_unambiguous(mover(30.0, 128), 0 * rcs, THROUGH)
    with pytest.raises(
        TensorsimError, match=r"mean radial speed of 4.00 m/s, .* 3.84 m/s of a PRF of 128 Hz; .* 133 Hz"
    ):
        check_unambiguous(mover(4.0, 128), rcs, THROUGH)
    one_foot = mover(0.5, 128)
    one_foot[:, 2] = mover(-6.0, 128)[:, 2]
    with pytest.warns(TensorsimWarning, match="some scatterer has a radial speed above"):
        check_unambiguous(one_foot, rcs, THROUGH)
    appearing = mover(0.5, 128)
    appearing[:10] = 0  # not there yet: no position, no RCS
    present = rcs.clone()
    present[:10] = 0
    check_unambiguous(appearing, present, THROUGH)


def test_simulator_refuses_motion_beyond_the_pulse_rate():
    simulator = RadarSimulator(THROUGH)
    p, rcs = mover(5.0, 128), torch.ones(4)
    with pytest.raises(TensorsimError, match="a PRF of"):
        simulator(p, rcs)
    with pytest.raises(TensorsimError, match="a PRF of"):
        simulator.stream(lambda a, b: (p[a:b], rcs), 40)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan")])
def test_bad_display_rate(rate):
    with pytest.raises(TensorsimError, match="display_rate_hz: got"):
        RadarSimulator(FREE, display_rate_hz=rate)


def test_warns_of_what_the_range_axis_cannot_show():
    far = torch.tensor([0.0, 9.0, 1.5]).expand(64, 2, 3).clone()
    with pytest.warns(TensorsimWarning, match=r"beyond the 7\.49 m"):
        check_unambiguous(far, torch.ones(64, 2), RadarConfig.free_space())
    check_unambiguous(far, torch.zeros(64, 2), RadarConfig.free_space())  # nobody is there
    check_unambiguous(far, torch.ones(64, 2), THROUGH)  # 30 m


def test_says_that_a_scatterer_beyond_twice_the_range_axis_appears_too_near() -> None:
    radar = RadarConfig.free_space()
    far_m = 2 * radar.reach_m + 2.0
    far = torch.tensor([0.0, far_m, 0.0], dtype=torch.float64).expand(900, 1, 3).clone()
    rcs = torch.ones(900, 1, dtype=torch.float64)
    with pytest.warns(TensorsimWarning, match="beyond 14.99 m, twice the range axis .* appears too near"):
        maps = RadarSimulator(radar)(far[None], rcs[None])
    peak = int(maps.range_time[0].mean(-1).argmax())
    assert peak * radar.range_resolution_m == pytest.approx(2.0, abs=0.2)
    # One that the receiver has filtered out does not, beside one that is heard.
    both = torch.cat([far, far - torch.tensor([0.0, 5.0, 0.0])], dim=1)
    with pytest.warns(TensorsimWarning, match="does not appear in the maps"):
        check_unambiguous(both, torch.cat([1e-8 * rcs, rcs], dim=1), radar)
    # Nor does one beyond three times the range axis, which is as far above the sample rate as one beyond the axis.
    farther = far + torch.tensor([0.0, radar.reach_m, 0.0])
    with pytest.warns(TensorsimWarning, match="does not appear in the maps"):
        maps = RadarSimulator(radar)(
            torch.cat([farther, far - torch.tensor([0.0, 12.0, 0.0])], 1)[None], torch.ones(1, 900, 2)
        )
    shown = maps.range_time[0].double().square().mean(-1)
    at = torch.arange(len(shown)) * radar.range_resolution_m
    assert float(shown[at < 3.0].sum()) < 0.01 * float(shown.sum())


def test_says_that_one_channel_shows_a_scatterer_beyond_the_range_axis_too_near() -> None:
    radar = RadarConfig.free_space()
    p, rcs = mover(0.0, radar.prf_hz, 1).repeat(23, 1, 1) + torch.tensor([0.0, 5.5, 0.0]), torch.ones(1)
    scene = SceneConfig(radar, receiver=ReceiverConfig(real=True), snr_db=None)
    simulator = RadarSimulator(scene)
    for run in (lambda: simulator(p, rcs), lambda: simulator.stream(lambda a, b: (p[a:b], rcs), len(p))):
        with pytest.warns(TensorsimWarning, match=r"beyond 7.49 m, the range axis .* appears too near"):
            maps = run()
        peak = int(maps.range_time.mean(-1).argmax())
        assert peak * radar.range_resolution_m == pytest.approx(2 * radar.reach_m - 9.5, abs=0.04)


@pytest.mark.parametrize(("near_m", "far_m"), [(0.0, 0.0), (0.5, 0.0), (0.0, -0.5)])
def test_warning_when_somebody_leaves_a_fixed_gate(near_m, far_m):
    p, rcs = mover(3.5, 128), torch.ones(4)
    near, far = gate_around(p, THROUGH, margin_m=0.1)
    simulator = RadarSimulator(THROUGH, range_gate_m=(near + near_m, far + far_m), snr_db=None)
    for run in (
        lambda: simulator(p, rcs),
        lambda: simulator.stream(lambda a, b: (p[a:b], rcs), len(p)),
    ):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run()
        leaves = any("some scatterer leaves the range gate of" in str(w.message) for w in caught)
        assert leaves == (near_m != far_m)


def test_warnings_of_several_clips_have_one_text():
    """Python shows a text once: not one for every clip of a data set."""
    rcs = torch.ones(40, 4)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for speed in (5.0, 6.0):
            one_foot = mover(0.5, 128)
            one_foot[:, 2] = mover(-speed, 128)[:, 2]
            check_unambiguous(one_foot, rcs, THROUGH)
    assert len({str(w.message) for w in caught}) == 1 < len(caught)


def test_a_last_pulse_alone_in_its_piece_goes_on_as_the_one_before():
    """Transmitters in turn see people who move on between pulses."""
    radar = replace(
        RadarConfig.through_wall(), tx_m=((-0.1, 0, 1.5), (0.0, 0, 1.5)), rx_m=((0.1, 0, 1.5), (0.15, 0, 1.5))
    )
    simulator = RadarSimulator(radar, snr_db=None, pulse_chunk=8)
    time_s = torch.arange(65).double() / radar.prf_hz
    p = torch.stack([0 * time_s, 4 - time_s, 1 + 0 * time_s], -1)[:, None]
    rcs = torch.ones(1, dtype=torch.float64)
    streamed = simulator.stream(lambda start, stop: (p[start:stop], rcs.expand(stop - start, 1)), 65)
    assert_same(streamed.range_time, simulator(p, rcs).range_time, atol=1e-5)


@pytest.mark.parametrize(
    ("positions", "margin_m", "message"),
    [
        (torch.ones(4, 2), 0.5, r"positions: got shape \[4, 2\], expected \(..., 3\) metres"),
        ([[0.0, 2.0, 1.0]], 0.5, "positions: got list, expected a tensor"),
        (torch.ones(4, 3), math.nan, "margin_m: got nan"),
        (torch.ones(4, 3), -5.0, "margin_m: got -5.0, expected metres from 0 on"),
    ],
)
def test_gates_around_nothing_are_refused(positions, margin_m, message):
    with pytest.raises(TensorsimError, match=message):
        gate_around(positions, THROUGH, margin_m)
