"""Torso motion taken out of profiles, and the rhythm of a map."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S as C
from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.analysis.gait import BulkDopplerCompensation, CadenceVelocityDiagram, path_of_speed
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tests.radar import reference
from tests.radar.scenes import SMALL
from tests.stage import StageTester

FREE = RadarConfig(tx_m=(0, 0, 0), rx_m=(0, 0, 0))


def generated(*shape):
    generator = torch.Generator().manual_seed(6)
    return torch.randn(*shape, dtype=torch.complex128, generator=generator)


class TestBulkDopplerCompensation(StageTester):
    batched_arguments = (0, 1)
    gradient_arguments = (0, 1)
    migration = False

    def make(self):
        return BulkDopplerCompensation(SMALL, self.migration)

    def inputs(self, batch, dtype):
        x = generated(*batch, 9, 5)
        path = 2 + 0.1 * x[..., 0].real
        if dtype == torch.float64:
            return (x, path)
        return (x.to(torch.complex64), path.float())

    def bad_inputs(self):
        x, path = self.inputs((), torch.float32)
        return [
            ((x.real, path), "profiles: got dtype"),
            ((x, path[:5]), r"range: got shape \[5\], expected \(..., 9 pulses\)"),
            ((x, path + float("inf")), "range: got NaN or infinite"),
            ((x, path.long()), "range: got dtype"),
            ((x[0], path), "profiles: got shape"),
        ]


class TestWithMigration(TestBulkDopplerCompensation):
    migration = True

    def bad_inputs(self):
        _, path = self.inputs((), torch.float32)
        return [*super().bad_inputs(), ((torch.ones(9, 25, dtype=torch.complex64), path), "at most 24")]


class TestCadenceVelocityDiagram(StageTester):
    def make(self):
        return CadenceVelocityDiagram(100.0)

    def inputs(self, batch, dtype):
        return (generated(*batch, 6, 11).abs().to(dtype),)

    def bad_inputs(self):
        x = self.inputs((), torch.float32)[0]
        return [
            ((x[0],), "map: got shape"),
            ((x[:, :1],), "at least 2 frames"),
            ((x[:0],), "map: got an empty tensor"),
            ((x + float("nan"),), "map: got NaN"),
            ((x.to(torch.complex64),), "map: got dtype"),
        ]


def walk(pulses=4096):
    """Profiles (M, 200) of a torso that walks in and sways and a hand that swings, and the torso's range (M,)."""
    t = np.arange(pulses) / 8192
    torso = 3.0 - 1.2 * t + 0.03 * np.sin(2 * np.pi * 1.8 * t)
    hand = torso - 0.3 - 1.5 * t
    p = np.zeros((pulses, 2, 3))
    p[..., 1] = np.stack((torso, hand), -1)
    profiles = reference.profiles(reference.echo(FREE, p, np.array([1.0, 0.05])))
    return torch.as_tensor(profiles), torch.as_tensor(torso)


@pytest.mark.parametrize("migration", [False, True])
def test_torso_goes_to_zero_and_limbs_keep_their_relative_speed(migration):
    profiles, torso = walk()
    module = DopplerTimeMap(FREE)
    before, after = module(profiles), module(BulkDopplerCompensation(FREE, migration)(profiles, torso))
    axis = module.doppler_hz.numpy()
    assert axis[before.argmax(0)].min() > 400  # 1.2 m/s and sway
    assert np.abs(axis[after.argmax(0)]).max() <= 8.0  # one bin
    fast = after.numpy() * (axis[:, None] > 300)
    expected = 2 * 1.5 / FREE.doppler_wavelength_m
    assert axis[fast.argmax(0)] == pytest.approx(expected, abs=16)


def test_migration_keeps_the_torso_in_its_bin():
    profiles, torso = walk()
    still = BulkDopplerCompensation(FREE, migration=True)(profiles, torso)
    bins = still.abs().argmax(-1)
    assert set(bins.tolist()) == {int(profiles[0].abs().argmax())}
    moving = BulkDopplerCompensation(FREE)(profiles, torso).abs().argmax(-1)
    assert int(moving[0] - moving[-1]) == round((float(torso[0] - torso[-1])) / (C / 8e9))
    # What a standing torso gives at the first range, pulse after pulse: amplitude (1 / r^2) and the hand apart.
    first = profiles[0, bins[0]].abs() * (torso[0] / torso) ** 2
    np.testing.assert_allclose(still[:, bins[0]].abs(), first, rtol=0.05)


def test_only_changes_of_range_matter():
    profiles, torso = walk(64)
    stage = BulkDopplerCompensation(FREE, migration=True)
    np.testing.assert_allclose(stage(profiles, torso), stage(profiles, torso + 7.0), atol=1e-9)
    standing = stage(profiles, torch.full_like(torso, 2.0))
    np.testing.assert_allclose(standing, profiles, atol=1e-12)


def test_path_of_speed_is_positive_when_approaching():
    t = torch.arange(8193).double() / 8192
    path = path_of_speed(0.8 * torch.cos(2 * math.pi * t) + 1.0, 8192.0)
    np.testing.assert_allclose(path, -(0.8 * torch.sin(2 * math.pi * t) / (2 * math.pi) + t), atol=1e-6)
    assert float(path[0]) == 0.0


def test_cadence_of_a_known_rhythm():
    """One bin of the map swells and fades 2.5 times a second, another is steady."""
    k = torch.arange(200).double()
    maps = torch.zeros(8, 200, dtype=torch.float64)
    maps[5] = 3 + 0.8 * torch.cos(2 * math.pi * 2.5 * k / 100)
    maps[2] = 4.0
    stage = CadenceVelocityDiagram(100.0)
    diagram, axis = stage(maps), stage.cadence_hz(200)
    assert diagram.shape == (8, 101) == (8, axis.numel())
    row, column = divmod(int(diagram.argmax()), 101)
    assert (row, float(axis[column])) == (5, 2.5)
    assert float(diagram[5, column]) == pytest.approx(0.8 * 200 / 4)
    assert float(diagram[2].max()) < 1e-10


def test_cadence_equals_numpy():
    maps = generated(6, 50).abs()
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(50) / 50)
    x = maps.numpy()
    expected = np.abs(np.fft.fft((x - x.mean(1, keepdims=True)) * window)[:, :26])
    np.testing.assert_allclose(CadenceVelocityDiagram(100.0)(maps), expected, atol=1e-12)
    np.testing.assert_allclose(CadenceVelocityDiagram(100.0).cadence_hz(51), np.arange(26) * 100 / 51)


def test_cadence_of_a_generated_gait():
    """A limb that swings to and fro at 0.9 Hz shows at 0.9 Hz and its multiples, off zero Doppler."""
    t = np.arange(4 * 2048) / 2048
    phase = 2 * np.pi * 0.3 / 0.05 * np.sin(2 * np.pi * 0.9 * t)
    module = DopplerTimeMap(RadarConfig.free_space(prf_hz=2048.0))
    maps = module(torch.as_tensor(np.exp(1j * phase))[:, None])
    stage = CadenceVelocityDiagram(module.frame_rate_hz)
    profile = stage(maps)[module.doppler_hz > 20].sum(0)
    cadence = stage.cadence_hz(maps.shape[1])
    assert float(cadence[profile.argmax()]) == pytest.approx(0.9, abs=0.2)


def test_bad_frame_rate():
    with pytest.raises(TensorsimError, match="frame_rate_hz: got 0"):
        CadenceVelocityDiagram(0.0)
