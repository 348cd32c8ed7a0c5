"""Options of the receiver: each sets its field and changes the maps; a run with them is repeated from its summary."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import tensorsim as ts
from tensorsim import cli
from tensorsim.commands.clip_options import ClipOptions
from tensorsim.commands.receiver import ReceiverOptions
from tensorsim.config import ClutterConfig, InterferenceConfig, ReceiverConfig
from tensorsim.errors import TensorsimError

#: Options with a value, and the fields of the scene that they set.
CASES = {
    "receiver": ("typical", {"receiver": ReceiverConfig.typical()}),
    "phase_noise_dbc_hz": (-60.0, {"receiver": ReceiverConfig(phase_noise_dbc_hz=-60.0)}),
    "iq_imbalance_db": (1.0, {"receiver": ReceiverConfig(iq_imbalance_db=1.0)}),
    "iq_phase_deg": (5.0, {"receiver": ReceiverConfig(iq_phase_rad=math.radians(5.0))}),
    "dc_offset_db": (10.0, {"receiver": ReceiverConfig(dc_offset_db=10.0)}),
    "real_receiver": (True, {"receiver": ReceiverConfig(real=True)}),
    "adc_bits": (5, {"receiver": ReceiverConfig(adc_bits=5)}),
    "adc_headroom_db": (-6.0, {"receiver": ReceiverConfig(adc_headroom_db=-6.0)}),
    "clutter": ("room", {"clutter": ClutterConfig()}),
    "interference": ((2.0, 6.0, 1.5), {"interference": InterferenceConfig((2.0, 6.0, 1.5))}),
}
#: The full scale of converters says nothing without converters.
BESIDE = {"adc_headroom_db": {"adc_bits": 5}}


def maps_of(config: ts.SimulationConfig) -> np.ndarray:
    joints = torch.rand(1, 1, 1, 14, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor(
        [0, 3.0, 0.5]
    )
    joints = joints - torch.linspace(0, 0.5, 30).view(1, 1, 30, 1, 1)
    valid = torch.ones(1, 1, 30, dtype=torch.bool)
    return ts.PoseToDoppler.from_config(config)(joints, valid, 30.0).range_time.numpy()


def test_every_option_of_the_receiver_is_tried() -> None:
    assert set(CASES) == {field.name for field in dataclasses.fields(ReceiverOptions)}


@pytest.mark.parametrize("option", CASES)
def test_each_option_sets_its_field_and_changes_the_maps(option: str) -> None:
    value, expected = CASES[option]
    beside = BESIDE.get(option, {})
    plain, config = (
        ClipOptions(scene="through-wall", **beside, **more).configuration().replace(scene__snr_db=None)
        for more in ({}, {option: value})
    )
    for name, part in expected.items():
        if beside:
            part = dataclasses.replace(part, **beside)
        assert getattr(config.scene, name) == part
    assert ts.SimulationConfig.from_document(json.loads(json.dumps(config.to_document()))) == config
    found, without = maps_of(config), maps_of(plain)
    assert np.isfinite(found).all()
    assert np.abs(found - without).max() > 1e-4 * without.max()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--interference", "1", "3"], "Missing value for argument '--interference'. Expected 3 values."),
        (["--interference", "1,3,1"], "Missing value for argument '--interference'. Expected 3 values."),
        (["--wall-size", "5", "b", "2"], "Error parsing --wall-size: got 5 b 2, expected 3 numbers"),
        (
            ["--image-size", "640", "36.5"],
            "Error parsing --image-size: got 640 36.5, expected 2 whole numbers",
        ),
    ],
)
def test_numbers_that_are_missing_or_none_are_said(
    given: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.parse(["simulate", "film.mp4", "--out", "out", *given])
    assert exit_.value.code == 2
    assert message in capsys.readouterr().err
    taken = cli.parse(["simulate", "--interference", "-1", "3", "1.5", "film.mp4", "--out", "out"])
    assert (taken.interference, taken.source) == ((-1.0, 3.0, 1.5), Path("film.mp4"))


def test_the_paper_has_an_ideal_receiver(tmp_path: Path) -> None:
    typical = ClipOptions(receiver="typical", clutter="room", sway=True, interference=(2.0, 6.0, 1.5))
    typical.configuration().to_yaml(tmp_path / "run.yaml")
    paper = ClipOptions(config=tmp_path / "run.yaml", paper=True).configuration().scene
    assert (paper.receiver, paper.clutter, paper.interference) == (ReceiverConfig(), None, None)
    assert not paper.sway
    assert not paper.vital_signs
    assert ClipOptions(paper=True, adc_bits=8).configuration().scene.receiver == ReceiverConfig(adc_bits=8)
    with pytest.raises(TensorsimError, match=r"--adc-bits: .*adc_bits: got 40, expected bits of a converter"):
        ClipOptions(adc_bits=40).configuration()


def test_simulate_with_an_array(tmp_path: Path) -> None:
    """Four channels, one set of maps."""
    (tmp_path / "array.yaml").write_text(
        "carrier_hz: 2e9\nbandwidth_hz: 1e9\nprf_hz: 128\n"
        "tx_m: [[-0.1, 0, 1.5], [0.05, 0, 1.5]]\nrx_m: [[0.1, 0, 1.5], [0.17, 0, 1.5]]\n"
    )
    body = np.array([0, 4, 1]) + np.random.default_rng(0).normal(0, 0.3, (14, 3))
    np.savez(tmp_path / "stand.npz", joints=np.repeat(body[None], 30, 0), fps=30.0)
    run = ["simulate", str(tmp_path / "stand.npz"), "--quiet", "--classifier", "none", "--sound"]
    cli.main([*run, "--radar", str(tmp_path / "array.yaml"), "--out", str(tmp_path / "out")])
    with np.load(tmp_path / "out" / "maps.npz") as maps:
        assert maps["range_time"].shape == (200, 128)
    assert (tmp_path / "out" / "doppler.wav").is_file()


def test_simulate_with_a_typical_receiver(tmp_path: Path) -> None:
    steps = np.linspace(0, 1, 45)[:, None, None]
    body = np.array([0, 4, 1]) + np.random.default_rng(0).normal(0, 0.3, (14, 3))
    np.savez(tmp_path / "walk.npz", joints=body + steps * [0.0, -1.0, 0.0], fps=30.0)
    run = ["simulate", str(tmp_path / "walk.npz"), "--quiet", "--classifier", "none", "--out"]
    options = ["--scene", "through-wall", "--receiver", "typical", "--adc-bits", "8", "--clutter", "room"]
    cli.main([*run, str(tmp_path / "first"), *options, "--interference", "2", "6", "1.5", "--seed", "4"])
    cli.main([*run, str(tmp_path / "again"), "--config", str(tmp_path / "first" / "summary.json")])
    scene = json.loads((tmp_path / "first" / "summary.json").read_text())["config"]["scene"]
    assert scene["receiver"]["adc_bits"] == 8
    assert scene["receiver"]["phase_noise_dbc_hz"] == -93.0
    assert scene["clutter"]["reflectors"] == 12
    assert scene["interference"]["position_m"] == [2.0, 6.0, 1.5]
    with np.load(tmp_path / "first" / "maps.npz") as one, np.load(tmp_path / "again" / "maps.npz") as other:
        assert all(np.array_equal(one[key], other[key]) for key in one.files)
