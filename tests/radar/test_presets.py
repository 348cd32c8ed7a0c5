"""Radars by name and from YAML files."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S, FloorConfig, RadarConfig, SceneConfig, WallConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.presets import (
    PRESETS,
    load_radar_yaml,
    load_scene_yaml,
    radar_scene,
    save_radar_yaml,
)
from tensorsim.radar.simulator import RadarSimulator

#: Band in Hz and highest chirp slope in Hz/s of the data sheets.
LIMITS = {
    "ti-awr1642": (76e9, 81e9, 100e12),
    "ti-awr1843": (76e9, 81e9, 100e12),
    "ti-iwr6843": (60e9, 64e9, 250e12),
    "infineon-bgt60tr13c": (57.4e9, 63.6e9, 400e12),
    "infineon-bgt24mtr12": (24.0e9, 24.25e9, 1e15),
}


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "radar.yaml"
    path.write_text(text, encoding="utf-8")
    return path


# ---- presets ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_presets_stay_within_the_data_sheet(name: str) -> None:
    radar = PRESETS[name].radar
    low, high, slope = LIMITS.get(name.removesuffix("-array"), (0.0, 1e12, 1e15))
    assert low <= radar.carrier_hz
    assert radar.carrier_hz + radar.bandwidth_hz <= high
    assert radar.slope_hz_per_s <= slope
    assert radar.samples_per_chirp // 2 * radar.range_resolution_m > 5.0, "a room is in range"
    if name != "through-wall":
        assert radar.unambiguous_speed_m_s > 4.5, "the feet of a walk"


def test_the_papers_scenes() -> None:
    assert PRESETS["free-space"] == SceneConfig(RadarConfig.free_space())
    assert PRESETS["through-wall"] == SceneConfig(RadarConfig.through_wall(), WallConfig())


def test_cw_sensor_has_160_hz_per_metre_per_second_and_one_range_bin() -> None:
    radar = PRESETS["cw-24ghz"].radar
    assert 2 / radar.doppler_wavelength_m == pytest.approx(160, abs=0.5)
    assert radar.range_resolution_m > 100


def test_arrays_have_the_geometry_of_the_boards() -> None:
    radar = PRESETS["ti-awr1843-array"].radar
    virtual = sorted(t[0] + r[0] for t in radar.tx_positions_m for r in radar.rx_positions_m)
    steps = torch.tensor(virtual).diff()
    assert len(virtual) == 8
    torch.testing.assert_close(steps, torch.full((7,), SPEED_OF_LIGHT_M_S / 79e9 / 2), rtol=1e-4, atol=0)
    corner, beside, above = PRESETS["infineon-bgt60tr13c-array"].radar.rx_positions_m
    assert corner[0] - beside[0] == pytest.approx(0.0025)
    assert above[2] - corner[2] == pytest.approx(0.0025)


@pytest.mark.parametrize("name", ["ti-awr1843", "infineon-bgt60tr13c", "infineon-bgt24mtr12", "cw-24ghz"])
def test_a_walker_shows_at_his_speed(name: str) -> None:
    radar = PRESETS[name].radar
    time = torch.arange(round(0.25 * radar.prf_hz), dtype=torch.float64) / radar.prf_hz
    position = torch.stack((0 * time, 3.0 - 1.5 * time, 0 * time + 1.0), -1).unsqueeze(-2)
    simulator = RadarSimulator(radar, snr_db=None)
    spectrum = simulator(position, torch.ones(1, dtype=torch.float64)).doppler_time.mean(-1)
    hertz = simulator.doppler.doppler_hz
    speed = float(hertz[spectrum.argmax()]) * radar.doppler_wavelength_m / 2
    bin_width = float(hertz[1] - hertz[0]) * radar.doppler_wavelength_m / 2
    assert speed == pytest.approx(1.5, abs=bin_width)


# ---- YAML ------------------------------------------------------------------------------------------------


def test_fields_wall_and_defaults(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        """
        carrier_hz: 24.0e9
        bandwidth_hz: 250e6      # plain YAML 1.1 reads this as text
        chirp_s: 256e-6
        prf_hz: 2000
        sample_rate_hz: 250e3
        rx_m: [0.02, 0, 1.0]
        wall:
          relative_permittivity: 4.5
          size_m: [3, 0.1, 2.5]
        """,
    )
    scene = load_scene_yaml(path)
    radar, wall, floor = scene.radar, scene.wall, scene.floor
    assert floor is None
    assert radar == RadarConfig(24e9, 250e6, 256e-6, 2000.0, 250e3, rx_m=(0.02, 0.0, 1.0))
    assert wall == WallConfig(relative_permittivity=4.5, size_m=(3.0, 0.1, 2.5))
    assert load_radar_yaml(str(path)) == radar
    assert isinstance(radar.prf_hz, float)
    hash(radar)  # lists became tuples


def test_a_radar_section_is_the_same(tmp_path: Path) -> None:
    scene = load_scene_yaml(written(tmp_path, "radar: {prf_hz: 4096}\nwall: {}\n"))
    assert scene == SceneConfig(RadarConfig(prf_hz=4096.0), WallConfig())


@pytest.mark.parametrize("name", PRESETS)
def test_round_trip(name: str, tmp_path: Path) -> None:
    path = tmp_path / "radar.yaml"
    save_radar_yaml(path, PRESETS[name].radar, PRESETS[name].wall, PRESETS[name].floor)
    assert load_scene_yaml(path) == PRESETS[name]
    assert radar_scene(str(path)) == radar_scene(name) == PRESETS[name]


def test_round_trip_of_numbers_that_decimals_do_not_hold(tmp_path: Path) -> None:
    radar = RadarConfig(carrier_hz=77e9 / 3, tx_m=(1 / 3, 0.1, 2 / 7), chirp_s=1e-4 / 3)
    save_radar_yaml(tmp_path / "r.yaml", radar, WallConfig(loss_tangent=1 / 7))
    assert load_scene_yaml(tmp_path / "r.yaml") == SceneConfig(radar, WallConfig(loss_tangent=1 / 7))


def test_floor_section(tmp_path: Path) -> None:
    scene = load_scene_yaml(written(tmp_path, "wall: {}\nfloor: {reflection: -5e-1}\nprf_hz: 4096\n"))
    assert scene == SceneConfig(RadarConfig(prf_hz=4096.0), WallConfig(), FloorConfig(reflection=-0.5))
    scene = load_scene_yaml(written(tmp_path, "floor: {reflection: null, relative_permittivity: 3}\n"))
    assert scene == SceneConfig(RadarConfig(), None, FloorConfig(relative_permittivity=3.0))


def test_several_receivers_become_tuples(tmp_path: Path) -> None:
    radar = load_radar_yaml(written(tmp_path, "rx_m: [[0.1, 0, 1], [0.2, 0, 1]]\n"))
    assert radar.rx_m == ((0.1, 0.0, 1.0), (0.2, 0.0, 1.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("carier_hz: 1e9", r"radar.yaml: got the key 'carier_hz', expected .*, perhaps 'carrier_hz'"),
        ("Wall: {}", r"got the key 'Wall', .* perhaps 'wall'"),
        (
            "wall: {permittivity: 4}",
            r"yaml: wall: got the key 'permittivity'.* perhaps 'relative_permittivity'",
        ),
        ("zzz: 1", r"got the key 'zzz', expected one of carrier_hz, .*, wall, floor$"),
        ("1: 2", r"got the key 1, expected"),
        ("carrier_hz: 77 GHz", r"yaml: carrier_hz: got '77 GHz', expected a number"),
        ("carrier_hz: true", r"carrier_hz: got True, expected a number"),
        ("carrier_hz: [1e9]", r"carrier_hz: got \[.*\], expected a number"),
        ("carrier_hz:", r"carrier_hz: got None, expected a number"),
        ("tx_m: 0.5", r"tx_m: got 0.5, expected a list of numbers"),
        ("tx_m: [0, left, 1]", r"tx_m: got 'left', expected a number"),
        ("tx_m: [0, 1]", r"radar.yaml: RadarConfig.tx_m: got \(0.0, 1.0\), expected three finite numbers"),
        ("rx_m: [[0, 0, 1], [0, 1]]", r"RadarConfig.rx_m: got \(0.0, 1.0\)"),
        ("prf_hz: -1", r"radar.yaml: RadarConfig.prf_hz: got -1, expected pulse repetition frequency from 1"),
        ("prf_hz: nan", r"RadarConfig.prf_hz: got nan"),
        ("wall: {relative_permittivity: 0.5}", r"yaml: wall: WallConfig.relative_permittivity: got 0.5"),
        ("wall:", r"yaml: wall: got None, expected keys with values"),
        ("wall: 6", r"wall: got 6, expected keys"),
        ("floor: concrete", r"yaml: floor: got 'concrete', expected keys"),
        ("floor: {reflection: -2}", r"yaml: floor: FloorConfig.reflection: got -2"),
        ("floor: {reflection: much}", r"yaml: floor: reflection: got 'much', expected a number"),
        ("floor: {permittivity: 4}", r"yaml: floor: got the key 'permittivity'"),
        ("radar: {}\nprf_hz: 4096", r"got prf_hz beside the section radar"),
        ("- 1\n- 2", r"yaml: got list, expected keys"),
        ("", r"yaml: got nothing, expected keys"),
        ("prf_hz: 1\nprf_hz: 2", r"duplicate key prf_hz"),
        ("prf_hz: [", r"radar.yaml: not valid YAML"),
        ("prf_hz: !!python/object/apply:os.getpid []", r"line 1 has an anchor, an alias or a tag"),
    ],
)
def test_refuses(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match=message):
        load_scene_yaml(written(tmp_path, text))


def test_refuses_what_is_no_text_and_no_file(tmp_path: Path) -> None:
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(TensorsimError, match=r"binary.yaml: not valid YAML"):
        load_radar_yaml(tmp_path / "binary.yaml")
    with pytest.raises(TensorsimError, match=r"none.yaml: No such file"):
        load_radar_yaml(tmp_path / "none.yaml")
    with pytest.raises(
        TensorsimError, match=r"got 'ti-awr1834', which is not a file, .* perhaps 'ti-awr1843'"
    ):
        radar_scene("ti-awr1834")
    with pytest.raises(TensorsimError, match=r"radar: got 'radar\.yaml', which is not a file"):
        radar_scene(Path("radar.yaml"))


def test_every_field_can_be_set_from_a_file(tmp_path: Path) -> None:
    """Also those that come later."""
    scene = SceneConfig(RadarConfig(), WallConfig(), FloorConfig())
    save_radar_yaml(tmp_path / "all.yaml", scene.radar, scene.wall, scene.floor)
    assert load_scene_yaml(tmp_path / "all.yaml") == scene
    text = (tmp_path / "all.yaml").read_text()
    for config in (RadarConfig, WallConfig, FloorConfig):
        assert all(f"{field.name}:" in text for field in dataclasses.fields(config))


def test_yaml_is_imported_on_use() -> None:
    code = "import sys, tensorsim.radar.presets; print('yaml' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
