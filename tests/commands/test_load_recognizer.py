"""Which radars get a label: those like the ones that the classifier was trained on."""

import warnings
from dataclasses import replace

import pytest

from tensorsim.commands.options import load_recognizer
from tensorsim.config import InterferenceConfig, SceneConfig, SimulationConfig
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.radar.presets import PRESETS


@pytest.mark.parametrize("scene", ["free-space", "through-wall", "ti-iwr6843"])
def test_radars_like_those_of_training_get_a_label(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_recognizer(SimulationConfig(scene=PRESETS[scene])) is not None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prf_hz": 90.0}, r"no label: the radar sees speeds up to 2\.7 m/s"),
        ({"carrier_hz": 0.5e9}, r"no label: the radar resolves speeds 1\.5 m/s apart"),
    ],
)
def test_others_get_none_and_a_reason(change, message):
    radar = replace(PRESETS["through-wall"].radar, **change)
    with pytest.warns(TensorsimWarning, match=message):
        assert load_recognizer(SimulationConfig(scene=SceneConfig(radar))) is None


def test_a_file_that_is_not_there():
    with pytest.raises(
        TensorsimError, match=r"nofile\.safetensors: no such file, expected the weights of a class"
    ):
        load_recognizer(SimulationConfig(classifier="nofile.safetensors"))


def test_none_is_wanted():
    assert load_recognizer(SimulationConfig(classifier="none")) is None


@pytest.mark.parametrize(
    ("scene", "classifier", "change", "message"),
    [
        ("through-wall", None, {"processing__integration": "paper"}, "integration 'paper' folds"),
        ("through-wall", None, {"scene__interference": InterferenceConfig()}, "another radar interferes"),
        ("cw-24ghz", "spnet-activities", {"scene__receiver__real": True}, "one channel without range folds"),
    ],
)
def test_maps_unlike_those_of_training_get_a_warning(scene, classifier, change, message):
    config = SimulationConfig(scene=PRESETS[scene], classifier=classifier)
    with pytest.warns(TensorsimWarning, match=f"the label is unreliable: .*{message}"):
        assert load_recognizer(config.replace(**change)) is not None


@pytest.mark.parametrize("scene", ["through-wall", "cw-24ghz"])
def test_one_channel_is_what_the_shipped_classifier_knows(scene):
    config = SimulationConfig(scene=PRESETS[scene]).replace(scene__receiver__real=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_recognizer(config) is not None
