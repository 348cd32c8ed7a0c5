"""Configurations: presets, derived numbers, refusals."""

import dataclasses
import math

import numpy as np
import pytest

import tensorsim as ts
from tensorsim.config import FloorConfig


def test_presets_are_the_panels() -> None:
    free, wall = ts.RadarConfig.free_space(), ts.RadarConfig.through_wall()
    assert free == ts.RadarConfig()
    assert (free.carrier_hz, free.bandwidth_hz, free.prf_hz) == (77e9, 4e9, 8192)
    assert (wall.carrier_hz, wall.bandwidth_hz, wall.prf_hz) == (2e9, 1e9, 128)
    assert free.samples_per_chirp == 400
    assert free.slope_hz_per_s == pytest.approx(1e14)
    assert free.range_resolution_m == pytest.approx(0.0374741, abs=1e-6)
    assert free.unambiguous_speed_m_s == pytest.approx(7.8, abs=0.05)
    assert wall.unambiguous_speed_m_s == pytest.approx(3.8, abs=0.05)
    assert ts.RadarConfig.through_wall(prf_hz=256.0).prf_hz == 256


def test_refractive_index_of_a_lossy_wall() -> None:
    n = ts.WallConfig().refractive_index
    assert n.real == pytest.approx(2.4498, abs=1e-3)
    assert n.imag < 0
    assert (n**2).real == pytest.approx(6)
    assert (n**2).imag == pytest.approx(-0.18)


def test_configs_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        ts.RadarConfig().prf_hz = 1.0  # type: ignore[misc]


