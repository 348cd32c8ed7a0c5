"""Radars by name, and radars from YAML files.

A file holds fields of :class:`~tensorsim.config.RadarConfig` and, for a scene with a wall or a reflecting floor,
sections with fields of :class:`~tensorsim.config.WallConfig` and :class:`~tensorsim.config.FloorConfig`; fields that
are not given keep their defaults::

    carrier_hz: 24.0e9
    bandwidth_hz: 250e6
    chirp_s: 256e-6
    prf_hz: 2000
    sample_rate_hz: 250e3
    rx_m: [0.02, 0.0, 1.0]
    wall:
      relative_permittivity: 4.5
    floor: {}
"""

from dataclasses import replace
from pathlib import Path

from tensorsim.config import SPEED_OF_LIGHT_M_S, FloorConfig, RadarConfig, SceneConfig, WallConfig
from tensorsim.config.documents import from_document, suggestion, to_document
from tensorsim.config.limited_yaml import dump_limited_yaml
from tensorsim.config.yaml_files import read_yaml
from tensorsim.errors import TensorsimError
from tensorsim.files import write_text
from tensorsim.radar.measured_sensors import MEASURED_SENSORS

#: The parts of a scene that a file describes besides the radar.
_SECTIONS: dict[str, type] = {"wall": WallConfig, "floor": FloorConfig}


#: Radars by name. Each number is marked: (D) a limit or value from the public documents of the part, (T) a typical
#: setting for observing people, within these limits; antennas are 1 m above the floor. The documents are the data
#: sheets of the parts, whose numbers are given below, and the user guides of the boards; check them where it matters.
#: The simulated pulses are evenly spaced, without pauses between frames, and the samples are complex; the whole swept
#: band is sampled, whereas a real chirp loses some of it at its ends.
PRESETS: dict[str, SceneConfig] = {
    # The two scenes of the paper's control panel.
    "free-space": SceneConfig(RadarConfig.free_space()),
    "through-wall": SceneConfig(RadarConfig.through_wall(), WallConfig()),
    # Texas Instruments AWR1642 (SWRS203) on its BOOST board: 76 to 81 GHz.
    "ti-awr1642": SceneConfig(
        RadarConfig(
            carrier_hz=77e9,  # D: start of the 4 GHz band
            bandwidth_hz=4e9,  # D: widest sweep
            chirp_s=51.2e-6,  # T: 78 MHz/us; D: at most 100 MHz/us
            prf_hz=8000.0,  # T: 7.6 m/s
            sample_rate_hz=6.25e6,  # D: highest complex rate (5 MHz of intermediate frequency); range 6 m
            tx_m=(-0.01, 0.0, 1.0),  # T: centimetres apart on the board
            rx_m=(0.01, 0.0, 1.0),
            antenna_gain_dbi=10.5,  # D: guide of the board, peak
            isolation_db=30.0,  # T
        )
    ),
    # Texas Instruments AWR1843 (SWRS222) on its BOOST board: 76 to 81 GHz.
    "ti-awr1843": SceneConfig(
        RadarConfig(
            carrier_hz=77e9,  # D: start of the 4 GHz band
            bandwidth_hz=4e9,  # D: widest sweep
            chirp_s=40.96e-6,  # T: 98 MHz/us; D: at most 100 MHz/us
            prf_hz=8000.0,  # T: 7.6 m/s
            sample_rate_hz=12.5e6,  # D: highest complex rate (10 MHz of intermediate frequency); range 9.6 m
            tx_m=(-0.01, 0.0, 1.0),  # T: centimetres apart on the board
            rx_m=(0.01, 0.0, 1.0),
            antenna_gain_dbi=10.5,  # D: guide of the board, peak
            isolation_db=30.0,  # T
        )
    ),
    # Texas Instruments IWR6843 (SWRS219) on its ISK board: 60 to 64 GHz.
    "ti-iwr6843": SceneConfig(
        RadarConfig(
            carrier_hz=60e9,  # D: start of the 4 GHz band
            bandwidth_hz=4e9,  # D: widest sweep
            chirp_s=40.96e-6,  # T: 98 MHz/us; D: at most 250 MHz/us
            prf_hz=6400.0,  # T: 7.7 m/s
            sample_rate_hz=12.5e6,  # D: highest complex rate (10 MHz of intermediate frequency); range 9.6 m
            tx_m=(-0.01, 0.0, 1.0),  # T: centimetres apart on the board
            rx_m=(0.01, 0.0, 1.0),
            antenna_gain_dbi=7.0,  # D: guide of the board, peak
            isolation_db=30.0,  # T
        )
    ),
    # Infineon BGT60TR13C (data sheet 2.4.9): antennas in the package, one transmitter, three receivers in an L; here
    # only the corner one.
    "infineon-bgt60tr13c": SceneConfig(
        RadarConfig(
            carrier_hz=58e9,  # D: 58 to 63.5 GHz
            bandwidth_hz=5.5e9,  # D: widest sweep
            chirp_s=128e-6,  # T: 43 MHz/us; D: at most 400 MHz/us
            prf_hz=4000.0,  # T: 4.9 m/s
            sample_rate_hz=4e6,  # D: highest rate, of real samples; their range is that of the N / 2 bins here, 7.0 m
            tx_m=(-0.0025, 0.0, 1.0),  # T: opposite side of a package 6.5 mm wide (D)
            rx_m=(0.0025, 0.0, 1.0),
            antenna_gain_dbi=5.0,  # T
            isolation_db=30.0,  # T
        )
    ),
    # Infineon BGT24MTR12 with patch arrays, as on its Position2Go board: the 24 GHz ISM band.
    "infineon-bgt24mtr12": SceneConfig(
        RadarConfig(
            carrier_hz=24e9,  # D: 24.0 to 24.25 GHz
            bandwidth_hz=250e6,  # D: all of the band, range bins of 0.6 m
            chirp_s=256e-6,  # T
            prf_hz=2000.0,  # T: 6.2 m/s
            sample_rate_hz=250e3,  # T: range 19 m
            tx_m=(-0.02, 0.0, 1.0),  # T: centimetres apart on the board
            rx_m=(0.02, 0.0, 1.0),
            antenna_gain_dbi=12.0,  # T: patch arrays of the board
            isolation_db=30.0,  # T
        )
    ),
    # A continuous-wave Doppler sensor at 24 GHz, 160 Hz per m/s: a sweep so narrow that everything is in one range bin.
    "cw-24ghz": SceneConfig(
        RadarConfig(
            carrier_hz=24e9 - 0.5e6,  # D: the centre of the sweep at 24 GHz
            bandwidth_hz=1e6,  # T: range bins of 150 m
            chirp_s=100e-6,  # T
            prf_hz=4096.0,  # T: 12.8 m/s
            sample_rate_hz=160e3,  # T
            tx_m=(-0.01, 0.0, 1.0),  # T
            rx_m=(0.01, 0.0, 1.0),
            antenna_gain_dbi=10.0,  # T
            isolation_db=20.0,  # T
        )
    ),
}