def test_names() -> None:
    assert len(ts.ACTIVITIES) == 12
    assert ts.ACTIVITIES[0] == "S1 Empty"
    assert ts.ACTIVITIES[-1] == "S12 Walking to Falling"
    assert len(ts.JOINTS) == len(ts.JOINT_RCS_M2) == 14
    assert [ts.JOINTS[i - 1] for i in (9, 12, 11, 14)] == [
        "right_hip",
        "left_hip",
        "right_ankle",
        "left_ankle",
    ]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ts.RadarConfig(carrier_hz=0), "carrier_hz: got 0"),
        (lambda: ts.RadarConfig(bandwidth_hz=-1), "bandwidth_hz"),
        (lambda: ts.RadarConfig(chirp_s=math.nan), "chirp_s: got nan"),
        (lambda: ts.RadarConfig(prf_hz=math.inf), "prf_hz"),
        (lambda: ts.RadarConfig(sample_rate_hz=1e3), "samples"),
        (
            lambda: ts.RadarConfig(sample_rate_hz=1e10),
            "chirp_s: got 400000, expected samples per chirp from 2 to 65536",
        ),
        (
            lambda: ts.RadarConfig(rx_m=[(k / 100, 0.0, 1.0) for k in range(300)]),  # type: ignore[arg-type]
            "tx_m times rx_m: got 300, expected antennas from 1 to 256",
        ),
        (
            lambda: ts.RadarConfig(tx_m=(1e9, 0.0, 0.0)),
            r"tx_m: got 1e\+09, expected position from -1000 to 1000 m",
        ),
        (lambda: ts.InterferenceConfig(position_m=(0.0, 1e9, 0.0)), "position_m: got .* expected position"),
        (lambda: ts.RadarConfig(prf_hz=1e6), "does not fit the pulse interval"),
        (lambda: ts.RadarConfig(tx_m=(0.0, 0.0)), "tx_m"),  # type: ignore[arg-type]
        (lambda: ts.RadarConfig(rx_m=(0.0, math.nan, 0.0)), "rx_m"),
        (lambda: ts.RadarConfig(antenna_gain_dbi=math.nan), "antenna_gain_dbi"),
        (lambda: ts.WallConfig(size_m=(5, -0.1, 2.5)), "size_m"),
        (lambda: ts.WallConfig(relative_permittivity=0.5), "relative_permittivity: got 0.5"),
        (lambda: ts.WallConfig(loss_tangent=-1), "loss_tangent"),
        (
            lambda: ts.WallConfig(loss_tangent=1e300),
            r"loss_tangent: got 1e\+300, expected loss tangent from 0 to 100",
        ),
        (
            lambda: ts.WallConfig(size_m=(4.0, 1e6, 3.0)),
            r"size_m: got 1e\+06, expected length from 0 to 1000 m",
        ),
        (lambda: ts.WallConfig(center_m=(0.0, 1e6, 3.0)), r"center_m: got 1e\+06, expected position"),
        (lambda: ts.WallConfig(center_m=(0, math.inf, 0)), "center_m"),
        (lambda: ts.CameraConfig(focal_px=-5), "focal_px"),
        (lambda: ts.CameraConfig(horizontal_fov_rad=60.0), "horizontal_fov_rad: got 60.0"),
        (lambda: ts.CameraConfig(position_m=(math.nan, 0, 0)), "position_m"),
        (lambda: ts.CameraConfig(pitch_rad=math.inf), "pitch_rad"),
        (lambda: ts.CameraConfig(center_px=(math.nan, 1.0)), "center_px: got .* two finite numbers"),
        (lambda: ts.CameraConfig(center_px=(1.0, 2.0, 3.0)), "center_px"),  # type: ignore[arg-type]
        (lambda: ts.RadarConfig(tx_m=5.0), "tx_m: got 5.0, expected three finite numbers"),  # type: ignore[arg-type]
        (lambda: ts.RadarConfig(rx_m=None), "rx_m: got None"),  # type: ignore[arg-type]
        (lambda: ts.RadarConfig(tx_m=((0.0, 0.0, 1.0), 5.0)), "tx_m: got 5.0"),  # type: ignore[arg-type]
        (lambda: ts.RadarConfig(carrier_hz="77e9"), "carrier_hz: got '77e9'"),  # type: ignore[arg-type]
        (lambda: ts.RadarConfig(isolation_db=None), "isolation_db: got None"),  # type: ignore[arg-type]
        (lambda: ts.WallConfig(center_m=3.0), "center_m: got 3.0"),  # type: ignore[arg-type]
        (lambda: ts.WallConfig(loss_tangent="no"), "loss_tangent: got 'no', expected loss tangent"),  # type: ignore[arg-type]
        (lambda: FloorConfig(reflection="no"), "reflection: got no"),  # type: ignore[arg-type]
        (lambda: ts.SceneConfig(bounces=0), "SceneConfig.bounces: got 0, expected an integer from 1 to 50"),
        (lambda: ts.SceneConfig(bounces=51), "SceneConfig.bounces: got 51, expected an integer from 1 to 50"),
        (lambda: ts.TrackerConfig(max_tracks=257), "max_tracks: got 257, expected an integer from 1 to 256"),
        (
            lambda: ts.TrackerConfig(delete_window=10_001),
            "delete_window: got 10001, expected an integer from",
        ),
        (
            lambda: ts.ProcessingConfig(pulse_chunk=10**7),
            "pulse_chunk: got 10000000, expected an integer from",
        ),
        (
            lambda: ts.ClutterConfig(reflectors=10_001),
            "reflectors: got 10001, expected an integer from 1 to 10000",
        ),
        (lambda: ts.SceneConfig(bounces=1.5), "bounces: got 1.5"),  # type: ignore[arg-type]
        (lambda: ts.SceneConfig(bounces=True), "bounces: got True"),
        (lambda: ts.SceneConfig(noise_figure_db=math.nan), "noise_figure_db: got nan"),
        (lambda: ts.ProcessingConfig(overlap="x"), "overlap: got 'x'"),  # type: ignore[arg-type]
        (lambda: ts.ProcessingConfig(ridge_count=7), "ridge_count: got 7, expected an integer from 1 to 6"),
        (lambda: ts.ProcessingConfig(range_window="foo"), "range_window: got 'foo'"),  # type: ignore[arg-type]
        (lambda: ts.ProcessingConfig(range_gate_m=(1.0, 2.0, 3.0)), "range_gate_m: got"),  # type: ignore[arg-type]
        (
            lambda: ts.ProcessingConfig(range_gate_m=(5.0, 2.0)),
            r"range_gate_m: got \(5.0, 2.0\), expected \(near",
        ),
        (lambda: ts.ProcessingConfig(range_gate_m=(1.0, math.nan)), "range_gate_m: got"),
        (lambda: ts.ProcessingConfig(range_gate_m=-1.0), "range_gate_m: got -1.0, expected a positive"),
    ],
)
def test_refuses(make: object, message: str) -> None:
    with pytest.raises(ts.TensorsimError, match=message):
        make()  # type: ignore[operator]


def test_lists_and_arrays_of_positions_are_tuples() -> None:
    wall = ts.WallConfig(center_m=[0.0, 1.0, 1.5], size_m=np.array([5.0, 0.2, 2.5]))  # type: ignore[arg-type]
    assert hash(wall) == hash(ts.WallConfig((0.0, 1.0, 1.5), (5.0, 0.2, 2.5)))
    camera = ts.CameraConfig(position_m=[0, 0, 1.5], center_px=[2, 3])  # type: ignore[arg-type]
    assert hash(camera) == hash(ts.CameraConfig(position_m=(0, 0, 1.5), center_px=(2, 3)))