#: Half a wavelength in the middle of the AWR1843's band.
_HALF_79_GHZ = SPEED_OF_LIGHT_M_S / 79e9 / 2

PRESETS |= MEASURED_SENSORS | {
    # D: four receivers half a wavelength apart, the two outer transmitters two wavelengths: a virtual row of eight.
    "ti-awr1843-array": SceneConfig(
        replace(
            PRESETS["ti-awr1843"].radar,
            tx_m=tuple((-0.01 + 4 * k * _HALF_79_GHZ, 0.0, 1.0) for k in range(2)),
            rx_m=tuple((0.01 + k * _HALF_79_GHZ, 0.0, 1.0) for k in range(4)),
        )
    ),
    # D: the corner of the L, its neighbours 2.5 mm beside and above it (which way is up depends on the mounting).
    "infineon-bgt60tr13c-array": SceneConfig(
        replace(
            PRESETS["infineon-bgt60tr13c"].radar,
            rx_m=((0.0025, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0025, 0.0, 1.0025)),
        )
    ),
}


def radar_scene(name_or_path: str | Path) -> SceneConfig:
    """The preset of this name, or the scene of this YAML file.

    Raises:
        TensorsimError: neither a preset nor a file, or a file that :func:`load_scene_yaml` refuses.
    """
    name = str(name_or_path)
    if name in PRESETS:
        return PRESETS[name]
    if Path(name_or_path).is_file():
        return load_scene_yaml(name_or_path)
    raise TensorsimError(
        f"radar: got {name!r}, which is not a file, expected one or a preset"
        f"{suggestion(name, list(PRESETS))} ({', '.join(PRESETS)})"
    )


def load_radar_yaml(path: str | Path) -> RadarConfig:
    """The radar of a YAML file; see the module for the format and :func:`load_scene_yaml` for the whole scene.

    Raises:
        TensorsimError: as :func:`load_scene_yaml`.
    """
    return load_scene_yaml(path).radar


def load_scene_yaml(path: str | Path) -> SceneConfig:
    """The radar of a YAML file, and its wall and floor if the file has sections ``wall`` and ``floor``.

    The fields of the radar may also be in a section ``radar``. Numbers may be written as in Python: unlike
    plain YAML 1.1, ``77e9`` is one. Nothing in the file is run.

    Raises:
        TensorsimError: no such file, invalid YAML, an unknown or repeated key, a value of the wrong type, or one that
            the configuration refuses; the message names file and key.
    """
    document = read_yaml(path)
    sections = {name: document.pop(name) for name in ("radar", *_SECTIONS) if name in document}
    fields = sections.pop("radar", document)
    if fields is not document and document:
        raise TensorsimError(
            f"{path}: got {', '.join(map(str, document))} beside the section radar, expected them in it"
        )
    radar = from_document(f"{path}", RadarConfig, fields, ("radar", *_SECTIONS))
    parts = {name: from_document(f"{path}: {name}", _SECTIONS[name], part) for name, part in sections.items()}
    return SceneConfig(radar, **parts)


def save_radar_yaml(
    path: str | Path, radar: RadarConfig, wall: WallConfig | None = None, floor: FloorConfig | None = None
) -> None:
    """Write a file from which :func:`load_scene_yaml` reads the same scene.

    Args:
        path: YAML file to write; it appears only when complete.
        radar: the radar.
        wall: a wall, or None.
        floor: a floor, or None.

    Raises:
        TensorsimError: the disk is full, or the folder is not writable.
    """
    document = to_document(radar)
    for name, part in (("wall", wall), ("floor", floor)):
        if part is not None:
            document[name] = to_document(part)
    write_text(path, dump_limited_yaml(document))
